"""From the smoothed motion of a trial without IMU to a solution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from factorgraph_dvl.geometry.rotations import frd_from_body, rph_from_rotation
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.graph.bordered_chain import Covariances
from factorgraph_dvl.graph.motion_problem import ATTITUDE, CURRENT, MotionEvaluation, MotionProblem
from factorgraph_dvl.graph.priors import PRIOR
from factorgraph_dvl.sensors.attitude import HEADING_OFFSET, heading_error
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.message import Message, message
from factorgraph_dvl.sensors.parameters import UNITS, Parameter
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.solution import (
    Cause,
    Estimate,
    Residuals,
    Solution,
    Trajectory,
    consistency_findings,
    not_observable,
    outlier_findings,
    white_noise,
)
from factorgraph_dvl.solvers.causes import numbers_with_unit
from factorgraph_dvl.solvers.motion_smoother import SmoothedMotion
from factorgraph_dvl.solvers.reported import estimates_of, in_order, in_unit
from factorgraph_dvl.trial import Trial

# Epochs whose covariances are computed at once.
_CHUNK = 4000
_MOTION_NOISE = "acceleration between states"
_TRACK = "how much the current carries the vessel"
_MEAN_CURRENT = "current_m_s"


@dataclass(frozen=True)
class _OverTrial:
    """The constants, with the mean of the current over the trial in place of its process's.

    A trial of hours shows the mean of a process that changes over hours badly, and its strength,
    on which the standard deviation depends, no better: errors were 2.3 standard deviations.
    What it carried the vessel with on average is known as well as the velocities.

    Parameters
    ----------
    values : dict of str to ndarray
        Of the parameters.
    with_nodes, with_constants : ndarray, shape (K, n, c) or (c, c)
        Covariances of states and constants (rows) with them (columns).
    by_track : ndarray, shape (c,)
        Their standard deviations, with signs, that come from the share of the current.
    covariance : ndarray, shape (c, c)
        Theirs, that of this share included.
    """

    values: dict[str, Array]
    with_nodes: Array
    with_constants: Array
    by_track: Array
    covariance: Array


def summarise_motion(trial: Trial, found: SmoothedMotion, *, rate_hz: float) -> Solution:
    """Return the solution at a minimum without IMU.

    Parameters
    ----------
    trial : Trial
        What was solved.
    found : SmoothedMotion
        Its minimum.
    rate_hz : float
        Rate of the trajectory, Hz; at most that of the attitude record.
    """
    problem, evaluation = found.problem, found.evaluation
    over_trial = _over_trial(found)
    estimates, covariance, gain = reported_calibration(
        problem, over_trial.values, over_trial.covariance
    )
    residuals, rejected = _residuals(found)
    noise = white_noise(problem.noise_factors)
    findings = [*found.findings]
    for o, seen in zip(problem.observations, evaluation.seen, strict=True):
        left_out = int((~seen.covered).sum())
        if left_out:
            text = message("unused.without_motion", count=left_out)
            findings.append(Finding(Code.UNUSED, text, sensor=o.label))
    findings += consistency_findings(estimates, residuals, noise)
    findings += outlier_findings(residuals, rejected)
    findings += _unobservable(trial, found, estimates)
    findings += _heading_and_misalignment(trial, found)
    return Solution(
        trial=trial.name,
        solver="batch",
        body_axes=trial.body_axes,
        inputs=trial.inputs,
        converged=found.converged,
        iterations=found.iterations,
        cost=problem.cost(evaluation),
        estimates=estimates,
        covariance=covariance,
        trajectory=_trajectory(found, rate_hz),
        residuals=residuals,
        findings=tuple(findings),
        rejected=rejected,
        limits=trial.limits,
        noise=noise,
        error_budget=_causes(
            found, over_trial, in_order(problem.all_parameters, lambda p: p), gain
        ),
    )


def _over_trial(found: SmoothedMotion) -> _OverTrial:
    """Return the constants with the mean of the current over the trial."""
    problem, factors = found.problem, found.factors
    chain, values = problem.chain, dict(found.evaluation.parameters)
    with_nodes = found.covariances.with_constants.copy()
    with_constants = found.covariances.constants.copy()
    covariance, by_track = with_constants.copy(), found.by_track.copy()
    if chain.has(CURRENT) and _MEAN_CURRENT in problem.columns:
        own, place = problem.columns[_MEAN_CURRENT], chain.place(CURRENT)
        sigma = next(p.sigma for p in chain.processes if p.name == CURRENT)
        share = np.gradient(chain.time)
        share /= share.sum()
        weights = np.zeros((*found.evaluation.states.shape, 2))
        weights[:, place] = share[:, None, None] * np.diag(sigma)
        values[_MEAN_CURRENT] = values[_MEAN_CURRENT] + np.einsum(
            "kim,ki->m", weights, found.evaluation.states
        )
        alone = np.eye(problem.constants)[:, own]
        with_nodes[:, :, own], with_constants[:, own] = factors.covariance_with(weights, alone)
        covariance = with_constants.copy()
        covariance[own] += np.einsum("kim,kic->mc", weights, with_nodes)
        by_track = with_constants.T @ np.linalg.solve(factors.constants, by_track)
    return _OverTrial(
        values, with_nodes, with_constants, by_track, covariance + np.outer(by_track, by_track)
    )


def reported_calibration(
    problem: MotionProblem, values: Mapping[str, Array], constants: Array
) -> tuple[tuple[Estimate, ...], Array, Array]:
    """Return estimates, their covariance, and the derivative of what is free by the constants.

    Parameters
    ----------
    problem : MotionProblem
        Whose parameters are reported.
    values : mapping of str to ndarray
        Their values, SI; rotations as matrices.
    constants : ndarray, shape (c, c)
        Covariance of the estimated ones, SI.
    """
    reported = (in_unit(p, values[p.name]) for p in problem.all_parameters)
    rows = in_order(reported, lambda r: r.parameter)
    free = [(r.parameter, r.derivative) for r in rows if r.parameter.estimated]
    gain = _reported_gain(problem, free)
    joint = gain @ constants @ gain.T
    return (*estimates_of([(r.parameter, r.value) for r in rows], joint), gain)


def _reported_gain(problem: MotionProblem, free: Sequence[tuple[Parameter, Array]]) -> Array:
    """Return the derivative of what is reported by the constants, (F, c)."""
    size = sum(p.mean.size for p, _ in free)
    out, at = np.zeros((size, problem.constants)), 0
    for p, derivative in free:
        out[at : at + p.mean.size, problem.columns[p.name]] = derivative
        at += p.mean.size
    return out


def _residuals(found: SmoothedMotion) -> tuple[tuple[Residuals, ...], tuple[Residuals, ...]]:
    """Return residuals that were used, and those that were rejected."""
    problem, used, rejected = found.problem, [], []
    for o, seen, total in zip(
        problem.observations, found.evaluation.seen, problem.total_sigma, strict=True
    ):
        kept = np.isfinite(total).any(axis=1)
        sigma = np.where(np.isfinite(total), total, np.nan)
        residual = np.where(np.isfinite(total), seen.residual, np.nan)
        used.append(
            Residuals(o.label, o.unit, o.components, o.time[kept], residual[kept], sigma[kept])
        )
        out = problem.rejected.get(o.label)
        if out is not None and out.any():
            stated = problem.sigma(o, seen, found.evaluation.parameters)[out]
            rejected.append(
                Residuals(
                    o.label,
                    o.unit,
                    o.components,
                    o.time[out],
                    seen.residual[out],
                    stated,
                    reason="outlier",
                )
            )
    return tuple(used), tuple(rejected)


def _trajectory(found: SmoothedMotion, rate_hz: float) -> Trajectory:
    """Return the motion between the nodes at a rate, with its covariance."""
    problem, evaluation = found.problem, found.evaluation
    begin, end = problem.chain.time[[0, -1]] - problem.offset(evaluation.parameters)
    time = trajectory_epochs(problem, evaluation.parameters, begin, end, rate_hz)
    return trajectory_of(problem, evaluation, found.covariances, time)


def trajectory_epochs(
    problem: MotionProblem, values: Mapping[str, Array], begin: float, end: float, rate_hz: float
) -> Array:
    """Return the epochs of a trajectory from one true time to another, s, its ends included.

    They come at a rate, Hz, at most that of the attitudes, and where these are known.
    """
    rate = min(rate_hz, 1.0 / problem.attitude.interval)
    time = np.arange(np.ceil(begin * rate), np.floor(end * rate) + 1.0) / rate
    offset = float(values[problem.attitude.sensor.clock.offset.name][0])
    return np.asarray(time[problem.attitude.covers(time + offset)])


def trajectory_of(
    problem: MotionProblem, evaluation: MotionEvaluation, covariances: Covariances, time: Array
) -> Trajectory:
    """Return the motion at true times (M,), s, between the nodes, with its covariance.

    Parameters
    ----------
    problem : MotionProblem
        Of the nodes.
    evaluation : MotionEvaluation
        States and parameters.
    covariances : Covariances
        Theirs.
    time : ndarray, shape (M,), s
        Epochs.
    """
    chain, frame, states = problem.chain, problem.frame, evaluation.states
    place = chain.place(ATTITUDE) if chain.has(ATTITUDE) else slice(0, 0)
    sigma = next((p.sigma for p in chain.processes if p.name == ATTITUDE), np.zeros(3))
    n, c = chain.size, problem.constants
    parts = []
    for a in range(0, max(time.size, 1), _CHUNK):
        at, x, body, by_heading = problem.body_at(
            time[a : a + _CHUNK], states, evaluation.parameters
        )
        P = covariances.around(at.node)
        every = np.broadcast_to(np.eye(n), (at.node.size, n, n))
        missing = at.variance(every)
        by_constants = np.zeros((at.node.size, n, c))
        if problem.clock in problem.columns:
            own = problem.columns[problem.clock]
            by_constants[:, :3, own] = x[:, 3:6, None]
            by_constants[:, 3:6, own] = at.accelerations(states)[:, :, None]
        to_state = np.concatenate([*at.by_nodes(every), by_constants], axis=2)
        motion = to_state @ P @ to_state.transpose(0, 2, 1) + missing
        # Errors of the attitude are those of the process and of the constants.
        to_rph = np.zeros((at.node.size, 3, 2 * n + c))
        if place.stop:
            to_rph -= sigma[:, None] * to_state[:, place]
        for name, by in by_heading.items():
            if name in problem.columns:
                own = problem.columns[name]
                to_rph[:, 2, 2 * n + own.start : 2 * n + own.stop] -= by
        rph_cov = to_rph @ P @ to_rph.transpose(0, 2, 1) + np.diag(problem.attitude.white**2)
        if place.stop:
            rph_cov += sigma[:, None] * missing[:, place, place] * sigma
        lat, lon, height = frame.geodetic(x[:, :3])
        level = frame.level_from_tangent(lat, lon)
        level_t = level.transpose(0, 2, 1)
        parts.append(
            (
                np.stack([lat, lon, height], axis=1),
                rotate(level, x[:, 3:6]),
                rph_from_rotation(level @ body.nRb, problem.attitude.body_axes),
                level @ motion[:, :3, :3] @ level_t,
                level @ motion[:, 3:6, 3:6] @ level_t,
                rph_cov,
            )
        )
    return Trajectory(time, *(np.concatenate(each) for each in zip(*parts, strict=True)))


def _causes(
    found: SmoothedMotion, over_trial: _OverTrial, reported: Sequence[Parameter], gain: Array
) -> tuple[Cause, ...]:
    """Return what each cause adds to the standard deviations: P = sum k kᵀ over rows of noise."""
    problem = found.problem
    with_nodes, with_constants = over_trial.with_nodes, over_trial.with_constants
    variances: dict[str, Array] = {}
    chain = problem.chain
    motion = problem.motion_rows(found.evaluation.states)
    for rows in (motion, *problem.rows(found.evaluation)):
        k = (
            rows.before @ with_nodes[rows.node]
            + rows.after @ with_nodes[rows.node + 1]
            + rows.constants @ with_constants
        ) @ gain.T
        squares = np.sum(k**2, axis=0)
        if rows is motion:
            first = (chain.first()[:, None] * with_nodes[0]) @ gain.T
            squares += first**2
            variances[_MOTION_NOISE] = squares[:6].sum(axis=0)
            for process in chain.processes:
                name = f"lasting errors of {process.name}"
                if process.name == CURRENT:
                    name = "changes of the current"
                variances[name] = squares[chain.place(process.name)].sum(axis=0)
        else:
            variances[f"noise of {rows.source}"] = squares.sum(axis=0)
    if problem.parameters:
        whiten = np.linalg.inv(problem.prior_root)
        for p in problem.parameters:
            k = whiten[problem.columns[p.name]] @ with_constants @ gain.T
            variances[PRIOR.format(p.name)] = np.sum(k**2, axis=0)
    if chain.has(CURRENT):
        variances[_TRACK] = (gain @ over_trial.by_track) ** 2
    assumed = {
        PRIOR.format(p.name): numbers_with_unit(p.sigma / p.si, UNITS[p.spec.unit].text)
        for p in problem.parameters
    }
    assumed[_TRACK] = "any share"
    is_free = np.concatenate([np.full(p.mean.size, p.estimated) for p in reported])
    exact = np.concatenate([p.sigma == 0.0 for p in reported])
    out = []
    for source, variance in variances.items():
        adds = np.zeros(is_free.size)
        adds[is_free] = np.sqrt(np.maximum(variance, 0.0))
        adds[exact] = 0.0
        out.append(Cause(source, assumed.get(source, ""), adds))
    total = np.maximum(np.sum([c.adds**2 for c in out], axis=0), np.finfo(float).tiny)
    return tuple(sorted(out, key=lambda c: -float(np.max(c.adds**2 / total))))


def _unobservable(
    trial: Trial, found: SmoothedMotion, estimates: Sequence[Estimate]
) -> list[Finding]:
    """Say which components the data did not determine, and why."""
    by_name = {p.name: aid for aid in trial.aids for p in aid.parameters()}
    seen: dict[str, Motion] = {}
    for o, each in zip(found.problem.observations, found.evaluation.seen, strict=True):
        for name in o.parameters:
            seen[name] = each.motion
    nuisances = {p.name for p in found.problem.parameters if p.spec.nuisance}
    out: list[Finding] = []

    def why(name: str, component: int) -> Message | str:
        return by_name[name].explain(name, component, seen.get(name))

    for e in estimates:
        if e.name not in nuisances:
            out += not_observable(e, partial(why, e.name))
    return out


def _heading_and_misalignment(trial: Trial, found: SmoothedMotion) -> list[Finding]:
    """Say how well the misalignment is known relative to the mean of the compass.

    A heading that is too large by e looks like a misalignment by e about the vertical: data show
    their sum, with the mean of e over the trial.
    """
    problem, x = found.problem, found.evaluation.states
    chain, values = problem.chain, found.evaluation.parameters
    name = "misalignment_deg"
    if name not in problem.columns or not (
        chain.has(ATTITUDE) or any(n in problem.columns for n in (HEADING_OFFSET,))
    ):
        return []
    down = frd_from_body(trial.body_axes)[2]
    by_constants = np.zeros(problem.constants)
    by_constants[problem.columns[name]] = down
    constants = found.constants
    alone = float(np.sqrt(by_constants @ constants @ by_constants))
    weight = np.gradient(chain.time) / (chain.time[-1] - chain.time[0])
    weight /= weight.sum()
    by_states = np.zeros_like(x)
    mean = 0.0
    if chain.has(ATTITUDE):
        place = chain.place(ATTITUDE)
        sigma = next(p.sigma for p in chain.processes if p.name == ATTITUDE)
        by_states[:, place.start + 2] = weight * sigma[2]
        mean += float(np.sum(by_states * x))
    time = chain.time - problem.offset(values)
    heading = problem.attitude.rph_at(time)[:, 2]
    lasting, by = heading_error(time, heading, values, problem.zero)
    mean += float(weight @ lasting)
    for own, matrix in by.items():
        if own in problem.columns:
            by_constants[problem.columns[own]] = weight @ matrix
    through = found.factors.solve_nodes(by_states[:, :, None])[:, :, 0]
    rest = by_constants - np.einsum("kic,ki->c", found.factors.influence, by_states)
    together = float(np.sqrt(np.vdot(by_states, through) + rest @ constants @ rest))
    angle = -float(down @ in_unit(_parameter(problem, name), values[name]).value)
    text = message(
        "heading_error.about_the_vertical",
        angle=angle,
        std=alone / DEG,
        relative=angle - mean / DEG,
        relative_std=together / DEG,
    )
    return [Finding(Code.HEADING_ERROR, text, parameter=name)]


def _parameter(problem: MotionProblem, name: str) -> Parameter:
    return next(p for p in problem.parameters if p.name == name)
