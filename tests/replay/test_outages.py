"""Outages of sensors, and their end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay.outages import Outages
from factorgraph_dvl.replay.update import Innovations


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
