"""Batch smoothing of a whole trial: prepare, minimise, covariances, summary."""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.graph.priors import ConstantsPrior
from factorgraph_dvl.graph.trajectory import TRAJECTORY_RATE
from factorgraph_dvl.plausibility.survey import accepted_errors, explained, survey
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import ambiguity
from factorgraph_dvl.ranging.hypothesis_weights import significant_costs
from factorgraph_dvl.solution import Progress, Solution
from factorgraph_dvl.solvers.averaging import without_hidden
from factorgraph_dvl.solvers.calibration import calibration
from factorgraph_dvl.solvers.curved_posterior import points_along_arc
from factorgraph_dvl.solvers.fixed_directions import (
    SolvedProblem,
    undetermined_there,
    with_covariances,
)
from factorgraph_dvl.solvers.hypotheses import relative_costs
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, minimise
from factorgraph_dvl.solvers.minima import (
    competing_minima,
    cost_terms,
    distinct,
    evidence_against,
    joined,
    most_probable_minimum,
)
from factorgraph_dvl.solvers.planar_preparation import PlanarPreparation, prepare_planar
from factorgraph_dvl.solvers.planar_setup import Track
from factorgraph_dvl.solvers.position_from_ranges import StartPositions
from factorgraph_dvl.solvers.preparation import Prepared, prepare
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu
from factorgraph_dvl.solvers.rounds import SettledMinimum, settle
from factorgraph_dvl.solvers.state_times import STATE_INTERVAL
from factorgraph_dvl.solvers.stretch import started_from_stretch
from factorgraph_dvl.solvers.summary import summarise, trajectory
from factorgraph_dvl.trial import Trial


def solve(
    trial: Trial,
    *,
    rate_hz: float = TRAJECTORY_RATE,
    state_interval_s: float = STATE_INTERVAL,
    anyway: bool = False,
    progress: Progress | None = None,
) -> Solution:
    """Estimate trajectory and calibration of a trial with their joint covariance.

    Parameters
    ----------
    trial : Trial
        Records of the sensors, with their priors.
    rate_hz : float, optional
        Rate of the trajectory in the solution, Hz; the solver's states are independent of it.
    state_interval_s : float, optional
        Time between the states of the graph, s; less where the noise of the gyros in between
        matters to a sensor of attitude. Without an IMU states are at pings.
    anyway : bool, optional
        Solve although there are records that cannot be used, or that contradict each other. By
        default, noise and what else the data show are not asked for where records contradict each
        other: the result is not to be used.
    progress : callable, optional
        Called with stage, iteration and cost (None where there is none yet).

    Returns
    -------
    Solution
        Also where the solver did not converge: `Solution.converged` says so. Not to be used if its
        findings contain one of severity `error`, such as records that contradict each other.

    Raises
    ------
    ConfigError, DataError
        If the trial cannot be solved as it is, or has records that cannot be used.
    SolveError
        If no minimum can be searched for at all.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> solution.estimate("misalignment_deg").value.round(1)
    array([ 1. , -2.1, 20. ])
    """
    solution, _ = solve_with_problem(
        trial,
        rate_hz=rate_hz,
        state_interval_s=state_interval_s,
        anyway=anyway,
        progress=progress,
    )
    return solution


def solve_with_problem(
    trial: Trial,
    *,
    rate_hz: float,
    state_interval_s: float = STATE_INTERVAL,
    anyway: bool = False,
    progress: Progress | None = None,
) -> tuple[Solution, SolvedProblem]:
    """Return the solution of a trial, and its problem at the most probable minimum.

    Parameters and errors are those of `solve`.
    """
    _check_above_zero("rate_hz", rate_hz)
    _check_above_zero("state_interval_s", state_interval_s)
    # What a trial without positions lacks comes before what is odd in its records.
    trial.frame()
    report = progress or _silent
    report("survey", 0, None)
    records = survey(trial)
    errors = accepted_errors(records, anyway=anyway)
    with explained(errors):
        prepared = _prepared(trial, state_interval_s, report)
        roughly = not anyway and _contradict(errors)
        found, solved = _most_probable(trial, prepared, rate_hz, report, roughly=roughly)
    kept = without_hidden(errors, trial.aids, found.estimates)
    return found.with_findings(kept), solved


def _contradict(errors: Iterable[Finding]) -> bool:
    """Whether records contradict each other, whatever is found later."""
    # A delay may be that of a window.
    return any(f.severity == "error" and f.code != Code.CLOCK_OFFSET for f in errors)


def _prepared(trial: Trial, state_interval_s: float, report: Progress) -> Prepared:
    """Return what the minimisation of a trial starts from."""
    if trial.planar:
        return prepare_planar(trial, report)
    if trial.imu is None:
        return started_from_stretch(prepare_without_imu(trial), report)
    return prepare(trial, state_interval_s, report)


