"""Deviation and correlation time of correlated noise, from what the whole graph says of it.

Residuals alone show too short a correlation time: the trajectory follows what is slow.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.processes import Process, walk_time
from factorgraph_dvl.solvers.levenberg_marquardt import factorized
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Steps at most, and the change of a logarithm from which on one counts. Chosen: a tenth of what
# is usually uncertain.
_STEPS = 12
_SAME = 0.03
# Ratio of two steps up to which they are extrapolated. Chosen: ten steps in one.
_MOST_RATIO = 0.9
# Largest logarithm of a step. Chosen: a factor of e.
_LARGEST = 1.0
# Least correlation of two nodes. Chosen: less has a time far below the spacing.
_LEAST_CORRELATION = 1e-3


def refitted(problem: Problem, evaluation: Evaluation) -> tuple[Process, ...]:
    """Return the processes with the deviations and times of the restricted maximum likelihood.

    By expectation and maximisation (Shumway and Stoffer, An approach to time series smoothing
    and forecasting using the EM algorithm, Journal of Time Series Analysis 3(4), 1982) with
    steps extrapolated; the motion is linearised where it is. Where a record is too short to show
    more than a density, deviations stay above the least, and times follow the density.

    Parameters
    ----------
    problem : Problem
        What was minimised.
    evaluation : Evaluation
        Its minimum.
    """
    before = problem.processes
    free = [
        p.label in problem.noise_factors and bool(p.sigma.any() or p.free_walk is not None)
        for p in before
    ]
    if not any(free):
        return before
    parameters = dict(evaluation.parameters)
    last: list[Array | None] = [None] * len(before)
    for _ in range(_STEPS):
        at = problem.evaluate(problem.values(evaluation.states, parameters))
        information, delta = factorized(problem, at)
        found = list(problem.processes)
        moved = 0.0
        for i, process in enumerate(problem.processes):
            if not free[i]:
                continue
            nodes = at.parameters[process.name] + np.array(
                [delta.at(process.key(j)) for j in range(process.time.size)]
            )
            step, of_walk = _step(process, nodes, information)
            moved = max(moved, float(np.abs(step).max()), abs(of_walk))
            found[i] = _moved(process, _extrapolated(step, last[i]), of_walk)
            last[i] = step if last[i] is None else None
            # The same error in another unit.
            grown = np.ones(process.size)
            later = found[i].sigma
            np.divide(process.sigma, later, out=grown[: later.size], where=later > 0.0)
            grown[later.size :] = np.exp(-of_walk)
            parameters[process.name] = at.parameters[process.name] * grown
        if moved < _SAME:
            break
        problem.processes = tuple(found)
    after, problem.processes = problem.processes, before
    return after


def _step(
    process: Process, nodes: Array, information: SquareRootInformation
) -> tuple[Array, float]:
    """Return the changes of logarithms: of deviation and time, (2, n), and of a walk's rate.

    0 where there is none, or where it is as stated.
    """
    pairs = [(process.key(j), process.key(j + 1)) for j in range(process.time.size - 1)]
    joint = np.array(information.joint_covariances(pairs))
    n, size = process.sigma.size, process.size
    variance = np.diagonal(joint, axis1=1, axis2=2)
    own = np.concatenate([variance[:1, :n], variance[:, size : size + n]])
    cross = np.diagonal(joint[:, :n, size : size + n], axis1=1, axis2=2)
    dt = np.diff(process.time)
    of_walk = 0.0
    if process.free_walk is not None:
        weight = np.exp(-dt / walk_time(process.time))
        step = np.column_stack([-weight, np.ones(dt.size)])
        at = joint[:, [[size - 1], [-1]], [size - 1, -1]]
        spread = np.einsum("ji,jik,jk->j", step, at, step)
        change = nodes[1:, -1] - weight * nodes[:-1, -1]
        of_walk = 0.5 * float(np.log(np.mean((change**2 + spread) / (1.0 - weight**2))))
    nodes = nodes[:, :n]
    spacing = float(np.median(dt))
    regular = np.abs(dt / spacing - 1.0) < 0.5
    square = nodes**2 + own
    s00, s11 = square[:-1][regular].sum(axis=0), square[1:][regular].sum(axis=0)
    s10 = (nodes[:-1] * nodes[1:] + cross)[regular].sum(axis=0)
    count = int(regular.sum())
    phi = np.clip(s10 / s00, _LEAST_CORRELATION, 1.0 - 1e-9)
    span = float(np.ptp(process.time))
    # What is shorter than the spacing is white; what is longer than the trial is a constant.
    tau = np.clip(-spacing / np.log(phi), spacing, span)
    phi = np.exp(-spacing / tau)
    innovation = (s11 - 2.0 * phi * s10 + phi**2 * s00) / count
    sigma = process.sigma * np.sqrt(innovation / (1.0 - phi**2))
    active = process.sigma > 0.0
    ratio = np.where(active, sigma, 1.0) / np.where(active, process.sigma, 1.0)
    step = np.stack([np.log(ratio), np.where(active, np.log(tau / process.tau), 0.0)])
    return _above_least(process, step), of_walk


def _above_least(process: Process, step: Array) -> Array:
    """Return a step that ends above the least deviation, with the same density 2 sigma² / tau."""
    if process.least_sigma is None:
        return step
    active = process.sigma > 0.0
    ratio = np.divide(process.least_sigma, process.sigma, out=np.ones(active.size), where=active)
    lack = np.where(active, np.maximum(np.log(ratio) - step[0], 0.0), 0.0)
    return step + np.stack([lack, 2.0 * lack])


def _extrapolated(step: Array, before: Array | None) -> Array:
    """Return the sum of a geometric series of steps, after two of them (Aitken)."""
    if before is None:
        return step
    ratio = np.divide(step, before, out=np.zeros_like(step), where=before != 0.0)
    return np.asarray(step / (1.0 - np.clip(ratio, 0.0, _MOST_RATIO)))


def _moved(process: Process, step: Array, of_walk: float) -> Process:
    """Return a process after steps of the logarithms."""
    step = _above_least(process, np.clip(step, -_LARGEST, _LARGEST))
    tau = process.tau * np.exp(step[1])
    if process.least_sigma is None:
        tau = np.minimum(tau, float(np.ptp(process.time)))
    walk = process.walk
    if walk is not None:
        walk = replace(walk, rate=walk.rate * float(np.exp(of_walk)))
    return replace(process, sigma=process.sigma * np.exp(step[0]), tau=tau, walk=walk)
