"""Rotations."""

import numpy as np
import pytest

from factorgraph_dvl.geometry.rotations import best_rotation, exp_so3

RNG = np.random.default_rng(7)


@pytest.mark.parametrize("phi", [[0.0, 0.0, 0.0], [0.3, -0.7, 0.2], [3.1, 0.1, 0.0]])
def test_best_rotation_takes_vectors_to_their_images(phi):
    R = exp_so3(phi)
    x = RNG.standard_normal((5, 3))
    assert best_rotation((x @ R.T).T @ x) == pytest.approx(R, abs=1e-12)


def test_two_directions_and_mirrored_vectors_give_rotations_too():
    x = RNG.standard_normal((5, 3))
    plane = x * [1.0, 1.0, 0.0]
    assert best_rotation(plane.T @ plane) == pytest.approx(np.eye(3), abs=1e-12)
    for moments in (-x.T @ x, RNG.standard_normal((3, 3))):
        R = best_rotation(moments)
        assert pytest.approx(np.eye(3), abs=1e-12) == R @ R.T
        assert np.linalg.det(R) == pytest.approx(1.0)
        near = [R @ exp_so3(0.01 * axis) for axis in (*np.eye(3), *-np.eye(3))]
        assert all(np.sum(R * moments) > np.sum(other * moments) for other in near)


def test_many_at_once_are_the_same_as_each_alone():
    moments = RNG.standard_normal((4, 3, 3))
    each = [best_rotation(m) for m in moments]
    assert best_rotation(moments) == pytest.approx(np.array(each), abs=1e-15)
