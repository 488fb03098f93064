"""Outliers among measurements, by graduated truncation around Gauss-Newton steps."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, BoolArray
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.solvers.levenberg_marquardt import quick_step
from factorgraph_dvl.statistics.elimination import eliminated
from factorgraph_dvl.statistics.robust_weights import (
    Truncation,
    misfit,
    persistent_misfit,
    windows,
)
from factorgraph_dvl.statistics.variance_components import LEAST_FACTOR

# Measurements from which on outliers are searched. Chosen: fewer do not show their own scale.
_FEWEST = 20


def robust_weights(
    problem: Problem, evaluation: Evaluation
) -> tuple[dict[str, Array], Evaluation] | None:
    """Return weights 0 or 1 by label, and where the rest leads; None if there is no outlier.

    A sensor's measurements are rejected only if that makes all of them more likely where the rest
    leads (`misfit`): truncated squares alone may split honest noise into what is small and what is
    not.

    Parameters
    ----------
    problem : Problem
        Its robust weights are replaced.
    evaluation : Evaluation
        Evaluation at a minimum.
    """
    groups = {o.label: i for i, o in enumerate(problem.observations) if o.noise_groups}
    if not any(t.worth_it for t in _searches(problem, evaluation, groups).values()):
        return None
    problem.robust_weights = {}
    problem.weigh(evaluation)
    used = _used(problem, groups)
    residuals = before = _normalised(problem, evaluation, used, groups)
    sigma = problem.sigma(evaluation)
    search = _searches(problem, evaluation, groups)
    search = {label: truncation for label, truncation in search.items() if truncation.worth_it}
    weights: dict[str, Array] = {}
    while not all(truncation.done for truncation in search.values()):
        for label, truncation in search.items():
            if not truncation.done:
                weights[label] = truncation.weights(residuals[label])
        problem.robust_weights = weights
        problem.weigh(evaluation)
        gaussian = problem.linearize(evaluation)
        ordering = problem.ordering()
        step = quick_step(gaussian, ordering)
        if step is None:
            step = eliminated(gaussian, ordering, evaluation.values.dims()).solution()
        after = problem.evaluate(evaluation.values.retract(step))
        if not np.isfinite(after.cost):
            break
        evaluation = after
        residuals = _normalised(problem, evaluation, used, groups)
    found: dict[str, Array] = {}
    for label, truncation in search.items():
        i = groups[label]
        out = truncation.outliers(residuals[label])
        out = _with_windows(problem.observations[i].time, out, used[label])
        factor = problem.noise_factors.get(label)
        least = None if factor is None else LEAST_FACTOR / float(factor.min())
        of_noise = partial(misfit, sigma=sigma[i], unit=problem.observations[i].unit, least=least)
        # Where all of them lead, the objective judges white noise; noise that persists is not yet
        # in the model.
        honest = min(
            of_noise(residuals[label], rejected=np.zeros_like(out)),
            *(persistent_misfit(each[label], sigma[i], least) for each in (before, residuals)),
        )
        if out.any() and of_noise(residuals[label], rejected=out) < honest:
            found[label] = 1.0 - out.astype(float)
    problem.robust_weights = found
    return found, evaluation


def noise_of_the_rest(
    problem: Problem, evaluation: Evaluation, weights: Mapping[str, Array]
) -> dict[str, Array]:
    """Return the factors (d,) of each label on stated noise by what is not rejected.

    Gross errors that were taken for noise made it as large.

    Parameters
    ----------
    problem : Problem
        Weighed with its noise factors.
    evaluation : Evaluation
        Where the rest leads.
    weights : mapping of str to ndarray
        Weights 0 or 1 by label.
    """
    factors = dict(problem.noise_factors)
    groups = {o.label: i for i, o in enumerate(problem.observations)}
    own = {label: groups[label] for label in weights if label in factors}
    residuals = _normalised(problem, evaluation, _used(problem, own), own)
    for label, i in own.items():
        good = np.where(weights[label] > 0.0, residuals[label], np.nan)
        factors[label] = factors[label].copy()
        for group in map(list, problem.observations[i].noise_groups):
            level = float(np.sqrt(np.nanmean(good[:, group] ** 2)))
            factors[label][group] = np.maximum(factors[label][group] * level, LEAST_FACTOR)
    return factors


def _searches(
    problem: Problem, evaluation: Evaluation, groups: Mapping[str, int]
) -> dict[str, Truncation]:
    """Return searches among what is used now, by label."""
    used = _used(problem, groups)
    residuals = _normalised(problem, evaluation, used, groups)
    return {
        label: Truncation(
            residuals[label],
            apart=problem.observations[i].independent,
            unit=1.0 / problem.noise_factors.get(label, np.ones(1)),
        )
        for label, i in groups.items()
        if np.count_nonzero(used[label].any(axis=1)) >= _FEWEST
    }


def _used(problem: Problem, groups: Mapping[str, int]) -> dict[str, BoolArray]:
    return {label: problem.weights[i] > 0.0 for label, i in groups.items()}


def _normalised(
    problem: Problem,
    evaluation: Evaluation,
    used: Mapping[str, BoolArray],
    groups: Mapping[str, int],
) -> dict[str, Array]:
    """Return residuals in standard deviations by label, (M, d); nan where unused."""
    sigma = problem.sigma(evaluation)
    out = {}
    for label, i in groups.items():
        residual = problem.residual(
            problem.observations[i], evaluation.motions[i], evaluation.parameters
        )
        out[label] = np.where(used[label], residual / sigma[i], np.nan)
    return out


def _with_windows(time: Array, out: BoolArray, used: BoolArray) -> BoolArray:
    """Return outliers with what lies between those that are wrong together, same shape."""
    known = used if out.shape[1] > 1 else np.asarray(used.any(axis=1, keepdims=True))
    whole = [o | windows(time, o & k, k) for o, k in zip(out.T, known.T, strict=True)]
    return np.stack(whole, axis=1)
