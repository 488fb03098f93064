"""Compass and log: what is missing, and where they are of no use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders import build_trial
from planar import trial

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.sensors.depth import Depth
from factorgraph_dvl.sensors.speed_log import Heading, SpeedLog
from factorgraph_dvl.trial import InitialVelocity


def test_rows_without_a_value_are_missing():
    t = trial()
    for kind, name in ((Heading, "heading"), (SpeedLog, "speed")):
        record = t.required(kind)
        values = getattr(record, name).copy()
        values[3] = np.nan
        assert np.flatnonzero(replace(record, **{name: values}).missing) == [3]
        found = replace(record, **{name: values}).observations(t.frame(), t.body_axes)
        # The chain has its attitude from the compass; only the log observes its motion.
        assert [o.time.size for o in found] == ([] if kind is Heading else [values.size - 1])


def test_other_sensors_are_not_left_out_in_silence():
    t, other = trial(), build_trial()
    heading = t.required(Heading)
    with pytest.raises(ConfigError, match=r"key imu: heading and log make a planar trial"):
        replace(other, others=(heading,))
    with pytest.raises(ConfigError, match=r"key gnss: .*; expected heading, log, depth, beacons"):
        replace(t, gnss=other.gnss)
    with pytest.raises(ConfigError, match=r"key initial\.velocity"):
        replace(t, initial_velocity=InitialVelocity(np.zeros(3), np.ones(3)))
    without = replace(t, others=tuple(a for a in t.others if a is not t.depth))
    with pytest.raises(ConfigError, match="the trial has no `depth`"):
        without.required(Depth)
