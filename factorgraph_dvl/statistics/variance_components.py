"""Variance components: the noise of sensors from their own residuals."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.sensors.protocol import Observation
from factorgraph_dvl.statistics.leverage import leverage
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Standard deviation of the logarithm of a factor before any data. Chosen: data sheets are right
# within a factor of three. As degrees of freedom at factor 1:
PRIOR_LOG_STD = float(np.log(3.0))
_PRIOR_FREEDOM = 1.0 / (2.0 * PRIOR_LOG_STD**2)
# Factor below which a stated standard deviation stays as it is. Chosen: residuals ten times
# smaller are those of a record that was smoothed, or simulated without noise, and say nothing
# of its error.
LEAST_FACTOR = 0.1
# Redundancy below which no factor is estimated. Chosen: it would be uncertain by over 20 %.
LEAST_REDUNDANCY = 10.0
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

    @classmethod
    def of(cls, squares: float, freedom: float) -> NoiseFactor:
        """Return the factor of one component from squares of its residuals and their freedom."""
        found = np.sqrt((squares + _PRIOR_FREEDOM) / (freedom + _PRIOR_FREEDOM))
        return cls(np.array([max(found, LEAST_FACTOR)]), np.array([freedom]))

    def after(self, applied: Array) -> Array:
        """Return the factors (d,) to apply next: those that were, where these are no others."""
        chance = _CHANCE / np.sqrt(2.0 * np.maximum(self.redundancy, 0.5))
        change = np.abs(self.factor / applied - 1.0)
        return np.where(change <= np.maximum(_SAME_FACTOR, chance), applied, self.factor)


def log_prior(noise_factors: Mapping[str, Array], observations: Iterable[Observation]) -> float:
    """Return -2 log of the prior of factors on stated noise: nu (1/f² + log f²) of each group.

    Parameters
    ----------
    noise_factors : mapping of str to ndarray
        Factors (d,) of each label.
    observations : iterable of Observation
        Their components share factors in groups.
    """
    square = [
        float(noise_factors[o.label][group[0]]) ** 2
        for o in observations
        if o.label in noise_factors
        for group in o.noise_groups
    ]
    return _PRIOR_FREEDOM * sum(1.0 / f + float(np.log(f)) for f in square)


def variance_components(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
) -> dict[str, NoiseFactor]:
    """Return factors of each label on stated deviations by restricted maximum likelihood.

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
    """
    found = residuals_with_leverages(problem, evaluation, information, problem.noise_factors)
    return {label: _white(problem, evaluation, label, *own) for label, own in found.items()}


def residuals_with_leverages(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
    labels: Container[str],
) -> dict[str, tuple[Array, Array]]:
    """Return whitened residuals (M, d) and their leverages (M, d), by label.

    Parameters
    ----------
    problem, evaluation, information : Problem, Evaluation or SquareRootInformation
        Problem with its weights, the minimum, and the information there.
    labels : container of str
        Measurements that are asked for, by label.
    """
    own = [each for each in problem.observation_rows(evaluation) if each.source in labels]
    count = sum(each.vector.size for each in own)
    found: dict[str, list[tuple[Array, Array]]] = {}
    for rows, h in leverage(lambda: own, count, information):
        found.setdefault(rows.source, []).append((rows.vector, h))
    return {
        label: (np.concatenate([v for v, _ in parts]), np.concatenate([h for _, h in parts]))
        for label, parts in found.items()
    }


def _white(
    problem: Problem, evaluation: Evaluation, label: str, vector: Array, h: Array
) -> NoiseFactor:
    """Return factors on the standard deviations that a sensor states.

    From the residuals and leverages of its rows.
    """
    size = vector.shape[1]
    (i,) = (i for i, o in enumerate(problem.observations) if o.label == label)
    sigma = problem.sigma(evaluation)[i]
    others = problem.sigma(evaluation, {label: np.zeros(size)})[i]
    used = problem.weights[i] > 0.0
    own = 1.0 - np.divide(others, sigma, out=np.ones(used.shape), where=used) ** 2
    long_run = problem.long_run.get(label, np.ones(size))
    squares = np.sum(own * vector**2, axis=0) * long_run**2
    freedom = np.sum(own * (used - h), axis=0)
    before = problem.noise_factors[label]
    factor, redundancy = np.ones(size), np.zeros(size)
    for group in map(list, problem.observations[i].noise_groups):
        left = max(float(freedom[group].sum()), 0.0)
        redundancy[group] = left
        total = float(squares[group] @ before[group] ** 2)
        found = np.sqrt((total + _PRIOR_FREEDOM) / (left + _PRIOR_FREEDOM))
        if left < LEAST_REDUNDANCY or (found < LEAST_FACTOR and before[group[0]] == 1.0):
            factor[group] = before[group]
        else:
            # Not back to what is stated: that would come and go.
            factor[group] = max(found, LEAST_FACTOR)
    return NoiseFactor(factor, redundancy)
