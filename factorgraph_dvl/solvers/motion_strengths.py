"""Strengths of a motion's prior, of processes and of white noise, by their likelihood."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.priors import Tilt
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.graph.smooth_chain import SmoothChain
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, factorized
from factorgraph_dvl.statistics.marginal_likelihood import log_determinant_gradient
from factorgraph_dvl.statistics.variance_components import variance_components

# Change of a logarithm from which on another estimate follows, and the largest of one estimate.
# Chosen: less changes no σ that is shown.
_SAME, _LARGEST = 0.1, 2.0
# Movement of the constants, in standard deviations, from which on another estimate follows.
_SAME_CONSTANTS = 0.1
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
    values : dict of str to ndarray
        Of all parameters, processes in their new unit.
    same : bool
        Whether all are about the same as before.
    """

    chain: SmoothChain
    factors: dict[str, Array]
    processes: tuple[Process, ...]
    tilt: Tilt
    values: dict[str, Array]
    same: bool


def motion_strengths(problem: Problem, minimum: Minimum, phase: IntArray) -> Strengths:
    """Return strengths by restricted maximum likelihood, and the tilt that goes with them.

    Parameters
    ----------
    problem : Problem
        Of a chain without IMU.
    minimum : Minimum
        Where it ended.
    phase : ndarray of int, shape (K - 1,)
        What the heading does: accelerations have densities of their own in each phase.
    """
    chain = problem.chain
    assert isinstance(chain, SmoothChain)
    problem.weigh(minimum.evaluation)
    evaluation = problem.weighed(minimum.evaluation)
    information, _ = factorized(problem, evaluation)
    found = variance_components(problem, evaluation, information)
    changes = []
    factors = dict(problem.noise_factors)
    for label, each in found.white.items():
        changes.append(np.log(each.factor / factors[label]))
        factors[label] = each.factor
    density = chain.density.copy()
    assert found.steps is not None
    squares, freedom = ((each[:, :6] + each[:, 6:]) for each in found.steps)
    for kind in np.unique(phase):
        where = phase == kind
        total, left = squares[where].sum(axis=0), freedom[where].sum(axis=0)
        ratio = (total + _PRIOR_FREEDOM) / (np.maximum(left, 0.0) + _PRIOR_FREEDOM)
        ratio = np.exp(np.clip(np.log(ratio), -_LARGEST, _LARGEST))
        after = np.clip(density[where] * ratio, _LEAST, _MOST)
        changes.append(np.log(after[0] / density[where][0]) * (left > 1.0))
        density[where] = after
    processes, values = [], dict(evaluation.parameters)
    for process in problem.processes:
        own = found.correlated.get(process.label)
        if own is not None and not process.density_only:
            ratio = np.clip(own.factor, np.exp(-1.0), np.exp(1.0))
            changes.append(np.log(ratio) * (own.redundancy > 1.0))
            values[process.name] = values[process.name] / ratio
            process = replace(process, sigma=process.sigma * ratio)
        processes.append(process)
    gradient = 0.5 * log_determinant_gradient(problem, evaluation, information)
    every = {
        problem.key(name): np.eye(gradient.size)[:, own] for name, own in problem.columns.items()
    }
    covariance = information.covariance_of([every]) if every else np.zeros((0, 0))
    tilt = Tilt(gradient, np.sqrt(np.diag(covariance)), dict(evaluation.parameters))
    before = problem.tilt.gradient if problem.tilt is not None else np.zeros(gradient.size)
    moved = covariance @ (gradient - before) / np.maximum(tilt.sigma, 1e-300)
    same = max((float(np.abs(c).max()) for c in changes), default=0.0) < _SAME
    same = same and float(np.abs(moved).max(initial=0.0)) < _SAME_CONSTANTS
    return Strengths(
        replace(chain, density=density), factors, tuple(processes), tilt, values, same
    )