def _most_probable(
    trial: Trial, prepared: Prepared, rate_hz: float, report: Progress, *, roughly: bool
) -> tuple[Solution, SolvedProblem]:
    """Return the most probable of all minima from all positions, with the spread of the others."""
    solutions, best = [], []
    for states in prepared.start_positions.states:
        minima = _minima(prepared, states, prepared.findings, report, roughly=roughly)
        if isinstance(prepared, PlanarPreparation):
            solutions.append(_along_arc(trial, prepared, minima[0], rate_hz, report))
        else:
            against = np.array([evidence_against(each) for each in minima])
            summaries = [summarise(trial, each, rate_hz=rate_hz) for each in minima]
            solutions.append(most_probable_minimum(summaries, against))
        best.append(minima[0])
    if isinstance(prepared, PlanarPreparation):
        costs = relative_costs([Track(b.problem, b.minimum.evaluation, True) for b in best])
    else:
        costs = significant_costs([cost_terms(each) for each in best])
    likeliest = int(np.argmin(costs))
    return joined(solutions, costs, prepared.start_positions.hypotheses), best[likeliest]


def _along_arc(
    trial: Trial,
    prepared: PlanarPreparation,
    found: SolvedProblem,
    rate_hz: float,
    report: Progress,
) -> Solution:
    """Return the solution of a track, with the spread along the arc that ranges leave."""
    points, against = points_along_arc(found, prepared.setup.rows.place, report)
    whole = summarise(trial, found, rate_hz=rate_hz)
    if len(points) == 1:
        return whole
    spread = []
    for each in points:
        estimates, covariance = calibration(each)
        motion = trajectory(each, trial.body_axes, rate_hz)
        spread.append(
            replace(whole, estimates=estimates, covariance=covariance, trajectory=motion)
        )
    mixture = most_probable_minimum(spread, against)
    # They are no minima, but one that is drawn out.
    return replace(mixture, findings=whole.findings, iterations=whole.iterations)


def solved_problems(
    trial: Trial,
    *,
    state_interval_s: float = STATE_INTERVAL,
    progress: Progress | None = None,
) -> list[SolvedProblem]:
    """Return the problem of a trial at all its minima, from the most probable position.

    The most probable one comes first; parameters and errors are those of `solve`.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> solved, *_ = fd.solved_problems(fd.simulate("examples/short.yaml", seed=1))
    >>> graph, values = solved.problem.nonlinear_graph()
    >>> graph.error(values) > graph.error(solved.minimum.evaluation.values)
    True
    """
    report = progress or _silent
    _check_above_zero("state_interval_s", state_interval_s)
    prepared = _prepared(trial, state_interval_s, report)
    start = prepared.start_positions
    findings = (*prepared.findings, *ambiguity(start.hypotheses))
    return _minima(prepared, start.states[0], findings, report)


def _minima(
    prepared: Prepared,
    states: Any,
    findings: tuple[Finding, ...],
    report: Progress,
    *,
    roughly: bool = False,
) -> list[SolvedProblem]:
    """Return the minima near some states and their rivals, the most probable first."""
    found = competing_minima(prepared, states, report, roughly=roughly)
    return distinct(prepared, [_with_covariances(each, findings, report) for each in found])


def settled_minimum(
    trial: Trial,
    *,
    state_interval_s: float = STATE_INTERVAL,
    progress: Progress | None = None,
    constants_prior: ConstantsPrior | None = None,
    clock_zero: float | None = None,
) -> tuple[SettledMinimum, StartPositions]:
    """Return the minimum of a trial's cost, and all positions where it may have started.

    It started at the first of these.

    Parameters
    ----------
    trial : Trial
        Records of the sensors, with their priors.
    state_interval_s : float, optional
        Time between the states of the graph, s.
    progress : callable, optional
        Called with stage, iteration and cost.
    constants_prior : ConstantsPrior, optional
        Joint prior of biases and calibration, in place of the trial's priors.
    clock_zero : float, optional
        Reference time of the clock offsets, s; by default in the middle of the trial.
    """
    report = progress or _silent
    _check_above_zero("state_interval_s", state_interval_s)
    prepared = _prepared(trial, state_interval_s, report)
    start = prepared.start_positions
    settled = settle(
        prepared,
        start.states[0],
        report,
        constants_prior=constants_prior,
        clock_zero=clock_zero,
    )
    findings = (*prepared.findings, *settled.findings, *ambiguity(start.hypotheses))
    return replace(settled, findings=findings), start


def _with_covariances(
    settled: SettledMinimum, findings: tuple[Finding, ...], report: Progress
) -> SolvedProblem:
    """Return a minimum with its covariances, and with undetermined directions fixed."""
    problem, before = settled.problem, settled.minimum
    # All measurements are bound, and a trajectory has no rates.
    problem.chain.release()

    def minimise_again(values: gtsam.Values) -> Minimum:
        stage = "all sensors, without undetermined directions"
        again = minimise(problem, values, stage=stage, progress=report)
        return replace(
            again,
            iterations=before.iterations + again.iterations,
        )

    report("covariance", 0, None)
    findings = (*findings, *settled.findings)
    free = copy(problem)
    solved = with_covariances(problem, before, minimise_again, findings=findings)
    solved = replace(solved, steps=settled.steps)
    if before.converged or not solved.minimum.converged:
        return solved
    converged = settled.settled and undetermined_there(solved, free)
    return replace(solved, minimum=replace(solved.minimum, converged=converged))


def _silent(stage: str, iteration: int, cost: float | None) -> None:
    """Report nothing."""


def _check_above_zero(name: str, value: float) -> None:
    """Raise ConfigError unless a number is finite and above 0."""
    if not (np.isfinite(value) and value > 0.0):
        raise ConfigError(f"{name} is {value}", expected="a number above 0")
