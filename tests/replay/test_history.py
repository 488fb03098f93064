"""The history of the records, as a trial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from truth import scenario

from factorgraph_dvl.replay.history import InertialHistory, RecordHistory
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate


def history(trial, **changes):
    out = InertialHistory(trial, **({"longest": 1800.0} | changes))
    imu = trial.imu
    out.add_samples(np.column_stack([imu.time, imu.gyro, imu.accel]))
    return out


def test_a_trial_has_what_was_recorded_up_to_a_time():
    trial = simulate(scenario())
    out = history(trial)
    assert not out.complete
    out.add_aid(trial.gnss)
    found = out.trial(10.0)
    assert found.imu.time[-1] <= 10.0
    # A sensor that has not reported yet is not part of it.
    assert found.dvl is None
    out.add_aid(trial.dvl)
    assert out.complete
    np.testing.assert_array_equal(out.trial(10.0).dvl.velocity, trial.dvl.velocity)


def test_rejected_rows_are_left_out_and_later_ones_removed():
    trial = simulate(scenario())
    out = history(trial)
    out.add_aid(trial.dvl)
    assert out.without_rejected(trial.frame()) is None
    label = trial.dvl.observations(trial.frame(), "RFU")[0].label
    out.reject(label, trial.dvl.time[[3, 5]])
    fewer = out.without_rejected(trial.frame()).trial(np.inf).dvl.time
    np.testing.assert_array_equal(fewer, np.delete(trial.dvl.time, [3, 5]))
    (later,) = out.remove_after(float(trial.dvl.time[8]))
    np.testing.assert_array_equal(later.time, trial.dvl.time[8:])
    np.testing.assert_array_equal(out.trial(np.inf).dvl.time, trial.dvl.time[:8])


def test_samples_are_shifted_after_a_time_and_old_ones_dropped():
    trial = simulate(scenario())
    out = history(trial)
    time = trial.imu.time
    out.shift_samples(float(time[100]), 0.5)
    np.testing.assert_array_equal(out.trial(np.inf).imu.time[:100], time[:100])
    np.testing.assert_allclose(out.trial(np.inf).imu.time[100:], time[100:] + 0.5)
    short = InertialHistory(trial, 5.0)
    table = np.column_stack([time, trial.imu.gyro, trial.imu.accel])
    for block in np.array_split(table, 40):
        short.add_samples(block)
    assert short.trial(np.inf).imu.time[0] >= time[-1] - 5.0 - (time[-1] - time[0]) / 40.0


def test_without_an_imu_rows_that_come_late_are_among_the_newest():
    trial = replace(simulate(scenario()), imu=None)
    out = RecordHistory(trial)
    late, first = 7, float(trial.gnss.time[10])
    for k in np.delete(np.arange(20), late):
        out.add_aid(rows_of(trial.gnss, [k]))
    assert out.start == np.inf
    out.add_aid(trial.dvl)
    assert out.start == max(trial.gnss.time[0], trial.dvl.time[0])
    out.add_aid(rows_of(trial.gnss, [late]))
    np.testing.assert_array_equal(out.newest(first, 1).gnss.time, trial.gnss.time[11:20])
    before = float(trial.gnss.time[late - 1])
    np.testing.assert_array_equal(out.newest(before, 1).gnss.time, trial.gnss.time[late:20])
    # Of few, some from before.
    np.testing.assert_array_equal(out.newest(first, 15).gnss.time, trial.gnss.time[5:20])
    until = out.trial(first)
    np.testing.assert_array_equal(until.gnss.time, trial.gnss.time[:11])
    assert until.dvl.time[-1] <= first
