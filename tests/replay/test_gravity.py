"""Gravity near the vehicle."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.replay.gravity import LocalGravity


def test_gravity_is_that_of_the_full_model_along_a_track():
    frame = LocalFrame(0.6, 0.3, 10.0)
    gravity = LocalGravity(frame)
    for step in np.linspace(0.0, 3000.0, 200):
        p = np.array([[step, 0.5 * step, -0.01 * step]])
        exact = frame.gravity_without_rotation(p)
        np.testing.assert_allclose(gravity.at(p), exact, rtol=0.0, atol=3e-9)
