"""From a minimum to a solution: calibration, trajectory, residuals, findings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from factorgraph_dvl.estimates import Estimate, Residuals, Trajectory
from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.graph.inertial_chain import InertialChain
from factorgraph_dvl.graph.planar_chain import PlanarChain
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.smooth_chain import SmoothChain
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.plausibility.earlier_calibration import prior_findings
from factorgraph_dvl.plausibility.usbl import grid_north_findings
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import (
    consistency_findings,
    mostly_rejected,
    not_observable,
    outlier_findings,
)
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.solvers.averaging import noise_of_means
from factorgraph_dvl.solvers.calibration import calibration
from factorgraph_dvl.solvers.change_along_trial import change_findings, without_explained
from factorgraph_dvl.solvers.correlated_noise import noise_of
from factorgraph_dvl.solvers.error_budget import causes
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.solvers.heading_and_misalignment import heading_and_misalignment
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.planar_setup import planar_trajectory
from factorgraph_dvl.solvers.true_times import trajectory_at_true_times
from factorgraph_dvl.statistics.robust_weights import windows
from factorgraph_dvl.trial import Trial


def summarise(trial: Trial, found: SolvedProblem, *, rate_hz: float) -> Solution:
    """Return the solution at a minimum.

    Parameters
    ----------
    trial : Trial
        What was solved.
    found : SolvedProblem
        Its problem at the minimum, with covariances.
    rate_hz : float
        Rate of the trajectory, Hz.
    """
    problem, minimum = found.problem, found.minimum
    evaluation = minimum.evaluation
    estimates, covariance = calibration(found)
    residuals = _residuals(problem, minimum)
    rejected = _rejected(problem, minimum)
    findings = [*found.findings]
    if not minimum.converged:
        text = message("not_converged.do_not_use", iterations=minimum.iterations)
        findings.append(Finding(Code.NOT_CONVERGED, text, severity="error"))
    for label, count in problem.uncovered.items():
        key = "unused.without_motion" if trial.imu is None else "unused.without_imu"
        text = message(key, count=count)
        findings.append(Finding(Code.UNUSED, text, sensor=label))
    noise = noise_of(problem)
    of_residuals = consistency_findings(estimates, residuals, noise)
    findings += noise_of_means(of_residuals, found.findings)
    findings += prior_findings(trial, estimates, covariance)
    findings += mostly_rejected(residuals, [r for r in rejected if r.reason == "echo"])
    findings += outlier_findings(residuals, [r for r in rejected if r.reason != "echo"])
    changes: list[Finding] = []
    # The rows, which take longest to make, serve both.
    error_budget = causes(
        found, lambda rows: changes.extend(change_findings(found, rows, estimates, trial.limits))
    )
    findings = without_explained(findings, found, estimates) + changes
    findings += _unobservable(trial, problem, estimates, evaluation.motions)
    findings += heading_and_misalignment(trial, found)
    findings += grid_north_findings(trial, estimates)
    return Solution(
        trial=trial.name,
        solver="batch",
        body_axes=trial.body_axes,
        epoch=trial.epoch,
        inputs=trial.inputs,
        converged=minimum.converged,
        iterations=minimum.iterations,
        cost=evaluation.cost,
        estimates=estimates,
        covariance=covariance,
        trajectory=trajectory(found, trial.body_axes, rate_hz),
        residuals=residuals,
        findings=tuple(findings),
        rejected=rejected,
        limits=trial.limits,
        noise=noise,
        error_budget=error_budget,
        steps=found.steps,
    )


def trajectory(found: SolvedProblem, body_axes: BodyAxes, rate_hz: float) -> Trajectory:
    """Return the motion at a rate, at true times."""
    chain = found.problem.chain
    if isinstance(chain, PlanarChain):
        at, P = found.minimum.evaluation, found.covariances
        return planar_trajectory(found.problem, at, P, chain.epochs(rate_hz))
    if isinstance(chain, SmoothChain):
        at = found.minimum.evaluation
        return trajectory_at_true_times(found.problem, at, found.covariances, body_axes, rate_hz)
    assert isinstance(chain, InertialChain)
    states = found.minimum.evaluation.states
    return chain.trajectory(states, found.covariances.nodes, body_axes, rate_hz)


def _residuals(problem: Problem, minimum: Minimum) -> tuple[Residuals, ...]:
    out = []
    for observation, whitened, weight in zip(
        problem.observations, minimum.evaluation.residuals, problem.weights, strict=True
    ):
        used = np.any(weight > 0.0, axis=1)
        measured = np.where(weight > 0.0, weight, np.nan)[used]
        out.append(
            Residuals(
                label=observation.label,
                unit=observation.unit,
                components=observation.components,
                time=observation.time[used],
                residual=whitened[used] / measured,
                sigma=1.0 / measured,
            )
        )
    return tuple(out)


def _rejected(problem: Problem, minimum: Minimum) -> tuple[Residuals, ...]:
    out = []
    evaluation = minimum.evaluation
    for o, motion in zip(problem.observations, evaluation.motions, strict=True):
        own = np.isin(o.time, problem.rejected.get(o.label, np.empty(0)))
        if own.any():
            residual = problem.residual(o, motion, evaluation.parameters)[own]
            sigma = o.sigma(motion, evaluation.parameters)[own]
            out.append(Residuals(o.label, o.unit, o.components, o.time[own], residual, sigma))
    return (*out, *_outliers(problem, evaluation))


def _outliers(problem: Problem, evaluation: Evaluation) -> Iterator[Residuals]:
    """Yield what robust weights leave out, single measurements and windows apart."""
    for o, motion, sigma in zip(
        problem.observations, evaluation.motions, problem.sigma(evaluation), strict=True
    ):
        if o.label not in problem.robust_weights:
            continue
        residual = problem.residual(o, motion, evaluation.parameters)
        weights = np.broadcast_to(problem.robust_weights[o.label], residual.shape)
        measured = np.isfinite(sigma)
        left_out = np.asarray(measured & (weights == 0.0))
        together = np.stack(
            [windows(o.time, c, m) for c, m in zip(left_out.T, measured.T, strict=True)], axis=1
        )
        for reason, kind in (
            ("outlier", left_out & ~together),
            ("window", left_out & together),
        ):
            rows = kind.any(axis=1)
            if rows.any():
                yield Residuals(
                    label=o.label,
                    unit=o.unit,
                    components=o.components,
                    time=o.time[rows],
                    residual=np.where(kind, residual, np.nan)[rows],
                    sigma=np.where(kind, sigma, np.nan)[rows],
                    reason=reason,
                )


def _unobservable(
    trial: Trial, problem: Problem, estimates: Sequence[Estimate], motions: Sequence[Motion]
) -> list[Finding]:
    """Say which components the data did not determine, and why."""
    by_name = {p.name: aid for aid in trial.aids for p in aid.parameters()}
    seen = {
        name: rows_of(motion, np.any(weight > 0.0, axis=1))
        for observation, motion, weight in zip(
            problem.observations, motions, problem.weights, strict=True
        )
        for name in observation.parameters
    }
    duration = problem.chain.duration
    out: list[Finding] = []
    calibrated = {p.name: p.joint for p in problem.all_parameters if p.joint is not None}
    kept = [n for e in estimates if e.name in calibrated and not e.observable.all()
            for n in np.array(e.component_names)[~e.observable]]  # fmt: skip
    if kept:
        source = next(iter(calibrated.values())).source
        text = message("prior_kept.little", names=kept, source=source)
        out.append(Finding(Code.PRIOR_KEPT, text, sensor="DVL"))

    def why(name: str, component: int) -> Message | str:
        if name in by_name:
            reason = by_name[name].explain(name, component, seen.get(name))
            if trial.gnss is None and trial.imu is not None:
                return message("not_observable.and_no_gnss", reason=reason)
            return reason
        if trial.gnss is None:
            return message("not_observable.imu_without_gnss")
        return message("not_observable.short_run", duration=duration)

    nuisances = {p.name for p in problem.parameters if p.spec.nuisance}
    for e in estimates:
        if e.name not in calibrated and e.name not in nuisances:
            out += not_observable(e, partial(why, e.name))
    return out
