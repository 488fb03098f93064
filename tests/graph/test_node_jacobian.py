"""Derivatives of measurements by the node before them.

That by the motion is held against numerical derivatives in `tests/imu/test_preintegration.py`.
"""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.sensors.protocol import Linearization


def test_derivatives_of_some_measurements_are_theirs():
    by_speed = np.arange(24.0).reshape(4, 2, 3)
    constant = np.ones((1, 2, 1))
    lin = Linearization(
        np.arange(8.0).reshape(4, 2), d_v=by_speed, d_parameters={"scale": constant}
    )
    for some in (slice(1, 3), np.array([3, 0])):
        found = lin.some(some)
        np.testing.assert_array_equal(found.residual, lin.residual[some])
        np.testing.assert_array_equal(found.d_v, by_speed[some])
        np.testing.assert_array_equal(found.d_parameters["scale"], np.ones((2, 2, 1)))
        assert found.d_p is None
