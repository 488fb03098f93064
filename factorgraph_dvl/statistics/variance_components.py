"""Variance components: the noise of sensors from their own residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.statistics.leverage import leverage
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Standard deviation of the logarithm of a factor before any data, as degrees of freedom at
# factor 1: 1 / (2 ln² 3). Chosen: data sheets are right within a factor of three.
_PRIOR_FREEDOM = 1.0 / (2.0 * np.log(3.0) ** 2)
# Factor below which a stated standard deviation stays as it is. Chosen: residuals ten times
# smaller are those of a record that was smoothed, or simulated without noise, and say nothing
# of its error.
_LEAST_FACTOR = 0.1
# Redundancy below which no factor is estimated. Chosen: it would be uncertain by over 20 %.
_LEAST_REDUNDANCY = 10.0
# Relative change of a factor from which on it counts, and in its own standard deviations.
# Chosen: less changes no σ that is shown, or is chance.
_SAME_FACTOR = 0.05
_CHANCE = 2.0


@dataclass(frozen=True)
class NoiseFactor:
    """Factors on the standard deviations that a sensor states, by component.

    Parameters
    ----------
    factor : ndarray, shape (d,)
        1 = as stated.
    redundancy : ndarray, shape (d,)
        Residuals of the components that share the factor, less what fitting took of them.
    """

    factor: Array
    redundancy: Array

    def after(self, applied: Array) -> Array:
        """Return the factors (d,) to apply next: those that were, where these are no others."""
        chance = _CHANCE / np.sqrt(2.0 * np.maximum(self.redundancy, 0.5))
        change = np.abs(self.factor / applied - 1.0)
        return np.where(change <= np.maximum(_SAME_FACTOR, chance), applied, self.factor)


def noise_factors(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
) -> dict[str, NoiseFactor]:
    """Return factors on stated standard deviations by restricted maximum likelihood.

    With residuals r whitened by the factor f that was applied, leverages h, and the share s of
    their variance that is the sensor's own,

        f² <- (f² sum s r² + nu) / (sum s (1 - h) + nu),

    whose fixed point is the restricted maximum of the likelihood (Förstner, Ein Verfahren zur
    Schätzung von Varianz- und Kovarianzkomponenten, 1979; Koch, Parameter Estimation and
    Hypothesis Testing in Linear Models, 1999, ch. 3.6). nu stands for the prior.

    Parameters
    ----------
    problem : Problem
        What was minimised, with the factors that were applied: they say which to estimate.
    evaluation : Evaluation
        Its minimum.
    information : SquareRootInformation
        Information there.

    Returns
    -------
    dict of str to NoiseFactor
        By label.
    """
    labels = [o.label for o in problem.observations]
    groups = {o.label: o.noise_groups for o in problem.observations}
    weights = dict(zip(labels, problem.weights, strict=True))
    sigmas = dict(zip(labels, problem.sigma(evaluation), strict=True))
    others = dict(zip(labels, problem.sigma(evaluation, dict.fromkeys(labels, 0.0)), strict=True))
    rows = [r for r in problem.observation_rows(evaluation) if r.source in problem.noise_factors]
    out = {}
    for each, h in zip(rows, leverage(rows, information), strict=True):
        label, size = each.source, len(each.components)
        used = weights[label] > 0.0
        ratio = np.divide(others[label], sigmas[label], out=np.ones(used.shape), where=used)
        own = 1.0 - ratio**2
        squares = np.sum(own * each.vector**2, axis=0)
        freedom = np.sum(own * (used - h), axis=0)
        before = problem.noise_factors[label]
        factor, redundancy = np.ones(size), np.zeros(size)
        for group in map(list, groups[label]):
            left = max(float(freedom[group].sum()), 0.0)
            redundancy[group] = left
            total = float(squares[group] @ before[group] ** 2)
            found = np.sqrt((total + _PRIOR_FREEDOM) / (left + _PRIOR_FREEDOM))
            if left < _LEAST_REDUNDANCY or (found < _LEAST_FACTOR and before[group[0]] == 1.0):
                factor[group] = before[group]
            else:
                # Not back to what is stated: that would come and go.
                factor[group] = max(found, _LEAST_FACTOR)
        out[label] = NoiseFactor(factor, redundancy)
    return out
