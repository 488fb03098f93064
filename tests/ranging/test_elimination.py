"""Banded elimination against differences and a dense inverse."""

from __future__ import annotations

import numpy as np
import pytest
from planar import ALL_CONSTANTS, trial, true_state

from factorgraph_dvl.ranging.elimination import System
from factorgraph_dvl.ranging.model import GATE, evaluate, terms
from factorgraph_dvl.ranging.problem import planar_setup
from factorgraph_dvl.ranging.smoother import covariance, fit


def test_the_gradient_is_that_of_the_cost():
    t = trial(**ALL_CONSTANTS)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    # Over the beginning of the turn too, where the velocity changes.
    n = 160
    rng = np.random.default_rng(4)
    x = x[:n] + rng.normal(0.0, [0.3, 0.3, 0.02, 0.02], (n, 4))
    at = evaluate(problem, x, theta)
    used = tuple((np.abs(r) <= GATE).astype(float) for r in (at.range_residual, at.rate_gate))
    assert sum(u.sum() for u in used) > 2 * n - 10
    system = System(problem, x, theta, at, used, 0.0)

    def cost(x, theta):
        return terms(problem, x, theta, evaluate(problem, x, theta)).sum()

    for node in (0, 7, 150, n - 1):
        for i in range(4):
            h = np.zeros_like(x)
            h[node, i] = 1e-5
            found = (cost(x + h, theta) - cost(x - h, theta)) / 2e-5
            assert system._g[4 * node + i] == pytest.approx(found, rel=2e-4, abs=0.05)


def test_covariance_against_a_dense_inverse():
    t = trial(**ALL_CONSTANTS)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    solution = fit(problem, x[:30], theta)
    states, cross, constants = covariance(problem, solution)
    at = evaluate(problem, solution.x, solution.theta)
    weights = (solution.range_used, solution.rate_used)
    system = System(problem, solution.x, solution.theta, at, weights, 0.0)
    n, c = 30, theta.size
    dense = np.zeros((4 * n + c, 4 * n + c))
    for k in range(n):
        a = slice(4 * k, 4 * k + 4)
        dense[a, a] = system._diagonal[k]
        if k:
            b = slice(4 * k - 4, 4 * k)
            dense[b, a], dense[a, b] = system._off[k - 1], system._off[k - 1].T
    dense[: 4 * n, 4 * n :] = system._border
    dense[4 * n :, : 4 * n] = system._border.T
    dense[4 * n :, 4 * n :] = system._schur + system._border.T @ system._influence
    P = np.linalg.inv(dense)
    scale = np.sqrt(np.diag(P))
    for k in range(n):
        a = slice(4 * k, 4 * k + 4)
        np.testing.assert_allclose(states[k] / np.outer(scale[a], scale[a]),
                                   P[a, a] / np.outer(scale[a], scale[a]), atol=1e-5)  # fmt: skip
        np.testing.assert_allclose(cross[k] / np.outer(scale[a], scale[4 * n :]),
                                   P[a, 4 * n :] / np.outer(scale[a], scale[4 * n :]),
                                   atol=1e-5)  # fmt: skip
    last, _, _ = covariance(problem, solution, last_only=True)
    np.testing.assert_allclose(last[0], states[-1], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(constants, P[4 * n :, 4 * n :], rtol=1e-4, atol=1e-12)
