"""Vibration is what goes on above 8 Hz; noise, sway and steps are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_dvl.imu.vibration import without_vibration
from factorgraph_dvl.sensors.imu import Imu, ImuSettings

DT = 0.01
TIME = DT * np.arange(6000)
SETTINGS = ImuSettings(grade="tactical")


def record(gyro, accel=None):
    """Return a record with white noise as stated beside signals (N,) on all axes."""
    rng = np.random.default_rng(5)
    s = SETTINGS
    noise = rng.standard_normal((2, TIME.size, 3)) / np.sqrt(DT)
    zero = np.zeros(TIME.size)
    return Imu(
        SETTINGS,
        TIME,
        gyro[:, None] + s.gyro_noise_root_psd * noise[0],
        (zero if accel is None else accel)[:, None] + s.accel_noise_root_psd * noise[1],
    )


def sway(time):
    return 0.3 * np.sin(2.0 * np.pi * 0.5 * time)


@pytest.mark.parametrize("of_the", ["gyros", "accelerometers"])
def test_vibration_is_taken_off_and_a_sway_beside_it_is_not(of_the):
    fast = 0.02 * np.sin(2.0 * np.pi * 24.0 * TIME)
    gyro, accel = (sway(TIME) + fast, sway(TIME)) if of_the == "gyros" else (sway(TIME), 20 * fast)
    given, still = record(gyro, accel), record(gyro - fast * (of_the == "gyros"))
    found = without_vibration(given)
    off = found.gyro - sway(TIME)[:, None]
    # White noise stays as it is below 8 Hz. At an end it is not known what goes on.
    expected = SETTINGS.gyro_noise_root_psd * np.sqrt(16.0)
    assert np.std(off[50:-50]) == pytest.approx(expected, rel=0.1)
    assert np.abs(off[:50]).max() < 0.5 * np.abs(fast).max()
    # What is left turns and moves the vessel as before.
    turned = np.cumsum(found.gyro - still.gyro, axis=0) * DT
    assert np.abs(turned).max() < 3e-4
    force = np.cumsum(found.accel - given.accel, axis=0) * DT
    assert np.abs(force).max() < 4e-3


def test_records_without_vibration_stay_as_they_are():
    """Noise that is larger than stated, a step and an impact are none."""
    step = np.where(TIME > 30.0, 0.5, 0.0)
    step[2000:2020] += 3.0 * (-1.0) ** np.arange(20)
    quiet = record(sway(TIME) + step)
    assert without_vibration(quiet) is quiet
    noisy = replace(
        quiet, gyro=quiet.gyro + 5.0 * (quiet.gyro - sway(TIME)[:, None] - step[:, None])
    )
    assert without_vibration(noisy) is noisy


def test_parts_are_filtered_each_by_itself():
    """A gap ends one, and what is shorter than the filter is left alone."""
    fast = 0.02 * np.sin(2.0 * np.pi * 24.0 * TIME)
    given = record(sway(TIME) + fast)
    rows = np.concatenate([np.arange(3000), np.arange(3050, 3120), np.arange(3500, 6000)])
    part = replace(given, time=TIME[rows], gyro=given.gyro[rows], accel=given.accel[rows])
    found = without_vibration(part)
    np.testing.assert_array_equal(found.gyro[3000:3070], part.gyro[3000:3070])
    for own in (slice(3000), slice(3070, None)):
        off = found.gyro[own] - sway(part.time[own])[:, None]
        assert np.abs(off[50:-50]).max() < 0.001
        assert np.abs(off).max() < 0.01


@pytest.mark.parametrize(("count", "jitter"), [(800, 0.0), (6000, 1e-3)])
def test_records_that_do_not_tell_stay_as_they_are(count, jitter):
    fast = 0.02 * np.sin(2.0 * np.pi * 24.0 * TIME)
    given = record(sway(TIME) + fast)
    time = TIME[:count] + jitter * np.random.default_rng(2).uniform(-1, 1, count)
    part = replace(given, time=time, gyro=given.gyro[:count], accel=given.accel[:count])
    assert without_vibration(part) is part
