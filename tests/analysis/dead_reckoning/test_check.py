"""Residuals and dead reckoning before and after calibration: exact with the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from truth import config, scenario

from factorgraph_dvl.analysis.comparison.halves import halves_of
from factorgraph_dvl.analysis.dead_reckoning.check import check_calibration
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve


@pytest.fixture(scope="module", params=["RFU", "FLU"])
def solved(request):
    trial = simulate(scenario(body_axes=request.param, gnss={"lever_arm_m": [0.3, -1.5, 4.0]}), 0)
    return trial, solve(trial, rate_hz=20.0)


def test_with_the_true_calibration_nothing_is_left(solved):
    trial, solution = solved
    check = check_calibration(trial, solution, trial.calibration_truth, "same data")
    assert np.abs(check.after).max() < 2e-3
    assert check.tracks.calibrated.score is not None
    assert check.tracks.calibrated.score.horizontal.max() < 0.02


def test_before_calibration_the_record_is_taken_for_the_velocity_of_the_vehicle(solved):
    trial, solution = solved
    check = check_calibration(trial, solution, trial.calibration_truth, "same data")
    v_d = trial.dvl.velocity[np.isin(trial.dvl.time, check.time)]
    true = trial.reference
    nRb = rotation_from_rph(CubicSpline(true.time, np.unwrap(true.rph, axis=0))(check.time),
                            trial.body_axes)  # fmt: skip
    v_n = CubicSpline(true.time, true.velocity)(check.time)
    v_b = np.einsum("kij,ki->kj", nRb, v_n)
    # Forward, starboard, down, written out.
    residual = v_b - v_d
    x, y, z = residual.T
    expected = {"RFU": (y, x, -z), "FLU": (x, -y, -z)}[trial.body_axes]
    assert np.allclose(check.before, np.stack(expected, axis=1), atol=2e-3)
    assert np.abs(check.before).max() > 0.1


def test_a_wrong_rotation_is_seen(solved):
    trial, solution = solved
    true = trial.calibration_truth
    wrong = true | {"misalignment_deg": -np.asarray(true["misalignment_deg"])}
    good = check_calibration(trial, solution, true, "same data")
    bad = check_calibration(trial, solution, wrong, "same data")
    assert np.abs(bad.after).max() > 10.0 * np.abs(good.after).max()


@pytest.mark.slow
def test_the_first_half_is_tested_on_the_second():
    trial = simulate(config("seed-a-phase-90"), 2)
    solution = solve(trial)
    first, second = halves_of(trial)
    values = {e.name: e.value for e in solve(first).estimates}
    check = check_calibration(second, solution, values, "second half")
    assert check.time[0] >= second.dvl.time[0]
    sigma = np.hypot(0.001, 0.002 * np.linalg.norm(trial.dvl.velocity, axis=1).max())
    rms = np.sqrt(np.mean(check.after**2, axis=0))
    assert np.all(rms < 1.3 * sigma)
    assert check.tracks.calibrated.score.horizontal[-1] < 1.0
    assert check.tracks.uncalibrated.score.horizontal[-1] > 50.0


def test_rejected_pings_are_left_out(solved):
    trial, solution = solved
    times = trial.dvl.time[trial.dvl.locked][20:23]
    label = solution.residuals[0]
    rejected = replace(
        label, label="DVL velocity", time=times, residual=np.ones((3, 3)), sigma=np.ones((3, 3)),
        components=("x", "y", "z"),
    )  # fmt: skip
    with_rejected = replace(solution, rejected=(rejected,))
    check = check_calibration(trial, with_rejected, trial.calibration_truth, "same data")
    assert not np.isin(times, check.time).any()
