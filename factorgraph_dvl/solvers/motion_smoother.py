"""Batch smoothing of a trial without IMU: minimise, weigh, strength of the prior by likelihood."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri

from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.graph.bordered_chain import Covariances, Factorisation
from factorgraph_dvl.graph.motion_chain import MotionChain
from factorgraph_dvl.graph.motion_problem import (
    CURRENT,
    MotionEvaluation,
    MotionProblem,
    with_sigma,
)
from factorgraph_dvl.graph.priors import after_step
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.motion_preparation import MotionPreparation
from factorgraph_dvl.statistics.robust_weights import robust_scale

# Decrease of the cost that the linear model still promises at a minimum, and steps of a round.
_CONVERGED = 1e-3
_STEPS = 6
# Rounds of weights, noise and strength after which they count as not settled, and the relative
# change of a standard deviation from which on there is another. Measured: most take four.
_ROUNDS = 25
_SAME = 0.03
# Degrees of freedom of what is known of a standard deviation: as of the sensors with an IMU.
_PRIOR_FREEDOM = 0.4
_LEAST_REDUNDANCY = 10.0
# Least factor on stated noise; residuals of less are those of a record that was smoothed.
_LEAST_FACTOR = 0.1
# Clock whose pings lie between nodes, and how far off the middle they may be, in intervals.
_DVL_CLOCK = "time_offset_s"
_OFF_CENTRE = 0.1
# Probability with which a good measurement passes the gate, factor on the gate from which on it is
# worth a search, and the share of outliers from which on it is the model that is wrong.
_GATE = 0.999
_WORTH = 2.0
_TOO_MANY = 0.4
# Rounds in which outliers are searched. Chosen: the second finds those that the first hid.
_SEARCHES = 3
# Rounds from one search for the strength of the current to the next, while all else changes.
_CURRENT_ROUNDS = 5
# Limits of the strength of a current: m/s and s, by its logarithm.
_CURRENT_STD = (np.log(0.005), np.log(2.0))
_CURRENT_TIME = (np.log(60.0), np.log(2e5))
# Density of acceleration, relative to that in turns, which changes nothing; and the largest step
# of its logarithm.
_NEGLIGIBLE = 1e-3
_LARGEST_STEP = 3.0
# Range of the density of acceleration, m²/s³. Chosen: regular, and beyond what vessels do.
_DENSITY = (1e-10, 1e3)


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
    """

    problem: MotionProblem
    evaluation: MotionEvaluation
    factors: Factorisation
    covariances: Covariances
    converged: bool
    iterations: int
    findings: tuple[Finding, ...]


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
    iterations, free_current, changing = 0, prepared.current_is_free, ["all"]
    last_moved = np.zeros_like(problem.chain.density)
    at_clock = float(values[_DVL_CLOCK][0]) if _DVL_CLOCK in values else 0.0
    for round_ in range(_ROUNDS):
        evaluation, factors, steps, reached = _minimise(problem, states, values, report)
        iterations += steps
        states, values = evaluation.states, evaluation.parameters
        covariances = factors.covariances()
        changing = []
        if not reached:
            changing.append("the minimum")
        moved_clock = float(values[_DVL_CLOCK][0]) - at_clock if _DVL_CLOCK in values else 0.0
        if abs(moved_clock) > _OFF_CENTRE * float(np.median(np.diff(problem.chain.time))):
            # Pings stay between the nodes: one at a node has a state to itself, which fits it at
            # any time, and would hold its clock there.
            changing.append("the times of measurements")
            problem, states = _shifted(problem, states, -moved_clock)
            at_clock = float(values[_DVL_CLOCK][0])
            if round_ < _ROUNDS - 1:
                continue
        rejected = _rejected(problem, evaluation)
        if round_ < _SEARCHES and not _same_rows(rejected, problem.rejected):
            changing.append("which measurements are outliers")
            problem.rejected = rejected
            continue
        noise = _noise(problem, evaluation, covariances)
        density = _density(problem, prepared.turning, states, covariances)
        if _differ(noise, problem.noise_factors):
            changing.append("the noise of the sensors")
        chain = problem.chain
        moved = np.log(density / chain.density)
        relevant = density > _NEGLIGIBLE * density.max(axis=0)
        if np.max(np.abs(moved) * relevant) > 2.0 * _SAME:
            changing.append("the acceleration of the vessel")
        density = chain.density * np.exp(_hastened(moved, last_moved))
        last_moved = moved
        # A search takes forty factorisations: not in every round.
        if free_current and (not changing or round_ % _CURRENT_ROUNDS == 0):
            report("current", round_, None)
            chain = _current(problem, evaluation, chain)
            old, new = (next(p for p in c.processes if p.name == CURRENT)
                        for c in (problem.chain, chain))  # fmt: skip
            states = states.copy()
            states[:, chain.place(CURRENT)] *= old.sigma / new.sigma
            if abs(np.log(new.sigma[0] / old.sigma[0])) > 3.0 * _SAME:
                changing.append("the current")
            free_current = len(changing) > 1 or "the current" in changing
        if not changing or round_ == _ROUNDS - 1:
            break
        problem = problem.with_chain(replace(chain, density=density))
        problem.noise_factors = noise
    findings = prepared.findings
    if changing:
        text = f"after {_ROUNDS} rounds {', '.join(changing)} still changed: do not use the result"
        findings += (Finding(Code.NOT_CONVERGED, text, severity="error"),)
    return SmoothedMotion(
        problem, evaluation, factors, covariances, not changing, iterations, findings
    )


