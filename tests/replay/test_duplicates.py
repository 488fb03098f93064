"""Measurements that are delivered twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from truth import scenario

from factorgraph_dvl.replay.duplicates import Duplicates
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate


def test_a_row_is_a_duplicate_if_every_number_is_equal():
    dvl = rows_of(simulate(scenario()).dvl, slice(0, 10))
    duplicates = Duplicates()
    assert duplicates.without(dvl) is dvl
    again = duplicates.without(replace(dvl, velocity=dvl.velocity + (np.arange(10) < 3)[:, None]))
    np.testing.assert_array_equal(again.time, dvl.time[:3])
    assert duplicates.rejected == {dvl.label: 7}
