"""Records as they arrive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from truth import scenario

from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay.arrivals import AHEAD, Clocks, Duplicates, Outages, PendingMeasurements
from factorgraph_dvl.replay.record import Innovations
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate


def test_a_row_is_a_duplicate_if_every_number_is_equal():
    dvl = rows_of(simulate(scenario()).dvl, slice(0, 10))
    duplicates = Duplicates()
    assert duplicates.without(dvl) is dvl
    again = duplicates.without(replace(dvl, velocity=dvl.velocity + (np.arange(10) < 3)[:, None]))
    np.testing.assert_array_equal(again.time, dvl.time[:3])
    assert duplicates.rejected == {dvl.label: 7}


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


def test_a_sensor_is_shifted_only_if_its_own_times_jump_back():
    dvl = rows_of(simulate(scenario()).dvl, slice(0, 20))
    first, second = rows_of(dvl, slice(0, 10)), rows_of(dvl, slice(10, 20))
    clocks = Clocks()
    assert clocks.corrected(first) is first
    clocks.jumped_back(50.0)
    assert clocks.imu == 50.0
    # Its own clock went on.
    assert clocks.corrected(second) is second
    back = replace(second, time=second.time - 50.0)
    np.testing.assert_allclose(clocks.corrected(back).time, second.time)


def test_a_jump_ahead_is_that_of_the_imu_alone():
    dvl = rows_of(simulate(scenario()).dvl, slice(0, 10))
    clocks = Clocks()
    clocks.jumped_ahead(1.5)
    assert clocks.imu == -1.5
    assert clocks.corrected(dvl) is dvl


def test_outages_is_that_of_arrivals():
    def heard(time):
        return [Innovations("GNSS", "m", ("e",), np.array([time]), *3 * (np.ones((1, 1)),))]

    outages = Outages()
    # As late as this receiver is: it is not silent.
    assert not [m for t in range(20) for m in outages.findings(t + 8.0, heard(float(t)))]
    assert [*map(str, outages.findings(34.0, []))] == [
        (
            "GNSS: no measurements since 19.0 s; the estimate continues without them, and its "
            "standard deviations grow"
        )
    ]
    assert outages.findings(35.0, heard(20.0)) == [
        Finding(Code.HEARD_AGAIN, message("heard_again.back", duration=8.0), "GNSS")
    ]


def test_a_missed_ping_is_no_outages():
    outages = Outages()
    heard = Innovations("range", "m", ("range",), *(np.zeros((1, 1)),) * 3, np.ones(1, dtype=bool))
    said = []
    for now in range(61):
        arrived = now % 5 == 0 and now not in (20, 25)
        each = [replace(heard, time=np.array([float(now)]))] if arrived and now < 40 else []
        said += outages.findings(float(now), each)
    assert [f.code for f in said] == [Code.SILENT]
    assert [*map(str, said)] == [
        (
            "range: no measurements since 35.0 s; the estimate continues without them, and its "
            "standard deviations grow"
        )
    ]
