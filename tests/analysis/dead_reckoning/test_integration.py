"""Velocities integrated on the ellipsoid."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.analysis.dead_reckoning import integration
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame, radii
from factorgraph_dvl.geometry.rotations import exp_so3


def test_along_the_equator_the_longitude_grows_by_distance_over_radius():
    time = np.linspace(0.0, 100.0, 11)
    velocity = np.tile([5.0, 0.0, -0.1], (11, 1))
    track = integration.integrated(time, velocity, np.array([0.0, 1.0, 20.0]))
    height = 20.0 - 0.1 * time
    np.testing.assert_allclose(track[:, 2], height)
    np.testing.assert_allclose(track[:, 0], 0.0, atol=1e-15)
    # 6378137 m to the ellipsoid; the mean height is 15 m.
    assert track[-1, 1] - 1.0 == pytest.approx(500.0 / (6378137.0 + 15.0), rel=1e-9)


def test_along_a_meridian_the_latitude_grows_with_the_local_radius():
    time = np.linspace(0.0, 1000.0, 1001)
    start = np.array([0.6, 2.0, 0.0])
    track = integration.integrated(time, np.tile([0.0, 5.0, 0.0], (1001, 1)), start)
    np.testing.assert_allclose(track[:, 1], 2.0)
    middle = float(radii(np.array(0.5 * (track[0, 0] + track[-1, 0])))[0])
    assert track[-1, 0] - 0.6 == pytest.approx(5000.0 / middle, rel=1e-8)


def test_a_displacement_is_that_of_the_tangent_frame():
    start = np.array([[0.6, 2.0, -40.0]])
    moved = integration.displaced(start, np.array([[3.0, -4.0, 1.0]]))
    np.testing.assert_allclose(
        LocalFrame(*start[0]).position(*moved.T), [[3.0, -4.0, 1.0]], atol=1e-5
    )


def test_a_neglected_lever_arm_moves_the_track_by_what_it_turns():
    nRb = exp_so3(np.array([[0, 0, 0], [0, 0, np.pi / 2], [0, 0, 2 * np.pi]]))
    error = integration.lever_arm_error(nRb, np.array([1.0, 0.0, 0.5]))
    np.testing.assert_allclose(error, [[0, 0, 0], [-1, 1, 0], [0, 0, 0]], atol=1e-15)


def test_missing_pings_are_filled_in_at_the_usual_interval():
    pings = np.array([0.0, 0.2, 0.4, 1.0, 1.2])
    np.testing.assert_allclose(
        integration._filled(pings), [0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2], atol=1e-12
    )
    with pytest.raises(DataError, match=r"no ping from 1\.2 to 9001\.2 s"):
        integration._filled(np.append(pings, 9001.2))


def test_a_gap_is_bridged_between_the_means_beside_it():
    before, after = np.arange(0.0, 20.0, 0.5), np.arange(30.0, 50.0, 0.5)
    pings = np.concatenate([before, after])
    # Swell of 10 s, the length of the mean, on 1 m/s before and 2 m/s after.
    ahead = np.where(pings < 25.0, 1.0, 2.0) + 0.3 * np.sin(2 * np.pi * pings / 10.0)
    v_b = np.stack([ahead, 0.0 * ahead, 0.0 * ahead], axis=1)
    knots, velocity, gaps = integration._with_gaps(pings, v_b)
    np.testing.assert_array_equal(gaps, [[19.5, 30.0]])
    inside = (knots > 19.5) & (knots < 30.0)
    assert inside.sum() == 2
    np.testing.assert_allclose(velocity[inside, 0], [1.0, 2.0], atol=1e-12)
