"""Noise of velocity logs: what of it is constant, and what grows with speed.

Data sheets state both. With the variance a of the constant part as stated, that of the other, b,
and all else that residuals r with leverages h have, c, the restricted likelihood has the gradient
of

    Σ (1 - h) log(α a + β b + c) + r² / (α a + β b + c)

by the logarithms of the factors α and β on the two (for h as it is now: variances that fitting
takes its share of). The factors on all of the noise of a sensor, which
`statistics.variance_components` finds by the same equation, are those of α = β.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import minimize

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation
from factorgraph_dvl.statistics.variance_components import (
    LEAST_FACTOR,
    LEAST_REDUNDANCY,
    PRIOR_LOG_STD,
    residuals_with_leverages,
)

# Groups of measurements by speed whose squares are summed. Chosen: variances in one differ little.
_GROUPS = 100


def growths(
    problem: Problem, evaluation: Evaluation, information: SquareRootInformation
) -> Iterator[tuple[str, Array, Array, float]]:
    """Yield factors on both parts of the noise of a label, as residuals ask for them.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Problem with weights, and its minimum. Factors on all of the noise are estimated there.
    information : SquareRootInformation
        Information there.

    Yields
    ------
    label : str
    parts : ndarray, shape (2,)
        Factors on the standard deviations of both, times those on all of the noise as applied.
    share : ndarray, shape (2, n)
        Shares of both in the variance of measurements with the factor on all of the noise alone.
    price : float
        What the shape costs, which -2 log of the likelihood must fall by.
    """
    for i, o in enumerate(problem.observations):
        if o.noise_by_speed is None or o.label not in problem.noise_factors:
            continue
        used = problem.weights[i] > 0.0
        if np.count_nonzero(used) < LEAST_REDUNDANCY:
            continue
        now = problem.noise_growth.get(o.label, np.ones(2))
        other, constant, grown = _parts(problem, evaluation, i)
        whole = now[0] ** 2 * constant + now[1] ** 2 * grown + other
        share = np.stack([constant / whole, grown / whole, other / whole])[:, used]
        long_run = problem.long_run.get(o.label, np.ones(used.shape[1]))
        found = residuals_with_leverages(problem, evaluation, information, {o.label})
        residual, h = found[o.label]
        squares, freedom = ((residual * long_run) ** 2)[used], 1.0 - h[used]
        # No part is smaller than what a record shows that was smoothed, or rounded.
        least = LEAST_FACTOR / float(np.max(problem.noise_factors[o.label]))
        parts, gain = _factors(share, squares, freedom, np.log(now**2), 2.0 * np.log(least))
        price = float(np.log(squares.size))
        if gain > price:
            yield o.label, np.sqrt(parts), share[:2], price


def normalised(parts: Array, share: Array) -> tuple[Array, float]:
    """Return factors on both parts that are one on average, and what they were on average.

    Parameters
    ----------
    parts : ndarray, shape (2,)
        Factors on both standard deviations.
    share : ndarray, shape (2, n)
        Shares of both in the variance of the measurements.
    """
    mean = np.sqrt(np.mean(parts**2 @ share / share.sum(axis=0)))
    return parts / mean, float(mean)


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


def _factors(
    share: Array, squares: Array, freedom: Array, start: Array, least: float
) -> tuple[Array, float]:
    """Return the factors (2,) on both variances, and what -2 log of the likelihood falls by.

    Against the best factors whose ratio is that of `start`, their logarithms; none below `least`.
    """
    order = np.argsort(share[1] / (share[0] + share[1]), kind="stable")
    groups = np.array_split(order, min(_GROUPS, squares.size))
    mean = np.stack([share[:, g].mean(axis=1) for g in groups], axis=1)
    square = np.array([squares[g].sum() for g in groups])
    free = np.array([freedom[g].sum() for g in groups])

    def cost(logs: Array) -> float:
        variance = np.exp(logs) @ mean[:2] + mean[2]
        prior = np.sum(logs**2) / (2.0 * PRIOR_LOG_STD) ** 2
        return float(free @ np.log(variance) + np.sum(square / variance) + prior)

    def of_both(log: Array) -> float:
        return cost(start + log[0])

    same = minimize(of_both, np.zeros(1))
    first = np.maximum(start + same.x[0], least)
    best = minimize(cost, first, bounds=[(least, None)] * 2)
    return np.exp(best.x), float(same.fun - best.fun)
