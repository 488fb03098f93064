"""Rivals that publications cite: adaptive identification, three points, differential evolution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kalman_trials import (
    LEVER_ARM,
    MISALIGNMENT,
    SCALE,
    exact_points,
    parameter,
)

from factorgraph_dvl.baselines.evolution import evolved
from factorgraph_dvl.baselines.kinsey_whitcomb import kinsey_whitcomb
from factorgraph_dvl.baselines.navigation import NavigationMotion
from factorgraph_dvl.baselines.three_points import three_points
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.vectors import rotate

ARM = np.array([1.0, -0.5, 2.0])


def angle(a, b):
    return float(np.linalg.norm(log_so3(a.T @ b)))


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [0.0, 0.0, np.pi - 0.01], [1.0, -2.0, 0.5]])
def test_a_population_finds_any_rotation(turn):
    points = exact_points(misalignment=turn, scale=-0.03, arm=ARM)
    outcome = evolved(points, MISALIGNMENT, SCALE, LEVER_ARM)
    assert outcome.converged
    dRb, scale, arm = outcome.estimated.values
    assert angle(dRb, exp_so3(np.array(turn))) < 1e-3
    np.testing.assert_allclose(scale, -0.03, atol=1e-3)
    np.testing.assert_allclose(arm, ARM, atol=0.02)
    again = evolved(points, MISALIGNMENT, SCALE, LEVER_ARM).estimated.values[0]
    np.testing.assert_array_equal(dRb, again)


def test_a_population_keeps_what_is_known():
    points = exact_points(misalignment=[0.1, -0.2, 0.3], scale=0.02, arm=ARM)
    known = parameter("lever_arm", ARM, np.zeros(3))
    found = evolved(points, MISALIGNMENT, SCALE, known).estimated.values
    np.testing.assert_array_equal(found[2], ARM)
    assert angle(found[0], exp_so3(np.array([0.1, -0.2, 0.3]))) < 1e-4


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.5], [1.0, -2.0, 0.5], [0.0, 0.0, 3.0]])
def test_adaptive_identification_converges_at_any_scale(turn):
    points = exact_points(2000, misalignment=turn, scale=-0.03, arm=ARM)
    outcome = kinsey_whitcomb(points, MISALIGNMENT, ARM)
    assert angle(outcome.estimated.values[0], exp_so3(np.array(turn))) < 1e-6


def test_one_step_of_adaptive_identification_by_hand():
    # Ahead is taken for starboard: the estimate turns about the vertical.
    ahead = replace(
        rows_of(exact_points(2), slice(0, 1)),
        v_b=np.array([[0.0, 2.0, 0.0]]),
        omega_b=np.zeros((1, 3)),
        v_d=np.array([[2.0, 0.0, 0.0]]),
    )
    R = kinsey_whitcomb(ahead, MISALIGNMENT, np.zeros(3)).estimated.values[0]
    # From a right angle on, tan(e / 2) falls by the factor exp(-0.1).
    left = 2.0 * np.arctan(np.exp(-0.1))
    np.testing.assert_allclose(log_so3(R), [0.0, 0.0, left - np.pi / 2.0], atol=1e-12)


def test_adaptive_identification_bears_a_vehicle_that_mostly_rests():
    """The mean speed sets the gain: steps of Euler turn too far where the speed is high."""
    turn = exp_so3(np.array([0.0, 0.0, 0.5]))
    points = exact_points(2000)
    v_b = np.where(np.arange(2000) < 1980, 0.01, 1.0)[:, None] * points.v_b
    resting = replace(points, v_b=v_b, omega_b=np.zeros((2000, 3)), v_d=v_b @ turn.T)
    R = kinsey_whitcomb(resting, MISALIGNMENT, np.zeros(3)).estimated.values[0]
    assert angle(R, turn) < 1e-6


def test_a_gap_between_pings_is_no_long_step():
    points = exact_points(200, misalignment=[0.0, 0.0, 0.5], arm=ARM)
    gap = replace(points, time=points.time + 600.0 * (points.time > points.time[100]))
    found, same = (
        kinsey_whitcomb(p, MISALIGNMENT, ARM).estimated.values[0] for p in (gap, points)
    )
    np.testing.assert_array_equal(found, same)


def track(R, scale, *, leg=200.0):
    """A vehicle along two legs, and what its DVL measures: level where it starts."""
    time = np.arange(0.0, 2.0 * leg, leg / 1000.0)
    psi = np.where(time < leg, 0.3, 2.0)
    nRb = exp_so3(np.column_stack([np.zeros((time.size, 2)), psi]))
    v_b = np.tile([0.0, 3.0, 0.0], (time.size, 1))
    v_n = rotate(nRb, v_b)
    steps = 0.5 * (v_n[1:] + v_n[:-1]) * leg / 1000.0
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    frame = LocalFrame(0.6, 1.9, 0.0)
    geodetic = np.stack(frame.geodetic(position), axis=1)
    level = frame.level_from_tangent(*geodetic[:, :2].T)
    nRb, v_n = level @ nRb, rotate(level, v_n)
    P = np.broadcast_to(1e-4 * np.eye(9), (time.size, 9, 9))
    zero = np.zeros((time.size, 3))
    motion = NavigationMotion(time, geodetic, v_n, nRb, P, zero, zero, np.ones(time.size, bool))
    return motion, (1.0 + scale) * (v_b @ R.T)


# Along 30 km the vertical turns by 0.3 degrees.
@pytest.mark.parametrize("leg", [200.0, 5000.0])
def test_three_points_find_two_angles_and_the_scale(leg):
    turn = exp_so3(np.array([0.0, 0.0, 0.4])) @ exp_so3(np.array([0.05, 0.0, 0.0]))
    motion, v_d = track(turn, 0.01, leg=leg)
    outcome = three_points(motion, v_d, MISALIGNMENT, SCALE, np.zeros(3), "RFU")
    assert outcome.converged
    found, scale = outcome.estimated.values
    ahead = np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(found @ ahead, turn @ ahead, atol=1e-4)
    np.testing.assert_allclose(scale, 0.01, atol=1e-4)
    # The angle about the bow stays that of the prior, with its σ.
    std = np.sqrt(outcome.estimated.covariance.diagonal())
    np.testing.assert_allclose(std[1], 3.0, rtol=1e-6)
    assert std[[0, 2]].max() < 1e-3
    transposed = replace(motion, nRb=motion.nRb.transpose(0, 2, 1))
    wrong = three_points(transposed, v_d, MISALIGNMENT, SCALE, np.zeros(3), "RFU")
    assert np.linalg.norm(wrong.estimated.values[0] @ ahead - turn @ ahead) > 0.1


@pytest.mark.parametrize("astern", [False, True])
@pytest.mark.parametrize("degrees", [120.0, 175.0, 180.0])
def test_three_points_find_a_large_turn(degrees, astern):
    turn = exp_so3(np.array([0.0, 0.0, np.radians(degrees)]))
    motion, v_d = track(turn, 0.01)
    if astern:
        back = exp_so3(np.array([0.0, 0.0, np.pi]))
        motion, turn = replace(motion, nRb=motion.nRb @ back), turn @ back
    outcome = three_points(motion, v_d, MISALIGNMENT, SCALE, np.zeros(3), "RFU")
    assert outcome.converged
    found, scale = outcome.estimated.values
    ahead = np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(found @ ahead, turn @ ahead, atol=1e-4)
    np.testing.assert_allclose(scale, 0.01, atol=1e-4)


def test_three_points_keep_a_misalignment_that_is_known():
    motion, v_d = track(exp_so3(np.array([0.0, 0.0, 0.4])), 0.01)
    known = parameter("misalignment", np.array([0.0, 0.0, 0.3]), np.zeros(3))
    R = three_points(motion, v_d, known, SCALE, np.zeros(3), "RFU").estimated.values[0]
    assert angle(R, exp_so3(np.array([0.0, 0.0, 0.3]))) < 1e-6


def test_three_points_are_needed():
    motion, v_d = track(np.eye(3), 0.0)
    few = replace(motion, time=motion.time[:2], nRb=motion.nRb[:2], geodetic=motion.geodetic[:2])
    outcome = three_points(few, v_d[:2], MISALIGNMENT, SCALE, np.zeros(3), "RFU")
    np.testing.assert_array_equal(outcome.estimated.values[0], np.eye(3))


def test_three_points_scatter_as_their_positions_say():
    motion, v_d = track(exp_so3(np.array([0.0, 0.0, 0.4])), 0.01)
    motion, v_d = rows_of(motion, slice(None, None, 40)), v_d[::40]
    frame = LocalFrame(0.6, 1.9, 0.0)
    position = frame.position(*motion.geodetic.T)
    rng, found = np.random.default_rng(0), []
    for _ in range(600):
        noisy = position + rng.normal(0.0, 0.01, position.shape)
        moved = replace(motion, geodetic=np.stack(frame.geodetic(noisy), axis=1))
        found.append(three_points(moved, v_d, MISALIGNMENT, SCALE, np.zeros(3), "RFU").estimated)
    scale = np.array([e.values[1][0] for e in found])
    turns = np.array([log_so3(found[0].values[0].T @ e.values[0]) for e in found])
    std = np.sqrt(found[0].covariance.diagonal())
    scatter = np.append(turns.std(axis=0)[[0, 2]], scale.std())
    assert np.all(np.abs(scatter / std[[0, 2, 3]] - 1.0) < 0.1)
