"""GNSS velocities against the carried IMU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import exact_states, scenario

from factorgraph_dvl.geometry.rotations import log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.initialization.gnss_windows import gnss_windows, level_velocities
from factorgraph_dvl.sensors.records import rows_of


def test_velocities_of_the_receiver_fit_and_give_the_attitude(exact):
    trial, windows = exact
    compared = gnss_windows(windows, trial.gnss)
    fit = compared.fit(0.0)
    assert np.abs(fit.residual).max() < 0.04
    assert np.abs(fit.arm_error).max() < 0.05
    found = compared.attitude(0.0, fit.level_R)[compared.inside]
    time = compared.time[compared.inside]
    truth = exact_states(scenario(), trial.frame(), time).nRb
    off = np.linalg.norm(log_so3(truth.transpose(0, 2, 1) @ found), axis=1) / DEG
    # Measured 1.5 deg: good enough for axes, which differ by 90.
    assert off.max() < 3.0


def test_a_late_clock_leaves_residuals_until_it_is_set_right(exact):
    trial, windows = exact
    late = replace(trial.gnss, time=trial.gnss.time + 0.4)
    compared = gnss_windows(windows, late)
    squares = [np.sum(compared.residual(offset) ** 2) for offset in (0.0, 0.4, 0.8)]
    assert squares[1] < 0.02 * min(squares[0], squares[2])


def test_an_antenna_elsewhere_is_found(exact):
    trial, windows = exact
    settings = type(trial.gnss.settings)(lever_arm_m=(0.0, 5.0, 0.0))
    moved = replace(trial.gnss, settings=settings)
    fit = gnss_windows(windows, moved).fit(0.0)
    np.testing.assert_allclose(fit.arm_error, [0.0, -5.0, 0.0], atol=0.3)


def test_without_velocities_those_between_fixes_are_taken(exact):
    trial, _ = exact
    gnss = trial.gnss
    nothing = np.full_like(gnss.velocity, np.nan)
    measured, between = level_velocities(gnss), level_velocities(replace(gnss, velocity=nothing))
    np.testing.assert_array_equal(measured.begin, measured.end)
    np.testing.assert_allclose(between.end - between.begin, 5.0, atol=1e-6)
    mean = [
        measured.velocity[(measured.begin >= a) & (measured.begin <= b)].mean(axis=0)
        for a, b in zip(between.begin, between.end, strict=True)
    ]
    np.testing.assert_allclose(between.velocity, mean, atol=0.1)
    one = replace(
        gnss,
        velocity=nothing,
        geodetic=np.where(np.arange(gnss.time.size)[:, None], np.nan, gnss.geodetic),
    )
    assert level_velocities(one).begin.size == 0


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_velocities_are_not_compared(exact, count):
    trial, windows = exact
    assert gnss_windows(windows, rows_of(trial.gnss, slice(0, count))) is None
