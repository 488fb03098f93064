"""Measurements that wait for the IMU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from truth import scenario

from factorgraph_dvl.replay.pending import AHEAD, PendingMeasurements
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate


def test_measurements_are_due_once_in_the_order_of_time():
    dvl = rows_of(simulate(scenario()).dvl, slice(0, 10))
    pending = PendingMeasurements("RFU")
    pending.add(rows_of(dvl, slice(5, 10)))
    pending.add(rows_of(dvl, slice(0, 5)))
    assert pending.first_after("dvl", dvl.time[2]) == dvl.time[3]
    found = pending.due("dvl", float(dvl.time[7]), None, {}, 0.0)
    assert found is not None
    np.testing.assert_array_equal(found[0].time, dvl.time[:7])
    np.testing.assert_array_equal(found[1], dvl.time[:7])
    assert pending.due("dvl", float(dvl.time[7]), None, {}, 0.0) is None
    assert pending.sections == ("dvl",)
    assert pending.due("dvl", np.inf, None, {}, 0.0)[0].time.size == 3
    assert pending.sections == ()


def test_times_are_corrected_by_the_clock_offset():
    trial = simulate(scenario())
    dvl = rows_of(trial.dvl, slice(0, 10))
    pending = PendingMeasurements("RFU")
    pending.add(dvl)
    values = {p.name: p.mean for p in dvl.parameters()}
    offset = next(name for name in values if "offset" in name)
    values[offset] = np.array([0.05])
    found = pending.due("dvl", np.inf, trial.frame(), values, 0.0)
    np.testing.assert_allclose(found[1], dvl.time - 0.05)


def test_what_is_far_ahead_of_the_imu_is_counted_and_discarded():
    dvl = rows_of(simulate(scenario()).dvl, slice(0, 10))
    time = np.where(np.arange(10) < 8, dvl.time, dvl.time + AHEAD + 100.0)
    pending = PendingMeasurements("RFU")
    pending.add(replace(dvl, time=time), newest=float(dvl.time[0]))
    assert pending.rejected == {dvl.label: 2}
    assert pending.due("dvl", np.inf, None, {}, 0.0)[0].time.size == 8
