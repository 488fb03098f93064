"""The most probable track near a start, its covariance, and which ranges are outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.ranging.elimination import System
from factorgraph_dvl.ranging.model import GATE, PlanarProblem, RangingEvaluation, evaluate, terms

# Chosen: decrease of the cost at which the iteration ends; half a unit is one sigma.
_CONVERGED = 1e-6
# Chosen: relative increase of a cost that rounding explains.
_ROUNDING = 1e-9
# Chosen: steps, m, up to which ranges are taken as linear; at 100 m the curvature adds 5 mm.
_STRAIGHT_M = 1.0
# Chosen after Transtrum and Sethna: fraction of a step at which its curvature is taken, and the
# largest acceptable ratio of acceleration to velocity.
_PROBE = 0.1
_LARGEST_ACCELERATION = 0.75


@dataclass(frozen=True)
class Fit:
    """A track that fits the measurements of the first n nodes.

    Parameters
    ----------
    x : ndarray, shape (n, 4)
        Positions, m, and noise of the velocity, m/s.
    theta : ndarray, shape (c,)
        Constants.
    range_used, rate_used : ndarray, shape (m,)
        Weights 0 or 1 of the measurements; 0 where there is none.
    cost : float
        Half the sum of squared whitened residuals; a rejected one counts as the gate.
    converged : bool
        Whether the last step, undamped, no longer lowered the cost.
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
        Of at least n nodes.
    x : ndarray, shape (n, 4)
        Start; the first n nodes are fitted.
    theta : ndarray, shape (c,)
        Start of the constants.
    graduated : bool, default False
        Whether to begin with the surrogate.
    iterations : int, default 30
        At most so many steps.
    """
    at = evaluate(problem, x, theta)
    control = _first_control(at) if graduated else np.inf
    damping = 0.0
    converged = False
    cost = _cost(problem, x, theta, at)
    for _ in range(iterations):
        weights = _weights(at, control)
        try:
            system = System(problem, x, theta, at, weights, damping)
        except np.linalg.LinAlgError:
            damping = max(10.0 * damping, 1e-2)
            continue
        dx, dtheta = system.step()
        if np.abs(dx[:, :2]).max() > _STRAIGHT_M:
            dx, dtheta = _along_geodesic(problem, x, theta, at, weights, system, dx, dtheta)
        trial_x, trial_theta = x + dx, theta + dtheta
        trial_at = evaluate(problem, trial_x, trial_theta)
        trial_cost = _cost(problem, trial_x, trial_theta, trial_at)
        if np.isfinite(control):
            x, theta, at, cost = trial_x, trial_theta, trial_at, trial_cost
            control = control * 1.6 if control < 100.0 else np.inf
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


def truncation_weights(squares: Array, control: float | Array) -> Array:
    """Return weights of squared whitened residuals; an infinite control parameter truncates."""
    gate = GATE**2
    hard = np.isinf(control)
    mu = np.where(hard, 1.0, control)
    with np.errstate(divide="ignore"):
        soft = GATE / np.sqrt(squares) * np.sqrt(mu * (mu + 1.0)) - mu
    return np.where(hard, squares <= gate, np.clip(soft, 0.0, 1.0))


def covariance(
    problem: PlanarProblem, solution: Fit, *, last_only: bool = False
) -> tuple[Array, Array, Array]:
    """Return covariances at a fit.

    Returns
    -------
    states : ndarray, shape (n, 4, 4)
        Of all nodes, or (1, 4, 4) of the last.
    cross : ndarray, shape (n, 4, c)
        Of states and constants.
    constants : ndarray, shape (c, c)
        Of the constants.
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


def _along_geodesic(
    problem: PlanarProblem,
    x: Array,
    theta: Array,
    at: RangingEvaluation,
    weights: tuple[Array, Array],
    system: System,
    dx: Array,
    dtheta: Array,
) -> tuple[Array, Array]:
    """Return the step with its geodesic acceleration.

    While the current is hardly known, the cost has a narrow minimum, curved around the beacon,
    along which straight steps are tiny. Transtrum and Sethna, Improvements to the
    Levenberg-Marquardt algorithm for nonlinear least-squares minimization, arXiv:1201.5885.
    """
    probe = evaluate(problem, x + _PROBE * dx, theta + _PROBE * dtheta)
    node = problem.ranging.node[: at.range_residual.size]
    second = []
    for here, there, by_x, by_theta, weight in (
        (at.range_residual, probe.range_residual, at.range_x, at.range_theta, weights[0]),
        (at.rate_residual, probe.rate_residual, at.rate_x, at.rate_theta, weights[1]),
    ):
        linear = np.sum(by_x * dx[node], axis=1) + by_theta @ dtheta
        curvature = 2.0 / _PROBE * ((there - here) / _PROBE - linear)
        second.append(np.where(weight > 0.0, curvature, 0.0))
    g, h = np.zeros_like(x), np.zeros_like(theta)
    for curvature, by_x, by_theta, weight in (
        (second[0], at.range_x, at.range_theta, weights[0]),
        (second[1], at.rate_x, at.rate_theta, weights[1]),
    ):
        g[node] += (weight * curvature)[:, None] * by_x
        h += by_theta.T @ (weight * curvature)
    ddx, ddtheta = system.solve(g.ravel(), h)
    if np.linalg.norm(ddx[:, :2]) > _LARGEST_ACCELERATION * np.linalg.norm(dx[:, :2]):
        return dx, dtheta
    return dx + 0.5 * ddx, dtheta + 0.5 * ddtheta


def _first_control(at: RangingEvaluation) -> float:
    squares = np.concatenate([at.range_residual, at.rate_gate]) ** 2
    largest = float(np.nanmax(squares, initial=0.0))
    return GATE**2 / (2.0 * largest - GATE**2) if largest > GATE**2 else np.inf


def _weights(at: RangingEvaluation, control: float) -> tuple[Array, Array]:
    out = []
    for residual in (at.range_residual, at.rate_gate):
        known = ~np.isnan(residual)
        squares = np.where(known, residual, 0.0) ** 2
        out.append(np.where(known, truncation_weights(squares, control), 0.0))
    return out[0], out[1]


def _cost(problem: PlanarProblem, x: Array, theta: Array, at: RangingEvaluation) -> float:
    return float(terms(problem, x, theta, at).sum())
