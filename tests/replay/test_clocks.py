"""Corrections of clocks that have jumped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from truth import scenario

from factorgraph_dvl.replay.clocks import Clocks
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate


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
