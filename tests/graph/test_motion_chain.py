"""A white-acceleration prior with processes, and the normal equations of a bordered chain."""

import numpy as np
import pytest

from factorgraph_dvl.graph.bordered_chain import NormalEquations
from factorgraph_dvl.graph.motion_chain import ChainProcess, MotionChain, chain_nodes

TIME = np.array([0.0, 1.7, 3.0, 8.0])


@pytest.fixture
def chain():
    density = np.array([[0.3, 0.3, 0.1], [0.2, 0.2, 0.1], [0.3, 0.3, 0.2]])
    return MotionChain(TIME, density, (ChainProcess("current", np.array([0.2, 0.2]), 50.0),))


def covariance_between(t, q):
    return q * np.array([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]])


def test_the_state_between_nodes_is_the_mean_of_the_process(chain):
    t = 0.6
    at = chain.at(np.array([TIME[1] + t]))
    span, q = TIME[2] - TIME[1], 0.2
    forward = np.array([[1.0, span - t], [0.0, 1.0]])
    own = covariance_between(t, q)
    after = own @ forward.T @ np.linalg.inv(covariance_between(span, q))
    before = np.array([[1.0, t], [0.0, 1.0]]) - after @ np.array([[1.0, span], [0.0, 1.0]])
    rows = np.ix_([0, 3], [0, 3])
    assert at.node == [1]
    every = np.eye(8)[None]
    (by_before,), (by_after,) = at.by_nodes(every)
    (variance,) = at.variance(every)
    np.testing.assert_allclose(by_before[rows], before, atol=1e-12)
    np.testing.assert_allclose(by_after[rows], after, atol=1e-12)
    np.testing.assert_allclose(variance[rows], own - after @ forward @ own, atol=1e-12)
    known = by_before[6, 6] * np.exp(-t / 50.0) + by_after[6, 6] * np.exp(-(span - t) / 50.0)
    assert variance[6, 6] == pytest.approx(1.0 - known)
    states = np.random.default_rng(1).standard_normal((4, 8))
    expected = by_before @ states[1] + by_after @ states[2]
    np.testing.assert_allclose(at.states(states)[0], expected, atol=1e-12)


def test_acceleration_is_the_slope_of_the_velocity(chain):
    states = np.random.default_rng(1).standard_normal((4, 8))

    def velocity(t):
        return chain.at(np.array([t])).states(states)[0, 3:6]

    at = chain.at(np.array([2.2]))
    slope = (velocity(2.2 + 1e-5) - velocity(2.2 - 1e-5)) / 2e-5
    np.testing.assert_allclose(at.accelerations(states)[0], slope, atol=1e-6)


def test_transitions_whiten_the_noise_of_a_step(chain):
    before, after = chain.transitions()
    Q = covariance_between(TIME[1], 0.3)
    W = after[0][np.ix_([0, 3], [0, 3])]
    np.testing.assert_allclose(W @ Q @ W.T, np.eye(2), atol=1e-12)
    F = np.array([[1.0, TIME[1]], [0.0, 1.0]])
    np.testing.assert_allclose(before[0][np.ix_([0, 3], [0, 3])], -W @ F, atol=1e-12)


def test_nodes_are_sparse_on_legs_and_dense_in_turns():
    time = np.arange(30.0)
    turning = (time > 9.0) & (time < 15.0)
    nodes = chain_nodes(time, turning, 5.0)
    np.testing.assert_array_equal(nodes, [0, 5, 10, 11, 12, 13, 14, 19, 24, 29])


def test_covariances_and_step_are_those_of_the_dense_system():
    rng = np.random.default_rng(2)
    k, n, c = 5, 3, 2
    equations = NormalEquations(k, n, c)
    node = np.repeat(np.arange(k - 1), 4)
    J = rng.standard_normal((node.size, 3, 2 * n + c))
    residual = rng.standard_normal((node.size, 3))
    equations.add(node, J[:, :, :n], J[:, :, n : 2 * n], J[:, :, 2 * n :], residual)
    dense = np.zeros((node.size, 3, k * n + c))
    for i, at in enumerate(node):
        dense[i, :, at * n : (at + 2) * n] = J[i, :, : 2 * n]
        dense[i, :, k * n :] = J[i, :, 2 * n :]
    A = dense.reshape(-1, k * n + c)
    P = np.linalg.inv(A.T @ A)
    factors = equations.factorise()
    step = -P @ A.T @ residual.ravel()
    nodes, constants = factors.step()
    np.testing.assert_allclose(np.append(nodes, constants), step, atol=1e-9)
    assert factors.log_determinant == pytest.approx(-np.linalg.slogdet(P)[1])
    found = factors.covariances().around(np.array([2]))[0]
    rows = [*range(2 * n, 4 * n), *range(k * n, k * n + c)]
    np.testing.assert_allclose(found, P[np.ix_(rows, rows)], atol=1e-9)
    sums = rng.standard_normal((k * n + c, 2))
    with_sums = factors.covariance_with(sums[: k * n].reshape(k, n, 2), sums[k * n :])
    of_nodes = with_sums[0].reshape(k * n, 2)
    np.testing.assert_allclose(np.vstack([of_nodes, with_sums[1]]), P @ sums, atol=1e-9)
