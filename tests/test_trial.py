"""A trial finds its sensors by their type."""

from __future__ import annotations

import pickle

import numpy as np
from builders import build_trial

from factorgraph_dvl.sensors.depth import Depth, DepthSettings
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.star import Star
from factorgraph_dvl.trial import Trial


def test_sensors_are_found_by_type():
    trial = build_trial()
    depth = Depth(DepthSettings(), np.arange(3.0), np.ones(3))
    dived = Trial(trial.name, trial.imu, trial.gnss, trial.dvl, others=(depth,))
    assert dived.find(Gnss) is trial.gnss
    assert dived.find(Dvl) is trial.dvl
    assert dived.find(Depth) is dived.depth is depth
    assert dived.find(Star) is None
    assert dived.beacons is dived.beams is None


def test_a_trial_goes_to_another_process_and_back():
    trial = build_trial()
    again = pickle.loads(pickle.dumps(trial))
    assert again.limits == trial.limits
    np.testing.assert_array_equal(again.imu.gyro, trial.imu.gyro)
