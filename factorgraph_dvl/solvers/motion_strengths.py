"""Strengths of a motion's prior, of processes and of white noise, by their likelihood."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.priors import Tilt
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.graph.smooth_chain import SmoothChain
from factorgraph_dvl.graph.smooth_motion import SmoothStates
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.statistics.marginal_likelihood import log_determinant_gradient
from factorgraph_dvl.statistics.variance_components import (
    VarianceComponents,
    variance_components,
)

# Change of a logarithm from which on another estimate follows, and the largest of one estimate.
# Chosen: less changes no σ that is shown.
_SAME, _LARGEST = 0.1, 3.0
# Ratio of two steps up to which they are extrapolated. Chosen: five steps in one.
_MOST_RATIO = 0.8
# Movement of the constants, in standard deviations, from which on another estimate follows.
_SAME_CONSTANTS = 0.1
# Longest step of the constants, in standard deviations of all together, that a gradient of the
# log determinant is trusted for. Chosen: it holds over some of them.
_TRUSTED = 3.0
# Degrees of freedom below which a strength changes nothing else. Chosen: one.
_FEWEST = 1.0
# Least and largest densities, rad²/s³ and m²/s³. Chosen: the chain stays regular.
_LEAST, _MOST = np.repeat([1e-14, 1e-10], 3), np.repeat([1.0, 1e2], 3)
# Freedom of a prior at what was assumed, so that a class of few steps keeps its density.
_PRIOR_FREEDOM = 1.0


@dataclass(frozen=True)
class Strengths:
    """What another minimisation assumes.

    Parameters
    ----------
    chain : SmoothChain
        With densities.
    factors : dict of str to ndarray
        By label, factors (d,) on stated white noise.
    processes : tuple of Process
        With their deviations.
    tilt : Tilt
        Gradient of the states' volume by the constants.
    states : SmoothStates
        Of the nodes of this chain.
    values : dict of str to ndarray
        Of all parameters, processes in their new unit.
    steps : dict of str to ndarray
        By strength, changes of the logarithms of its variances that residuals asked for.
    same : bool
        Whether all are about the same as before.
    """

    chain: SmoothChain
    factors: dict[str, Array]
    processes: tuple[Process, ...]
    tilt: Tilt
    states: SmoothStates
    values: dict[str, Array]
    steps: dict[str, Array]
    same: bool


def motion_strengths(
    problem: Problem,
    minimum: Minimum,
    phase: IntArray,
    before: Mapping[str, Array] | None = None,
) -> Strengths:
    """Return strengths by restricted maximum likelihood, and the tilt that goes with them.

    Parameters
    ----------
    problem : Problem
        Of a chain without IMU.
    minimum : Minimum
        Where it ended.
    phase : ndarray of int, shape (K - 1,)
        What the heading does: accelerations have densities of their own in each phase.
    before : mapping of str to ndarray, optional
        `Strengths.steps` of the estimate before.
    """
    chain = problem.chain
    assert isinstance(chain, SmoothChain)
    evaluation = problem.weighed(minimum.evaluation)
    # Nothing holds the constants in what follows.
    problem.tilt = None
    information = minimum.information
    step = information.solution()
    found = variance_components(problem, evaluation, information)
    wanted = _wanted(problem, found, phase)
    steps = {
        name: np.clip(_hastened(step, (before or {}).get(name)), -_LARGEST, _LARGEST)
        for name, (step, _) in wanted.items()
    }
    factors = {
        label: factor * np.exp(0.5 * steps[label])
        for label, factor in problem.noise_factors.items()
    }
    density = chain.density.copy()
    changed = {name: each * (left > _FEWEST) for name, (each, left) in wanted.items()}
    for kind in np.unique(phase).tolist():
        name = f"{chain.step_source} {kind}"
        before_it = density[phase == kind][0]
        after = np.clip(before_it * np.exp(steps[name]), _LEAST, _MOST)
        density[phase == kind] = after
        # At a bound, what is asked for beyond it changes nothing.
        changed[name] = np.where(after == before_it, 0.0, changed[name])
    processes, values = [], dict(evaluation.parameters)
    for process in problem.processes:
        if process.name in steps:
            ratio = np.exp(0.5 * steps[process.name])
            values[process.name] = values[process.name] / ratio
            process = replace(process, sigma=process.sigma * ratio)
        processes.append(process)
    gradient = 0.5 * log_determinant_gradient(problem, evaluation, information)
    every = {
        problem.key(name): np.eye(gradient.size)[:, own] for name, own in problem.columns.items()
    }
    covariance = information.covariance_of([every]) if every else np.zeros((0, 0))
    moved = np.concatenate([step.at(key) for key in every]) if every else np.zeros(0)
    tilt, moved = _next_tilt(evaluation.parameters, covariance, moved, gradient)
    same = max((float(np.abs(c).max()) for c in changed.values()), default=0.0) < 2.0 * _SAME
    same = same and float(np.abs(moved).max(initial=0.0)) < _SAME_CONSTANTS
    chain = replace(chain, density=density)
    return Strengths(
        chain,
        factors,
        tuple(processes),
        tilt,
        evaluation.states,
        values,
        {name: each for name, (each, _) in wanted.items()},
        same,
    )


def _next_tilt(
    values: Mapping[str, Array], covariance: Array, step: Array, gradient: Array
) -> tuple[Tilt, Array]:
    """Return the tilt at some values, and the step of the parameters that it asks for, in σ.

    The gradient holds near by: a longer step than `_TRUSTED` is held back.

    Parameters
    ----------
    values : mapping of str to ndarray
        All parameters.
    covariance : ndarray, shape (P, P)
        Of the estimated parameters.
    step : ndarray, shape (P,)
        To the minimum without a tilt.
    gradient : ndarray, shape (P,)
        Half that of the log determinant.
    """
    sigma = np.sqrt(np.diag(covariance))
    moved = (step - covariance @ gradient) / np.maximum(sigma, 1e-300)
    correlation = covariance / np.maximum(np.outer(sigma, sigma), 1e-300)
    root = np.linalg.cholesky(correlation)
    inverse = np.asarray(solve_triangular(root, np.eye(sigma.size), lower=True))
    far = float(np.linalg.norm(inverse @ moved))
    hold = None
    if far > _TRUSTED:
        hold = np.sqrt(far / _TRUSTED - 1.0) * inverse / sigma
    return Tilt(gradient, sigma, dict(values), hold), moved


def _wanted(
    problem: Problem, found: VarianceComponents, phase: IntArray
) -> dict[str, tuple[Array, Array]]:
    """Return steps of the logarithms of variances and their freedom: noise, motion, processes."""
    out = {}
    for label, white in found.white.items():
        step = 2.0 * np.log(white.factor / problem.noise_factors[label])
        out[label] = step, white.redundancy
    assert found.steps is not None
    squares, freedom = ((each[:, :6] + each[:, 6:]) for each in found.steps)
    for kind in np.unique(phase).tolist():
        total, left = (each[phase == kind].sum(axis=0) for each in (squares, freedom))
        left = np.maximum(left, 0.0)
        ratio = (total + _PRIOR_FREEDOM) / (left + _PRIOR_FREEDOM)
        out[f"{problem.chain.step_source} {kind}"] = np.log(ratio), left
    for process in problem.processes:
        own = found.correlated.get(process.label)
        if own is not None and not process.density_only:
            out[process.name] = 2.0 * np.log(own.factor), own.redundancy
    return out


def _hastened(step: Array, before: Array | None) -> Array:
    """Return steps of a fixed-point iteration that go where their ratio points (Aitken)."""
    if before is None or before.shape != step.shape:
        return step
    known = np.abs(before) > _SAME
    ratio = np.divide(step, before, out=np.zeros_like(step), where=known)
    return np.asarray(step / (1.0 - np.clip(ratio, -1.0, _MOST_RATIO)))
