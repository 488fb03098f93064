"""Strengths of a motion's prior, of processes and of white noise, by their likelihood."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.priors import Tilt
from factorgraph_dvl.graph.problem import Evaluation, Problem, Rows
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.graph.smooth_chain import SmoothChain
from factorgraph_dvl.graph.smooth_motion import SmoothStates
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.phases import each_phase
from factorgraph_dvl.statistics.average_information import (
    RestrictedScore,
    SharedRows,
    restricted_score,
)
from factorgraph_dvl.statistics.marginal_likelihood import (
    by_place,
    constants_of,
    covariance_with_states,
    every_constant,
    leverage_of,
    log_determinant_gradient,
)
from factorgraph_dvl.statistics.rows import CORRELATED, rows_by_source
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation
from factorgraph_dvl.statistics.variance_components import LEAST_FACTOR, LEAST_REDUNDANCY

# Change of a logarithm, and fall of -2 log of the likelihood by it, from which on another estimate
# follows. Chosen: less changes no σ that is shown; 0.7 of its own standard deviation. With 2 in
# place of 0.5, two starts led to lever arms that were 0.2 standard deviations apart.
_SAME, LEAST_GAIN = 0.2, 0.5
# Largest change of one estimate. Chosen: the information holds near by.
_LARGEST = 3.0
# The same of one that goes to zero.
_TO_ZERO = 6.0
# Movement of the constants, in standard deviations, from which on another estimate follows.
_SAME_CONSTANTS = 0.1
# Longest step of the constants, in standard deviations of all together, that a gradient of the
# log determinant is trusted for. Chosen: it holds over some of them.
_TRUSTED = 3.0
# Least and largest densities, rad²/s³ and m²/s³. Chosen: the chain stays regular.
_LEAST, _MOST = np.repeat([1e-14, 1e-10], 3), np.repeat([1.0, 1e2], 3)
# Freedom of a prior at what was assumed, so that a class of few steps keeps its density.
_PRIOR_FREEDOM = 1.0
# The same of what a sensor states of its noise: right within a factor of three.
_STATED_FREEDOM = 1.0 / (2.0 * np.log(3.0) ** 2)


@dataclass(frozen=True)
class Strengths:
    """What another minimisation assumes.

    Parameters
    ----------
    chain : SmoothChain
        Chain with densities.
    factors : dict of str to ndarray
        Factors (d,) of each label on stated white noise.
    processes : tuple of Process
        Processes with their deviations.
    tilt : Tilt
        Gradient of the states' volume by the constants.
    states : SmoothStates
        States of the nodes of this chain.
    values : dict of str to ndarray
        Values of all parameters, processes in their new unit.
    same : bool
        Whether all are about the same as before.
    """

    chain: SmoothChain
    factors: dict[str, Array]
    processes: tuple[Process, ...]
    tilt: Tilt
    states: SmoothStates
    values: dict[str, Array]
    same: bool


def motion_strengths(
    problem: Problem, minimum: Minimum, phase: IntArray, least_gain: float = LEAST_GAIN
) -> Strengths:
    """Return strengths by restricted maximum likelihood, and the tilt that goes with them.

    Parameters
    ----------
    problem : Problem
        Problem of a chain without IMU.
    minimum : Minimum
        Where it ended.
    phase : ndarray of int, shape (K - 1, 6)
        Phases of the accelerations, which have densities of their own in each.
    least_gain : float, optional
        Fall of -2 log of the likelihood by one strength from which on another estimate follows.
    """
    chain = problem.chain
    assert isinstance(chain, SmoothChain)
    evaluation = problem.weighed(minimum.evaluation)
    information = minimum.information
    strengths = _strengths_of(problem, phase)
    score, gradient, covariance = _score(problem, evaluation, information, phase, strengths)
    wanted, gain = _step(strengths, score)
    factors = {label: factor.copy() for label, factor in problem.noise_factors.items()}
    density = chain.density.copy()
    sigma = {process.name: process.sigma.copy() for process in problem.processes}
    places = {(f"{chain.step_source} {kind}", i): where for kind, i, where in each_phase(phase)}
    for i, s in enumerate(strengths):
        own = list(s.components)
        if (s.name, own[0]) in places:
            (component,) = s.components
            where = places[s.name, component]
            before = density[where, component][0]
            after = float(np.clip(before * np.exp(wanted[i]), _LEAST[component], _MOST[component]))
            density[where, component] = after
            # At a bound, what is asked for beyond it changes nothing.
            wanted[i] = np.log(after / before)
        elif s.name in factors:
            before = factors[s.name][own[0]]
            after = max(before * float(np.exp(0.5 * wanted[i])), LEAST_FACTOR)
            factors[s.name][own] = after
            wanted[i] = 2.0 * np.log(after / before)
        else:
            sigma[s.name][own] *= np.exp(0.5 * wanted[i])
    values = dict(evaluation.parameters)
    for process in problem.processes:
        ratio = sigma[process.name] / np.where(process.sigma > 0.0, process.sigma, 1.0)
        nodes = values[process.name].copy()
        nodes[:, : ratio.size] /= np.where(ratio > 0.0, ratio, 1.0)
        values[process.name] = nodes
    if problem.tilt is not None and problem.tilt.hold is None:
        # At a minimum the step is this; where the slope jumps, the linear model has another.
        moved = covariance @ problem.tilt.gradient
    else:
        step = information.solution()
        every = [step.at(problem.key(name)) for name in problem.columns]
        moved = np.concatenate(every or [np.zeros(0)])
    tilt, moved = _next_tilt(evaluation.parameters, covariance, moved, gradient)
    other = (np.abs(wanted) > _SAME) & (gain > least_gain)
    same = not other.any() and float(np.abs(moved).max(initial=0.0)) < _SAME_CONSTANTS
    return Strengths(
        chain=replace(chain, density=density),
        factors=factors,
        processes=tuple(replace(p, sigma=sigma[p.name]) for p in problem.processes),
        tilt=tilt,
        states=evaluation.states,
        values=values,
        same=same,
    )


def _score(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
    phase: IntArray,
    strengths: Sequence[_Strength],
) -> tuple[RestrictedScore, Array, Array]:
    """Return what residuals say of strengths, half the gradient of log det, and P of constants."""
    constants = constants_of(problem)
    shared = list(_rows_of(problem, evaluation, phase, strengths))
    observed = {o.label for o in problem.observations}
    known = {(rows.source, rows.begin) for rows, _, _ in shared if rows.source in observed}
    every = [rows for rows, _, _ in shared]
    every += [r for r in problem.observation_rows(evaluation) if (r.source, r.begin) not in known]
    with_states = covariance_with_states(every, information.given(constants), constants)
    with_constants = information.covariance_with([every_constant(problem)])
    covariance = np.zeros((len(problem.prior_root),) * 2)
    for name, own in problem.columns.items():
        covariance[own] = with_constants[problem.key(name)]
    root = np.linalg.cholesky(np.linalg.inv(covariance))
    parts = []
    for (rows, number, share), with_own in zip(shared, with_states, strict=False):
        h = leverage_of(rows, with_own, with_constants, root, constants)
        parts.append(SharedRows(rows, number, np.broadcast_to(share, number.shape), h))
    score = restricted_score(parts, len(strengths), information)
    gradient = log_determinant_gradient(
        problem, evaluation, information, by_place(every, with_states)
    )
    return score, 0.5 * gradient, covariance


def _step(strengths: Sequence[_Strength], score: RestrictedScore) -> tuple[Array, Array]:
    """Return the changes of logarithms of variances by their information, and what each gains.

    That is the fall of -2 log of the likelihood, by the change of one alone.
    """
    stated = np.array([s.stated for s in strengths])
    own = np.where(stated > 0.0, _STATED_FREEDOM, _PRIOR_FREEDOM)
    squares = score.squares + own * np.where(stated > 0.0, stated, 1.0)
    freedom = np.maximum(score.freedom, 0.0) + own
    # What of the score a change leaves is squares exp(-change) - freedom where nothing but this
    # variance is known, and there this is its change, however large.
    slope = squares * np.log(squares / freedom)
    bend = score.information + np.diag(squares - score.squares)
    # What is smaller by far than stated is that of a record that was smoothed: see `LEAST_FACTOR`.
    smoothed = (stated == 1.0) & (squares < LEAST_FACTOR**2 * freedom)
    held = smoothed | ((stated > 0.0) & (score.freedom < LEAST_REDUNDANCY))
    slope[held] = 0.0
    bend[held], bend[:, held] = 0.0, 0.0
    bend[held, held] = 1.0
    change = np.clip(np.linalg.solve(bend, slope), -_LARGEST, _LARGEST)
    # A variance that goes to zero does so along a line, its logarithm for ever.
    plain = np.linalg.solve(bend, np.where(held, 0.0, squares - freedom))
    weak = (plain < 0.0) & (2.0 * np.diag(bend) < squares)
    change[weak] = np.log(np.maximum(1.0 + plain[weak], np.exp(-_TO_ZERO)))
    return change, (squares - freedom) * change - 0.5 * np.diag(bend) * change**2


def _next_tilt(
    values: Mapping[str, Array], covariance: Array, step: Array, gradient: Array
) -> tuple[Tilt, Array]:
    """Return the tilt at some values, and the step of the parameters that it asks for, in σ.

    The gradient is valid near by. Where it alone moves the parameters by more than `_TRUSTED`,
    they are damped.

    Parameters
    ----------
    values : mapping of str to ndarray
        All parameters.
    covariance : ndarray, shape (P, P)
        Covariance of the estimated parameters.
    step : ndarray, shape (P,)
        Step to the minimum without a tilt.
    gradient : ndarray, shape (P,)
        Half that of the log determinant.
    """
    sigma = np.sqrt(np.diag(covariance))
    by_gradient = covariance @ gradient / np.maximum(sigma, 1e-300)
    moved = step / np.maximum(sigma, 1e-300) - by_gradient
    correlation = covariance / np.maximum(np.outer(sigma, sigma), 1e-300)
    root = np.linalg.cholesky(correlation)
    inverse = np.asarray(solve_triangular(root, np.eye(sigma.size), lower=True))
    far = float(np.linalg.norm(inverse @ by_gradient))
    hold = None
    if far > _TRUSTED:
        hold = np.sqrt(far / _TRUSTED - 1.0) * inverse / sigma
    return Tilt(gradient, sigma, dict(values), hold), moved


@dataclass(frozen=True)
class _Strength:
    """A variance that residuals may ask to change: of noise, of a motion, or of a process.

    Parameters
    ----------
    name : str
        Label of the noise, phase of the motion, or name of the process.
    components : tuple of int
        Which of its components have this variance.
    stated : float, default 0
        What a sensor states of it over what is assumed; 0 = nothing is stated.
    """

    name: str
    components: tuple[int, ...]
    stated: float = 0.0


def _strengths_of(problem: Problem, phase: IntArray) -> list[_Strength]:
    """Return the strengths of a problem: noise, motion, processes."""
    out = []
    groups = {o.label: o.noise_groups for o in problem.observations}
    for label, factors in problem.noise_factors.items():
        for group in groups[label]:
            out.append(_Strength(label, group, 1.0 / float(factors[group[0]]) ** 2))
    for kind, i, _ in each_phase(phase):
        out.append(_Strength(f"{problem.chain.step_source} {kind}", (i,)))
    for process in problem.processes:
        if process.density_only or not (process.label in problem.noise_factors or process.free):
            continue
        together = groups.get(process.label, (tuple(range(process.sigma.size)),))
        out += [_Strength(process.name, group) for group in together]
    return out


def _rows_of(
    problem: Problem, evaluation: Evaluation, phase: IntArray, strengths: Sequence[_Strength]
) -> Iterator[tuple[Rows, IntArray, Array]]:
    """Yield the rows of strengths, which has each, and which share of its variance."""
    number = {(s.name, c): i for i, s in enumerate(strengths) for c in s.components}
    labels = [o.label for o in problem.observations]
    own = _own_shares(problem, evaluation)
    processes = {CORRELATED.format(p.label): p.name for p in problem.processes}
    for rows in rows_by_source(problem, evaluation):
        d = rows.vector.shape[1]
        if rows.source == problem.chain.step_source:
            own_phase = phase[rows.begin : rows.begin + len(rows.vector)]
            numbers = np.empty_like(own_phase)
            for kind, i, where in each_phase(own_phase):
                numbers[where, i] = number[f"{rows.source} {kind}", i]
            # Turn and shift, then what rates change by.
            yield rows, np.tile(numbers, (1, d // 6)), np.ones(d)
            continue
        name = processes.get(rows.source, rows.source)
        each = np.array([number.get((name, i), -1) for i in range(d)])
        if not np.any(each >= 0):
            continue
        share = np.ones(d)
        if rows.source in labels:
            share = own[rows.source][rows.begin : rows.begin + len(rows.vector)]
            long_run = problem.long_run.get(rows.source, 1.0)
            rows = replace(rows, vector=rows.vector * long_run)
        yield rows, np.broadcast_to(each, rows.vector.shape), share


def _own_shares(problem: Problem, evaluation: Evaluation) -> dict[str, Array]:
    """Return the shares of the variance of measurements that are their own noise, by label."""
    none = {o.label: np.zeros(len(o.components)) for o in problem.observations}
    out = {}
    for o, sigma, others, weight in zip(
        problem.observations,
        problem.sigma(evaluation),
        problem.sigma(evaluation, none),
        problem.weights,
        strict=True,
    ):
        ratio = np.divide(others, sigma, out=np.ones(weight.shape), where=weight > 0.0)
        out[o.label] = 1.0 - ratio**2
    return out
