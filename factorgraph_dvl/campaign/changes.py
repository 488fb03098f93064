"""Changes between trials: steps of one component, and components that walk at random."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtrc, ndtr, ndtri, stdtr

from factorgraph_dvl.campaign.information import Information
from factorgraph_dvl.campaign.model import Effect, Fit, fit, fitted
from factorgraph_dvl.geometry.vectors import Array

# Chosen: probability by which a campaign without changes has one, over all components and trials.
FALSE_ALARM = 0.01
# Share of a component's information that must lie on either side of a step for it to be tested.
# Chosen: far less than one trial in a thousand.
_LEAST_INFORMED = 1e-6
# Below it a probability is no number to be read.
_LEAST_PROBABILITY = 1e-300


@dataclass(frozen=True)
class Change:
    """A component that stepped between two trials.

    Parameters
    ----------
    after : int
        Last trial before it.
    component : int
        Component that stepped.
    probability : float
        Probability of as clear a step anywhere, in any component, if there were none.
    """

    after: int
    component: int
    probability: float

    def effect(self, trials: int) -> Effect:
        """Return the step as an effect of so many trials."""
        return Effect(self.component, np.where(np.arange(trials) > self.after, 1.0, 0.0))


@dataclass(frozen=True)
class StepScores:
    """Score tests of a step of each component after each trial.

    Parameters
    ----------
    statistic : ndarray, shape (n, N - 1)
        Standard normal where there is no step; 0 where it cannot be tested.
    std : ndarray, shape (n, N - 1)
        Standard deviation of the step, in reported units; infinite where it cannot be tested.
    tested : ndarray of bool, shape (n, N - 1)
        Where it can.
    neighbours : ndarray, shape (n, N - 2)
        Correlation of each statistic with that of a step one trial later.
    """

    statistic: Array
    std: Array
    tested: np.ndarray
    neighbours: Array

    @property
    def largest(self) -> tuple[int, int]:
        """Component and trial of the clearest step."""
        k, c = np.unravel_index(int(np.abs(self.statistic).argmax()), self.statistic.shape)
        return int(k), int(c)

    def probability(self, z: float) -> float:
        """Return the probability that any |statistic| exceeds z where there is no step."""
        total = 0.0
        for tested, neighbours in zip(self.tested, self.neighbours, strict=True):
            at = np.flatnonzero(tested)
            if at.size:
                total += supremum_probability(z, neighbours[at[:-1]])
        return min(max(total, _LEAST_PROBABILITY), 1.0)


def step_scores(found: Fit, omitted: Sequence[int] = ()) -> StepScores:
    """Return the score tests of a step of each component after each trial, others unchanged.

    With W and the scores s of the fit, S = Σ s over the trials after c has, of each component, the
    variance I(c) = ΣW - ΣWX A⁻¹ ΣXᵀW, and of two c the covariance with the sum of the later.

    Parameters
    ----------
    found : Fit
        Fit without the steps.
    omitted : sequence of int, optional
        Components that are not tested.
    """
    after = _after(np.einsum("ikk->ik", found.weight))
    cross = _after(found.weight @ found.design)
    score = _after(found.score)
    reduced = np.einsum("ckp,pq->ckq", cross, found.covariance)
    own = after - np.einsum("ckp,ckp->ck", reduced, cross)
    later = after[1:] - np.einsum("ckp,ckp->ck", reduced[:-1], cross[1:])
    total = np.maximum(np.einsum("ikk->k", found.weight), np.finfo(float).tiny)
    tested = own > _LEAST_INFORMED * total
    tested[:, list(omitted)] = False
    safe = np.where(tested, own, 1.0)
    statistic = np.where(tested, score / np.sqrt(safe), 0.0)
    neighbours = np.clip(later / np.sqrt(safe[:-1] * safe[1:]), -1.0, 1.0)
    std = np.where(tested, found.scale / np.sqrt(safe), np.inf)
    return StepScores(statistic.T, std.T, tested.T, neighbours.T)


def next_step(
    information: Information, effects: Sequence[Effect] = (), omitted: Sequence[int] = ()
) -> Change | None:
    """Return the clearest step between trials, None if none is clearer than chance.

    The variance between trials is that of the trials with the step: the step would else be part of
    it. Where it is estimated, the statistic is one of Student's t.

    Parameters
    ----------
    information : Information
        Information of N trials, in order.
    effects : sequence of Effect, optional
        Effects to estimate besides the common value.
    omitted : sequence of int, optional
        Components that are not tested.
    """
    count = information.square.size
    if count < 2:
        return None
    zero = step_scores(fit(information, np.zeros(information.prior_std.size), effects), omitted)
    k, c = zero.largest
    # Variance between trials makes every statistic smaller.
    if zero.probability(abs(zero.statistic[k, c])) > FALSE_ALARM:
        return None
    k, c = step_scores(fitted(information, effects), omitted).largest
    variance = fitted(information, [*effects, Change(c, k, 1.0).effect(count)]).variance
    scores = step_scores(fit(information, variance, effects), omitted)
    k, c = scores.largest
    z = abs(float(scores.statistic[k, c]))
    if variance[k] > 0.0:
        informed = np.einsum("ikk->ik", information.matrix)[:, k] > 0.0
        used = sum(e.component == k and np.isinf(e.variance) for e in effects)
        z = normal_equivalent(z, max(int(informed.sum()) - 2 - used, 1))
    probability = scores.probability(z)
    return Change(c, k, probability) if probability <= FALSE_ALARM else None


def _after(values: Array) -> Array:
    """Return sums over the trials after each but the last, (N - 1, ...)."""
    return np.asarray(np.cumsum(values[::-1], axis=0)[-2::-1])


# Nodes of the quadrature over the correlation. Chosen: 1e-10 at correlations up to 0.9999.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(48)


def supremum_probability(largest: float, neighbours: Array) -> float:
    """Return an upper bound of the probability that any |Z| of a chain exceeds a number.

    P(any) ≤ Σ P(i) - Σ P(i and i + 1), for standard normal Z with correlations between neighbours
    (Worsley 1982, Biometrika 69, 297-302): for a chain of steps it is close to the probability.

    Parameters
    ----------
    largest : float
        The number.
    neighbours : ndarray, shape (M - 1,)
        Correlation of each of the M statistics with the next.
    """
    single = 2.0 * float(ndtr(-largest))
    pairs = _both_exceed(largest, neighbours)
    return min(single * (neighbours.size + 1) - float(pairs.sum()), 1.0)


def normal_equivalent(statistic: float, freedom: float) -> float:
    """Return the normal statistic of the same tail probability as one of Student's t."""
    tail = float(stdtr(freedom, -abs(statistic)))
    return float(-ndtri(max(tail, 1e-300)))


