"""A trial without noise, and its IMU carried through windows."""

from __future__ import annotations

import pytest
from truth import scenario

from factorgraph_dvl.initialization.carried_windows import carried_windows
from factorgraph_dvl.simulation import simulate


@pytest.fixture(scope="session")
def exact():
    trial = simulate(scenario())
    return trial, carried_windows(trial.imu)
