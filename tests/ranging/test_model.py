"""The planar graph: zero error at the truth, Jacobians."""

from __future__ import annotations

import numpy as np
import pytest
from planar import ALL_CONSTANTS, trial, true_state

from factorgraph_dvl.ranging.model import evaluate, step_errors
from factorgraph_dvl.ranging.problem import planar_setup


@pytest.mark.parametrize("constant", ["heading", "beacons"])
def test_zero_error_at_the_truth(constant):
    # The lever arm lies along the heading as it is measured, so not both at once.
    others = {name: ALL_CONSTANTS[name] for name in ("log", constant)}
    t = trial(noise=False, **others)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    at = evaluate(problem, x, theta)
    error, _ = step_errors(problem, x, theta)
    r = problem.ranging
    # The turn is abrupt: where it begins and ends, halfway between samples, the trapezoid
    # misses by centimetres; the reference is interpolated as well.
    assert np.abs(at.range_residual * r.range_std).max() < 2e-3
    assert np.median(np.abs(at.rate_residual * r.rate_std)) < 1e-4
    assert np.median(np.abs(error)) < 1e-3
    assert np.abs(error).max() < 0.05


def test_jacobians_against_differences():
    t = trial(**ALL_CONSTANTS)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    n = 20
    rng = np.random.default_rng(1)
    x = x[:n] + rng.normal(0.0, [3.0, 3.0, 0.05, 0.05], (n, 4))
    theta = theta + 0.5 * problem.prior_sigma * rng.normal(size=theta.size)
    at = evaluate(problem, x, theta)
    node = problem.ranging.node[: at.range_residual.size]
    for i in range(4):
        h = np.zeros(4)
        h[i] = 1e-4
        a, b = (evaluate(problem, x + s * h, theta) for s in (1, -1))
        for name, by in (("range_residual", at.range_x), ("rate_residual", at.rate_x)):
            found = (getattr(a, name) - getattr(b, name)) / 2e-4
            np.testing.assert_allclose(by[:, i], found, atol=2e-5)
    for i in range(theta.size):
        h = np.zeros(theta.size)
        h[i] = 1e-4 * problem.prior_sigma[i]
        a, b = (evaluate(problem, x, theta + s * h) for s in (1, -1))
        for name, by in (("range_residual", at.range_theta), ("rate_residual", at.rate_theta)):
            found = (getattr(a, name) - getattr(b, name)) / (2 * h[i])
            np.testing.assert_allclose(by[:, i], found, atol=2e-6 * max(1, np.abs(found).max()))
        c, d = (step_errors(problem, x, theta + s * h)[0] for s in (1, -1))
        _, through = step_errors(problem, x, theta)
        by = -problem.by_constants(through, theta, np.diff(problem.time[:n]))[:, :, i]
        found = (c - d) / (2 * h[i])
        np.testing.assert_allclose(by, found, atol=2e-6 * max(1, np.abs(found).max()))
    assert node.size >= n - 1
