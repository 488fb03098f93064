"""The prior of smooth motion: residuals, Jacobians, the motion between nodes and its variance."""

from __future__ import annotations

from dataclasses import fields, replace

import gtsam
import numpy as np
import pytest
from scipy.linalg import block_diag

from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.vectors import rotate
from factorgraph_dvl.graph.smooth_motion import (
    Place,
    SmoothStates,
    interpolated,
    motion_steps,
    turns_of,
    variance_between,
)
from factorgraph_dvl.sensors.protocol import Linearization

TIME = np.array([0.0, 0.7, 2.0, 4.5, 5.0, 6.1])
SPANS = np.diff(TIME)
# Times after given nodes: inside, at nodes, and beyond these on both sides.
NODE = np.array([0, 0, 1, 2, 3, 4, 4, 0, 2, 3])
AT = np.array([0.0, 0.2, 1.1, 3.9, 4.6, 6.1, 6.5, -0.3, 1.8, 5.2])
# What the clock of attitudes is late by: either may be beyond nodes by itself.
TURNED = AT + np.array([0.0, 0.1, -0.05, 0.3, 0.45, -0.2, 0.1, 0.2, 0.3, -0.1])
# Nodes of attitudes: the same, or others.
TURNED_NODE = np.array([0, 0, 0, 2, 4, 4, 4, 0, 2, 4])
DENSITY = np.array([1e-3, 2e-3, 5e-4, 0.02, 0.01, 0.03])
VARYING = DENSITY * np.linspace(1.0, 3.0, SPANS.size)[:, None]
# Standard deviations of the turn from node to node, rad.
SIZES = [0.0, 1e-9, 1e-4, 0.1, 1.0]
BLOCKS = ("d_theta", "d_p", "d_v", "d_omega")


def scene(size):
    """Return states, and level axes of a track; turns between nodes have sigma `size`."""
    rng = np.random.default_rng(0)

    def draw(scale):
        return scale * rng.standard_normal((TIME.size, 3))

    def chained(first, steps):
        out = [exp_so3(np.array(first))]
        for step in exp_so3(steps[1:]):
            out.append(out[-1] @ step)
        return np.array(out)

    nRb = chained([0.4, -0.9, 2.0], draw(size))
    nRt = chained([0.0, 0.0, -1.2], draw(size) * [0.0, 0.0, 1.0])
    p_n = 10.0 + np.cumsum(draw(2.0), axis=0)
    return SmoothStates(nRb, p_n, draw(2.0), draw(size)), nRt


def steady(time):
    """Return states that keep rates of the body and a velocity along turning level axes."""
    nRb = exp_so3(np.array([0.4, -0.9, 2.0])) @ exp_so3(time[:, None] * [0.1, -0.05, 0.4])
    rate, u = 0.3, np.array([3.0, 0.5, -0.2])
    turn, to_port = rate * time, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    nRt = exp_so3(np.array([0.0, 0.0, 1.0]) * turn[:, None])
    level = np.diag([1.0, 1.0, 0.0])
    sine, cosine = np.sin(turn)[:, None], np.cos(turn)[:, None]
    p_n = (sine * (level @ u) + (1.0 - cosine) * (to_port @ u)) / rate
    p_n = [10.0, 20.0, -5.0] + p_n + time[:, None] * [0.0, 0.0, u[2]]
    omega = np.tile([0.1, -0.05, 0.4], (time.size, 1))
    return SmoothStates(nRb, p_n, nRt @ u, omega), nRt


def steps_of(states, nRt, time=TIME, density=VARYING):
    return motion_steps(turns_of(time, states), states, nRt, density)


def places(node, time, nodes=TIME):
    return Place(node, time - nodes[node], np.diff(nodes)[node])


def motion_at(states, node=NODE, at=AT, turned=TURNED, turned_node=TURNED_NODE):
    return interpolated(
        turns_of(TIME, states), states, places(node, at), places(turned_node, turned)
    )


def difference(motion, from_motion):
    """Return motion minus motion, in the rows of a Jacobian."""
    theta = log_so3(from_motion.nRb.swapaxes(1, 2) @ motion.nRb)
    names = ("p_n", "v_n", "omega_eb_b")
    rest = [getattr(motion, n) - getattr(from_motion, n) for n in names]
    return np.concatenate([theta, *rest], axis=1)


