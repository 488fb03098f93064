"""The clock of an IMU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from builders import build_trial

from factorgraph_dvl.imu.timestamps import fill_lost, unrounded, without_restarted_clock
from factorgraph_dvl.quality.finding import Code


def test_stamps_in_milliseconds_of_a_regular_clock_become_regular():
    exact = np.arange(2000) / 128.0
    found = unrounded(np.round(exact + 100.0, 3))
    np.testing.assert_allclose(np.diff(found), 1.0 / 128.0, atol=1e-7)
    np.testing.assert_allclose(found, exact, atol=1e-3)


def test_lost_samples_are_counted_in_the_line():
    number = np.delete(np.arange(2000), [700, 701])
    found = unrounded(np.round(number / 128.0, 3), number)
    assert np.isclose(found[700] - found[699], 3.0 / 128.0, atol=1e-6)


def test_a_clock_that_is_irregular_stays_as_it_is():
    time = np.arange(100) / 100.0
    time[50:] += 0.004
    np.testing.assert_array_equal(unrounded(time), time)


def test_lost_samples_of_a_cubic_are_filled_in_exactly():
    time = np.arange(10.0)
    lost = np.zeros(9, dtype=int)
    keep = np.delete(time, [4, 5])
    lost_after = np.array([0, 0, 0, 2, 0, 0, 0])
    samples = np.stack([keep**k for k in (0, 1, 2, 3, 2, 1)], axis=1)
    filled, values, sigma, broken = fill_lost(
        keep, samples, lost_after, lost_after > 0, np.zeros(7, dtype=bool)
    )
    np.testing.assert_allclose(filled, time)
    expected = np.stack([time**k for k in (0, 1, 2, 3, 2, 1)], axis=1)
    np.testing.assert_allclose(values, expected, atol=1e-9)
    # What a straight line would have missed is what is not known; of a line nothing.
    assert np.flatnonzero(sigma[:, 3]).tolist() == [4, 5]
    np.testing.assert_allclose(sigma[:, :2], 0.0, atol=1e-9)
    assert broken.size == lost.size


def test_samples_of_another_clock_are_left_out_where_no_sensor_measured():
    trial = build_trial()
    imu = trial.imu
    early = replace(
        imu,
        time=np.concatenate([imu.time[:5] - 1e6, imu.time]),
        gyro=np.concatenate([imu.gyro[:5], imu.gyro]),
        accel=np.concatenate([imu.accel[:5], imu.accel]),
    )
    found = without_restarted_clock(replace(trial, imu=early))
    np.testing.assert_array_equal(found.imu.time, imu.time)
    (note,) = found.notes[len(trial.notes) :]
    assert note.code is Code.CLOCK_RESTARTED
    assert "the 5 samples" in note.text
    assert without_restarted_clock(trial) is trial
