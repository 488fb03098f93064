"""Errors that are not estimated: what they change, and what they add to standard deviations."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
import yaml
from monte_carlo import RUNS
from scipy.stats import chi2
from truth import CONFIGS, TURNING, scenario

from factorgraph_dvl.analysis.error_statistics import calibration_errors, trajectory_errors
from factorgraph_dvl.geometry.units import ARCSEC
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solvers.batch import solve, solved_problems
from factorgraph_dvl.solvers.considered_errors import considered_errors, likely_square
from factorgraph_dvl.solvers.correlated_noise import unseen_offsets
from factorgraph_dvl.solvers.levenberg_marquardt import minimise
from factorgraph_dvl.solvers.posterior import of_states

CAUSE = "deflection of the vertical"


def turning(simulated, stated):
    """Return a short trial at navigation grade."""
    imu = {"rate_hz": 50, "gravity_deflection_std_arcsec": simulated}
    scene = scenario(noise=True, manoeuvres=TURNING[:3], imu=imu)
    claims = scene.trial.imu | {"gravity_deflection_std_arcsec": stated}
    trial = msgspec.structs.replace(scene.trial, imu=claims)
    return simulate(msgspec.structs.replace(scene, trial=trial), 0)


def test_a_deflection_tilts_the_attitude_and_its_standard_deviation_says_so():
    straight, tilted = (solve(turning(real, 10.0)) for real in (0.0, 10.0))
    without = solve(turning(0.0, 0.0))
    # The estimate is that without it.
    np.testing.assert_array_equal(straight.trajectory.rph, without.trajectory.rph)
    change = (tilted.trajectory.rph - straight.trajectory.rph)[:, :2] / ARCSEC
    assert np.hypot(*change.T).mean() > 3.0
    added = np.linalg.eigvalsh(straight.trajectory.rph_cov - without.trajectory.rph_cov)
    assert np.all(added > -1e-15)
    added = straight.trajectory.rph_cov[:, :2, :2] - without.trajectory.rph_cov[:, :2, :2]
    np.testing.assert_allclose(np.trace(added, axis1=1, axis2=2) / ARCSEC**2, 200.0, rtol=0.02)
    normalised = np.einsum("mi,mij,mj->m", change, np.linalg.inv(added / ARCSEC**2), change)
    assert normalised.max() < chi2.ppf(0.999, 2)
    moved = [np.concatenate([e.value for e in s.estimates]) for s in (straight, tilted)]
    (cause,) = (c for c in straight.error_budget if c.cause == CAUSE)
    assert cause.assumed == "10″"
    # A minimum is one within a twentieth of the standard deviation.
    sigma = np.sqrt(np.diag(straight.covariance))
    assert np.all(np.abs(moved[1] - moved[0]) <= 3.0 * cause.adds + 0.05 * sigma)
    total = np.sum([c.adds**2 for c in straight.error_budget], axis=0)
    np.testing.assert_allclose(total, np.diag(straight.covariance), rtol=1e-3)


@pytest.mark.slow
def test_attitudes_at_navigation_grade_hold_their_standard_deviations():
    plan = yaml.safe_load((CONFIGS / "data-sheet-mix-navigation.yaml").read_text(encoding="utf-8"))
    # The reference is at times of the IMU's clock.
    plan["imu"] |= {"gravity_deflection_std_arcsec": 10, "time_offset_s": 0}
    nees, of_mount = [], []
    for seed in range(RUNS):
        trial = simulate(parse_scenario(plan), seed)
        found = solve(trial)
        # An attitude's error hardly changes along a trial.
        nees.append(trajectory_errors(found, trial.reference).attitude.nees.mean())
        errors = calibration_errors(found, trial.calibration_truth)
        own = [i for i, n in enumerate(errors.names) if n.startswith(("misal", "scale", "lever"))]
        P, away = errors.covariance[np.ix_(own, own)], errors.error[own]
        of_mount.append(float(away @ np.linalg.solve(P, away)))
        assert found.verdict.grade == "good"
    for values, freedom in ((nees, 3), (of_mount, 7)):
        low, high = chi2.ppf([0.005, 0.995], freedom * RUNS)
        assert low < sum(values) < high, np.round(np.array(values) / freedom, 2)


def test_what_residuals_do_not_show_of_positions_moves_the_trajectory_and_nothing_else():
    found = solved_problems(turning(0.0, 0.0))[0]
    problem, evaluation = found.problem, found.minimum.evaluation
    problem.processes = ()
    problem.noise_factors = {"GNSS position": np.array([0.6, 0.6, 1.0])}
    problem.weigh(evaluation)
    minimum = minimise(problem, evaluation.values, stage="as weighed", weighed=True)
    error, *_ = considered_errors(problem, minimum)
    assert error.cause == "slow errors of GNSS position"
    change = of_states(problem.chain, error.changes)
    moved = minimum.evaluation.states.nRb @ change[:, 3:6]
    # As far as the fixes: 0.8 of what is stated of each.
    expected = np.array([[0.4, 0.0], [0.0, 0.4], [0.0, 0.0]])
    np.testing.assert_allclose(moved @ moved.transpose(0, 2, 1), np.broadcast_to(
        expected @ expected.T, (len(moved), 3, 3)), atol=1e-3)  # fmt: skip
    assert np.abs(change[:, :3]).max() < 1e-6
    assert np.abs(change[:, 6:]).max() < 1e-4
    sigma = np.sqrt(np.diag(found.covariances.parameters))
    moved = np.concatenate([error.changes[problem.key(p.name)] for p in problem.parameters])
    in_priors = np.linalg.solve(problem.prior_root, moved)
    assert np.all(np.abs(in_priors) < 0.05 * sigma[:, None])
    # Noise that is as stated, and noise that is found to persist, leave nothing.
    problem.noise_factors = {"GNSS position": np.ones(3)}
    assert not unseen_offsets(problem)


@pytest.mark.slow
@pytest.mark.parametrize(
    "tau",
    [
        pytest.param(15.0, marks=pytest.mark.study),
        100.0,
        pytest.param(600.0, marks=pytest.mark.study),
    ],
)
def test_positions_hold_their_standard_deviations_under_slow_errors(tau):
    plan = yaml.safe_load((CONFIGS / "data-sheet-mix-tactical.yaml").read_text(encoding="utf-8"))
    plan["imu"]["time_offset_s"] = 0
    plan["gnss"] |= {"position_std_m": [0.02, 0.02, 0.04], "correlation_time_s": tau}
    nees, squares, inside = [], [], []
    # An error that lasts is one draw in a trial.
    for seed in range(max(RUNS, 4)):
        trial = simulate(parse_scenario(plan), seed)
        position = trajectory_errors(solve(trial, rate_hz=1.0), trial.reference).position
        nees.append(position.nees.mean() / 3.0)
        squares.append(np.mean(position.normalised**2, axis=0))
        inside.append(np.mean(np.abs(position.normalised) < 2.0, axis=0))
    assert np.mean(nees) < 2.0, np.round(nees, 2)
    assert np.mean(inside, axis=0).min() > 0.9, np.round(inside, 2)
    assert np.sqrt(np.mean(squares)) > 0.6, np.round(squares, 2)


@pytest.mark.slow
def test_what_may_be_averaged_is_considered_until_it_is_stated():
    """The change is that of a window whose length is known, from the same minimum."""
    plan = yaml.safe_load((CONFIGS / "seed-a-phase-90.yaml").read_text(encoding="utf-8"))
    for axis in ("roll", "pitch"):
        plan["sway"][axis][0]["frequency_hz"] = 0.3
    found = solved_problems(simulate(parse_scenario(plan), 1))[0]
    (error,) = (e for e in found.covariances.errors if e.cause == "averaging of DVL velocity")
    longest = float(error.assumed.removeprefix("up to ").removesuffix(" s"))
    assert 0.02 < longest < 0.2
    lengths = 0.05, 0.1
    ends = []
    for length in lengths:
        plan["trial"]["dvl"] |= {"averaging_s": length, "averaging_std_s": 0.0}
        stated = solved_problems(simulate(parse_scenario(plan), 1))[0]
        ends.append(stated.minimum.evaluation.parameters["lever_arm_m"])
    # Half of the square of the longest is considered.
    share = (lengths[1] ** 2 - lengths[0] ** 2) / (0.5 * longest**2)
    change = share * error.changes[found.problem.key("lever_arm_m")][:, 0]
    assert np.abs(change).max() > 2e-3
    np.testing.assert_allclose(ends[1] - ends[0], change, atol=0.15 * np.abs(change).max())
    assert not any("DVL" in e.cause for e in stated.covariances.errors)


def test_how_long_a_window_may_be():
    # Nothing is known: half of 3 L⁴, the fourth moment of a normal distribution.
    assert likely_square(0.0, 0.0, 0.3) == pytest.approx(0.09 * np.sqrt(1.5), rel=1e-4)
    # Well known: what is found, or nothing.
    assert likely_square(0.04 * 1e8, 1e8, 0.3) == pytest.approx(0.04, rel=1e-3)
    assert likely_square(-0.04 * 1e6, 1e6, 0.3) < 1e-5
    # Around zero the density by the square is m^(-1/2): by hand, with a precision of 1 / s⁴ and a
    # window that is plausible without limit, all that averages has half of 1 / precision.
    precision, wide = 1e10, 10.0
    within = np.sqrt(2.0 / np.pi) / wide * precision**-0.25 * 0.5 * 2.0**-0.75 * 3.6256
    expected = within * 0.5 / precision
    assert likely_square(0.0, precision, wide) ** 2 == pytest.approx(expected, rel=0.01)
