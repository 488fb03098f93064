"""The prior of smooth motion: residuals, Jacobians, the motion between nodes and its variance."""

from dataclasses import fields

import gtsam
import numpy as np
import pytest

from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.vectors import rotate
from factorgraph_dvl.graph.smooth_motion import (
    SmoothStates,
    interpolated,
    motion_steps,
)

TIME = np.array([0.0, 0.7, 2.0, 4.5, 5.0, 6.1])
AT = np.array([0.0, 0.2, 0.7, 1.1, 3.9, 4.6, 5.9, 6.1])
DENSITY = np.array([1e-3, 2e-3, 5e-4, 0.02, 0.01, 0.03])
# Standard deviations of the turn from node to node, rad.
SIZES = [0.0, 1e-9, 1e-4, 0.1, 1.0]
# What the motion consists of, as the rows of a Jacobian do.
EVERY = np.broadcast_to(np.eye(12), (AT.size, 12, 12))


def scene(size, seed=0):
    """Return states near some motion, and currents; turns between nodes have sigma `size`."""
    rng = np.random.default_rng(seed)
    steps = exp_so3(size * rng.standard_normal((TIME.size, 3)))
    nRb = [exp_so3([0.4, -0.9, 2.0])]
    for step in steps[1:]:
        nRb.append(nRb[-1] @ step)
    current = np.array([0.4, -0.3, 0.0]) * rng.standard_normal((TIME.size - 1, 1))
    states = SmoothStates(
        np.array(nRb),
        1000.0 + np.cumsum(2.0 * size * rng.standard_normal((TIME.size, 3)), axis=0),
        current[[0, 0, 1, 2, 3, 4]] + 2.0 * size * rng.standard_normal((TIME.size, 3)),
        size * rng.standard_normal((TIME.size, 3)),
    )
    return states, current


def changed(states, node, column, step):
    delta = np.zeros((TIME.size, 12))
    delta[node, column] = step
    return states.retracted(delta)


def numerical(function, states, current):
    """Return derivatives of function(states, current) by every node's tangent and current."""
    h = 1e-6
    by_nodes = [
        [
            (
                function(changed(states, k, i, h), current)
                - function(changed(states, k, i, -h), current)
            )
            / (2.0 * h)
            for i in range(12)
        ]
        for k in range(TIME.size)
    ]
    by_current = []
    for k in range(TIME.size - 1):
        for i in range(3):
            up, down = current.copy(), current.copy()
            up[k, i] += h
            down[k, i] -= h
            by_current.append((function(states, up) - function(states, down)) / (2.0 * h))
    return np.array(by_nodes), np.array(by_current).reshape(TIME.size - 1, 3, *by_current[0].shape)


def difference(motion, from_motion):
    """Return motion minus motion, in the rows of a Jacobian."""
    theta = log_so3(from_motion.nRb.swapaxes(1, 2) @ motion.nRb)
    names = ("p_n", "v_n", "omega_eb_b")
    rest = [getattr(motion, n) - getattr(from_motion, n) for n in names]
    return np.concatenate([theta, *rest], axis=1)


def constant_twist(twist, current, time):
    """Return states of a body that keeps a twist through the water."""
    start = gtsam.Pose3(gtsam.Rot3(exp_so3([0.4, -0.9, 2.0])), np.array([10.0, 20.0, -5.0]))
    poses = [start.compose(gtsam.Pose3.Expmap(twist * t)) for t in time]
    nRb = np.array([p.rotation().matrix() for p in poses])
    p_n = np.array([p.translation() for p in poses]) + time[:, None] * current
    omega = np.tile(twist[:3], (time.size, 1))
    return SmoothStates(nRb, p_n, nRb @ twist[3:] + current, omega)


@pytest.mark.parametrize("turn", [0.0, 0.3, 0.9])
def test_a_constant_twist_through_the_water_leaves_no_residual(turn):
    twist = np.array([0.3 * turn, -0.2 * turn, turn, 3.0, 0.5, -0.2])
    current = np.array([0.5, -0.8, 0.0])
    states = constant_twist(twist, current, TIME)
    steps = motion_steps(TIME, states, np.tile(current, (TIME.size - 1, 1)), DENSITY)
    np.testing.assert_allclose(steps.residual, 0.0, atol=1e-11)
    # Another current is seen in turns, and on a straight leg it is not.
    other = motion_steps(TIME, states, np.tile(current + 0.1, (TIME.size - 1, 1)), DENSITY)
    assert (np.abs(other.residual).max() > 0.1) == (turn > 0.0)


