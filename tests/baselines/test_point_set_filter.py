"""The seven-state filter: its measurement matrix, its accuracy on the published scenario."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from kalman_trials import LEVER_ARM, MISALIGNMENT, SCALE, exact_points, parameter
from truth import config
from workers import in_two_processes

from factorgraph_dvl.analysis.error_statistics import (
    calibration_errors,
    paper_accuracy,
)
from factorgraph_dvl.baselines import calibrate
from factorgraph_dvl.baselines.point_set_filter import measurement_matrix, point_set
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.simulation import simulate

SEEDS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "100"))
# Largest changes from ping to ping after 30 s: deg, 1, m.
SMOOTH = np.array([0.02, 0.06, 0.01, 2e-4, *[0.01] * 3])


def test_the_measurement_matrix_is_that_of_the_format():
    rng = np.random.default_rng(1)
    v, omega = rng.normal(size=3), rng.normal(size=3)

    def z(x):
        return (1 + x[3]) * exp_so3(x[:3]) @ (v + np.cross(omega, x[4:])) - v

    step = 1e-6
    numeric = np.stack([(z(step * e) - z(-step * e)) / (2 * step) for e in np.eye(7)], axis=1)
    np.testing.assert_allclose(measurement_matrix(v[None], omega[None])[0], numeric, atol=1e-8)


# Seed 12 leads steps from no rotation into an end that fits nothing.
@pytest.mark.parametrize(
    ("phase", "seed"),
    [*(pytest.param(phase, 0, marks=pytest.mark.slow) for phase in ("0", "90")), ("90", 12)],
)
def test_seven_states_reach_the_accuracy_of_the_paper(phase, seed):
    trial = simulate(config(f"seed-a-phase-{phase}"), seed)
    solution, history = calibrate(trial)
    assert solution.converged
    # No chatter: from ping to ping nothing jumps.
    assert np.all(largest_steps(history) < SMOOTH)
    # The last row of the history is the solution: the filter needs no second pass.
    np.testing.assert_allclose(history.values[-1], solution_values(solution), rtol=2e-3)
    assert paper_accuracy(solution.estimates, trial.calibration_truth) > 97.3
    assert history.names[:4] == (
        "misalignment_x_deg",
        "misalignment_y_deg",
        "misalignment_z_deg",
        "scale_error",
    )
    assert np.all(np.diff(history.time) > 0)
    assert history.std[-1, 2] < 1e-3 * history.std[0, 2]
    np.testing.assert_allclose(history.values[-1, 2], 30.0, atol=0.2)


def largest_steps(history):
    return np.abs(np.diff(history.values[history.time > 30.0], axis=0)).max(axis=0)


def solution_values(solution):
    names = ("misalignment_deg", "scale_error", "lever_arm_m")
    return np.concatenate([solution.estimate(name).value for name in names])


def one(job):
    """Return whether the filter settled on a seed, its largest steps, accuracy and errors in σ."""
    phase, seed = job
    trial = simulate(config(f"seed-a-phase-{phase}"), seed)
    solution, history = calibrate(trial)
    errors = calibration_errors(solution, trial.calibration_truth)
    accuracy = paper_accuracy(solution.estimates, trial.calibration_truth)
    return solution.converged, largest_steps(history), accuracy, errors.normalised


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["0", "90"])
def test_seven_states_over_seeds(phase):
    runs = in_two_processes(one, [(phase, seed) for seed in range(SEEDS)])
    converged, steps, accuracy, normalised = zip(*runs, strict=True)
    assert all(converged), np.flatnonzero(~np.array(converged))
    assert np.all(np.max(steps, axis=0) < SMOOTH)
    assert np.mean(accuracy) > 99.0
    ratio = np.sqrt(np.mean(np.square(normalised), axis=0))
    # The heading error of SINS/GNSS stays the same from ping to ping, and the filter takes
    # it for new each time.
    assert ratio[2] > 2.0
    # The SINS/GNSS filter itself is honest.
    assert np.all(ratio[7:] < 1.6)


@pytest.mark.parametrize("turn", [[0.05, 0.02, -0.03], [0.0, 0.0, 3.0]], ids=str)
def test_without_noise_it_is_exact(turn):
    arm = np.array([1.0, -0.5, 2.0])
    points = exact_points(misalignment=turn, scale=0.02, arm=arm)
    outcome = point_set(points, MISALIGNMENT, SCALE, LEVER_ARM)
    assert outcome.converged
    dRb, scale, found = outcome.estimated.values
    # The priors of 0.1 and 10 m draw by less than these.
    np.testing.assert_allclose(dRb, exp_so3(turn), atol=1e-4)
    np.testing.assert_allclose(scale, 0.02, atol=1e-5)
    np.testing.assert_allclose(found, arm, atol=1e-3)


def test_known_components_stay_where_they_are():
    arm = np.array([1.0, -0.5, 2.0])
    points = exact_points(misalignment=[0.05, 0.02, 0.5], scale=0.02, arm=arm)
    known = parameter("lever_arm", arm, np.zeros(3))
    outcome = point_set(points, MISALIGNMENT, SCALE, known)
    np.testing.assert_array_equal(outcome.estimated.values[2], arm)
    np.testing.assert_array_equal(outcome.estimated.covariance[4:], np.zeros((3, 7)))
    np.testing.assert_allclose(outcome.estimated.values[0], exp_so3([0.05, 0.02, 0.5]), atol=1e-4)


def test_sway_that_moves_the_dvl_faster_than_the_vessel_settles():
    """Steps by the printed gain diverge here: they leave alpha x (omega x l) out."""
    rng = np.random.default_rng(5)
    arm = np.array([1.0, 1.2, 1.4])
    phase = rng.uniform(0.0, 2.0 * np.pi, 400)
    omega = 0.9 * np.column_stack([np.cos(phase), np.sin(phase), np.zeros(400)])
    # The lever arm's velocity stands across the vessel's own, which hardly has any there.
    v = np.column_stack([0.1 * np.sin(phase), np.full(400, 4.0), 0.1 * np.cos(phase)])
    points = replace(
        exact_points(400),
        v_b=v,
        omega_b=omega,
        v_d=1.005 * (v + np.cross(omega, arm)) @ exp_so3([0.035, 0.035, 0.5]).T,
    )
    wide = parameter("misalignment", np.zeros(3), np.full(3, np.pi), kind="rotation")
    outcome = point_set(points, wide, SCALE, LEVER_ARM)
    assert outcome.converged
    np.testing.assert_allclose(
        outcome.estimated.values[0], exp_so3([0.035, 0.035, 0.5]), atol=1e-3
    )
    np.testing.assert_allclose(outcome.estimated.values[2], arm, atol=1e-2)
