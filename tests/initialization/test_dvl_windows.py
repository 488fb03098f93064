"""DVL velocities against the carried IMU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.initialization.dvl_windows import dvl_windows
from factorgraph_dvl.sensors.records import rows_of

TRUE = exp_so3(np.array([2.0, 2.0, 30.0]) * DEG)


def test_the_mounting_is_found_without_any_other_sensor(exact):
    trial, windows = exact
    fit = dvl_windows(windows, trial.dvl).fit(0.0)
    assert np.linalg.norm(log_so3(TRUE.T @ fit.dRb)) / DEG < 1.0
    # Measured -0.005 for 0.005: units are wrong by more.
    assert fit.scale_error == pytest.approx(0.005, abs=0.02)
    np.testing.assert_allclose(fit.lever_arm, [1.0, 1.2, 1.4], atol=0.3)
    assert np.abs(fit.residual).max() < 0.05


def test_mirrored_axes_are_told_by_the_determinant(exact):
    trial, windows = exact
    mirrored = replace(trial.dvl, velocity=trial.dvl.velocity * [1.0, 1.0, -1.0])
    compared = dvl_windows(windows, mirrored)
    free = compared.fit(0.0)
    assert np.linalg.det(free.dRb) == pytest.approx(-1.0)
    right = replace(compared, handedness=1).fit(0.0)
    assert np.linalg.det(right.dRb) == pytest.approx(1.0)
    assert np.sum(right.residual**2) > 5.0 * np.sum(free.residual**2)


def test_a_log_that_measures_exactly_nothing_has_no_mounting_and_no_error(exact):
    trial, windows = exact
    still = replace(trial.dvl, velocity=np.zeros_like(trial.dvl.velocity))
    fit = dvl_windows(windows, still).fit(0.0)
    assert np.isfinite(fit.residual).all()


def test_a_late_clock_leaves_residuals_until_it_is_set_right(exact):
    trial, windows = exact
    late = replace(trial.dvl, time=trial.dvl.time + 0.3)
    compared = dvl_windows(windows, late)
    squares = [np.sum(compared.residual(offset) ** 2) for offset in (0.0, 0.3, 0.6)]
    assert squares[1] < 0.1 * min(squares[0], squares[2])


def test_lost_pings_and_outliers_are_left_out(exact):
    trial, windows = exact
    velocity = trial.dvl.velocity.copy()
    velocity[100] = np.nan
    velocity[120] += 20.0
    compared = dvl_windows(windows, replace(trial.dvl, velocity=velocity))
    assert not np.isin(trial.dvl.time[[100, 120]], compared.stamp).any()
    assert dvl_windows(windows, rows_of(trial.dvl, slice(0, 3))) is None
