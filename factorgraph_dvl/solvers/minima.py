"""Several minima of one trial: how short trials reach others, and which is more probable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from factorgraph_dvl.estimates import OBSERVABLE, Hypothesis, mixed
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import ambiguity
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solution import Progress, Solution
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, minimise
from factorgraph_dvl.solvers.preparation import ROUGH_TOLERANCE, Preparation, Prepared
from factorgraph_dvl.solvers.rounds import SettledMinimum, settle

# Length, s, up to which start values may lead to a wrong minimum, and standard deviation, rad,
# of a mounting from which on it may. Chosen:
# in so short a time neither heading nor mounting may be known without the DVL.
_SHORT = 30.0
_ANY_ANGLE = 45.0 * DEG
# Headings to start from, rad. Chosen: no heading is more than 45 degrees from one of them.
_HEADINGS = np.array([0.0, 90.0, 180.0, 270.0]) * DEG
# Starts that are minimised roughly, those of the lowest cost, and steps for each. Chosen: the
# four best mountings for each heading.
_STARTS = 16
_START_ITERATIONS = 15
# Cost above the best one from which on a rough minimum is not followed, and angle, rad, up to
# which two minima are the same. Chosen: a likelihood of e^-30; a sixth of what
# separates the headings.
_ROUGHLY_AS_GOOD = 30.0
_SAME_ANGLE = 15.0 * DEG
# Evidence against a minimum with which it is not worth a word. Chosen: a probability of e^-15.
_IMPOSSIBLE = 15.0


def competing_minima(
    prepared: Prepared, states: Any, report: Progress, *, roughly: bool = False
) -> list[SettledMinimum]:
    """Return the minimum that some states lead to, then others that are about as probable.

    In some seconds neither heading nor mounting is known before the DVL is used, and start
    values lead to any of several minima. From longer trials they lead to the right one, as they do
    without an IMU: a sensor then measures the heading.

    Parameters
    ----------
    prepared : Prepared
        Chain, measurements and parameters.
    states : object
        Where to start, as the chain has it.
    report : callable
        Called with stage, iteration and cost.
    roughly : bool, default False
        Whether records contradict each other: that of `settle`.
    """
    first = settle(prepared, states, report, roughly=roughly)
    rotations = [p for p in prepared.parameters if p.rotation and p.estimated]
    time = first.problem.chain.node_time
    is_free = any(p.sigma.max() > _ANY_ANGLE for p in rotations)
    long = time[-1] - time[0] > _SHORT
    if roughly or long or not is_free or not isinstance(prepared, Preparation):
        return [first]
    report("other mountings", 0, None)
    out = [first]
    for against, each in _rough_minima(prepared, first, states):
        found = each.evaluation
        best = min(_against(m.problem, m.minimum.evaluation) for m in out)
        if against > best + _ROUGHLY_AS_GOOD:
            break
        if _is_among(out, found, rotations):
            continue
        other = settle(prepared, found.states, report, values=found.parameters)
        if not _is_among(out, other.minimum.evaluation, rotations):
            out.append(other)
    return out


def _rough_minima(
    prepared: Preparation, first: SettledMinimum, states: States
) -> list[tuple[float, Minimum]]:
    """Return minima from all headings and mountings, lowest first, with what is against each."""
    chain = prepared.chain(first.minimum.evaluation.states)
    tilt = first.problem.tilt
    if tilt is not None:
        tilt = tilt.of(first.problem.parameters, [p for p in prepared.parameters if p.estimated])
    # A problem of their own: minimising weighs the measurements anew.
    problem = Problem(
        chain,
        prepared.observations,
        prepared.parameters,
        start=first.minimum.evaluation.parameters,
        tilt=tilt,
    )
    problem.noise_factors = first.problem.noise_factors
    problem.noise_growth = first.problem.noise_growth
    problem.robust_weights = first.problem.robust_weights
    rotations = {p.name for p in problem.parameters if p.rotation}
    mountings = prepared.mountings_at(chain, states)
    starts = []
    for angle in _HEADINGS:
        turn = exp_so3(np.array([0.0, 0.0, angle]))
        turned = replace(states, nRb=turn @ states.nRb)
        # The sensors keep their attitude in n, at least at first.
        back = states.nRb[0].T @ turn @ states.nRb[0]
        for mounting in mountings:
            values = prepared.mountings | {
                name: value @ back if name in rotations else value
                for name, value in mounting.items()
            }
            at = problem.values(turned, problem.prior_values() | values)
            starts.append((problem.evaluate(at).cost, at))
    rough = []
    for _, at in sorted(starts, key=lambda s: s[0])[:_STARTS]:
        found = minimise(
            problem,
            at,
            stage="other mountings",
            max_iterations=_START_ITERATIONS,
            tolerance=ROUGH_TOLERANCE,
            proven=False,
        )
        # The next one weighs the measurements anew.
        rough.append((_against(problem, found.evaluation), found))
    return sorted(rough, key=lambda each: each[1].evaluation.cost)


def _is_among(
    minima: Sequence[SettledMinimum] | Sequence[SolvedProblem],
    one: Evaluation,
    rotations: Sequence[Parameter],
) -> bool:
    """Whether attitude and mountings are those of another minimum, judged by angles."""
    for each in minima:
        other = each.minimum.evaluation
        pairs = [(one.parameters[p.name], other.parameters[p.name]) for p in rotations]
        pairs.append((one.states.nRb[0], other.states.nRb[0]))
        if all(float(np.linalg.norm(log_so3(a.T @ b))) < _SAME_ANGLE for a, b in pairs):
            return True
    return False


def distinct(prepared: Prepared, minima: Sequence[SolvedProblem]) -> list[SolvedProblem]:
    """Return the most probable of the minima that are the same now, once for each.

    Some differed only along what the data do not determine, which is fixed at the prior since.

    Parameters
    ----------
    prepared : Prepared
        What all started from.
    minima : sequence of SolvedProblem
        Minima with their covariances.
    """
    rotations = [p for p in prepared.parameters if p.rotation and p.estimated]
    out: list[SolvedProblem] = []
    for each in sorted(minima, key=evidence_against):
        if not _is_among(out, each.minimum.evaluation, rotations):
            out.append(each)
    return out


def evidence_against(found: SolvedProblem) -> float:
    """Return the negative logarithm of the posterior probability about a minimum.

    Laplace's approximation: a minimum that is wide is more probable than a narrow one.
    """
    _, log_det = np.linalg.slogdet(found.covariances.parameters)
    return _against(found.problem, found.minimum.evaluation) - 0.5 * float(log_det)


def _against(problem: Problem, evaluation: Evaluation) -> float:
    """Return the negative logarithm of the posterior density, but for a constant."""
    return evaluation.cost + sum(float(part.sum()) for part in problem.log_sigma(evaluation))


def cost_terms(found: SolvedProblem) -> Array:
    """Return the terms of the negative log posterior: of each measurement, and of all priors."""
    problem, evaluation = found.problem, found.minimum.evaluation
    parts = []
    total = 0.0
    for residual, log_sigma in zip(
        evaluation.residuals, problem.log_sigma(evaluation), strict=True
    ):
        own = 0.5 * np.sum(residual**2, axis=1)
        total += own.sum()
        parts.append(own + log_sigma)
    return np.concatenate([*parts, [evaluation.cost - total]])


def joined(
    solutions: Sequence[Solution], against: Array, hypotheses: Sequence[Hypothesis]
) -> Solution:
    """Return the most likely of some solutions, with what is known of the others.

    Parameters
    ----------
    solutions : sequence of Solution
        Solutions of the living hypotheses.
    against : ndarray, shape (S,)
        Negative logarithms of their likelihoods, relative to the best.
    hypotheses : sequence of Hypothesis
        What the search for a start found: the living, in the order of `solutions`, then the dead.
        Empty if there was no search.
    """
    if len(solutions) == 1 and len(hypotheses) < 2:
        return solutions[0]
    weights = np.exp(-against) / np.exp(-against).sum()
    order = np.argsort(-weights)
    living = [
        replace(hypotheses[i], weight=float(weights[i]), trajectory=solutions[i].trajectory)
        for i in order
    ]
    every = (*living, *hypotheses[len(solutions) :])
    best = solutions[order[0]]
    return replace(
        best,
        converged=all(s.converged for s in solutions),
        trajectory=mixed([solutions[i].trajectory for i in order], weights[order]),
        hypotheses=every,
        findings=(*best.findings, *ambiguity(every)),
    )


def most_probable_minimum(solutions: Sequence[Solution], against: Array) -> Solution:
    """Return the most probable of some minima of one problem, with the spread of the others.

    Parameters
    ----------
    solutions : sequence of Solution
        Solutions at the minima, with the same estimates and epochs.
    against : ndarray, shape (S,)
        Negative logarithms of their probabilities.
    """
    order = [i for i in np.argsort(against) if against[i] - against.min() < _IMPOSSIBLE]
    best = solutions[order[0]]
    if len(order) == 1:
        return best
    weights = np.exp(against.min() - against[order])
    weights /= weights.sum()
    values = [np.concatenate([e.value for e in solutions[i].estimates]) for i in order]
    covariance = np.zeros_like(best.covariance)
    for i, weight, value in zip(order, weights, values, strict=True):
        deviation = value - values[0]
        covariance += weight * (solutions[i].covariance + np.outer(deviation, deviation))
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    estimates, at = [], 0
    for k, e in enumerate(best.estimates):
        own = std[at : at + e.std.size]
        at += e.std.size
        seen = np.all([solutions[i].estimates[k].observable for i in order], axis=0)
        seen &= own <= OBSERVABLE * e.prior_std
        estimates.append(replace(e, std=own, observable=seen))
    turned = [
        message("words.at", name=e.name, value=str(np.round(e.value, 1).tolist()))
        for i in order[1:]
        for e in solutions[i].estimates
        if e.spec.kind == "rotation"
    ]
    return replace(
        best,
        converged=all(solutions[i].converged for i in order),
        # That of one minimum does not explain the spread of all.
        error_budget=(),
        estimates=tuple(estimates),
        covariance=covariance,
        trajectory=mixed([solutions[i].trajectory for i in order], weights),
        findings=(
            *best.findings,
            Finding(
                Code.AMBIGUOUS,
                message(
                    "ambiguous.minima", count=len(order), weights=weights, others=tuple(turned)
                ),
            ),
        ),
    )
