"""Planar trials: smoother, hypotheses, echoes, files, filters, command line."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from builders import edit
from planar import _BASE, trial
from truth import CONFIGS, merged

from factorgraph_dvl.baselines.single_beacon import filter_planar
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import ConfigError, DataError, FactorgraphDvlError, SolveError
from factorgraph_dvl.geometry.vectors import interpolate
from factorgraph_dvl.io.planar_folder import is_planar, load_planar_trial, save_planar_trial
from factorgraph_dvl.io.solution_folder import load_solution
from factorgraph_dvl.io.trial_folder import load_trial
from factorgraph_dvl.quality.plausibility_planar import planar_findings
from factorgraph_dvl.quality.survey_planar import survey_planar
from factorgraph_dvl.ranging.elimination import System
from factorgraph_dvl.ranging.hypothesis_weights import hypothesis_costs, significant_costs
from factorgraph_dvl.ranging.marginal_posterior import grid_points, posterior_weights
from factorgraph_dvl.ranging.model import GATE, evaluate, step_errors, terms
from factorgraph_dvl.ranging.planar_solution import solve_planar
from factorgraph_dvl.ranging.planar_track import velocity_change_psd
from factorgraph_dvl.ranging.problem import dead_reckoned, planar_setup
from factorgraph_dvl.ranging.smoother import covariance, fit
from factorgraph_dvl.simulation import parse_scenario, simulate, simulate_planar
from factorgraph_dvl.solution import Residuals, contradictions, mostly_rejected
from factorgraph_dvl.trial import InitialPosition

SEEDS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "20"))
ALL_CONSTANTS = {
    "heading": {"bias_deg": 1.0, "bias_std_deg": 2.0},
    "log": {"scale_error": 0.02, "scale_error_std": 0.03},
    "beacons": {
        "positions": {
            "B1": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": -80},
            "B2": {"lat_deg": 25.004, "lon_deg": 135.004, "height_m": -90, "std_m": 2},
        },
        "sound_speed_error": 0.003,
        "sound_speed_error_std": 0.004,
        "lever_arm_m": [0.5, 2.0, -1.0],
    },
}
STRAIGHT = {"manoeuvres": [{"straight_s": 300}]}


def truth(t, time):
    r = t.reference
    return t.frame().position(*interpolate(time, r.time, r.geodetic).T)[:, :2]


def true_state(t, problem):
    p = truth(t, problem.time)
    parts = [t.calibration_truth[c.name] * c.si for c in problem.constants]
    return np.column_stack([p, np.zeros_like(p)]), np.concatenate(parts)


def error_of(t, solution):
    track = solution.trajectory
    return t.frame().position(*track.geodetic.T)[:, :2] - truth(t, track.time)


@pytest.mark.parametrize("constant", ["heading", "beacons"])
def test_zero_error_at_the_truth(constant):
    # The lever arm lies along the heading as it is measured, so not both at once.
    others = {name: ALL_CONSTANTS[name] for name in ("log", constant)}
    t = trial(noise=False, **others)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    at = evaluate(problem, x, theta)
    error, _ = step_errors(problem, x, theta)
    r = problem.ranging
    # The turn is abrupt: where it begins and ends, halfway between samples, the trapezoid
    # misses by centimetres; the reference is interpolated as well.
    assert np.abs(at.range_residual * r.range_std).max() < 2e-3
    assert np.median(np.abs(at.rate_residual * r.rate_std)) < 1e-4
    assert np.median(np.abs(error)) < 1e-3
    assert np.abs(error).max() < 0.05


def test_jacobians_against_differences():
    t = trial(**ALL_CONSTANTS)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    n = 20
    rng = np.random.default_rng(1)
    x = x[:n] + rng.normal(0.0, [3.0, 3.0, 0.05, 0.05], (n, 4))
    theta = theta + 0.5 * problem.prior_sigma * rng.normal(size=theta.size)
    at = evaluate(problem, x, theta)
    node = problem.ranging.node[: at.range_residual.size]
    for i in range(4):
        h = np.zeros(4)
        h[i] = 1e-4
        a, b = (evaluate(problem, x + s * h, theta) for s in (1, -1))
        for name, by in (("range_residual", at.range_x), ("rate_residual", at.rate_x)):
            found = (getattr(a, name) - getattr(b, name)) / 2e-4
            np.testing.assert_allclose(by[:, i], found, atol=2e-5)
    for i in range(theta.size):
        h = np.zeros(theta.size)
        h[i] = 1e-4 * problem.prior_sigma[i]
        a, b = (evaluate(problem, x, theta + s * h) for s in (1, -1))
        for name, by in (("range_residual", at.range_theta), ("rate_residual", at.rate_theta)):
            found = (getattr(a, name) - getattr(b, name)) / (2 * h[i])
            np.testing.assert_allclose(by[:, i], found, atol=2e-6 * max(1, np.abs(found).max()))
        c, d = (step_errors(problem, x, theta + s * h)[0] for s in (1, -1))
        _, through = step_errors(problem, x, theta)
        by = -problem.by_constants(through, theta, np.diff(problem.time[:n]))[:, :, i]
        found = (c - d) / (2 * h[i])
        np.testing.assert_allclose(by, found, atol=2e-6 * max(1, np.abs(found).max()))
    assert node.size >= n - 1


def test_the_gradient_is_that_of_the_cost():
    t = trial(**ALL_CONSTANTS)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    # Over the beginning of the turn too, where the velocity changes.
    n = 160
    rng = np.random.default_rng(4)
    x = x[:n] + rng.normal(0.0, [0.3, 0.3, 0.02, 0.02], (n, 4))
    at = evaluate(problem, x, theta)
    used = tuple((np.abs(r) <= GATE).astype(float) for r in (at.range_residual, at.rate_gate))
    assert sum(u.sum() for u in used) > 2 * n - 10
    system = System(problem, x, theta, at, used, 0.0)

    def cost(x, theta):
        return terms(problem, x, theta, evaluate(problem, x, theta)).sum()

    for node in (0, 7, 150, n - 1):
        for i in range(4):
            h = np.zeros_like(x)
            h[node, i] = 1e-5
            found = (cost(x + h, theta) - cost(x - h, theta)) / 2e-5
            assert system._g[4 * node + i] == pytest.approx(found, rel=2e-4, abs=0.05)


def test_a_vehicle_is_as_smooth_as_it_is_seen_to_be():
    quiet, turning = trial(**STRAIGHT), trial()
    psd = velocity_change_psd(dead_reckoned(quiet))
    root = np.sqrt(np.trace(psd, axis1=1, axis2=2))
    # Within half a minute no more than a few of the centimetres per second of the mean's noise.
    assert np.median(root[40:-40]) * np.sqrt(30.0) < 0.03
    track = dead_reckoned(turning)
    at = np.argmin(np.abs(track.time - 157.0))
    # 2 m/s turning by 2 degrees in a second: no less in any direction.
    assert np.linalg.eigvalsh(velocity_change_psd(track)[at]).min() > (2.0 * np.radians(2.0)) ** 2
    # A line of slope a, by hand: W a²; the trapezoid makes its slope larger by 2 (1 s / W)².
    line = replace(
        track,
        velocity=np.outer(track.time, [0.003, -0.004]),
        velocity_cov=np.zeros_like(track.velocity_cov),
    )
    by_hand = 60.0 * (0.005 * (1.0 + 2.0 / 60.0**2)) ** 2
    np.testing.assert_allclose(velocity_change_psd(line)[at], by_hand * np.eye(2), rtol=1e-6)


def test_a_straight_run_tells_no_more_of_the_current_than_its_prior():
    t = trial(1, **STRAIGHT)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    best = fit(problem, x, theta, iterations=100)
    grid = grid_points(problem, best)
    assert len(grid) > 5
    share = posterior_weights(grid)
    first = np.array([s.fit.p[0] for s in grid])
    beacon = problem.place[0, :2]
    # All on an arc about the beacon: its range is known, the bearing is not.
    radius = np.hypot(*(first - beacon).T)
    assert np.ptp(radius) < 0.05 * radius.mean()
    spread = np.sqrt(np.sum(share[:, None] * (first - share @ first) ** 2))
    # The ground velocity is known in size alone; across it the current has its prior, 0.3 m/s.
    moved = np.linalg.norm(x[-1, :2] - x[0, :2]) / (problem.time[-1] - problem.time[0])
    assert spread == pytest.approx(radius.mean() * 0.3 / moved, rel=0.3)


def test_what_counts_as_evidence():
    rng = np.random.default_rng(0)
    base = 0.5 * rng.normal(size=1000) ** 2
    walk = [significant_costs([base, base + rng.normal(0.0, 0.5, 1000)])[1] for _ in range(200)]
    # Sums of 16 by chance are not believed.
    assert np.mean(np.abs(walk) < 3.0) > 0.95
    turn = base.copy()
    turn[:5] += 8.0
    np.testing.assert_allclose(significant_costs([base, turn]), [0.0, 40.0])
    # A current that ten standard deviations of its prior speak against, and nothing else does.
    t = trial(1, **STRAIGHT)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    good = fit(problem, x, theta)
    bad = replace(good, theta=good.theta + 3.0)
    assert hypothesis_costs(problem, [good, bad])[1] > 50.0


def test_covariance_against_a_dense_inverse():
    t = trial(**ALL_CONSTANTS)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    solution = fit(problem, x[:30], theta)
    states, cross, constants = covariance(problem, solution)
    at = evaluate(problem, solution.x, solution.theta)
    weights = (solution.range_used, solution.rate_used)
    system = System(problem, solution.x, solution.theta, at, weights, 0.0)
    n, c = 30, theta.size
    dense = np.zeros((4 * n + c, 4 * n + c))
    for k in range(n):
        a = slice(4 * k, 4 * k + 4)
        dense[a, a] = system._diagonal[k]
        if k:
            b = slice(4 * k - 4, 4 * k)
            dense[b, a], dense[a, b] = system._off[k - 1], system._off[k - 1].T
    dense[: 4 * n, 4 * n :] = system._border
    dense[4 * n :, : 4 * n] = system._border.T
    dense[4 * n :, 4 * n :] = system._schur + system._border.T @ system._influence
    P = np.linalg.inv(dense)
    scale = np.sqrt(np.diag(P))
    for k in range(n):
        a = slice(4 * k, 4 * k + 4)
        np.testing.assert_allclose(states[k] / np.outer(scale[a], scale[a]),
                                   P[a, a] / np.outer(scale[a], scale[a]), atol=1e-5)  # fmt: skip
        np.testing.assert_allclose(cross[k] / np.outer(scale[a], scale[4 * n :]),
                                   P[a, 4 * n :] / np.outer(scale[a], scale[4 * n :]),
                                   atol=1e-5)  # fmt: skip
    last, _, _ = covariance(problem, solution, last_only=True)
    np.testing.assert_allclose(last[0], states[-1], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(constants, P[4 * n :, 4 * n :], rtol=1e-4, atol=1e-12)


def test_a_straight_run_leaves_both_mirror_images_and_admits_to_it():
    t = trial(1, **STRAIGHT)
    solution = solve_planar(t, rate_hz=1.0)
    living = [h for h in solution.hypotheses if h.died is None]
    assert len(living) == 2
    assert sum(h.weight for h in living) == pytest.approx(1.0)
    assert living[1].weight > 0.02
    assert any("ambiguous" in w for w in solution.warnings)
    end = truth(t, np.array([t.reference.time[-1]]))[0]
    ends = [t.frame().position(*h.trajectory.geodetic[-1])[:2] for h in living]
    near = min(ends, key=lambda e: np.hypot(*(e - end)))
    far = max(ends, key=lambda e: np.hypot(*(e - end)))
    assert np.hypot(*(near - end)) < 200.0 < np.hypot(*(far - end))
    # The answer says that it may be the other one.
    assert np.hypot(*solution.trajectory.position_std[-1, :2]) > 0.1 * np.hypot(*(far - near))
    own = living[0].trajectory.position_std[-1, :2]
    assert np.hypot(*own) < np.hypot(*solution.trajectory.position_std[-1, :2])


def test_after_a_turn_by_30_degrees_the_wrong_one_is_dead():
    t = trial(3)
    solution = solve_planar(t, rate_hz=1.0)
    first, second = solution.hypotheses[:2]
    assert first.died is None
    assert 150.0 < second.died < 175.0
    assert not any("ambiguous" in w for w in solution.warnings)
    assert np.hypot(*error_of(t, solution).T).max() < 15.0


def test_ranges_without_rates_are_enough():
    t = trial(2, beacons={"range_rate_std_m_s": None})
    assert np.isnan(t.beacons.range_rate).all()
    solution = solve_planar(t, rate_hz=1.0)
    assert len([h for h in solution.hypotheses if h.died is None]) in (0, 1)
    assert np.hypot(*error_of(t, solution).T).max() < 40.0


def test_echoes_are_named_and_lost_ranges_do_no_harm():
    clean, echoes = trial(4), trial(4, beacons={"multipath": 0.2, "missed": 0.1})
    solution = solve_planar(echoes, rate_hz=1.0)
    longer = echoes.beacons.range - clean.beacons.range > 1.0
    rejected = np.concatenate([r.time for r in solution.rejected if r.unit == "m"])
    assert longer.sum() > 40
    assert np.isin(echoes.beacons.time[longer], rejected).all()
    assert rejected.size <= longer.sum() + 2
    best = solve_planar(clean, rate_hz=1.0)
    rms = [np.sqrt(np.mean(error_of(a, b) ** 2)) for a, b in ((clean, best), (echoes, solution))]
    assert rms[1] < max(1.3 * rms[0], 3.0)


def test_a_range_at_the_very_end_but_for_rounding_is_no_step_of_its_own():
    t = trial(**STRAIGHT)
    b = t.beacons
    ends = np.append(b.time[:-1], t.heading.time[-1] - 1e-12)
    setup = planar_setup(replace(t, beacons=replace(b, time=ends)))
    assert np.diff(setup.problem.time).min() > 0.5
    assert solve_planar(replace(t, beacons=replace(b, time=ends)), rate_hz=1.0).converged


def test_a_depth_that_is_noisier_than_the_ranges_counts_as_it_does():
    deep = {"positions": {"B1": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": -400}}}
    t = trial(0, depth={"rate_hz": 1, "std_m": 3.0}, beacons={**deep, "range_std_m": 0.3})
    solution = solve_planar(t, rate_hz=0.2)
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
        solve_planar(replace(t, beacons=cut))


def test_the_filters_start_from_a_position_only():
    with pytest.raises(DataError, match=r"initial\.position"):
        filter_planar(trial(), "4sv-3ob")
    start = {"initial": {"position_std_m": [5, 5, 1]}}
    t = trial(5, trial=start)
    for method in ("4sv-2ob", "4sv-3ob"):
        solution, history = filter_planar(t, method)
        error = error_of(t, solution)
        assert np.hypot(*error[-1]) < 20.0
        assert history.names == ("current_e_m_s", "current_n_m_s")
        assert np.all(np.diff(history.std[:, 0]) < 1e-3)


def test_the_filters_pass_over_missing_headings_and_depths():
    t = trial(5, trial={"initial": {"position_std_m": [5, 5, 1]}})
    heading, depth = t.heading.heading.copy(), t.depth.depth.copy()
    heading[5:8] = depth[5:8] = np.nan
    lost = replace(
        t, heading=replace(t.heading, heading=heading), depth=replace(t.depth, depth=depth)
    )
    motions = [filter_planar(x, "4sv-3ob")[0].trajectory for x in (t, lost)]
    for name in ("rph", "geodetic", "velocity"):
        np.testing.assert_allclose(*(getattr(m, name) for m in motions), atol=0.5)


def test_files_and_commands(tmp_path, capsys):
    t = trial(6, beacons={"missed": 0.1}, trial={"initial": {"position_std_m": [5, 5, 1]}})
    save_planar_trial(t, tmp_path / "t")
    assert is_planar(tmp_path / "t")
    loaded = load_planar_trial(tmp_path / "t")
    np.testing.assert_array_equal(loaded.log.speed, t.log.speed)
    np.testing.assert_array_equal(loaded.beacons.range, t.beacons.range)
    np.testing.assert_allclose(loaded.heading.heading, t.heading.heading, rtol=1e-15)
    with pytest.raises(ConfigError, match="planar trial"):
        load_trial(tmp_path / "t")

    def run(*args):
        with pytest.raises(SystemExit) as exit_info:
            main([*map(str, args), "--quiet"])
        capsys.readouterr()
        return exit_info.value.code

    assert run("solve", tmp_path / "t", "--out", tmp_path / "s", "--no-figures") == 0
    solution = load_solution(tmp_path / "s")
    assert solution.solver == "planar"
    assert np.hypot(*error_of(t, solution).T).max() < 30.0
    assert run("kalman", tmp_path / "t", "--out", tmp_path / "k", "--no-figures") == 0
    assert load_solution(tmp_path / "k").solver == "kalman-4sv-3ob"
    assert (tmp_path / "k" / "history.csv").exists()
    wrong = ("kalman", tmp_path / "t", "--out", tmp_path / "w", "--method", "wahba")
    assert run(*wrong) == 2


def test_more_than_a_third_of_echoes_is_doubtful():
    def some(n):
        return (
            Residuals("Beacon B1 range", "m", ("range",), *np.ones((1, n)), *np.ones((2, n, 1))),
        )

    assert not mostly_rejected(some(80), some(20))
    assert "40 of 100 were rejected" in mostly_rejected(some(60), some(40))[0]


def without(record, first, last):
    """Return the record of heading or log without what lies between two times."""
    kept = (record.time <= first) | (record.time >= last)
    name = "heading" if record.label == "Heading" else "speed"
    out = {"time": record.time[kept], name: getattr(record, name)[kept]}
    if name == "speed":
        out["starboard"] = record.starboard[kept]
    return replace(record, **out)


def test_implausible_records_are_named():
    t = trial()
    assert not list(planar_findings(t))
    place = {"B1": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": 80}}
    above = simulate_planar(parse_scenario(merged(_BASE, {"beacons": {"positions": place}})), 0)
    for wrong, label, says in (
        (replace(t, heading=without(t.heading, 140, 180)), "Heading", "1 gap from 140 to 180 s"),
        (replace(t, log=without(t.log, 20, 50)), "Log", "1 gap from 20 to 50 s"),
        (
            replace(t, heading=replace(t.heading, heading=t.heading.heading * np.pi / 180)),
            "Heading",
            "radians",
        ),
        (replace(t, log=replace(t.log, speed=-t.log.speed)), "Log", "astern"),
        (replace(t, log=replace(t.log, speed=0.0 * t.log.speed)), "Log", "a circle"),
        (replace(t, depth=replace(t.depth, depth=-t.depth.depth)), "Depth", "positive down"),
        (above, "Beacon", "B1 is 80 m above the sea surface"),
    ):
        ((found, text),) = planar_findings(wrong)
        assert found == label
        assert says in text


def test_a_gap_is_no_secret():
    t = trial()
    ((label, text),) = planar_findings(replace(t, heading=without(t.heading, 140, 180)))
    assert label == "Heading"
    assert text.startswith("1 gap from 140 to 180 s")


def test_clocks_that_do_not_fit_are_refused():
    t = trial()
    late = replace(t, beacons=replace(t.beacons, time=t.beacons.time + 1e5))
    with pytest.raises(DataError, match=r"1 to 315 s: they are from 100001 to 100315 s"):
        planar_setup(late)
    with pytest.raises(DataError, match=r"one value every 1000 s; expected .* 60 s apart"):
        planar_setup(replace(t, heading=replace(t.heading, time=1e3 * t.heading.time)))
    nothing = np.full(t.beacons.time.size, np.nan)
    empty = replace(t, beacons=replace(t.beacons, range=nothing, range_rate=nothing))
    with pytest.raises(DataError, match="no range and no range rate"):
        planar_setup(empty)
    with pytest.raises(SolveError, match="0 ranges are too few"):
        solve_planar(replace(t, beacons=replace(t.beacons, range=nothing)))


def test_inspect_knows_planar_trials(tmp_path, capsys):
    t = trial()
    save_planar_trial(replace(t, heading=without(t.heading, 140, 180)), tmp_path / "t")
    with pytest.raises(SystemExit) as exit_info:
        main(["inspect", str(tmp_path / "t")])
    out = capsys.readouterr().out
    assert exit_info.value.code == 0
    for text in ("Heading", "Log", "Depth", "Beacon", "speed 1.", "warning: Heading: 1 gap"):
        assert text in out
    late = replace(t, beacons=replace(t.beacons, time=t.beacons.time + 1e5))
    (finding,) = survey_planar(late).problems
    assert finding.severity == "error"
    assert "do not overlap" in finding.text


def test_hypotheses_are_written(tmp_path, capsys):
    save_planar_trial(trial(7, **STRAIGHT), tmp_path / "t")
    with pytest.raises(SystemExit) as exit_info:
        main(["solve", str(tmp_path / "t"), "--out", str(tmp_path / "s")])
    assert exit_info.value.code == 0
    captured = capsys.readouterr()
    assert "Hypotheses" in captured.out
    assert "ambiguous" in captured.err
    items = json.loads((tmp_path / "s" / "hypotheses.json").read_text())["hypotheses"]
    assert [i["died_s"] for i in items[:2]] == [None, None]
    assert (tmp_path / "s" / items[1]["trajectory"]).exists()
    assert (tmp_path / "s" / "figures" / "track.png").exists()


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("trial.yaml", "heading: {", "headings: {", "unknown key `headings`"),
        ("trial.yaml", "reference: water", "reference: air", "expected water or bottom"),
        (
            "trial.yaml",
            "sound_speed_error_std: 0.0",
            "sound_speed_error_std: 1500",
            "expected a number <= 0.5",
        ),
        ("log.csv", "speed_m_s", "speed", "missing column speed_m_s"),
        ("heading.csv", "time_s,heading_deg\n0,", "time_s,heading_deg\n0,9", "out of range"),
    ],
)
def test_bad_input_is_named(tmp_path, file, old, new, says):
    save_planar_trial(trial(), tmp_path / "t")
    edit(tmp_path / "t" / file, old, new)
    with pytest.raises(FactorgraphDvlError) as error:
        load_planar_trial(tmp_path / "t")
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"beacons": None}, "missing key `beacons`"),
        ({"heading": None, "log": None}, "missing key `imu`"),
        ({"imu": {"rate_hz": 10}}, "belongs to a planar trial"),
        ({"gnss": {"rate_hz": 1, "position_std_m": [1, 1, 1]}}, "`gnss` needs an imu"),
    ],
)
def test_a_scenario_is_planar_or_has_an_imu(changes, says):
    with pytest.raises(ConfigError, match=says):
        parse_scenario(merged(_BASE, changes))


def test_a_planar_scenario_is_no_other(tmp_path, capsys):
    with pytest.raises(ConfigError, match="there is no imu"):
        simulate(parse_scenario(_BASE))
    with pytest.raises(SystemExit) as exit_info:
        main(["simulate", str(CONFIGS / "one-beacon.yaml"), "--out", str(tmp_path / "t")])
    capsys.readouterr()
    assert exit_info.value.code == 0
    assert load_planar_trial(tmp_path / "t").name == "one-beacon"


@pytest.mark.slow
def test_a_straight_run_is_covered_and_never_decided():
    covered = []
    for seed in range(SEEDS):
        current = np.random.default_rng([seed, 1]).normal(0.0, 0.3, 2)
        t = trial(seed, **STRAIGHT, current_m_s=[*current.tolist(), 0.0])
        solution = solve_planar(t, rate_hz=1.0)
        error = error_of(t, solution)
        covered.append(np.mean(np.abs(error) < 2.0 * solution.trajectory.position_std[:, :2]))
        assert len([h for h in solution.hypotheses if h.died is None]) == 2
    assert np.mean(covered) > 0.95 - 4.0 * np.sqrt(0.05 / SEEDS)


@pytest.mark.slow
def test_the_covariance_is_honest():
    nees, covered, right = [], [], []
    for seed in range(SEEDS):
        t = trial(seed, beacons={"sound_speed_error": "draw", "sound_speed_error_std": 0.001})
        solution = solve_planar(t, rate_hz=1.0)
        error = error_of(t, solution)
        P = solution.trajectory.position_cov[:, :2, :2]
        nees.append(np.einsum("mi,mij,mj->m", error, np.linalg.inv(P), error).mean())
        covered.append(np.mean(np.abs(error) < 2.0 * solution.trajectory.position_std[:, :2]))
        right.append(len([h for h in solution.hypotheses if h.died is None]) <= 1)
    # Along one track errors are hardly independent: as if each seed were one draw of two.
    assert np.mean(nees) == pytest.approx(2.0, abs=4.0 * np.sqrt(4.0 / SEEDS))
    assert np.mean(covered) > 0.95 - 4.0 * np.sqrt(0.05 / SEEDS)
    assert all(right)


def test_a_fit_that_was_cut_short_has_not_converged():
    setup = planar_setup(trial())
    start = true_state(trial(), setup.problem)
    away = start[0] + np.array([30.0, -20.0, 0.0, 0.0])
    assert not fit(setup.problem, away, start[1], iterations=1).converged
    whole = fit(setup.problem, away, start[1])
    assert whole.converged
    again = fit(setup.problem, whole.x, whole.theta, iterations=2)
    assert again.converged
    assert again.cost == pytest.approx(whole.cost, abs=1e-5)


def placed(t, east, north, std):
    """The trial with a start so far from the beacon, m."""
    place = InitialPosition(
        np.array([np.radians(25.0) + north / 6.37e6, np.radians(135.0) + east / 5.79e6, -40.0]),
        np.array([std, std, 1.0]),
    )
    return replace(t, initial_position=place)


def test_a_filter_that_went_to_a_mirror_image_has_not_converged(tmp_path, capsys):
    t = placed(trial(5, **STRAIGHT), 1.0, 1.0, 600.0)
    for method in ("4sv-2ob", "4sv-3ob"):
        solution, _ = filter_planar(t, method)
        assert not solution.converged
        assert any("mirror image" in w for w in solution.warnings)
    save_planar_trial(t, tmp_path / "t")
    with pytest.raises(SystemExit) as exit_info:
        main(["kalman", str(tmp_path / "t"), "--out", str(tmp_path / "k"), "--no-figures"])
    assert exit_info.value.code == 1
    assert "not converged" in capsys.readouterr().err


def test_a_filter_whose_innovations_contradict_it_has_not_converged():
    start = {"initial": {"position_std_m": [5, 5, 1]}}
    assert filter_planar(trial(5, trial=start), "4sv-3ob")[0].converged
    echoes = trial(5, trial=start, beacons={"multipath": 0.2})
    solution, _ = filter_planar(echoes, "4sv-3ob")
    assert not solution.converged
    assert any(w.startswith("Beacon range: over the last half") for w in solution.warnings)


def test_a_few_large_innovations_are_chance():
    def seen(size, sigmas):
        z = np.full((size, 1), sigmas)
        return Residuals(
            "Beacon range", "m", ("range",), np.arange(float(size)), z, np.ones_like(z)
        )

    assert not contradictions([seen(2, 2.5), seen(100, 1.5), seen(100, 0.1), seen(0, 1.0)])
    assert len(contradictions([seen(100, 2.5)])) == 1
