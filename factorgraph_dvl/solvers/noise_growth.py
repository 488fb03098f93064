"""Noise of velocity logs: what of it is constant, and what grows with speed.

Data sheets state both. With the variance a of the constant part as stated, that of the other, b,
and all else that residuals r have, c, their likelihood

    -2 log L = Σ log(α a + β b + c) + r² / (α a + β b + c)

is largest at the factors α and β on the two. The factors on all of the noise of a sensor, which
`statistics.variance_components` finds, are those of α = β.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import minimize

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.statistics.variance_components import PRIOR_LOG_STD

# Groups of measurements by speed whose squares are summed. Chosen: variances in one differ little.
_GROUPS = 100


def growths(problem: Problem, evaluation: Evaluation) -> Iterator[tuple[str, Array, float, float]]:
    """Yield factors on both parts of the noise of a label, as residuals ask for them.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Problem with weights, and its minimum. Factors on all of the noise are estimated there.

    Yields
    ------
    label : str
    growth : ndarray, shape (2,)
        Factors on the standard deviations, one on average over the measurements.
    factor : float
        By which the factor on all of the noise changes with it.
    price : float
        What the shape costs, which -2 log of the likelihood must fall by.
    """
    for i, o in enumerate(problem.observations):
        if o.noise_by_speed is None or o.label not in problem.noise_factors:
            continue
        residual, weight = evaluation.residuals[i], problem.weights[i]
        used = weight > 0.0
        if not used.any():
            continue
        now = problem.noise_growth.get(o.label, np.ones(2))
        other, constant, grown = _parts(problem, evaluation, i)
        # Relative to what all is now; fitting takes its share of squares of any speed.
        whole = now[0] ** 2 * constant + now[1] ** 2 * grown + other
        share = np.stack([constant / whole, grown / whole, other / whole])[:, used]
        squares = residual[used] ** 2
        found, gain = _factors(share, squares / squares.mean(), np.log(now**2))
        price = float(np.log(squares.size))
        if gain <= price:
            continue
        mean = _mean_square(found, share) / _mean_square(now**2, share)
        yield o.label, np.sqrt(found / _mean_square(found, share)), float(np.sqrt(mean)), price


def _parts(problem: Problem, evaluation: Evaluation, i: int) -> tuple[Array, Array, Array]:
    """Return the variances (M, d) of all but the noise, and of both parts of that as stated."""
    label = problem.observations[i].label
    applied = problem.noise_factors[label]
    now = problem.noise_growth.get(label, np.ones(2))
    out = []
    for part in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)):
        factor = (np.array(part) / now)[:, None] * applied
        out.append(problem.sigma(evaluation, {label: factor})[i] ** 2)
    other, constant, grown = out
    with np.errstate(invalid="ignore"):
        return other, constant - other, grown - other


def _mean_square(factors: Array, share: Array) -> float:
    """Return the mean ratio of the variance of the noise with these factors to that as stated."""
    stated = share[0] + share[1]
    return float(np.mean((factors[0] * share[0] + factors[1] * share[1]) / stated))


def _factors(share: Array, squares: Array, start: Array) -> tuple[Array, float]:
    """Return the factors (2,) on both variances, and what -2 log of the likelihood falls by.

    Against the best factors whose ratio is that of `start`, their logarithms.
    """
    order = np.argsort(share[1] / (share[0] + share[1]), kind="stable")
    groups = np.array_split(order, min(_GROUPS, squares.size))
    count = np.array([g.size for g in groups])
    mean = np.stack([share[:, g].mean(axis=1) for g in groups], axis=1)
    square = np.array([squares[g].sum() for g in groups])

    def cost(logs: Array) -> float:
        variance = np.exp(logs) @ mean[:2] + mean[2]
        prior = np.sum(logs**2) / (2.0 * PRIOR_LOG_STD) ** 2
        return float(count @ np.log(variance) + np.sum(square / variance) + prior)

    def of_both(log: Array) -> float:
        return cost(start + log[0])

    same = minimize(of_both, np.zeros(1))
    best = minimize(cost, start + same.x[0])
    return np.exp(best.x), float(same.fun - best.fun)