def _both_exceed(z: float, correlation: Array) -> Array:
    """Return P(|X| > z and |Y| > z) of standard normal X, Y by their correlation, (M,).

    By Plackett's identity, P(X > z, Y > z) = Q(z)² + ∫ exp(-z² / (1 + sin θ)) dθ / 2π from 0 to
    arcsin ρ.
    """
    end = np.arcsin(np.clip(correlation, -1.0, 1.0))
    theta = 0.5 * end[:, None] * (_NODES + 1.0)
    total = np.zeros(end.size)
    for sign in (1.0, -1.0):
        # 1 + sin θ vanishes where one is minus the other.
        below = np.maximum(1.0 + np.sin(sign * theta), 1e-300)
        integral = 0.5 * end * (np.exp(-(z**2) / below) @ _WEIGHTS)
        total += 2.0 * (float(ndtr(-z)) ** 2 + sign * integral / (2.0 * np.pi))
    return np.clip(total, 0.0, 2.0 * float(ndtr(-z)))


# Chosen: largest variance of a walk between two trials in units of that between trials.
_LARGEST = 1e4


@dataclass(frozen=True)
class Drift:
    """A component that walks at random.

    Parameters
    ----------
    component : int
        Component that drifts.
    variance : float
        Variance of its walk, squared reported units a day, or a trial where the dates are not
        known.
    probability : float
        Probability of as clear a drift if there were none.
    """

    component: int
    variance: float
    probability: float

    def effects(self, days: Array) -> list[Effect]:
        """Return the walk as the sum of its steps between trials at times (N,)."""
        trial = np.arange(days.size)
        return [
            Effect(self.component, np.where(trial > c, 1.0, 0.0), self.variance * dt)
            for c, dt in enumerate(np.diff(days))
            if dt > 0.0
        ]


def drift_of(
    information: Information, found: Fit, component: int, days: Array
) -> tuple[Drift, float] | None:
    """Return the drift of a component and the gain in likelihood over none.

    The walk is a sum of independent steps: with their scores g and information G, its restricted
    likelihood given the variances q is that of g ~ N(0, G + G Q G). The variance of the component
    between trials is estimated with it.

    Parameters
    ----------
    information : Information
        Information of N trials, in order.
    found : Fit
        Fit without the drift.
    component : int
        Component that may drift.
    days : ndarray, shape (N,)
        Times of the trials.

    Returns
    -------
    tuple of (Drift, float) or None
        Drift and gain; None if no drift is more likely.
    """
    k = component
    interval = np.sqrt(np.maximum(np.diff(days), 0.0))
    unit = max(float(found.variance[k]), 1e-6)
    days_long = float(interval.max(initial=0.0)) ** 2
    if days_long <= 0.0:
        return None

    def negative(x: Array) -> float:
        variance = found.variance.copy()
        variance[k] = max(x[0], 0.0) * unit
        base = fit(information, variance, found.effects)
        score, matrix = _step_information(base, k)
        scaled = interval * np.sqrt(max(x[1], 0.0) * unit / days_long)
        normal = np.eye(score.size) + scaled[:, None] * matrix * scaled
        root = np.linalg.cholesky(normal)
        left = np.linalg.solve(root, scaled * score)
        return -base.likelihood + float(np.log(np.diag(root)).sum() - 0.5 * left @ left)

    best = min(
        (
            minimize(negative, start, method="L-BFGS-B", bounds=[(0.0, _LARGEST)] * 2)
            for start in ([0.1, 0.1], [0.5, 0.01])
        ),
        key=lambda result: float(result.fun),
    )
    gain = -found.likelihood - float(best.fun)
    variance = float(best.x[1]) * unit / days_long * float(found.scale[k]) ** 2
    if gain <= 0.0 or variance <= 0.0:
        return None
    return Drift(k, variance, 0.5 * float(chdtrc(1, 2.0 * gain))), gain


def _step_information(found: Fit, k: int) -> tuple[Array, Array]:
    """Return scores (N - 1,) and their covariance of a step of a component after each trial."""
    own = np.cumsum(found.weight[::-1, k, k])[-2::-1]
    cross = np.cumsum((found.weight @ found.design)[::-1, k], axis=0)[-2::-1]
    score = np.cumsum(found.score[::-1, k])[-2::-1]
    later = np.maximum.outer(np.arange(own.size), np.arange(own.size))
    return score, own[later] - cross @ found.covariance @ cross.T