def numerical(function, states):
    """Return derivatives (K, 12, ...) of function(states) by the tangent of every node.

    Turn and rate, then position and velocity.
    """
    h = 1e-6
    out = []
    for k in range(TIME.size):
        for i in range(12):
            step = np.zeros((TIME.size, 12))
            step[k, i] = h
            up, down = function(states.retracted(step)), function(states.retracted(-step))
            out.append((up - down) / (2.0 * h))
    return np.array(out).reshape(TIME.size, 12, *out[0].shape)


def identity_rows(count):
    """Return residuals that are the changes of the motion itself."""
    one = np.broadcast_to(np.eye(12), (count, 12, 12))
    own = {name: one[:, :, 3 * i : 3 * i + 3] for i, name in enumerate(BLOCKS)}
    return Linearization(np.zeros((count, 12)), **own)


def test_steady_motion_leaves_no_residual():
    states, nRt = steady(TIME)
    np.testing.assert_allclose(steps_of(states, nRt).residual, 0.0, atol=1e-11)
    faster = replace(states, v_n=1.1 * states.v_n)
    assert np.abs(steps_of(faster, nRt).residual[:, 3:6]).max() > 0.1
    # The same velocity along axes that do not turn accelerates.
    assert np.abs(steps_of(states, np.tile(nRt[0], (TIME.size, 1, 1))).residual).max() > 0.1


def test_a_step_by_hand():
    # A quarter of a turn to port in 2 s, over a chord of 4 m along the first axis.
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    nRb = np.array([np.eye(3), quarter])
    p_n = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    states = SmoothStates(nRb, p_n, np.zeros((2, 3)), np.zeros((2, 3)))
    time, density = np.array([0.0, 2.0]), np.full((1, 6), 3.0)
    residual = steps_of(states, nRb, time, density).residual[0]
    # An arc of radius 4 / sqrt(2), pi long along each axis, leads 45 degrees to starboard.
    moved = np.array([0.0, 0.0, np.pi / 2.0, np.pi, -np.pi, 0.0])
    # Q = 3 [8/3 2; 2 2] = [8 6; 6 6]: its lower root is [sqrt(8) 0; 6/sqrt(8) sqrt(1.5)].
    first = moved / np.sqrt(8.0)
    second = -6.0 / np.sqrt(8.0) * first / np.sqrt(1.5)
    np.testing.assert_allclose(residual, [*first, *second], atol=1e-14)
    # 2 m/s to the east is ahead in the end, and to port in the beginning: the shift that is left
    # is 2 * 2 m less to port, and u changes by [2, -2, 0].
    moving = replace(states, v_n=np.tile([0.0, 2.0, 0.0], (2, 1)))
    residual = steps_of(moving, nRb, time, density).residual[0]
    first = np.array([np.pi, -np.pi - 4.0, 0.0]) / np.sqrt(8.0)
    second = (np.array([2.0, -2.0, 0.0]) - 6.0 / np.sqrt(8.0) * first) / np.sqrt(1.5)
    np.testing.assert_allclose(residual[3:6], first, atol=1e-14)
    np.testing.assert_allclose(residual[9:], second, atol=1e-14)


def test_half_way_by_hand():
    # From rest at 0 to 8 m and 3 m/s within 2 s, about an axis to 0.8 rad and 0.3 rad/s.
    one = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    states = SmoothStates(exp_so3(0.8 * one), 8.0 * one, 3.0 * one, 0.3 * one)
    time, half = np.array([0.0, 2.0]), np.ones(1)
    turns = turns_of(time, states)
    middle = places(np.zeros(1, dtype=int), half, time)
    found = interpolated(turns, states, middle, middle).motion
    # Half the way less T/8 of the rate; 3/2 of the mean rate less a quarter of that at the end.
    assert found.p_n[0, 2] == pytest.approx(4.0 - 0.75)
    assert found.v_n[0, 2] == pytest.approx(6.0 - 0.75)
    assert found.a_n[0, 2] == pytest.approx(1.5)
    assert log_so3(found.nRb)[0, 2] == pytest.approx(0.4 - 0.075)
    assert found.omega_eb_b[0, 2] == pytest.approx(0.6 - 0.075)
    assert found.alpha_b[0, 2] == pytest.approx(0.15)


