"""What all sensors share."""

from __future__ import annotations

import numpy as np
from truth import scenario

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.sensors.dvl import DvlVelocity
from factorgraph_dvl.sensors.records import joined, rows_of
from factorgraph_dvl.simulation import simulate


def test_rows_of_a_record_are_joined_in_the_order_of_time():
    dvl = simulate(scenario()).dvl
    parts = [rows_of(dvl, [4]), rows_of(dvl, slice(0, 3)), rows_of(dvl, [1])]
    out = joined(parts)
    np.testing.assert_array_equal(out.time, dvl.time[[0, 1, 2, 4]])
    np.testing.assert_array_equal(out.velocity, dvl.velocity[[0, 1, 2, 4]])
    assert isinstance(out.observations(LocalFrame(0.0, 0.0, 0.0), "RFU")[0], DvlVelocity)
