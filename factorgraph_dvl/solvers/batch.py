"""Batch smoothing of a whole trial: alignment, mounting, Levenberg-Marquardt, covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.inertial_chain import Chain, inertial_chain
from factorgraph_dvl.graph.priors import ConstantsPrior
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import Segments, segments
from factorgraph_dvl.imu.propagation import States, attach, motion_at
from factorgraph_dvl.imu.timestamps import without_strays
from factorgraph_dvl.initialization.attitude_sensors import attitudes, mean_mounting
from factorgraph_dvl.initialization.dvl_mounting import calibrated, initial_values
from factorgraph_dvl.initialization.in_motion_alignment import initial_states
from factorgraph_dvl.ranging.hypothesis_weights import significant_costs
from factorgraph_dvl.ranging.position_from_ranges import StartPositions, positions_from_ranges
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Aid, Motion, Observation
from factorgraph_dvl.solution import Solution, ambiguity, joined, not_told_apart
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, Progress, minimise
from factorgraph_dvl.solvers.posterior import Posterior, changes_with, considered, posterior
from factorgraph_dvl.solvers.state_times import STATE_INTERVAL, dense_epochs
from factorgraph_dvl.solvers.summary import summarise
from factorgraph_dvl.solvers.trajectory import TRAJECTORY_RATE
from factorgraph_dvl.statistics.spurious_information import (
    at_prior_along,
    data_information,
    parameter_information,
)
from factorgraph_dvl.trial import Trial

# Root mean square error of the positions at which gravity was taken, m: 1 m turns it by
# 0.16 micro-g.
_SAME_GRAVITY = 2.0
# The first stage only prepares the second.
_ROUGH = 1.0
_ROUGH_ITERATIONS = 10
# Most trials take one or two.
_ROUNDS = 12
# Length, s, up to which start values may lead to a wrong minimum, and standard deviation, rad,
# of a mounting from which on it may. Others are sought from the best of all local minima of
# the mounting, at these headings.
_SHORT = 30.0
_ANY_ANGLE = 45.0 * DEG
_HEADINGS = np.array([0.0, 90.0, 180.0, 270.0]) * DEG
_RIVALS = 16
_RIVAL_ITERATIONS = 15
# Cost above the best one from which on a rough minimum is no rival, and angle, rad, from which on
# it is not the same.
_ROUGHLY_AS_GOOD = 30.0
_APART = 15.0 * DEG
# So long before and after a fix the motion without the DVL is good enough to mount it by, s.
_HELD_BY_FIXES = 10.0


# A problem, its minimum, and what is worth telling of that.
_Found = tuple[Problem, Minimum, tuple[str, ...]]


@dataclass(frozen=True)
class SolvedProblem:
    """A trial at its minimum, before it is summarised.

    Parameters
    ----------
    problem, minimum, covariances : what was minimised, and where it ended.
    held : ndarray, shape (P, h)
        Directions that are not observable, in units of the priors' standard deviations.
    notes : tuple of str
        What is worth telling.
    """

    problem: Problem
    minimum: Minimum
    covariances: Posterior
    held: Array
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Prepared:
    """What every start has in common, and the starts."""

    trial: Trial
    frame: LocalFrame
    seg: Segments
    start_positions: StartPositions
    mountings: dict[str, Array]
    notes: tuple[str, ...]


def solve(
    trial: Trial,
    *,
    rate_hz: float = TRAJECTORY_RATE,
    state_interval_s: float = STATE_INTERVAL,
    progress: Progress | None = None,
) -> Solution:
    """Estimate trajectory and calibration of a trial with their joint covariance.

    Parameters
    ----------
    trial : Trial
    rate_hz : float, optional
        Rate of the trajectory in the solution; the solver's states are independent of it.
    state_interval_s : float, optional
        Time between the states of the graph; less where the noise of the gyros in between matters
        to a sensor of attitude.
    progress : callable, optional
        Called with stage, iteration and cost (None where there is none yet).

    Returns
    -------
    Solution
        Also where the solver did not converge: `Solution.converged` says so.

    Raises
    ------
    ConfigError, DataError
        If the trial cannot be solved as it is.
    SolveError
        If no minimum can be searched for at all.
    """
    _check_above_zero("rate_hz", rate_hz)
    report = progress or (lambda stage, iteration, cost: None)
    prepared = _prepare(trial, state_interval_s, report)
    found, solutions = [], []
    for states in prepared.start_positions.states:
        minima = [
            _described(*each, report, prepared.notes) for each in _minima(prepared, states, report)
        ]
        against = np.array([_evidence_against(each) for each in minima])
        solutions.append(not_told_apart([solution_of(each, rate_hz) for each in minima], against))
        found.append(minima[int(np.argmin(against))])
    against = significant_costs([_cost_terms(each) for each in found])
    return joined(solutions, against, prepared.start_positions.hypotheses)


def solution_of(found: SolvedProblem, rate_hz: float) -> Solution:
    """Return the solution at a minimum, with a trajectory of so many Hz."""
    return summarise(
        found.problem,
        found.minimum,
        found.covariances,
        held=found.held,
        rate_hz=rate_hz,
        notes=found.notes,
    )


def solved_problem(
    trial: Trial,
    *,
    state_interval_s: float = STATE_INTERVAL,
    progress: Progress | None = None,
) -> SolvedProblem:
    """Minimise the problem of a trial; arguments and errors as of `solve`."""
    report = progress or (lambda stage, iteration, cost: None)
    problem, minimum, notes, _ = fit(trial, state_interval_s=state_interval_s, progress=report)
    return _described(problem, minimum, notes, report)


def _described(
    problem: Problem,
    minimum: Minimum,
    own: tuple[str, ...],
    report: Progress,
    notes: tuple[str, ...] = (),
) -> SolvedProblem:
    """Return a minimum with its covariances, and without what the data cannot tell."""
    report("covariance", 0, None)
    covariances = posterior(problem, minimum)
    told = data_information(problem, minimum.evaluation, covariances.parameters, covariances.given)
    held = told.undetermined_directions()
    if held.size:
        # How others go with what is held is linear here, where the directions belong.
        full = parameter_information(problem, minimum.evaluation)
        changes = changes_with(covariances, held, told.coupled(held, full))
        origin = at_prior_along(problem, minimum.evaluation.parameters, held)
        problem.fix_directions(held, origin)
        at = problem.values(minimum.evaluation.states, origin)
        again = minimise(
            problem, at, stage="all sensors, without what they cannot tell", progress=report
        )
        minimum = replace(
            again,
            converged=minimum.converged and again.converged,
            iterations=minimum.iterations + again.iterations,
        )
        covariances = considered(posterior(problem, minimum), changes)
    return SolvedProblem(problem, minimum, covariances, held, (*notes, *own))


def _evidence_against(found: SolvedProblem) -> float:
    """Return the negative logarithm of the posterior probability about a minimum.

    Laplace's approximation: a minimum that is wide is more probable than a narrow one.
    """
    _, log_det = np.linalg.slogdet(found.covariances.parameters)
    return found.minimum.evaluation.cost - 0.5 * float(log_det)


def _cost_terms(found: SolvedProblem) -> Array:
    """Return the terms of the cost: of each measurement, of the rest at once."""
    evaluation = found.minimum.evaluation
    parts = []
    total = 0.0
    for observation, residual, weight in zip(
        found.problem.observations, evaluation.residuals, found.problem.weights, strict=True
    ):
        own = 0.5 * np.sum(residual**2, axis=1)
        total += own.sum()
        gate = observation.gate or 0.0
        parts.append(np.where((weight > 0.0).any(axis=1), own, 0.5 * gate**2))
    return np.concatenate([*parts, [evaluation.cost - total]])


def fit(
    trial: Trial,
    *,
    state_interval_s: float,
    progress: Progress,
    known: ConstantsPrior | None = None,
) -> tuple[Problem, Minimum, tuple[str, ...], StartPositions]:
    """Find the minimum of a trial's cost, from nothing but its data.

    Parameters
    ----------
    trial, state_interval_s : Trial or float
        As for `solve`.
    progress : callable
        Called with stage, iteration and cost.
    known : ConstantsPrior, optional
        Of biases and calibration, in place of the trial's priors.

    Returns
    -------
    problem, minimum, notes : what was minimised, where it ended, what the user must know.
    start_positions : where it may have begun; it did at the first.
    """
    prepared = _prepare(trial, state_interval_s, progress)
    states = prepared.start_positions.states[0]
    problem, minimum, own = _descended(prepared, states, progress, known)
    notes = (*prepared.notes, *own, *ambiguity(prepared.start_positions.hypotheses))
    return problem, minimum, notes, prepared.start_positions


def _prepare(trial: Trial, state_interval_s: float, report: Progress) -> _Prepared:
    _check_above_zero("state_interval_s", state_interval_s)
    trial = without_strays(trial)
    frame = trial.frame()
    report("increments", 0, None)
    inc, gaps = increments(trial.imu)
    seg = segments(inc, state_interval_s, dense_epochs(trial, frame, state_interval_s))
    report("alignment", 0, None)
    start = initial_states(trial, frame, seg)
    if trial.beacons is not None:
        report("ranges", 0, None)
    start_positions = positions_from_ranges(trial, frame, seg, start.states)
    consistency_warnings = [
        doubt for seen in attitudes(trial, frame) for doubt in seen.consistency_warnings
    ]
    notes = (*trial.notes, *gaps, *start.notes, *consistency_warnings, *start_positions.notes)
    return _Prepared(trial, frame, seg, start_positions, start.mountings, notes)


def _minima(prepared: _Prepared, states: States, report: Progress) -> list[_Found]:
    """Return the minimum that is reached from some states, and others as probable.

    In some seconds neither heading nor mounting are known before the DVL is used, and start
    values lead to any of several minima. From longer trials they lead to the right one.
    """
    first = _descended(prepared, states, report)
    out = [first]
    time = prepared.seg.node_time
    if time[-1] - time[0] > _SHORT or not _free(prepared.trial):
        return out
    report("other mountings", 0, None)
    trial, frame, seg = prepared.trial, prepared.frame, prepared.seg
    # One of their own: minimising weighs the measurements anew.
    problem = Problem(
        first[0].chain, *_sensors(trial.aids, frame), start=first[1].evaluation.parameters
    )
    mountings = _mountings(trial, frame, seg, problem.chain.gravity_n, states)
    rotations = {p.name for p in problem.parameters if p.rotation}
    starts = []
    for angle in _HEADINGS:
        turn = exp_so3(np.array([0.0, 0.0, angle]))
        start = replace(states, nRb=turn @ states.nRb)
        # What the sensors see stays as it is, at least at first.
        back = states.nRb[0].T @ turn @ states.nRb[0]
        for mounting in mountings:
            own = {
                name: value @ back if name in rotations else value
                for name, value in mounting.items()
            }
            at = problem.values(start, problem.prior_values() | prepared.mountings | own)
            starts.append((problem.evaluate(at).cost, at))
    rough = [
        minimise(
            problem,
            at,
            stage="other mountings",
            max_iterations=_RIVAL_ITERATIONS,
            tolerance=_ROUGH,
            proven=False,
        )
        for _, at in sorted(starts, key=lambda s: s[0])[:_RIVALS]
    ]
    rough.sort(key=lambda m: m.evaluation.cost)
    for each in rough:
        found = each.evaluation
        best = min(m.evaluation.cost for _, m, _ in out)
        if found.cost > best + _ROUGHLY_AS_GOOD:
            break
        if any(_same_minimum(prepared, found, m.evaluation) for _, m, _ in out):
            continue
        other = _descended(prepared, found.states, report, values=found.parameters)
        if not any(_same_minimum(prepared, other[1].evaluation, m.evaluation) for _, m, _ in out):
            out.append(other)
    return out


def _free(trial: Trial) -> bool:
    """Whether a mounting may be turned to anywhere."""
    return any(
        p.rotation and p.estimated and p.sigma.max() > _ANY_ANGLE
        for aid in trial.aids
        for p in aid.parameters()
    )


def _same_minimum(prepared: _Prepared, a: Evaluation, b: Evaluation) -> bool:
    """Whether two minima have the same attitude and mountings, as far as angles tell."""
    pairs = [(a.states.nRb[0], b.states.nRb[0])]
    for aid in prepared.trial.aids:
        for p in aid.parameters():
            if p.rotation and p.estimated:
                pairs.append((a.parameters[p.name], b.parameters[p.name]))
    return all(float(np.linalg.norm(log_so3(x.T @ y))) < _APART for x, y in pairs)


def _descended(
    prepared: _Prepared,
    states: States,
    report: Progress,
    known: ConstantsPrior | None = None,
    values: dict[str, Array] | None = None,
) -> tuple[Problem, Minimum, tuple[str, ...]]:
    """Return the minimum that is reached from some states, and notes of its own.

    Gravity, weights, times and outliers are taken at the states before, so that minimum and
    problem are made anew until nothing changes any more.
    """
    trial, frame, seg = prepared.trial, prepared.frame, prepared.seg
    rejected = prepared.start_positions.rejected
    if known is not None:
        values = known.parameters
    iterations = 0
    tried: list[Mapping[str, Array]] = []
    cycle: list[Mapping[str, Array]] = []
    p_gravity = np.full_like(states.p_n, np.inf)
    for _ in range(_ROUNDS):
        if np.sqrt(np.mean((states.p_n - p_gravity) ** 2)) > _SAME_GRAVITY:
            chain = inertial_chain(trial, frame, seg, states, bias_prior=known is None)
            p_gravity = states.p_n
        if values is None:
            # A DVL that is calibrated does no harm from the start.
            mounted = trial.dvl is not None and calibrated(trial.dvl)
            if trial.gnss is not None and not mounted:
                coarse = _without_dvl(chain, states, prepared.mountings, report)
                iterations += coarse.iterations
                states = coarse.evaluation.states
            report("mounting", 0, None)
            (best, *_) = _mountings(trial, frame, seg, chain.gravity_n, states)
            values = prepared.mountings | best
        problem = Problem(chain, *_sensors(trial.aids, frame), start=values, known=known)
        problem.reject(rejected)
        at = problem.values(states, {**problem.prior_values(), **values})
        minimum = minimise(problem, at, stage="all sensors", progress=report)
        iterations += minimum.iterations
        states, values = minimum.evaluation.states, minimum.evaluation.parameters
        changing = _changing(problem, minimum.evaluation, p_gravity)
        if not (tried and _same(tried[-1], rejected)):
            tried.append(rejected)
        if not cycle:
            outliers: Mapping[str, Array] = problem.outliers(minimum.evaluation)
            cycle = _cycle(tried, outliers)
        if cycle:
            outliers = min(cycle, key=_count)
        if not _same(outliers, rejected):
            changing.append("which measurements are echoes")
        if not changing:
            break
        rejected = outliers
    notes = _at_the_gate(cycle)
    if changing:
        notes += (
            f"after {_ROUNDS} rounds {', '.join(changing)} still changed: the solution is none",
        )
    converged = minimum.converged and not changing
    return problem, replace(minimum, converged=converged, iterations=iterations), notes


def _changing(problem: Problem, evaluation: Evaluation, p_gravity: Array) -> list[str]:
    """Return what of the problem would be another if it were made at an evaluation."""
    away = np.sqrt(np.mean((evaluation.states.p_n - p_gravity) ** 2))
    found = {
        "gravity along the track": not away <= _SAME_GRAVITY,
        "the times of measurements": problem.needs_rebinding(evaluation.parameters),
        "the weights of measurements": problem.needs_reweighting(evaluation),
    }
    return [name for name, changed in found.items() if changed]


def _cycle(
    tried: Sequence[Mapping[str, Array]], outliers: Mapping[str, Array]
) -> list[Mapping[str, Array]]:
    """Return the sets of outliers that follow each other for ever; none if they do not.

    Each set made the next; the last of them made `outliers`. A measurement at its gate may
    lie inside where it is left out, and outside where it is used.
    """
    for i, before in enumerate(tried[:-1]):
        if _same(before, outliers):
            return list(tried[i:])
    return []


def _count(rejected: Mapping[str, Array]) -> int:
    return sum(times.size for times in rejected.values())


def _at_the_gate(cycle: Sequence[Mapping[str, Array]]) -> tuple[str, ...]:
    """Say how many measurements of a cycle may be echoes or not."""
    if not cycle:
        return ()
    kept, none = min(cycle, key=_count), np.empty(0)
    out = []
    for label in dict.fromkeys(label for each in cycle for label in each):
        ever = np.unique(np.concatenate([each.get(label, none) for each in cycle]))
        open_ = np.setdiff1d(ever, kept.get(label, none)).size
        if open_:
            out.append(
                f"{label}: {open_} at the gate would be rejected if they were used, and used if "
                "they were rejected; they are used"
            )
    return tuple(out)


def _same(a: Mapping[str, Array], b: Mapping[str, Array]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)


def _check_above_zero(name: str, value: float) -> None:
    """Raise ConfigError unless a number is finite and above 0."""
    if not (np.isfinite(value) and value > 0.0):
        raise ConfigError(f"{name} is {value}", expected="a number above 0")


def _without_dvl(
    chain: Chain, states: States, mountings: dict[str, np.ndarray], report: Progress
) -> Minimum:
    """Return the minimum without the sensors whose mounting that is to tell."""
    trial = chain.trial
    unknown = {a.mounting.name for a in attitudes(trial, chain.frame)} - mountings.keys()
    if trial.beams is not None:
        unknown |= {p.name for p in trial.beams.parameters() if p.rotation and p.estimated}
    used = [
        aid
        for aid in trial.aids
        if aid is not trial.dvl and not any(p.name in unknown for p in aid.parameters())
    ]
    problem = Problem(chain, *_sensors(used, chain.frame), start=mountings)
    return minimise(
        problem,
        problem.values(states, problem.prior_values() | mountings),
        stage="inertial and GNSS",
        progress=report,
        max_iterations=_ROUGH_ITERATIONS,
        tolerance=_ROUGH,
        proven=False,
    )


def _sensors(aids: Sequence[Aid], frame: LocalFrame) -> tuple[list[Observation], list[Parameter]]:
    observations = [o for aid in aids for o in aid.observations(frame)]
    parameters = [p for aid in aids for p in aid.parameters()]
    return observations, parameters


def _near_fixes(trial: Trial, time: Array) -> NDArray[np.bool_]:
    """Whether GNSS holds the inertial motion at times; without any, all are as good."""
    if trial.gnss is None:
        return np.ones(time.size, dtype=bool)
    known = ~np.isnan(trial.gnss.geodetic[:, 0]) | ~np.isnan(trial.gnss.velocity[:, 0])
    fixes = np.concatenate([[-np.inf], trial.gnss.time[known], [np.inf]])
    after = np.searchsorted(fixes, time)
    nearest = np.minimum(time - fixes[after - 1], fixes[after] - time)
    return np.asarray((nearest < _HELD_BY_FIXES) | (fixes.size == 2))


def _mountings(
    trial: Trial, frame: LocalFrame, seg: Segments, gravity_n: np.ndarray, states: States
) -> list[dict[str, np.ndarray]]:
    """Return values of the sensors' mountings by the motion, rotations as matrices.

    The best first, then rivals.
    """

    def motion_by(time: np.ndarray) -> tuple[Motion, np.ndarray]:
        index, since, covered = seg.increments.locate(time)
        inside = seg.increments.start[index] + np.clip(since, 0.0, seg.increments.dt[index])
        at = attach(seg, np.where(covered, time, inside), frame.earth_rate)
        held = covered & _near_fixes(trial, time)
        return motion_at(at, states, gravity_n, frame.earth_rate), held

    out = {}
    for seen in attitudes(trial, frame):
        if seen.mounting.estimated:
            motion, covered = motion_by(seen.time)
            out[seen.mounting.name] = mean_mounting(seen, motion.nRb * covered[:, None, None])
    return [out | each for each in initial_values(trial, lambda pings, time: motion_by(time))]
