"""The Earth: ellipsoid, gravity, tangent frame."""

from __future__ import annotations

import numpy as np
import pymap3d
import pytest

from factorgraph_dvl.geometry.earth import LocalFrame, enu_from_ecef, normal_gravity, radii
from factorgraph_dvl.geometry.units import DEG

FRAME = LocalFrame(36.0 * DEG, 121.0 * DEG, 10.0)


@pytest.mark.parametrize("lat_deg", [0.0, 36.0, 45.0, -60.0, 90.0])
def test_normal_gravity_is_that_of_somigliana(lat_deg):
    # NIMA TR8350.2: semi-axes, and gravity at equator and poles.
    (a, b), (equator, pole) = (6378137.0, 6356752.3142), (9.7803253359, 9.8321849379)
    c, s = np.cos(lat_deg * DEG), np.sin(lat_deg * DEG)
    expected = (a * equator * c**2 + b * pole * s**2) / np.hypot(a * c, b * s)
    assert normal_gravity(lat_deg * DEG, 0.0) == pytest.approx(expected, abs=1e-9)
    # Free air: 3.1 µm/s² a metre.
    fall = normal_gravity(lat_deg * DEG, 100.0) - normal_gravity(lat_deg * DEG, 0.0)
    assert fall == pytest.approx(-3.086e-4, rel=3e-3)


def test_radii_of_curvature_are_the_derivatives_of_the_position():
    step = 1e-6
    north, east = radii(FRAME.lat)
    along = FRAME.position(FRAME.lat + step, FRAME.lon, FRAME.height)
    across = FRAME.position(FRAME.lat, FRAME.lon + step, FRAME.height)
    assert along[1] / step == pytest.approx(north + FRAME.height, rel=1e-5)
    assert across[0] / step == pytest.approx((east + FRAME.height) * np.cos(FRAME.lat), rel=1e-5)


def test_positions_and_back():
    p_n = np.random.default_rng(0).normal(0.0, 5e3, (20, 3))
    lat, lon, height = FRAME.geodetic(p_n)
    np.testing.assert_allclose(FRAME.position(lat, lon, height), p_n, atol=1e-6)
    one = FRAME.geodetic(p_n[0])
    assert all(np.shape(x) == () for x in one)


@pytest.mark.parametrize("size_m", [10.0, 1e4, 1e6, 8e6])
@pytest.mark.parametrize("lat_deg", [36.0, -90.0, 0.0])
def test_positions_are_those_of_pymap3d_however_far(lat_deg, size_m):
    frame = LocalFrame(lat_deg * DEG, 121.0 * DEG, 10.0)
    p_n = np.random.default_rng(0).normal(0.0, size_m, (20, 3))
    geodetic = frame.geodetic(p_n)
    np.testing.assert_allclose(frame.position(*geodetic), p_n, atol=3e-8)
    # Its way back is off by metres there.
    enu = pymap3d.geodetic2enu(*geodetic, frame.lat, frame.lon, frame.height, deg=False)
    np.testing.assert_allclose(np.stack(enu, axis=1), p_n, atol=3e-8)


def test_axes_of_the_tangent_frame_are_level_at_its_origin():
    np.testing.assert_allclose(
        FRAME.level_from_tangent(FRAME.lat, FRAME.lon), np.eye(3), atol=1e-15
    )
    R = enu_from_ecef(FRAME.lat, FRAME.lon)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    # The Earth turns about its axis.
    np.testing.assert_allclose(R.T @ FRAME.earth_rate, [0.0, 0.0, 7.292115e-5], atol=1e-12)


def test_gravity_turns_as_the_vessel_moves_and_keeps_its_size():
    p_n = np.array([[0.0, 0.0, 0.0], [5000.0, 0.0, 0.0], [0.0, 0.0, 1000.0]])
    gravity = FRAME.gravity(p_n)
    lat, _, height = FRAME.geodetic(p_n)
    np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), normal_gravity(lat, height))
    # 5 km are 0.8 mrad.
    assert -gravity[1, 0] / 9.8 == pytest.approx(5000.0 / 6.386e6, rel=1e-3)


def test_without_rotation_the_centrifugal_force_about_the_origin_is_missing():
    p_n = np.array([3000.0, -2000.0, 100.0])
    omega = FRAME.earth_rate
    expected = FRAME.gravity(p_n) + np.cross(omega, np.cross(omega, p_n))
    np.testing.assert_allclose(FRAME.gravity_without_rotation(p_n), expected, atol=1e-15)
