"""The deflection of the vertical as a random field."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.deflection import deflection_along, deflection_covariance


def test_the_field_is_the_slope_of_a_geoid():
    # The curl of a gradient is zero: so is its variance, by differences of the covariance.
    h = 1.0
    around = np.array([[h, 0.0], [-h, 0.0], [0.0, h], [0.0, -h]])
    curl = np.zeros((4, 2))
    curl[0, 1], curl[1, 1], curl[2, 0], curl[3, 0] = 1.0, -1.0, -1.0, 1.0
    divergence = np.zeros((4, 2))
    divergence[0, 0], divergence[1, 0], divergence[2, 1], divergence[3, 1] = 1.0, -1.0, 1.0, -1.0
    C = deflection_covariance(around).reshape(8, 8)
    turning, spreading = (each.ravel() @ C @ each.ravel() for each in (curl, divergence))
    assert spreading > 0.0
    assert abs(turning) < 1e-3 * spreading


def test_components_along_a_track_make_up_the_field():
    track = np.linspace(0.0, 1.0, 999)[:, None] * np.array([30e3, -10e3])
    along = deflection_along(track)
    some = np.array([0, 10, 400, 998])
    found = np.einsum("mih,njh->minj", along[some], along[some])
    np.testing.assert_allclose(found, deflection_covariance(track[some]), atol=1e-3)
    # At one place it is a constant.
    assert deflection_along(np.zeros((50, 2))).shape == (50, 2, 2)
    assert deflection_along(np.zeros((1, 2))).shape == (1, 2, 2)
