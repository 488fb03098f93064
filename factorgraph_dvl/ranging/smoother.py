"""The most probable track near a start, its covariance, and the ranges that are none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.ranging.elimination import System
from factorgraph_dvl.ranging.model import GATE, PlanarProblem, RangingEvaluation, evaluate, terms

_CONVERGED = 1e-6
# Relative error of a cost.
_ROUNDING = 1e-9
# Steps, m, up to which a range is as good as linear.
_STRAIGHT_M = 1.0
# How far along a step its curvature is taken, and the largest ratio to the step that is believed.
_AHEAD = 0.1
_MOST_BENT = 0.75


@dataclass(frozen=True)
class Fit:
    """A track that fits the measurements of the first n nodes.

    Parameters
    ----------
    x : ndarray, shape (n, 4)
        Positions, m, and noise of the velocity, m/s.
    theta : ndarray
        (c,) constants.
    range_used, rate_used : ndarray, shape (m,)
        Weights 0 or 1 of the measurements; 0 where there is none.
    cost : float
        Half the sum of squared whitened residuals; a rejected one counts as the gate.
    converged : bool
        Whether a full step promised no more: the last one, undamped.
    """

    x: Array
    theta: Array
    range_used: Array
    rate_used: Array
    cost: float
    converged: bool

    @property
    def p(self) -> Array:
        """Positions, (n, 2), m."""
        return self.x[:, :2]


def fit(
    problem: PlanarProblem,
    x: Array,
    theta: Array,
    *,
    graduated: bool = False,
    iterations: int = 30,
) -> Fit:
    """Return the most probable track near a start, without the measurements that do not fit.

    Truncated least squares by Gauss-Newton, damped once a step fails to lower the cost.
    Graduated, it begins with a convex surrogate of the truncated square, so that outliers
    do not decide where it ends (Yang et al., Graduated non-convexity for robust spatial
    perception, IEEE RA-L 5(2), 2020).

    Parameters
    ----------
    problem : PlanarProblem
    x : ndarray, shape (n, 4)
        Start; the first n nodes are fitted.
    theta : ndarray
        (c,) start of the constants.
    graduated : bool, default False
        Whether to begin with the surrogate.
    iterations : int, default 30
        At most so many steps.
    """
    at = evaluate(problem, x, theta)
    softness = _softness(at) if graduated else np.inf
    damping = 0.0
    converged = False
    cost = _cost(problem, x, theta, at)
    for _ in range(iterations):
        weights = _weights(at, softness)
        try:
            system = System(problem, x, theta, at, weights, damping)
        except np.linalg.LinAlgError:
            damping = max(10.0 * damping, 1e-2)
            continue
        dx, dtheta = system.step()
        if np.abs(dx[:, :2]).max() > _STRAIGHT_M:
            dx, dtheta = _bent(problem, x, theta, at, weights, system, dx, dtheta)
        trial_x, trial_theta = x + dx, theta + dtheta
        trial_at = evaluate(problem, trial_x, trial_theta)
        trial_cost = _cost(problem, trial_x, trial_theta, trial_at)
        if np.isfinite(softness):
            x, theta, at, cost = trial_x, trial_theta, trial_at, trial_cost
            softness = softness * 1.6 if softness < 100.0 else np.inf
            continue
        if trial_cost <= cost + _ROUNDING * (1.0 + cost):
            gain = cost - trial_cost
            x, theta, at, cost = trial_x, trial_theta, trial_at, trial_cost
            damping = damping / 10.0 if damping > 1e-3 else 0.0
            converged = gain < _CONVERGED and damping == 0.0
            if converged:
                break
        else:
            damping = max(10.0 * damping, 1e-2)
            if damping > 1e8:
                break
    hard = _weights(at, np.inf)
    return Fit(x, theta, *hard, cost, converged)


def graduated_weights(squares: Array, softness: float | Array) -> Array:
    """Return weights of squared whitened residuals for a softness; inf = 0 or 1 by the gate."""
    gate = GATE**2
    hard = np.isinf(softness)
    mu = np.where(hard, 1.0, softness)
    with np.errstate(divide="ignore"):
        soft = GATE / np.sqrt(squares) * np.sqrt(mu * (mu + 1.0)) - mu
    return np.where(hard, squares <= gate, np.clip(soft, 0.0, 1.0))


def covariance(
    problem: PlanarProblem, solution: Fit, *, last_only: bool = False
) -> tuple[Array, Array, Array]:
    """Return covariances at a fit.

    Returns
    -------
    states : (n, 4, 4) of all nodes, or (1, 4, 4) of the last.
    cross : (n or 1, 4, c) of states and constants.
    constants : (c, c).
    """
    at = evaluate(problem, solution.x, solution.theta)
    weights = (solution.range_used, solution.rate_used)
    system = System(problem, solution.x, solution.theta, at, weights, 0.0)
    return system.covariance(last_only=last_only)


def residuals(problem: PlanarProblem, solution: Fit) -> tuple[Array, Array, Array, Array]:
    """Return residuals of ranges (m,) and rates (m,), predicted - measured, and their sigmas."""
    at = evaluate(problem, solution.x, solution.theta)
    rows = at.range_residual.size
    range_std, rate_std = problem.ranging.range_std[:rows], problem.ranging.rate_std[:rows]
    return at.range_residual * range_std, at.rate_residual * rate_std, range_std, rate_std


def cost_terms(problem: PlanarProblem, solution: Fit) -> Array:
    """Return the terms that add up to the cost: rows, steps, noise of the velocity and priors."""
    at = evaluate(problem, solution.x, solution.theta)
    return terms(problem, solution.x, solution.theta, at)


def _bent(
    problem: PlanarProblem,
    x: Array,
    theta: Array,
    at: RangingEvaluation,
    weights: tuple[Array, Array],
    system: System,
    dx: Array,
    dtheta: Array,
) -> tuple[Array, Array]:
    """Return a step that follows the valley: with its acceleration along the geodesic.

    While the current is hardly known, the cost is a narrow valley that bends around the
    beacon, and straight steps down it are tiny. Transtrum and Sethna, Improvements to the
    Levenberg-Marquardt algorithm for nonlinear least-squares minimization, arXiv:1201.5885.
    """
    ahead = evaluate(problem, x + _AHEAD * dx, theta + _AHEAD * dtheta)
    node = problem.ranging.node[: at.range_residual.size]
    second = []
    for here, there, by_x, by_theta, weight in (
        (at.range_residual, ahead.range_residual, at.range_x, at.range_theta, weights[0]),
        (at.rate_residual, ahead.rate_residual, at.rate_x, at.rate_theta, weights[1]),
    ):
        linear = np.sum(by_x * dx[node], axis=1) + by_theta @ dtheta
        bend = 2.0 / _AHEAD * ((there - here) / _AHEAD - linear)
        second.append(np.where(weight > 0.0, bend, 0.0))
    g, h = np.zeros_like(x), np.zeros_like(theta)
    for bend, by_x, by_theta, weight in (
        (second[0], at.range_x, at.range_theta, weights[0]),
        (second[1], at.rate_x, at.rate_theta, weights[1]),
    ):
        g[node] += (weight * bend)[:, None] * by_x
        h += by_theta.T @ (weight * bend)
    ddx, ddtheta = system.solve(g.ravel(), h)
    if np.linalg.norm(ddx[:, :2]) > _MOST_BENT * np.linalg.norm(dx[:, :2]):
        return dx, dtheta
    return dx + 0.5 * ddx, dtheta + 0.5 * ddtheta


def _softness(at: RangingEvaluation) -> float:
    squares = np.concatenate([at.range_residual, at.rate_alone]) ** 2
    largest = float(np.nanmax(squares, initial=0.0))
    return GATE**2 / (2.0 * largest - GATE**2) if largest > GATE**2 else np.inf


def _weights(at: RangingEvaluation, softness: float) -> tuple[Array, Array]:
    out = []
    for residual in (at.range_residual, at.rate_alone):
        known = ~np.isnan(residual)
        squares = np.where(known, residual, 0.0) ** 2
        out.append(np.where(known, graduated_weights(squares, softness), 0.0))
    return out[0], out[1]


def _cost(problem: PlanarProblem, x: Array, theta: Array, at: RangingEvaluation) -> float:
    return float(terms(problem, x, theta, at).sum())