def test_between_nodes_of_a_constant_twist_it_stays():
    twist = np.array([0.1, -0.05, 0.4, 3.0, 0.5, -0.2])
    current = np.array([0.5, -0.8, 0.0])
    states = constant_twist(twist, current, TIME)
    found = interpolated(TIME, states, np.tile(current, (TIME.size - 1, 1)), AT).motion
    expected = constant_twist(twist, current, AT)
    np.testing.assert_allclose(found.nRb, expected.nRb, atol=1e-13)
    np.testing.assert_allclose(found.p_n, expected.p_n, atol=1e-12)
    np.testing.assert_allclose(found.v_n, expected.v_n, atol=1e-13)
    np.testing.assert_allclose(found.omega_eb_b, expected.omega_b, atol=1e-13)
    np.testing.assert_allclose(found.alpha_b, 0.0, atol=1e-12)
    turned = expected.nRb @ np.cross(twist[:3], twist[3:])
    np.testing.assert_allclose(found.a_n, turned, atol=1e-12)


def test_a_step_by_hand():
    # A quarter of a turn to port in 2 s, over a chord of 4 m along the first axis: an arc of
    # radius 4 / sqrt(2), which leads 45 degrees to starboard of the chord.
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    states = SmoothStates(
        np.array([np.eye(3), quarter]),
        np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]]),
        np.zeros((2, 3)),
        np.zeros((2, 3)),
    )
    time, density = np.array([0.0, 2.0]), np.full(6, 3.0)
    residual = motion_steps(time, states, np.zeros((1, 3)), density).residual[0]
    # The arc is sqrt(2) pi long, pi along each axis.
    gamma = np.array([0.0, 0.0, np.pi / 2.0, np.pi, -np.pi, 0.0])
    # Q = 3 [8/3 2; 2 2] = [8 6; 6 6]: its lower root is [sqrt(8) 0; 6/sqrt(8) sqrt(1.5)].
    first = gamma / np.sqrt(8.0)
    second = -6.0 / np.sqrt(8.0) * first / np.sqrt(1.5)
    np.testing.assert_allclose(residual, [*first, *second], atol=1e-14)
    # The same chord, drifted by a current of 2 m/s, is no way through the water; both nodes then
    # move backwards through it, at 2 m/s.
    drifted = motion_steps(time, states, np.array([[2.0, 0.0, 0.0]]), density).residual[0]
    np.testing.assert_allclose(drifted[:6], [0, 0, gamma[2] / np.sqrt(8), 4 / np.sqrt(8), 0, 0])