@pytest.mark.parametrize("size", SIZES)
def test_jacobians_of_steps(size):
    states, nRt = scene(size)
    steps = steps_of(states, nRt)
    expected = numerical(lambda s: steps_of(s, nRt).residual, states)
    scale = np.abs(expected).max()
    for k in range(SPANS.size):
        np.testing.assert_allclose(steps.before[k], expected[k, :, k].T, atol=2e-8 * scale)
        np.testing.assert_allclose(steps.after[k], expected[k + 1, :, k].T, atol=2e-8 * scale)


@pytest.mark.parametrize("size", SIZES)
def test_jacobians_between_nodes(size):
    states, _ = scene(size)
    between, lin = motion_at(states), identity_rows(AT.size)
    found = between.by_nodes(lin)
    expected = numerical(lambda s: difference(motion_at(s).motion, between.motion), states)
    for m, (k, j) in enumerate(zip(TURNED_NODE, NODE, strict=True)):
        around = (expected[k, :6, m], expected[k + 1, :6, m])
        around += (expected[j, 6:, m], expected[j + 1, 6:, m])
        both = np.concatenate([each.T for each in around], axis=1)
        for row in range(0, 12, 3):
            some = slice(row, row + 3)
            atol = 1e-8 * max(1.0, np.abs(both[some]).max())
            np.testing.assert_allclose(found[m, some], both[some], rtol=1e-7, atol=atol)
    # What depends on some of the motion only has the same rows.
    for i, name in enumerate(BLOCKS):
        own, some = Linearization(lin.residual, **{name: getattr(lin, name)}), [3 * i, 3 * i + 3]
        part = between.by_nodes(own)
        np.testing.assert_allclose(part[:, slice(*some)], found[:, slice(*some)], atol=1e-12)
        assert not np.delete(part, range(*some), axis=1).any()


def test_the_frame_n_does_not_matter_and_transposed_axes_do():
    states, nRt = scene(0.4)
    turn = exp_so3(np.array([0.3, -1.1, 0.7]))
    p_n, v_n = rotate(turn[None], states.p_n), rotate(turn[None], states.v_n)
    turned = SmoothStates(turn @ states.nRb, p_n, v_n, states.omega_b)
    first, second = steps_of(states, nRt), steps_of(turned, turn @ nRt)
    np.testing.assert_allclose(second.residual, first.residual, atol=1e-9)
    # Positions and velocities are in n.
    back = block_diag(np.eye(6), turn, turn)
    for one, other in zip(first[1:], second[1:], strict=True):
        np.testing.assert_allclose(other @ back, one, atol=1e-9)
    here, there = motion_at(states), motion_at(turned)
    np.testing.assert_allclose(there.motion.nRb, turn @ here.motion.nRb, atol=1e-12)
    for name in ("omega_eb_b", "alpha_b"):
        there_, here_ = getattr(there.motion, name), getattr(here.motion, name)
        np.testing.assert_allclose(there_, here_, atol=1e-12)
    for name in ("p_n", "v_n", "a_n"):
        there_, here_ = getattr(there.motion, name), getattr(here.motion, name)
        np.testing.assert_allclose(there_, here_ @ turn.T, atol=1e-9)
    back = turn.T @ there.missing(VARYING, turn @ nRt) @ turn
    np.testing.assert_allclose(back, here.missing(VARYING, nRt), atol=1e-12)
    wrong = replace(states, nRb=states.nRb.swapaxes(1, 2))
    assert np.abs(steps_of(wrong, nRt).residual - first.residual).max() > 1.0
    transposed = steps_of(states, nRt.swapaxes(1, 2)).residual
    assert np.abs(transposed - first.residual).max() > 1.0
    assert np.abs(difference(motion_at(wrong).motion, here.motion)).max() > 0.1
    assert np.abs(here.missing(VARYING, nRt.swapaxes(1, 2)) - back).max() > 1e-3


@pytest.mark.parametrize("size", SIZES)
def test_each_is_the_derivative_in_time_of_the_other(size):
    states, _ = scene(size)
    # At nodes accelerations jump.
    inside, h = ~np.isin(AT, TIME), 1e-5
    node, at, turned, other = (each[inside] for each in (NODE, AT, TURNED, TURNED_NODE))
    up, down, here = (
        motion_at(states, node, at + s, turned + s, other).motion for s in (h, -h, 0.0)
    )
    slope = difference(up, down) / (2.0 * h)
    np.testing.assert_allclose(slope[:, :3], here.omega_eb_b, atol=1e-7)
    np.testing.assert_allclose(slope[:, 3:6], here.v_n, atol=1e-7)
    np.testing.assert_allclose(slope[:, 6:9], here.a_n, atol=1e-7)
    np.testing.assert_allclose(slope[:, 9:], here.alpha_b, atol=1e-7)
    np.testing.assert_array_equal(here.omega_sigma, 0.0)