def _shifted(problem: MotionProblem, states: Array, by: float) -> tuple[MotionProblem, Array]:
    """Return a problem whose nodes are later by so many seconds, and their states."""
    chain = problem.chain
    time = chain.time + by
    at = chain.at(np.clip(time, chain.time[0], chain.time[-1]))
    x = rotate(at.before, states[at.node]) + rotate(at.after, states[at.node + 1])
    return problem.with_chain(replace(chain, time=time), x), x


def _hastened(moved: Array, before: Array) -> Array:
    """Return steps of a fixed-point iteration that go where their ratio points (Aitken)."""
    ratio = np.divide(moved, before, out=np.zeros_like(moved), where=np.abs(before) > 1e-6)
    ratio = np.clip(ratio, 0.0, 0.8)
    return np.clip(moved / (1.0 - ratio), -_LARGEST_STEP, _LARGEST_STEP)


def _minimise(
    problem: MotionProblem, states: Array, values: dict[str, Array], report: Progress
) -> tuple[MotionEvaluation, Factorisation, int, bool]:
    """Return the minimum near states and values, its factorisation, steps, and if it was reached.

    Gauss-Newton; a step that does not lower the cost is halved.
    """
    evaluation = problem.evaluate(states, values)
    problem.weigh(evaluation)
    evaluation = problem.evaluate(states, values)
    cost = problem.cost(evaluation)
    if not np.isfinite(cost):
        raise SolveError(
            "the cost at the start is not finite",
            where="all sensors",
            hint="Inspect the trial: a unit or a column may be wrong",
        )
    for steps in range(_STEPS):
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
        dx, dc = factors.step()
        promised = -0.5 * float(
            np.vdot(dx, equations.node_gradient) + dc @ equations.constant_gradient
        )
        if promised < _CONVERGED:
            return evaluation, factors, steps, True
        share = 1.0
        while share > 1e-3:
            after = problem.evaluate(
                evaluation.states + share * dx,
                after_step(problem.parameters, evaluation.parameters, share * dc),
            )
            after_cost = problem.cost(after)
            if after_cost < cost:
                break
            share *= 0.5
        else:
            # No digits are left, or the weights hold the step back.
            return evaluation, factors, steps, promised < 1e-2
        evaluation, cost = after, after_cost
        if share == 1.0 and steps < 3:
            # A DVL's noise follows from its speed, which a far start has wrong.
            problem.weigh(evaluation)
            evaluation = problem.evaluate(evaluation.states, evaluation.parameters)
            cost = problem.cost(evaluation)
    return evaluation, factors, _STEPS, False


def _rejected(problem: MotionProblem, evaluation: MotionEvaluation) -> dict[str, np.ndarray]:
    """Return measurements beyond the gate, by label: their scale is that of the others."""
    out = {}
    for o, residuals in zip(problem.observations, problem.residuals(evaluation), strict=True):
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
    return a.keys() == b.keys() and all(np.mean(a[k] != b[k]) < 1e-3 for k in a)


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
    problem: MotionProblem, evaluation: MotionEvaluation, chain: MotionChain
) -> MotionChain:
    """Return a chain whose current has the strength of the greatest restricted likelihood."""
    now = next(p for p in chain.processes if p.name == CURRENT)

    def chain_of(x: Array) -> MotionChain:
        return with_sigma(chain, CURRENT, np.full(2, np.exp(x[0])), float(np.exp(x[1])))

    def deviance(x: Array) -> float:
        penalty = sum(
            max(low - v, v - high, 0.0) ** 2
            for v, (low, high) in zip(x, (_CURRENT_STD, _CURRENT_TIME), strict=True)
        )
        inside = np.array([np.clip(x[0], *_CURRENT_STD), np.clip(x[1], *_CURRENT_TIME)])
        return problem.deviance(evaluation, chain_of(inside)) + 100.0 * penalty

    start = np.array([np.log(now.sigma[0]), np.log(now.tau)])
    # By diffusion and standard deviation, along which the likelihood is round.
    simplex = start + np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.7]])
    found = minimize(
        deviance,
        start,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.05, "fatol": 0.1, "maxfev": 40},
    )
    x = np.array([np.clip(found.x[0], *_CURRENT_STD), np.clip(found.x[1], *_CURRENT_TIME)])
    return chain_of(x)