def test_whitened_by_the_covariance_of_a_step():
    states, current = scene(0.3)
    varying = DENSITY * np.linspace(1.0, 3.0, TIME.size - 1)[:, None]
    found = motion_steps(TIME, states, current, varying)
    for k, t in enumerate(np.diff(TIME)):
        (nRb, other), p = states.nRb[k : k + 2], states.p_n[k : k + 2]
        relative = nRb.T @ (p[1] - p[0] - current[k] * t)
        pose = gtsam.Pose3(gtsam.Rot3(nRb.T @ other), relative)
        gamma = gtsam.Pose3.Logmap(pose)
        twists = [
            np.concatenate([states.omega_b[i], states.nRb[i].T @ (states.v_n[i] - current[k])])
            for i in (k, k + 1)
        ]
        rate = gtsam.Pose3.LogmapDerivative(gamma) @ twists[1]
        Q = np.kron([[t**3 / 3, t**2 / 2], [t**2 / 2, t]], np.diag(varying[k]))
        e = np.concatenate([gamma - t * twists[0], rate - twists[0]])
        expected = np.linalg.solve(np.linalg.cholesky(Q), e)
        np.testing.assert_allclose(found.residual[k], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("size", SIZES)
def test_jacobians_of_steps(size):
    states, current = scene(size)
    steps = motion_steps(TIME, states, current, DENSITY)
    by_nodes, by_current = numerical(
        lambda s, c: motion_steps(TIME, s, c, DENSITY).residual, states, current
    )
    scale = np.abs(by_nodes).max()
    for k in range(TIME.size - 1):
        for found, expected in (
            (steps.before[k], by_nodes[k, :, k].T),
            (steps.after[k], by_nodes[k + 1, :, k].T),
            (steps.by_current[k], by_current[k, :, k].T),
        ):
            np.testing.assert_allclose(found, expected, atol=2e-8 * scale)


@pytest.mark.parametrize("size", SIZES)
def test_jacobians_between_nodes(size):
    states, current = scene(size)
    between = interpolated(TIME, states, current, AT)
    found = between.derivatives(EVERY)

    def motion(s, c):
        return difference(interpolated(TIME, s, c, AT).motion, between.motion)

    by_nodes, by_current = numerical(motion, states, current)
    scale = np.abs(by_nodes).max()
    for m, k in enumerate(between.node):
        for block, expected in (
            (found.before[m], by_nodes[k, :, m].T),
            (found.after[m], by_nodes[k + 1, :, m].T),
            (found.by_current[m], by_current[k, :, m].T),
        ):
            np.testing.assert_allclose(block, expected, atol=1e-7 * scale)


def test_at_the_nodes_and_beyond_the_ends_it_is_the_nodes():
    states, current = scene(0.6)
    beyond = np.concatenate([[-3.0], TIME, [9.0]])
    at = interpolated(TIME, states, current, beyond)
    k = np.clip(np.arange(-1, TIME.size + 1), 0, TIME.size - 1)
    np.testing.assert_array_equal(at.node, [0, 0, 1, 2, 3, 4, 4, 4])
    np.testing.assert_allclose(at.motion.nRb, states.nRb[k], atol=1e-13)
    np.testing.assert_allclose(at.motion.p_n, states.p_n[k], atol=1e-11)
    np.testing.assert_allclose(at.motion.v_n, states.v_n[k], atol=1e-13)
    np.testing.assert_allclose(at.motion.omega_eb_b, states.omega_b[k], atol=1e-13)
    np.testing.assert_array_equal(at.motion.omega_sigma, 0.0)
    rows = np.broadcast_to(np.eye(12), (beyond.size, 12, 12))
    np.testing.assert_allclose(at.variance(DENSITY, rows), 0.0, atol=1e-15)


@pytest.mark.parametrize("size", SIZES)
def test_each_is_the_derivative_in_time_of_the_other(size):
    states, current = scene(size)
    at, h = np.array([0.3, 1.7, 2.9, 4.8, 5.2]), 1e-5
    up, down, here = (interpolated(TIME, states, current, t).motion for t in (at + h, at - h, at))
    slope = difference(up, down) / (2.0 * h)
    omega = log_so3(down.nRb.swapaxes(1, 2) @ up.nRb) / (2.0 * h)
    np.testing.assert_allclose(omega, here.omega_eb_b, atol=1e-8)
    np.testing.assert_allclose(slope[:, 3:6], here.v_n, atol=1e-7)
    np.testing.assert_allclose(slope[:, 6:9], here.a_n, atol=2e-8)
    np.testing.assert_allclose(slope[:, 9:], here.alpha_b, atol=1e-8)


def test_the_frame_n_does_not_matter():
    # A transposed rotation would make it matter.
    states, current = scene(0.4)
    turn = exp_so3([0.3, -1.1, 0.7])
    turned = SmoothStates(
        turn @ states.nRb,
        rotate(turn[None], states.p_n),
        rotate(turn[None], states.v_n),
        states.omega_b,
    )
    first = motion_steps(TIME, states, current, DENSITY)
    second = motion_steps(TIME, turned, current @ turn.T, DENSITY)
    np.testing.assert_allclose(second.residual, first.residual, atol=1e-9)
    np.testing.assert_allclose(second.before, first.before, atol=1e-9)
    np.testing.assert_allclose(second.by_current @ turn, first.by_current, atol=1e-9)
    wrong = SmoothStates(states.nRb.swapaxes(1, 2), states.p_n, states.v_n, states.omega_b)
    assert np.abs(motion_steps(TIME, wrong, current, DENSITY).residual - first.residual).max() > 1


def conditioned(twist, time, density):
    """Return covariances of the inner nodes of a chain, given both ends, in tangent spaces."""
    current = np.array([0.5, -0.8, 0.0])
    states = constant_twist(twist, current, time)
    steps = motion_steps(time, states, np.tile(current, (time.size - 1, 1)), density)
    information = np.zeros((12 * time.size, 12 * time.size))
    for k in range(time.size - 1):
        J = np.concatenate([steps.before[k], steps.after[k]], axis=1)
        information[12 * k : 12 * k + 24, 12 * k : 12 * k + 24] += J.T @ J
    return states, np.linalg.inv(information[12:-12, 12:-12])


# Densities hold along the axes of the node before, here of the first one, there of every node:
# what differs is of first order in the turn.
@pytest.mark.parametrize(("turn", "tolerance"), [(0.0, 1e-9), (1e-4, 1e-4)])
def test_variance_is_that_of_the_process_given_both_nodes(turn, tolerance):
    time = np.linspace(0.0, 2.0, 9)
    twist = turn * np.array([0.3, -0.2, 1.0, 1.0, 0.4, 0.1])
    states, P = conditioned(twist, time, DENSITY)
    ends = SmoothStates(*(getattr(states, f.name)[[0, -1]] for f in fields(SmoothStates)))
    between = interpolated(time[[0, -1]], ends, np.array([[0.5, -0.8, 0.0]]), time[1:-1])
    rows = np.broadcast_to(np.eye(12), (7, 12, 12))
    found = between.variance(DENSITY, rows)
    for m in range(7):
        to_motion = np.eye(12)
        to_motion[3:6, 3:6] = to_motion[6:9, 6:9] = states.nRb[m + 1]
        expected = to_motion @ P[12 * m : 12 * m + 12, 12 * m : 12 * m + 12] @ to_motion.T
        sigma = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            found[m] / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=tolerance
        )
