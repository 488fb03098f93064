"""Changes between trials: steps of one component, found with trial, size and probability."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.campaign.between_trials import fitted
from factorgraph_dvl.campaign.information import Information
from factorgraph_dvl.campaign.model import Effect, Fit, fit
from factorgraph_dvl.campaign.supremum import normal_equivalent, supremum_probability
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
        That stepped.
    probability : float
        Of as clear a step anywhere, in any component, if there were none.
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
        Without the steps.
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
        Of N trials, in order.
    effects : sequence of Effect, optional
        To estimate besides.
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
