"""Batch smoothing of a trial without IMU: minimise, weigh, strength of the prior by likelihood."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri

from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.bordered_chain import Covariances, Factorisation
from factorgraph_dvl.graph.motion_chain import MotionChain
from factorgraph_dvl.graph.motion_problem import (
    CURRENT,
    TRACK_STD,
    MotionEvaluation,
    MotionProblem,
    with_sigma,
)
from factorgraph_dvl.graph.priors import after_step, local_coordinates
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.message import message
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.motion_preparation import MotionPreparation
from factorgraph_dvl.statistics.robust_weights import robust_scale

# Decrease of the cost that the linear model still promises at a minimum, and steps of the first
# round, which starts far off, and of others, in which noise and strengths move the minimum.
_CONVERGED = 1e-3
# The same while noise and strengths still change. Chosen: 0.3 standard deviations of a constant,
# as the next round moves it by more.
_NEAR_ENOUGH = 0.05
_FAR_STEPS = 6
# Change of constants within two rounds, in standard deviations, below which steps count as those
# at a minimum with a kink: the acceleration jumps at a node, where a clock may move a measurement.
_STILL = 0.05
_STEPS = 3
# Standard deviations by which a new slope of the cost may move the minimum at the end.
# Chosen: it follows noise and strengths, which are known no better.
_PULLED = 0.1
# Share by which a cost may miss what the linear model promised before another length of the step
# is tried, and the longest of these. Chosen: well above rounding, and what clocks need.
_POOR = 0.3
_LONGEST_STEP = 4.0
# Rounds of weights, noise and strength after which they count as not settled, and the relative
# change of a standard deviation from which on there is another. Measured: most take four to ten, a
# river boat with five searches for outliers 45.
_ROUNDS = 60
_SAME = 0.03
# Change of the logarithm of a noise factor below which it is extrapolated. Chosen: larger ones are
# those of the first rounds, in which outliers and clocks move them.
_SLOW = 0.1
# Degrees of freedom of what is known of a standard deviation: as of the sensors with an IMU.
_PRIOR_FREEDOM = 0.4
_LEAST_REDUNDANCY = 10.0
# Least factor on stated noise; residuals of less are those of a record that was smoothed.
_LEAST_FACTOR = 0.1
# Probability with which a good measurement passes the gate, factor on the gate from which on it is
# worth a search, and the share of outliers from which on it is the model that is wrong.
_GATE = 0.999
_WORTH = 2.0
_TOO_MANY = 0.4
# How often outliers are searched before anything else, and in all. Chosen: the second search finds
# those that the first hid, and the last ones judge them by the noise that was found.
_FIRST_SEARCHES = 2
_SEARCHES = 5
_CURRENT = message("not_converged.current")
# Rounds from one search for the strength of the current to the next, while all else changes.
_CURRENT_ROUNDS = 5
# Reach of the first and the later searches by the logarithm of the strength, and their precision.
_FAR, _NEAR, _FINEST = 0.7, 0.2, 0.03
# Limits of the strength of a current: m/s and s, by its logarithm. Chosen: a current that changes
# faster is noise of pings. A limit of 60 s, in a tidal race of 20 to 30 s, took slow changes for
# more uncertain, and fast ones for less, than they were.
_CURRENT_STD = (math.log(0.005), math.log(2.0))
_CURRENT_TIME = (math.log(3.0), math.log(2e5))
# Density of acceleration, relative to that in turns, which changes nothing; and the largest step
# of its logarithm.
_NEGLIGIBLE = 1e-3
_LARGEST_STEP = 3.0
# Range of the density of acceleration, m²/s³. Chosen: a velocity that wanders by 1 mm/s in 100 s,
# and beyond what vessels do.
_DENSITY = (1e-8, 1e3)


@dataclass(frozen=True)
class SmoothedMotion:
    """A minimum without IMU, with its covariances.

    Parameters
    ----------
    problem : MotionProblem
        What was minimised.
    evaluation : MotionEvaluation
        Its minimum.
    factors : Factorisation
        Information there.
    covariances : Covariances
        Of the states and the parameters.
    converged : bool
        Whether minimum, weights and strengths have settled.
    iterations : int
        Steps of all rounds.
    findings : tuple of Finding
        What the user must know.
    by_track : ndarray, shape (c,)
        Standard deviations of the constants, with signs, that come from not knowing how much the
        current carries the vessel.
    """

    problem: MotionProblem
    evaluation: MotionEvaluation
    factors: Factorisation
    covariances: Covariances
    converged: bool
    iterations: int
    findings: tuple[Finding, ...]
    by_track: Array

    @property
    def constants(self) -> Array:
        """Covariance of the constants, (c, c), that of the share of the current included."""
        return self.covariances.constants + np.outer(self.by_track, self.by_track)


def smooth_motion(prepared: MotionPreparation, report: Progress) -> SmoothedMotion:
    """Return the minimum of a problem whose noise and prior have the strength that fits best.

    Raises
    ------
    SolveError
        If there is nothing to start from, or no step is possible.
    """
    problem, states, values = prepared.problem, prepared.states, prepared.values
    problem.noise_factors = {
        o.label: np.ones(len(o.components))
        for o in problem.observations
        if o.label in prepared.estimated_noise
    }
    iterations, searches, free_current = 0, 0, prepared.current_is_free
    changing = [message("not_converged.all")]
    last_moved, reach = np.zeros_like(problem.chain.density), _FAR
    earlier, enough = [values], _NEAR_ENOUGH
    last_noise = {label: np.zeros_like(f) for label, f in problem.noise_factors.items()}
    for round_ in range(_ROUNDS):
        evaluation, factors, steps, reached = _minimise(
            problem, states, values, report, far=round_ == 0, enough=enough
        )
        iterations += steps
        states, values = evaluation.states, evaluation.parameters
        covariances = factors.covariances()
        changing = []
        if not reached and _moved(problem, factors, values, earlier[-2:][0]) > _STILL:
            changing.append(message("not_converged.minimum"))
        earlier.append(values)
        slope = problem.slope
        by_track = problem.follow_motion(evaluation, factors, covariances)
        pulled = factors.constants @ (problem.slope - slope)
        if np.any(np.abs(pulled) > _PULLED * np.sqrt(np.diag(factors.constants))):
            changing.append(message("not_converged.minimum"))
        if searches < _FIRST_SEARCHES and _rejects_others(problem, evaluation, covariances):
            searches += 1
            changing.append(message("not_converged.outliers"))
            continue
        noise_moved = {
            label: np.log(found / problem.noise_factors[label])
            for label, found in _noise(problem, evaluation, covariances).items()
        }
        noise = {
            label: problem.noise_factors[label]
            * np.exp(np.where(np.abs(m) < _SLOW, _hastened(m, last_noise[label]), m))
            for label, m in noise_moved.items()
        }
        last_noise = noise_moved
        density = _density(problem, prepared.turning, states, covariances)
        if _differ(noise, problem.noise_factors):
            changing.append(message("not_converged.noise"))
        chain = problem.chain
        moved = np.log(density / chain.density)
        relevant = density > _NEGLIGIBLE * density.max(axis=0)
        if np.max(np.abs(moved) * relevant) > 2.0 * _SAME:
            changing.append(message("not_converged.acceleration"))
        density = np.clip(chain.density * np.exp(_hastened(moved, last_moved)), *_DENSITY)
        last_moved = moved
        # A search takes twenty factorisations: not in every round.
        if free_current and (not changing or round_ % _CURRENT_ROUNDS == _CURRENT_ROUNDS - 1):
            report("current", round_, None)
            chain = _current(problem, evaluation, chain, reach)
            reach = _NEAR
            old, new = (next(p for p in c.processes if p.name == CURRENT)
                        for c in (problem.chain, chain))  # fmt: skip
            states = states.copy()
            states[:, chain.place(CURRENT)] *= old.sigma / new.sigma
            if abs(np.log(new.sigma[0] / old.sigma[0])) > 3.0 * _SAME:
                changing.append(_CURRENT)
            free_current = len(changing) > 1 or _CURRENT in changing
        if (
            not changing
            and searches < _SEARCHES
            and _rejects_others(problem, evaluation, covariances)
        ):
            # What seemed far off while noise and strengths were not known may be none.
            searches += 1
            changing.append(message("not_converged.outliers"))
            if round_ < _ROUNDS - 1:
                continue
        if not changing and enough > _CONVERGED:
            enough = _CONVERGED
            changing.append(message("not_converged.minimum"))
        if not changing or round_ == _ROUNDS - 1:
            break
        problem = problem.with_chain(replace(chain, density=density))
        problem.noise_factors = noise
    findings = prepared.findings
    if changing:
        text = message("not_converged.rounds", rounds=_ROUNDS, changing=changing)
        findings += (Finding(Code.NOT_CONVERGED, text, severity="error"),)
    return SmoothedMotion(
        problem,
        evaluation,
        factors,
        covariances,
        not changing,
        iterations,
        findings,
        TRACK_STD * factors.constants @ by_track,
    )


def _moved(
    problem: MotionProblem,
    factors: Factorisation,
    values: Mapping[str, Array],
    before: Mapping[str, Array],
) -> float:
    """Return by how many standard deviations a constant moved at most."""
    moved = [local_coordinates(p, values[p.name], before[p.name]) for p in problem.parameters]
    sigma = np.sqrt(np.diag(factors.constants))
    return float(np.max(np.abs(np.concatenate(moved)) / sigma, initial=0.0)) if moved else 0.0


def _hastened(moved: Array, before: Array) -> Array:
    """Return steps of a fixed-point iteration that go where their ratio points (Aitken).

    A ratio of steps that change nothing is chance.
    """
    known = (np.abs(before) > 1e-6) & (np.abs(moved) > _SAME)
    ratio = np.divide(moved, before, out=np.zeros_like(moved), where=known)
    ratio = np.clip(ratio, -1.0, 0.8)
    return np.clip(moved / (1.0 - ratio), -_LARGEST_STEP, _LARGEST_STEP)


def _minimise(
    problem: MotionProblem,
    states: Array,
    values: dict[str, Array],
    report: Progress,
    *,
    far: bool,
    enough: float,
) -> tuple[MotionEvaluation, Factorisation, int, bool]:
    """Return the minimum near states and values, its factorisation, steps, and if it was reached.

    It is reached where the cost can decrease by no more than `enough`. From a far start weights
    follow the first steps: a DVL's noise is that of its speed.
    """
    most = _FAR_STEPS if far else _STEPS
    evaluation, cost = _weighted(problem, states, values)
    if not np.isfinite(cost):
        raise SolveError(
            "the cost at the start is not finite",
            where="all sensors",
            hint="Inspect the trial: a unit or a column may be wrong",
        )
    for steps in range(most):
        report("all sensors", steps, cost)
        equations = problem.equations(evaluation)
        try:
            factors = equations.factorise()
        except np.linalg.LinAlgError:
            raise SolveError(
                "the information is not positive definite",
                where="all sensors",
                hint="Inspect the trial: standard deviations may differ by too many digits",
            ) from None
        if factors.decrease < enough:
            return evaluation, factors, steps, True
        after = _lower(problem, evaluation, cost, factors)
        if after is None:
            # No digits are left, or the weights hold the step back.
            return evaluation, factors, steps, factors.decrease < max(enough, 1e-2)
        evaluation, cost = after
        if far and steps < 3:
            evaluation, cost = _weighted(problem, evaluation.states, evaluation.parameters)
    return evaluation, factors, most, False


def _weighted(
    problem: MotionProblem, states: Array, values: dict[str, Array]
) -> tuple[MotionEvaluation, float]:
    """Weigh a problem anew, and return its evaluation and cost."""
    evaluation = problem.weighed(states, values)
    return evaluation, problem.cost(evaluation)


def _lower(
    problem: MotionProblem,
    evaluation: MotionEvaluation,
    cost: float,
    factors: Factorisation,
) -> tuple[MotionEvaluation, float] | None:
    """Return an evaluation of lower cost along a Gauss-Newton step; None if there is none.

    States are linear, clocks are not: where turns are noisy the step of a clock is up to twice
    too long, or much too short. The cost at a second length shows how long it should be, while
    the states follow the constants.
    """
    (dx, dc), promised = factors.step(), factors.decrease

    def along(share: float) -> tuple[MotionEvaluation, float]:
        there = problem.evaluate(
            evaluation.states + dx + factors.influence @ ((1.0 - share) * dc),
            after_step(problem.parameters, evaluation.parameters, share * dc),
        )
        return there, problem.cost(there)

    found = along(1.0)
    by_constants = 0.5 * float(dc @ np.linalg.solve(factors.constants, dc))
    if abs(cost - found[1] - promised) > _POOR * promised and by_constants > _CONVERGED:
        curvature = found[1] - (cost - promised + by_constants) + 2.0 * by_constants
        share = by_constants / max(curvature, by_constants / _LONGEST_STEP)
        other = along(max(share, 1.0 / _LONGEST_STEP))
        found = min(found, other, key=lambda each: each[1])
    share = 0.5
    while not found[1] < cost:
        if share < 1e-3:
            return None
        there = problem.evaluate(
            evaluation.states + share * dx,
            after_step(problem.parameters, evaluation.parameters, share * dc),
        )
        found = there, problem.cost(there)
        share *= 0.5
    return found


def _rejects_others(
    problem: MotionProblem, evaluation: MotionEvaluation, covariances: Covariances
) -> bool:
    """Reject measurements beyond the gate; return whether they are others than before."""
    before, problem.rejected = problem.rejected, _rejected(problem, evaluation, covariances)
    return not _same_rows(problem.rejected, before)


def _rejected(
    problem: MotionProblem, evaluation: MotionEvaluation, covariances: Covariances
) -> dict[str, np.ndarray]:
    """Return measurements beyond the gate, by label: their scale is that of the others."""
    out = {}
    all_residuals = problem.residuals(evaluation, covariances)
    for o, residuals in zip(problem.observations, all_residuals, strict=True):
        known = np.isfinite(residuals).any(axis=1)
        if not o.noise_groups or known.sum() < 20:
            continue
        # A component may never be measured, such as the vertical one of course and speed.
        residuals = residuals[:, np.isfinite(residuals).any(axis=0)]
        # What is slow in residuals is no outlier, however small the noise beside it.
        middle = np.nanmedian(residuals, axis=0)
        spread = 1.4826 * np.nanmedian(np.abs(residuals - middle), axis=0)
        scale = np.maximum(robust_scale(residuals), np.nan_to_num(spread))
        squares = np.nansum((residuals / scale) ** 2, axis=1)
        gate = chdtri(residuals.shape[1], 1.0 - _GATE)
        out_ = known & (squares > gate)
        if squares[known].max() > _WORTH * gate and out_.sum() < _TOO_MANY * known.sum():
            out[o.label] = out_
    return out


def _same_rows(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray]) -> bool:
    rows = ((a.get(k, False), b.get(k, False)) for k in a.keys() | b.keys())
    return all(np.mean(one != other) < 1e-3 for one, other in rows)


def _differ(a: Mapping[str, Array], b: Mapping[str, Array]) -> bool:
    return any(np.max(np.abs(a[k] / b[k] - 1.0)) > _SAME for k in a)


def _noise(
    problem: MotionProblem, evaluation: MotionEvaluation, covariances: Covariances
) -> dict[str, Array]:
    """Return factors on stated standard deviations by restricted maximum likelihood.

    As `statistics.variance_components.noise_factors`: f² <- f² sum s r² / sum s (1 - h), with the
    share s of a residual's variance that is the sensor's own.
    """
    out = dict(problem.noise_factors)
    for o, seen, rows, total in zip(
        problem.observations,
        evaluation.seen,
        problem.rows(evaluation),
        problem.total_sigma,
        strict=True,
    ):
        if o.label not in out:
            continue
        used = np.isfinite(total)
        own = np.where(used, problem.sigma(o, seen, evaluation.parameters), 0.0)
        share = np.where(used, own / np.where(used, total, 1.0), 0.0) ** 2
        squares = np.sum(share * rows.residual**2, axis=0)
        freedom = np.sum(share * (used - rows.leverage(covariances)), axis=0)
        factor = out[o.label].copy()
        for group in map(list, o.noise_groups):
            left = float(freedom[group].sum())
            if left < _LEAST_REDUNDANCY:
                continue
            before = factor[group[0]]
            found = (squares[group].sum() * before**2 + _PRIOR_FREEDOM) / (left + _PRIOR_FREEDOM)
            factor[group] = max(np.sqrt(found), _LEAST_FACTOR)
        out[o.label] = factor
    return out


def _density(
    problem: MotionProblem, turning: np.ndarray, states: Array, covariances: Covariances
) -> Array:
    """Return the density of acceleration on legs and in turns by restricted likelihood."""
    rows = problem.motion_rows(states)
    left = 1.0 - rows.leverage(covariances)
    density = problem.chain.density.copy()
    for where in (turning, np.logical_not(turning)):
        for axes in ([0, 1], [2]):
            own = [*axes, *(3 + i for i in axes)]
            freedom = float(left[where][:, own].sum())
            if freedom < _LEAST_REDUNDANCY:
                continue
            squares = float(np.sum(rows.residual[where][:, own] ** 2))
            ratio = (squares + _PRIOR_FREEDOM) / (freedom + _PRIOR_FREEDOM)
            density[np.ix_(np.flatnonzero(where), np.array(axes))] *= ratio
    return np.clip(density, *_DENSITY)


def _current(
    problem: MotionProblem, evaluation: MotionEvaluation, chain: MotionChain, reach: float
) -> MotionChain:
    """Return a chain whose current has the strength of the greatest restricted likelihood.

    It is searched within a reach of its logarithm first.
    """
    now = next(p for p in chain.processes if p.name == CURRENT)
    deviance_of = problem.deviance(evaluation, CURRENT)

    def deviance(x: Array) -> float:
        return deviance_of(np.full(2, np.exp(x[0])), float(np.exp(x[1])))

    limits = [_CURRENT_STD, _CURRENT_TIME]
    start = np.clip([np.log(now.sigma[0]), np.log(now.tau)], *np.transpose(limits))
    found = minimize(
        deviance,
        start,
        method="COBYQA",
        bounds=limits,
        options={"initial_tr_radius": reach, "final_tr_radius": _FINEST, "maxfev": 40},
    )
    sigma, tau = np.exp(found.x)
    return with_sigma(chain, CURRENT, np.full(2, sigma), float(tau))
