"""Rotations: the best between vectors, derivatives, covariances by Monte Carlo."""

import numpy as np
import pytest
from exactness import worst_relative

from factorgraph_dvl.geometry.rotations import (
    best_rotation,
    exp_so3,
    inverse_right_jacobian,
    log_so3,
    reported_rotation_vector,
    right_jacobian,
    rotation_from_rph,
    rph_from_rotation,
    rph_jacobian,
    wrapped,
)
from factorgraph_dvl.geometry.units import DEG

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


def test_wrapped_angles_are_the_same_angle_in_one_turn():
    angle = np.array([0.1, -3.0, 3.5, -3.5, 7.0, -100.0])
    found = wrapped(angle)
    assert np.all((found >= -np.pi) & (found < np.pi))
    assert np.exp(1j * found) == pytest.approx(np.exp(1j * angle), abs=1e-13)
    assert np.array_equal(found[:2], angle[:2])
    assert wrapped(np.pi) == -np.pi


def test_rotation_vectors_near_half_a_turn_stay_in_one_branch():
    rng = np.random.default_rng(0)
    phi = np.array([0.0, 0.0, 180.0]) * DEG
    found = np.array(
        [
            reported_rotation_vector(exp_so3(phi) @ exp_so3(d), near=phi)
            for d in rng.normal(0.0, 0.5 * DEG, (500, 3))
        ]
    )
    assert np.abs(found - phi).max() < 4.0 * DEG
    # Half a turn halves what lies across its axis: theta / 2 / tan(theta / 2) = 0 leaves
    # the cross product alone, pi / 2 times the tangent.
    derivative = inverse_right_jacobian(phi)
    expected = np.sqrt(np.diag(derivative @ derivative.T)) * 0.5 * DEG
    np.testing.assert_allclose(found.std(axis=0), expected, rtol=0.1)
    np.testing.assert_allclose(expected / (0.5 * DEG), [np.pi / 2, np.pi / 2, 1.0])


def test_right_jacobian_and_its_inverse():
    rng = np.random.default_rng(0)
    for scale in (0.0, 1e-5, 1e-4, 0.1, 1.0, 3.0, 4.5):
        phi = rng.normal(size=3)
        phi *= scale / np.linalg.norm(phi)
        step = 1e-6
        columns = [
            log_so3(exp_so3(phi - h).T @ exp_so3(phi + h)) / (2.0 * step) for h in np.eye(3) * step
        ]
        np.testing.assert_allclose(right_jacobian(phi), np.stack(columns, axis=1), atol=1e-8)
        product = right_jacobian(phi) @ inverse_right_jacobian(phi)
        np.testing.assert_allclose(product, np.eye(3), atol=1e-11)


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
@pytest.mark.parametrize("rph", [[0, 0, 0], [10, -20, 137], [-40, 60, 300]], ids=str)
def test_covariance_of_roll_pitch_heading_by_monte_carlo(body_axes, rph):
    rph = np.array(rph) * DEG
    nRb = rotation_from_rph(rph, body_axes)
    rng = np.random.default_rng(0)
    theta = rng.normal(size=(20_000, 3)) @ (np.diag([0.02, 0.08, 0.05]) * DEG)
    theta = theta @ np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]])
    error = rph_from_rotation(nRb @ exp_so3(theta), body_axes) - rph
    error = wrapped(error)
    derivative = rph_jacobian(rph, body_axes)
    assert worst_relative(np.cov(error.T), derivative @ np.cov(theta.T) @ derivative.T) < 0.01


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0, 170.0])
@pytest.mark.parametrize("axis", [[0, 0, 1], [1, -2, 2]], ids=str)
def test_covariance_of_the_rotation_vector_by_monte_carlo(axis, angle):
    phi = angle * DEG * np.array(axis) / np.linalg.norm(axis)
    tangent = np.diag([0.05, 0.2, 0.1]) * DEG
    rng = np.random.default_rng(0)
    n = 20_000
    draws = rng.normal(size=(n, 3)) @ tangent
    found = log_so3(exp_so3(phi) @ exp_so3(draws)) - phi
    derivative = inverse_right_jacobian(phi)
    stated = derivative @ tangent @ tangent.T @ derivative.T
    # Standard deviations of 20000 draws scatter by 0.5 %, correlations by 0.7 %.
    np.testing.assert_allclose(found.std(axis=0), np.sqrt(np.diag(stated)), rtol=0.025)
    assert worst_relative(np.cov(found.T), stated) < 0.04
    if angle >= 30.0:
        # Without the transport it would be wrong.
        assert worst_relative(np.cov(found.T), tangent @ tangent.T) > 0.1


@pytest.mark.parametrize("angle", [0.0, 1e-160, 1e-9, 1e-3, 1.0, 2.0, 3.1])
def test_the_logarithm_is_exact_at_every_angle(angle):
    axes = np.random.default_rng(2).standard_normal((20, 3))
    phi = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    np.testing.assert_allclose(log_so3(exp_so3(phi)), phi, atol=1e-15, rtol=1e-13)
    np.testing.assert_allclose(log_so3(exp_so3(phi[0])), phi[0], atol=1e-15, rtol=1e-13)
