"""Planar trials from end to end: ranges, echoes, depth, files, honesty over seeds."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from planar import BASE, STRAIGHT, changed, error_of, trial

from factorgraph_dvl import kalman, predict, solve, solved_problems
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import ConfigError, DataError, SolveError
from factorgraph_dvl.estimates import Residuals
from factorgraph_dvl.files.solution_folder import load_solution
from factorgraph_dvl.files.trial_folder import load_trial, save_trial
from factorgraph_dvl.quality.results import mostly_rejected
from factorgraph_dvl.simulation import parse_scenario

SEEDS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "20"))


def test_ranges_without_rates_are_enough():
    t = trial(2, beacons={"range_rate_std_m_s": None})
    assert np.isnan(t.beacons.range_rate).all()
    solution = solve(t, rate_hz=1.0)
    assert len([h for h in solution.hypotheses if h.died is None]) in (0, 1)
    assert np.hypot(*error_of(t, solution).T).max() < 40.0


@pytest.mark.slow
def test_echoes_are_named_and_lost_ranges_do_no_harm():
    clean, echoes = trial(4), trial(4, beacons={"multipath": 0.2, "missed": 0.1})
    solution = solve(echoes, rate_hz=1.0)
    longer = echoes.beacons.range - clean.beacons.range > 1.0
    rejected = np.concatenate([r.time for r in solution.rejected if r.unit == "m"])
    assert longer.sum() > 40
    assert np.isin(echoes.beacons.time[longer], rejected).all()
    assert rejected.size <= longer.sum() + 2
    best = solve(clean, rate_hz=1.0)
    rms = [np.sqrt(np.mean(error_of(a, b) ** 2)) for a, b in ((clean, best), (echoes, solution))]
    assert rms[1] < max(1.3 * rms[0], 3.0)


@pytest.mark.slow
def test_a_depth_that_is_noisier_than_the_ranges_counts_as_it_does():
    deep = {"positions": {"B1": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": -400}}}
    t = trial(0, depth={"rate_hz": 1, "std_m": 3.0}, beacons={**deep, "range_std_m": 0.3})
    solution = solve(t, rate_hz=0.2)
    assert sum(r.time.size for r in solution.rejected) < 10
    normalised = error_of(t, solution) / solution.trajectory.position_std[:, :2]
    assert np.abs(normalised).max() < 4.0


def test_too_few_ranges_are_no_position():
    t = trial()
    few = np.arange(t.beacons.time.size) < 4
    cut = replace(
        t.beacons,
        time=t.beacons.time[few],
        name=t.beacons.name[few],
        range=t.beacons.range[few],
        range_rate=t.beacons.range_rate[few],
    )
    with pytest.raises(SolveError, match="4 ranges are too few"):
        solve(changed(t, cut))


def test_files_and_commands(tmp_path, capsys):
    t = trial(6, beacons={"missed": 0.1}, trial={"initial": {"position_std_m": [5, 5, 1]}})
    save_trial(t, tmp_path / "t")
    loaded = load_trial(tmp_path / "t")
    assert loaded.planar
    (heading, log, *_), (as_loaded, as_logged, *_) = t.records, loaded.records
    np.testing.assert_array_equal(as_logged.speed, log.speed)
    np.testing.assert_array_equal(loaded.beacons.range, t.beacons.range)
    np.testing.assert_allclose(as_loaded.heading, heading.heading, rtol=1e-15)

    def run(*args):
        with pytest.raises(SystemExit) as exit_info:
            main([*map(str, args), "--quiet"])
        capsys.readouterr()
        return exit_info.value.code

    assert run("solve", tmp_path / "t", "--out", tmp_path / "s", "--no-figures") == 0
    solution = load_solution(tmp_path / "s")
    assert solution.solver == "batch"
    assert np.hypot(*error_of(t, solution).T).max() < 30.0
    assert run("kalman", tmp_path / "t", "--out", tmp_path / "k", "--no-figures") == 0
    assert load_solution(tmp_path / "k").solver == "kalman-4sv-3ob"
    assert (tmp_path / "k" / "history.csv").exists()
    wrong = ("kalman", tmp_path / "t", "--out", tmp_path / "w", "--method", "wahba")
    assert run(*wrong) == 2


def test_one_call_solves_any_trial():
    t = trial(2, trial={"initial": {"position_std_m": [5, 5, 1]}})
    solution = solve(t, rate_hz=1.0)
    np.testing.assert_array_equal(solution.covariance, solve(t, rate_hz=1.0).covariance)
    solved, *_ = solved_problems(t)
    assert solved.minimum.evaluation.cost == pytest.approx(solution.cost, rel=1e-9)
    assert kalman(t).solver == "kalman-4sv-3ob"
    with pytest.raises(DataError, match="no DVL"):
        kalman(t, "wahba")
    with pytest.raises(ConfigError, match="planar"):
        predict(parse_scenario(BASE))


def test_more_than_a_third_of_echoes_is_doubtful():
    def some(n):
        return (
            Residuals("Beacon B1 range", "m", ("range",), *np.ones((1, n)), *np.ones((2, n, 1))),
        )

    assert not mostly_rejected(some(80), some(20))
    assert "40 of 100 were rejected" in mostly_rejected(some(60), some(40))[0].text


@pytest.mark.slow
def test_hypotheses_are_written(tmp_path, capsys):
    save_trial(trial(7, **STRAIGHT), tmp_path / "t")
    with pytest.raises(SystemExit) as exit_info:
        main(["solve", str(tmp_path / "t"), "--out", str(tmp_path / "s")])
    assert exit_info.value.code == 0
    captured = capsys.readouterr()
    assert "Hypotheses" in captured.out
    assert "ambiguous" in captured.out
    items = json.loads((tmp_path / "s" / "hypotheses.json").read_text())["hypotheses"]
    assert [i["died_s"] for i in items[:2]] == [None, None]
    assert (tmp_path / "s" / items[1]["trajectory"]).exists()
    assert (tmp_path / "s" / "figures" / "track.png").exists()


@pytest.mark.slow
def test_a_straight_run_is_covered_and_never_decided():
    covered = []
    for seed in range(SEEDS):
        current = np.random.default_rng([seed, 1]).normal(0.0, 0.3, 2)
        t = trial(seed, **STRAIGHT, current_m_s=[*current.tolist(), 0.0])
        solution = solve(t, rate_hz=1.0)
        error = error_of(t, solution)
        covered.append(np.mean(np.abs(error) < 2.0 * solution.trajectory.position_std[:, :2]))
        assert len([h for h in solution.hypotheses if h.died is None]) == 2
    assert np.mean(covered) > 0.95 - 4.0 * np.sqrt(0.05 / SEEDS)


@pytest.mark.slow
def test_the_covariance_is_honest():
    nees, covered, right = [], [], []
    for seed in range(SEEDS):
        t = trial(seed, beacons={"sound_speed_error": "draw", "sound_speed_error_std": 0.001})
        solution = solve(t, rate_hz=1.0)
        error = error_of(t, solution)
        P = solution.trajectory.position_cov[:, :2, :2]
        nees.append(np.einsum("mi,mij,mj->m", error, np.linalg.inv(P), error).mean())
        covered.append(np.mean(np.abs(error) < 2.0 * solution.trajectory.position_std[:, :2]))
        right.append(len([h for h in solution.hypotheses if h.died is None]) <= 1)
    # Along one track errors are hardly independent: as if each seed were one draw of two.
    assert np.mean(nees) == pytest.approx(2.0, abs=4.0 * np.sqrt(4.0 / SEEDS))
    assert np.mean(covered) > 0.95 - 4.0 * np.sqrt(0.05 / SEEDS)
    assert all(right)
