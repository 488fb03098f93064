"""From a minimum to a solution: covariances, reported parametrisation, warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import partial

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.solution import (
    Estimate,
    Residuals,
    Solution,
    consistency_warnings,
    mostly_rejected,
    not_observable,
)
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.posterior import Posterior
from factorgraph_dvl.solvers.reported import estimates_of, in_order, in_unit
from factorgraph_dvl.solvers.trajectory import trajectory_between


def summarise(
    problem: Problem,
    minimum: Minimum,
    covariances: Posterior,
    *,
    held: Array,
    rate_hz: float,
    notes: Sequence[str],
) -> Solution:
    """Return the solution at a minimum.

    Parameters
    ----------
    problem, minimum, covariances : what was minimised, and where it ended.
    held : ndarray, shape (P, h)
        Directions of the parameters in which the prior was held because the data say nothing, as
        `feigned_directions` returns them.
    rate_hz : float
        Rate of the trajectory.
    notes : sequence of str
        What is already known to be worth telling.
    """
    chain = problem.chain
    trial = chain.trial
    evaluation = minimum.evaluation
    estimates, covariance = calibration(problem, evaluation, covariances, held)
    trajectory = trajectory_between(
        chain.segments,
        evaluation.states,
        covariances.nodes,
        chain.gravity_n,
        chain.frame,
        trial.body_axes,
        chain.segments.increments.ticks(rate_hz),
    )
    residuals = _residuals(problem, minimum)
    rejected = _rejected(problem, minimum)
    warnings = [*notes]
    if not minimum.converged:
        warnings.append(
            f"the solver did not converge in {minimum.iterations} iterations: not to be used"
        )
    for label, count in problem.uncovered.items():
        warnings.append(f"{label}: {count} measurements at times without IMU data were not used")
    warnings += consistency_warnings(estimates, residuals)
    warnings += mostly_rejected(residuals, rejected)
    warnings += _unobservable(problem, estimates, evaluation.motions)
    return Solution(
        trial=trial.name,
        solver="batch",
        body_axes=trial.body_axes,
        inputs=trial.inputs,
        converged=minimum.converged,
        iterations=minimum.iterations,
        cost=evaluation.cost,
        estimates=estimates,
        covariance=covariance,
        trajectory=trajectory,
        residuals=residuals,
        warnings=tuple(warnings),
        rejected=rejected,
    )


def reported(
    problem: Problem, evaluation: Evaluation
) -> list[tuple[Parameter, Array, dict[int, Array] | None]]:
    """Return all calibration parameters in the order in which they are reported.

    Each with its value in reported units and the derivatives of that with respect to the
    variables of the graph, by key; None for one that is fixed.
    """
    chain = problem.chain
    seg = chain.segments
    weight = _mean_weights(seg)
    gyro, accel = chain.trial.imu.parameters(float(seg.duration.sum()))
    states = evaluation.states
    rows: list[tuple[Parameter, Array, dict[int, Array] | None]] = []
    for parameter, bias, first in ((gyro, states.gyro_bias, 3), (accel, states.accel_bias, 0)):
        select = np.eye(6)[first : first + 3] / parameter.si
        functional = (
            {keys.bias(k): w * select for k, w in enumerate(weight)}
            if chain.walking
            else {keys.bias(0): select}
        )
        rows.append((parameter, weight @ bias / parameter.si, functional))
    for p in problem.all_parameters:
        row = in_unit(p, evaluation.parameters[p.name])
        own = {problem.key(p.name): row.derivative} if p.estimated else None
        rows.append((p, row.value, own))
    return in_order(rows, lambda r: r[0])


def calibration(
    problem: Problem, evaluation: Evaluation, covariances: Posterior, held: Array
) -> tuple[tuple[Estimate, ...], Array]:
    """Return the calibration with its joint covariance, in reported units.

    Parameters
    ----------
    problem, evaluation, covariances : at the minimum.
    held : ndarray
        As of `summarise`.
    """
    rows = reported(problem, evaluation)
    free = [f for _, _, f in rows if f is not None]
    joint = covariances.information.covariance_of(free)
    spread = prior_along(problem, held, free, covariances.considered)
    if covariances.considered:
        # Linear over a hundred degrees, a bias would change by more than its prior allows.
        prior = np.concatenate([p.sigma / p.si for p, _, f in rows if f is not None])
        room = np.sqrt(np.maximum(prior**2 - np.diag(joint), 0.0))
        size = np.maximum(np.linalg.norm(spread, axis=1), room)
        own = np.concatenate(
            [np.full(p.mean.size, p.name in problem.columns) for p, _, f in rows if f is not None]
        )
        spread *= np.where(own, 1.0, room / np.maximum(size, np.finfo(float).tiny))[:, None]
    joint = joint + spread @ spread.T
    return estimates_of([(p, value) for p, value, _ in rows], joint)


def prior_along(
    problem: Problem,
    held: Array,
    functionals: Sequence[dict[int, Array]],
    considered: Mapping[int, Array],
) -> Array:
    """Return a root (n, h) of the prior covariance of functionals along held directions.

    Parameters
    ----------
    problem, held, functionals : of what.
    considered : mapping of int to ndarray
        Change of other variables with the directions, as of `Posterior`.
    """
    spread = problem.prior_root @ held
    by_key = {problem.key(name): spread[place] for name, place in problem.columns.items()}
    by_key |= considered
    parts = []
    for functional in functionals:
        rows = next(iter(functional.values())).shape[0]
        part = np.zeros((rows, held.shape[1]))
        for key, matrix in functional.items():
            if key in by_key:
                part += matrix @ by_key[key]
        parts.append(part)
    return np.concatenate(parts)


def _mean_weights(seg: Segments) -> Array:
    """Return weights of the nodes in the mean over the time that the IMU recorded."""
    weight = np.zeros(seg.node_time.size)
    weight[seg.origin] += seg.duration
    weight[seg.origin + 1] += seg.duration
    return np.asarray(weight / weight.sum())


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
            residual = o.residual(motion, evaluation.parameters)[own]
            sigma = o.sigma(motion, evaluation.parameters)[own]
            out.append(Residuals(o.label, o.unit, o.components, o.time[own], residual, sigma))
    return tuple(out)


def _subset(motion: Motion, used: np.ndarray) -> Motion:
    return Motion(**{f.name: getattr(motion, f.name)[used] for f in fields(motion)})


def _unobservable(
    problem: Problem, estimates: Sequence[Estimate], motions: Sequence[Motion]
) -> list[str]:
    """Say which components the data did not determine, and why."""
    trial = problem.chain.trial
    by_name = {p.name: aid for aid in trial.aids for p in aid.parameters()}
    seen = {
        name: _subset(motion, np.any(weight > 0.0, axis=1))
        for observation, motion, weight in zip(
            problem.observations, motions, problem.weights, strict=True
        )
        for name in observation.parameters
    }
    duration = float(problem.chain.segments.duration.sum())
    out = []
    calibrated = {p.name: p.joint for p in problem.all_parameters if p.joint is not None}
    kept = [n for e in estimates if e.name in calibrated and not e.observable.all()
            for n in np.array(e.component_names)[~e.observable]]  # fmt: skip
    if kept:
        source = next(iter(calibrated.values())).source
        out.append(f"{', '.join(kept)}: as in {source}; this trial adds little or nothing to that")

    def why(name: str, component: int) -> str:
        if name in by_name:
            missing = "; the trial has no GNSS" if trial.gnss is None else ""
            return by_name[name].explain(name, component, seen.get(name)) + missing
        if trial.gnss is None:
            return "without GNSS nothing separates the errors of the IMU from the motion"
        return (
            f"{duration:.0f} s with these manoeuvres do not tell it better than the prior; "
            "it takes longer, or turns and changes of speed"
        )

    for e in estimates:
        if e.name not in calibrated:
            out += not_observable(e, partial(why, e.name))
    return out