@pytest.mark.parametrize("size", SIZES)
def test_at_both_nodes_it_is_the_nodes_and_goes_on_from_there(size):
    states, _ = scene(size)
    before = np.arange(SPANS.size)
    for k in (before, before + 1):
        for late in (0.0, 1e-9, -1e-9):
            time = TIME[k] + late
            found = motion_at(states, before, time, time, before).motion
            np.testing.assert_allclose(found.nRb, states.nRb[k], atol=1e-8)
            np.testing.assert_allclose(found.p_n, states.p_n[k], atol=1e-7)
            np.testing.assert_allclose(found.v_n, states.v_n[k], atol=1e-7)
            np.testing.assert_allclose(found.omega_eb_b, states.omega_b[k], atol=1e-7)
    beyond = motion_at(states, before, TIME[1:] + 2.0, TIME[1:], before).motion
    np.testing.assert_allclose(beyond.p_n, states.p_n[1:] + 2.0 * states.v_n[1:], atol=1e-11)
    np.testing.assert_allclose(beyond.v_n, states.v_n[1:], atol=1e-12)
    np.testing.assert_array_equal(beyond.a_n, 0.0)


def white_acceleration(time):
    """Return the information matrix of values and rates at K times, as (K, 2, K, 2)."""
    out = np.zeros((time.size, 2, time.size, 2))
    for k, t in enumerate(np.diff(time)):
        Q = np.array([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]])
        rows = np.zeros((2, time.size, 2))
        rows[:, k], rows[:, k + 1] = -np.array([[1.0, t], [0.0, 1.0]]), np.eye(2)
        out += np.einsum("akb,ac,cld->kbld", rows, np.linalg.inv(Q), rows)
    return out


# Times before, at and after nodes, the first and last beyond all of them.
DENSE = np.array([-1.5, 0.0, 0.4, 1.0, 1.7, 2.6, 2.9])
KNOWN = np.isin(DENSE, [0.0, 1.0, 2.6])


def test_given_nodes_it_is_the_process_of_white_acceleration():
    information = white_acceleration(DENSE)
    among, of_nodes = (information[~KNOWN][:, :, some].reshape(8, -1) for some in (~KNOWN, KNOWN))
    P = np.linalg.inv(among).reshape(4, 2, 4, 2)
    time, at, node = DENSE[KNOWN], DENSE[~KNOWN], np.array([0, 0, 1, 1])
    value, both, rate = variance_between(at - time[node], np.diff(time)[node])
    expected = np.array([P[m, :, m] for m in range(4)])
    np.testing.assert_allclose(value, expected[:, 0, 0], rtol=1e-9)
    np.testing.assert_allclose(both, expected[:, 0, 1], rtol=1e-9)
    np.testing.assert_allclose(rate, expected[:, 1, 1], rtol=1e-9)
    # Its mean is what is interpolated.
    p_n, v_n = np.random.default_rng(4).standard_normal((2, 3, 3))
    states = SmoothStates(np.tile(np.eye(3), (3, 1, 1)), p_n, v_n, np.zeros((3, 3)))
    mean = -np.linalg.solve(among, of_nodes @ np.stack([p_n, v_n], axis=1).reshape(6, 3))
    place = places(node, at, time)
    found = interpolated(turns_of(time, states), states, place, place).motion
    np.testing.assert_allclose(found.p_n, mean[0::2], atol=1e-9)
    np.testing.assert_allclose(found.v_n, mean[1::2], atol=1e-9)


