"""Noise of a velocity log that is constant, and that grows with speed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from monte_carlo import RUNS, nees_of
from scipy.stats import chi2
from truth import CONFIGS

from factorgraph_dvl.files.calibration_file import encode_calibration, load_calibration
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.replay.start import solve_start
from factorgraph_dvl.sensors.protocol import velocity_sigma
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solvers.batch import solve, solve_with_problem, solved_problems
from factorgraph_dvl.solvers.noise_growth import _factors, growths

# Noise of the DVL, beside 1 mm/s and 0.2 % of the speed as stated.
NOISE = 0.008


def trial_of(seed, std=NOISE):
    """Return a quarter of an hour of the cruise, with more noise that is constant."""
    plan = yaml.safe_load((CONFIGS / "cruise.yaml").read_text(encoding="utf-8"))
    plan["manoeuvres"][2]["repeat"] = 1
    trial = simulate(parse_scenario(plan), seed)
    noise = std * np.random.default_rng(seed + 100).standard_normal(trial.dvl.velocity.shape)
    return replace(trial, dvl=replace(trial.dvl, velocity=trial.dvl.velocity + noise))


def at(solved):
    """Return the minimum, and the information there."""
    return solved.minimum.evaluation, solved.minimum.information


def test_both_parts_of_the_noise_add_up_by_hand():
    """Of 3 mm/s and 0.2 % at 2 m/s: √(3² + 4²) mm/s; doubled parts √(6² + 4²) and √(3² + 8²)."""
    noise, speed = (0.003, 0.002), np.array([[2.0]])
    assert velocity_sigma(noise, speed, 1.0) == pytest.approx(0.005)
    assert velocity_sigma(noise, speed, np.array([2.0, 3.0])).ravel() == pytest.approx(
        [0.010, 0.015]
    )
    parts = np.array([[2.0, 1.0], [1.0, 2.0]])
    expected = np.sqrt([36.0 + 16.0, 9.0 + 64.0]) / 1e3
    assert velocity_sigma(noise, speed, parts).ravel() == pytest.approx(expected)


def test_noise_at_rest_is_as_small_as_any_measured():
    assert velocity_sigma((0.0, 0.002), np.zeros((1, 1)), 1.0) == pytest.approx(1e-4)


def test_noise_as_stated_has_its_parts():
    (solved, *_) = solved_problems(trial_of(0, std=0.0))
    assert solved.problem.noise_growth == {}
    assert list(growths(solved.problem, *at(solved))) == []


def test_a_constant_part_that_is_larger_is_found_and_named(tmp_path):
    solution, solved = solve_with_problem(trial_of(0), rate_hz=1.0)
    (noise,) = [n for n in solution.noise if n.name == "dvl_velocity"]
    assert noise.by_speed.std == pytest.approx(np.hypot(NOISE, 0.001), rel=0.05)
    assert noise.by_speed.fraction == pytest.approx(0.002, rel=0.1)
    (reason,) = solution.verdict.reasons
    assert (reason.code, reason.sensor) == (Code.LARGE_RESIDUALS, "DVL velocity")
    assert f"enter velocity_std_m_s: {noise.by_speed.std:.2g} and" in reason.text

    path = tmp_path / "calibration.json"
    path.write_bytes(encode_calibration(solution))
    assert load_calibration(path).noise[-1].by_speed == noise.by_speed

    problem, evaluation = solved.problem, solved.minimum.evaluation
    (i,) = (i for i, o in enumerate(problem.observations) if o.label == "DVL velocity")
    growth = problem.noise_growth
    assert growth["DVL velocity"][0] > 2.0 > 1.0 > growth["DVL velocity"][1]
    # It is found once, and is one on average.
    assert list(growths(problem, *at(solved))) == []
    now = problem.sigma(evaluation)[i]
    problem.noise_growth = {}
    ratio = now / problem.sigma(evaluation)[i]
    assert np.mean(ratio[np.isfinite(ratio)] ** 2) == pytest.approx(1.0, abs=0.02)


def test_squares_that_fitting_took_are_no_less_noise():
    """Half of 4000 at rest, of whose squares a trajectory takes nine tenths; then 4 mm/s for 2."""
    rng = np.random.default_rng(0)
    fast = np.arange(4000) % 2
    share = np.stack([1.0 - 0.9 * fast, 0.9 * fast, 0.0 * fast])
    freedom = np.where(fast, 0.9, 0.1)
    squares = freedom * rng.standard_normal(4000) ** 2
    found, gain = _factors(share, squares, freedom, np.zeros(2), -9.0)
    assert gain < np.log(4000)
    assert found == pytest.approx([1.0, 1.0], abs=0.15)
    more = np.where(fast, share[0] * 3.0 + 1.0, 4.0)
    found, gain = _factors(share, more * squares, freedom, np.zeros(2), -9.0)
    assert gain > np.log(4000)
    assert found == pytest.approx([4.0, 1.0], rel=0.15)


def test_a_part_is_no_smaller_than_what_a_record_shows():
    fast = np.arange(1000) % 2
    share = np.stack([1.0 - 0.9 * fast, 0.9 * fast, 0.0 * fast])
    found, _ = _factors(share, 1.0 * fast, np.ones(1000), np.zeros(2), 2.0 * np.log(0.1))
    assert np.sqrt(found[0]) == pytest.approx(0.1)


def test_a_replay_weighs_both_parts():
    """It starts with what the first minutes say of both."""
    trial = trial_of(0).until(300.0)
    start = solve_start(trial, None, 1.0, 0.0, lambda *_: None, 0.0)
    factors = start.noise_factors["DVL velocity"]
    assert factors.shape == (2, 3)
    constant = 0.001 * factors[0]
    assert constant == pytest.approx(np.full(3, np.hypot(NOISE, 0.001)), rel=0.15)
    assert 0.002 * factors[1] == pytest.approx(np.full(3, 0.002), rel=0.5)


@pytest.mark.slow
def test_standard_deviations_hold():
    squares = []
    for seed in range(RUNS):
        trial = trial_of(seed)
        solution = solve(trial, rate_hz=1.0)
        assert solution.verdict.grade == "doubtful"
        squares.append(nees_of(solution, trial))
    low, high = chi2.ppf([0.005, 0.995], 7 * RUNS)
    assert low < sum(squares) < high, np.round(np.array(squares) / 7, 2)
