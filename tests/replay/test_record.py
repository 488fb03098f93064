"""The record of a replay."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from factorgraph_dvl.estimates import Estimate, Trajectory
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay.calibration import CalibrationEstimate
from factorgraph_dvl.replay.record import Innovations, Recorder, Update


def trajectory(time):
    time = np.asarray(time, dtype=float)
    vector = time[:, None] + np.arange(3.0)
    matrix = time[:, None, None] + np.arange(9.0).reshape(3, 3)
    return Trajectory(time, vector, vector + 1, vector + 2, matrix, matrix + 1, matrix + 2)


def note(time):
    return Finding(Code.UNUSED, f"at {time}")


def update(time, names, *, epochs, smoothed=None, used=True):
    ones = np.ones(1)
    estimates = tuple(
        Estimate(n, (n,), time * ones, 0.1 * ones, 0.0 * ones, ones, np.array([True]))
        for n in names
    )
    calibration = CalibrationEstimate(estimates, np.eye(len(names)))
    innovation = Innovations(
        "DVL", "m/s", ("x", "y"), time * ones, np.array([[time, 2.0]]), np.ones((1, 2)),
        np.array([used]),
    )  # fmt: skip
    return Update(
        time, 0.01, lambda: trajectory([time]), lambda: trajectory(epochs), lambda: calibration,
        smoothed,
        (innovation,), (note(time),), False, (),
    )  # fmt: skip


def test_the_record_is_what_the_updates_were():
    recorder = Recorder()
    recorder.add(update(1.0, ["a"], epochs=[0.9, 1.0]))
    recorder.add(update(2.0, ["a"], epochs=[], used=False))
    # A second sensor is calibrated from here on.
    recorder.add(update(3.0, ["b", "a"], epochs=[2.5], smoothed=trajectory([0.9])))
    record = recorder.record(0.25)
    assert record.names == ("b", "a")
    np.testing.assert_array_equal(record.time, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(record.values, [[np.nan, 1.0], [np.nan, 2.0], [3.0, 3.0]])
    np.testing.assert_array_equal(record.std[-1], [0.1, 0.1])
    assert record.findings == tuple((time, note(time)) for time in (1.0, 2.0, 3.0))
    assert record.delay == 0.25
    for found, expected in (
        (recorder.trajectory(), trajectory([0.9, 1.0, 2.5])),
        (record.smoothed, trajectory([0.9])),
    ):
        for f in fields(Trajectory):
            np.testing.assert_array_equal(getattr(found, f.name), getattr(expected, f.name))
    (residuals,) = recorder.residuals()
    np.testing.assert_array_equal(residuals.time, [1.0, 3.0])
    np.testing.assert_array_equal(residuals.residual, [[1.0, 2.0], [3.0, 2.0]])


def test_an_hour_of_updates_takes_their_numbers_only():
    recorder = Recorder()
    for i in range(2000):
        recorder.add(update(float(i), ["a"], epochs=[float(i), i + 0.5]))
    kept = [recorder._trajectory, recorder._estimates[0][1], recorder._residuals["DVL"][1]]
    numbers = 2000 * (2 * 37 + 6 + 5)
    assert sum(len(each) for each in kept) == numbers
    assert sum(memoryview(each).nbytes for each in kept) == 8 * numbers