# Densities hold along axes at the times themselves here, and between nodes there: what differs
# is of first order in the turn.
@pytest.mark.parametrize(("turn", "tolerance"), [(0.0, 1e-8), (1e-4, 1e-3)])
def test_what_is_missing_is_the_covariance_of_the_prior_given_the_nodes(turn, tolerance):
    rates = turn * np.array([0.3, -0.2, 1.0])
    nRb = exp_so3(np.array([0.4, -0.9, 2.0])) @ exp_so3(DENSE[:, None] * rates)
    nRt = exp_so3(np.array([0.0, 0.0, -1.2]) + DENSE[:, None] * [0.0, 0.0, turn])
    v_n = nRt @ np.array([3.0, 0.5, 0.0])
    p_n = np.cumsum(v_n * np.diff(DENSE, prepend=DENSE[0])[:, None], axis=0)
    states = SmoothStates(nRb, p_n, v_n, np.tile(rates, (DENSE.size, 1)))
    density = np.repeat([DENSITY, 2.0 * DENSITY], [3, 3], axis=0)
    steps = steps_of(states, nRt, DENSE, density)
    information = np.zeros((DENSE.size * 12,) * 2)
    for k in range(DENSE.size - 1):
        J, some = np.concatenate([steps.before[k], steps.after[k]], axis=1), 12 * k
        information[some : some + 24, some : some + 24] += J.T @ J
    free = np.repeat(~KNOWN, 12)
    P = np.linalg.inv(information[free][:, free]).reshape(4, 12, 4, 12)
    known = SmoothStates(*(getattr(states, f.name)[KNOWN] for f in fields(SmoothStates)))
    time, at, node = DENSE[KNOWN], DENSE[~KNOWN], np.array([0, 0, 1, 1])
    place = places(node, at, time)
    between = interpolated(turns_of(time, known), known, place, place)
    found = between.missing(density[[1, 4]], nRt[KNOWN])
    for m, to_n in enumerate(nRb[~KNOWN]):
        # Attitudes turn about axes of the body; positions and velocities are in n.
        for i, (first, axes) in enumerate(((0, to_n), (6, np.eye(3)), (9, np.eye(3)))):
            own = P[m, first : first + 3, m, first : first + 3]
            expected = axes @ own @ axes.T
            atol = tolerance * np.abs(expected).max()
            np.testing.assert_allclose(found[m, i], expected, atol=atol)


def test_residuals_of_paths_of_the_prior_have_unit_covariance():
    # White angular acceleration about the axes of the body, and acceleration along those of a
    # track that turns; in steps so small that these axes stand still.
    rng = np.random.default_rng(5)
    count, parts, span, rate = 20_000, 20, 0.8, 0.01
    h = span / parts
    root = np.linalg.cholesky([[h**3 / 3.0, h**2 / 2.0], [h**2 / 2.0, h]])
    density = 1e-3 * DENSITY
    nRb = exp_so3(rng.standard_normal((count, 3)))
    nRt = exp_so3(rng.uniform(-3.0, 3.0, (count, 1)) * [0.0, 0.0, 1.0])
    omega, u = 0.01 * rng.standard_normal((count, 3)), 3.0 * rng.standard_normal((count, 3))
    p_n = np.zeros((count, 3))
    path = [(nRb, p_n, rotate(nRt, u), omega, nRt)]
    middle, on = (gtsam.Rot3.Rz(a).matrix() for a in (0.5 * rate * h, rate * h))
    for _ in range(parts):
        noise = np.einsum("ab,mbi->mai", root, rng.standard_normal((count, 2, 6)))
        value, slope = np.swapaxes(noise * np.sqrt(density), 0, 1)
        nRb = nRb @ exp_so3(h * omega + value[:, :3])
        p_n = p_n + rotate(nRt @ middle, h * u + value[:, 3:])
        omega, u, nRt = omega + slope[:, :3], u + slope[:, 3:], nRt @ on
    path.append((nRb, p_n, rotate(nRt, u), omega, nRt))
    time = (10.0 * np.arange(count)[:, None] + [0.0, span]).ravel()
    *of_states, nRt = (
        np.stack(each, axis=1).reshape(2 * count, *each[0].shape[1:])
        for each in zip(*path, strict=True)
    )
    every = np.broadcast_to(density, (2 * count - 1, 6))
    residual = steps_of(SmoothStates(*of_states), nRt, time, every).residual[::2]
    error = np.sqrt(np.where(np.eye(12), 2.0, 1.0) / count)
    # Five standard errors: 78 covariances exceed this by chance in one of 20 000 trials.
    assert np.abs((residual.T @ residual / count - np.eye(12)) / error).max() < 5.0
    assert np.abs(residual.mean(axis=0)).max() < 5.0 / np.sqrt(count)
