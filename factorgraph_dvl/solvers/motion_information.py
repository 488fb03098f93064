"""Information on the calibration of a trial without IMU, along the trial and of a plan."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.motion_problem import TRACK_STD
from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.solvers.motion_preparation import prepare_motion
from factorgraph_dvl.solvers.motion_smoother import SmoothedMotion
from factorgraph_dvl.solvers.motion_summary import reported_calibration
from factorgraph_dvl.statistics.information_history import InformationHistory
from factorgraph_dvl.trial import Trial

# Entries of a history; chosen: a figure shows no more.
_ENTRIES = 200


def motion_history(found: SmoothedMotion, *, entries: int | None = None) -> InformationHistory:
    """Return the covariance of all constants given the data up to nodes along the trial.

    Parameters
    ----------
    found : SmoothedMotion
        Of the trial.
    entries : int, optional
        Most entries of the history, with the first and the last.
    """
    problem, evaluation = found.problem, found.evaluation
    last = problem.chain.time.size - 1
    nodes = np.unique(np.linspace(0, last, min(entries or _ENTRIES, last + 1)).astype(int))
    estimates, _, gain = reported_calibration(problem, evaluation.parameters, found.constants)
    is_free = [each.prior_std > 0.0 for each in estimates if np.any(each.prior_std > 0.0)]
    gain = gain[np.concatenate(is_free)]
    # What is not known of the current's share in the motion grows with the record.
    by_track = np.linalg.solve(found.factors.constants, found.by_track)
    covariances = [problem.prior_root @ problem.prior_root.T]
    along = problem.constants_along(evaluation, nodes[1:].tolist())
    for node, constants in zip(nodes[1:].tolist(), along, strict=True):
        grown = constants @ by_track * node / last
        covariances.append(constants + np.outer(grown, grown))
    return InformationHistory(
        time=problem.chain.time[nodes] - problem.offset(evaluation.parameters),
        names=tuple(
            name
            for each in estimates
            for name, prior in zip(each.component_names, each.prior_std, strict=True)
            if prior > 0.0
        ),
        root=np.asarray(np.linalg.cholesky(gain @ np.array(covariances) @ gain.T)),
    )


def predict_motion(
    trial: Trial, recorded: Trial, true_states: Callable[[LocalFrame, Array], States]
) -> SmoothedMotion:
    """Return what a solver will know of a trial without IMU, without noise and without solving.

    Parameters
    ----------
    trial : Trial
        Its records without noise, its true calibration, and the noise that it claims.
    recorded : Trial
        The same with noise, from which the white noise of the attitude comes: no trial claims it.
    true_states : callable
        Returns the states at (K,) times in a frame.
    """
    prepared = prepare_motion(trial)
    problem, sensor = prepared.problem, recorded.attitude
    assert sensor is not None
    assert trial.attitude is not None
    noisy = AttitudeRecord(sensor, recorded.body_axes, estimated=recorded.estimates_noise(sensor))
    problem.attitude = noisy.of_rows(trial.attitude)
    values = problem.prior_values()
    for p in problem.parameters:
        true = trial.calibration_truth.get(p.name)
        if true is not None:
            if p.nominal is None and p.mean.size < true.size:
                # One scale is estimated of an instrument that has three.
                true = np.mean(true, keepdims=True)
            values[p.name] = p.internal(true)
    motion = true_states(problem.frame, problem.chain.time - problem.offset(values))
    states = np.zeros_like(prepared.states)
    states[:, :3], states[:, 3:6] = motion.p_n, motion.v_n
    evaluation = problem.weighed(states, values)
    factors = problem.equations(evaluation).factorise()
    covariances = factors.covariances()
    by_track = problem.follow_motion(evaluation, factors, covariances)
    return SmoothedMotion(
        problem,
        evaluation,
        factors,
        covariances,
        converged=True,
        iterations=0,
        findings=prepared.findings,
        by_track=TRACK_STD * factors.constants @ by_track,
    )
