"""Deviation and correlation time of correlated noise, from what the whole graph says of it.

Residuals alone show too short a correlation time: the trajectory follows what is slow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.processes import Activity, Process
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
# Largest share of what an error follows. Chosen: between two manoeuvres some of it is left.
_MOST_SHARE = 0.999
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
    free = [p.label in problem.noise_factors and bool(p.sigma.any()) for p in before]
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
            squares = _Squares.of(process, nodes, information)
            if process.activity is not None:
                shares, _ = _following(process, process.activity, squares)
                process = replace(process, activity=shares)
            step = _step(process, squares)
            moved = max(moved, float(np.abs(step).max()))
            found[i] = _moved(process, _extrapolated(step, last[i]))
            last[i] = step if last[i] is None else None
            # The same error in another unit.
            grown = np.ones(process.size)
            later = found[i].sigma
            np.divide(process.sigma, later, out=grown[: later.size], where=later > 0.0)
            parameters[process.name] = at.parameters[process.name] * grown
        if moved < _SAME:
            break
        problem.processes = tuple(found)
    after, problem.processes = problem.processes, before
    return after


@dataclass(frozen=True)
class _Squares:
    """Expected squares of the nodes of a process, and products of one with the next.

    Parameters
    ----------
    before, after, product : ndarray, shape (J - 1, n)
        Of the two nodes of each transition.
    """

    before: Array
    after: Array
    product: Array

    @classmethod
    def of(cls, process: Process, nodes: Array, information: SquareRootInformation) -> _Squares:
        pairs = [(process.key(j), process.key(j + 1)) for j in range(process.time.size - 1)]
        joint = np.array(information.joint_covariances(pairs))
        n, size = process.sigma.size, process.size
        variance = np.diagonal(joint, axis1=1, axis2=2)
        own = np.concatenate([variance[:1, :n], variance[:, size : size + n]])
        cross = np.diagonal(joint[:, :n, size : size + n], axis1=1, axis2=2)
        nodes = nodes[:, :n]
        square = nodes**2 + own
        return cls(square[:-1], square[1:], nodes[:-1] * nodes[1:] + cross)

    def innovations(self, phi: Array) -> Array:
        """Return the expected squares of innovations with correlations of (J - 1, n) or (n,)."""
        return self.after - 2.0 * phi * self.product + phi**2 * self.before


def _step(process: Process, squares: _Squares) -> Array:
    """Return the change of the logarithms of deviation and time, (2, n); 0 where there is none."""
    dt = np.diff(process.time)
    spacing = float(np.median(dt))
    regular = np.abs(dt / spacing - 1.0) < 0.5
    weight = 1.0 / process.innovations[regular]
    s00 = np.sum(weight * squares.before[regular], axis=0)
    s10 = np.sum(weight * squares.product[regular], axis=0)
    phi = np.clip(s10 / s00, _LEAST_CORRELATION, 1.0 - 1e-9)
    span = float(np.ptp(process.time))
    # What is shorter than the spacing is white; what is longer than the trial is a constant.
    tau = np.clip(-spacing / np.log(phi), spacing, span)
    phi = np.exp(-spacing / tau)
    innovation = np.mean(weight * squares.innovations(phi)[regular], axis=0)
    sigma = process.sigma * np.sqrt(innovation / (1.0 - phi**2))
    active = process.sigma > 0.0
    ratio = np.where(active, sigma, 1.0) / np.where(active, process.sigma, 1.0)
    return np.stack([np.log(ratio), np.where(active, np.log(tau / process.tau), 0.0)])


def _following(process: Process, activity: Activity, squares: _Squares) -> tuple[Activity, float]:
    """Return an activity with the shares that innovations follow, and the gain against none.

    The gain is the fall of -2 log of the likelihood of the nodes.
    """
    relative = activity.between(process.time)
    phi = np.exp(-np.diff(process.time)[:, None] / process.tau)
    unit = squares.innovations(phi) / (1.0 - phi**2)
    share, gain = np.zeros(process.sigma.size), 0.0

    def cost(own: float, square: Array) -> float:
        variance = 1.0 - own + own * relative
        return float(np.log(np.mean(square / variance)) + np.mean(np.log(variance)))

    for i in np.flatnonzero(process.sigma > 0.0).tolist():
        found = minimize_scalar(
            cost, bounds=(0.0, _MOST_SHARE), args=(unit[:, i],), method="bounded"
        )
        share[i] = found.x
        gain += len(relative) * (cost(0.0, unit[:, i]) - found.fun)
    return replace(activity, share=share), gain


def following(
    process: Process, activity: Activity, nodes: Array, information: SquareRootInformation
) -> tuple[Process, float]:
    """Return a process whose innovations follow an activity, and how much more likely it is.

    Parameters
    ----------
    process : Process
        Its innovations are alike.
    activity : Activity
        What they may follow.
    nodes : ndarray, shape (J, size)
        Its nodes at the minimum.
    information : SquareRootInformation
        Information there.
    """
    squares = _Squares.of(process, nodes, information)
    found, gain = _following(process, activity, squares)
    return replace(process, activity=found), gain


def _extrapolated(step: Array, before: Array | None) -> Array:
    """Return the sum of a geometric series of steps, after two of them (Aitken)."""
    if before is None:
        return step
    ratio = np.divide(step, before, out=np.zeros_like(step), where=before != 0.0)
    return np.asarray(step / (1.0 - np.clip(ratio, 0.0, _MOST_RATIO)))


def _moved(process: Process, step: Array) -> Process:
    """Return a process after a step of the logarithms."""
    sigma, tau = np.exp(step)
    sigma, tau = process.sigma * sigma, process.tau * tau
    if process.least_sigma is None:
        tau = np.minimum(tau, float(np.ptp(process.time)))
    else:
        known = np.where(sigma > 0.0, sigma, 1.0)
        short = np.maximum(np.where(sigma > 0.0, process.least_sigma, 1.0) / known, 1.0)
        sigma, tau = sigma * short, tau * short**2
    ratio = np.divide(sigma, process.sigma, out=np.ones(sigma.size), where=sigma > 0.0)
    most = np.exp(_LARGEST)
    return replace(
        process,
        sigma=process.sigma * np.clip(ratio, 1.0 / most, most),
        tau=process.tau * np.clip(tau / process.tau, 1.0 / most, most),
    )
