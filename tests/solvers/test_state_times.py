"""When states are needed besides those every second."""

from __future__ import annotations

import numpy as np
import pytest
from inertial import SETTINGS

from factorgraph_dvl.sensors.parameters import Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import Attitudes
from factorgraph_dvl.solvers.state_times import CLOSEST, _thinned, needs_states

MOUNTING = Parameter(ParameterSpec("mounting", "deg", kind="rotation"), np.zeros(3), np.ones(3))
# Angle that the gyros walk in 1 s, rad.
WALK = SETTINGS.gyro_noise_root_psd


@pytest.mark.parametrize(("sigmas_of_walk", "needed"), [(6.0, True), (8.0, False)])
def test_attitudes_near_the_walk_of_the_gyros_need_their_own(sigmas_of_walk, needed):
    # 2 % of the variance: 7.07 times the walk.
    seen = Attitudes(
        np.arange(5.0), np.zeros((5, 3, 3)), np.full(5, sigmas_of_walk * WALK), MOUNTING
    )
    assert needs_states(seen, SETTINGS, 1.0) == needed


def test_many_attitudes_to_a_state_are_as_one_that_is_better():
    seen = Attitudes(
        np.arange(0, 5, 0.1), np.zeros((50, 3, 3)), np.full(50, 20.0 * WALK), MOUNTING
    )
    assert needs_states(seen, SETTINGS, 1.0)
    assert not needs_states(seen, SETTINGS, 0.1)


def test_times_too_close_to_one_another_are_thinned():
    time = np.array([0.0, 0.01, 0.05, 0.06, 0.2])
    np.testing.assert_array_equal(_thinned(time), [0.0, 0.05, 0.2])
    apart = np.arange(4) * CLOSEST
    assert _thinned(apart) is apart
