"""From a trial to a solution by the filter of single beams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.baselines.beam_filter import (
    BeamPings,
    attitude_errors,
    beam_filter,
    beam_residuals,
    without_spurious_information,
)
from factorgraph_dvl.baselines.navigation import attitude_is_known, motion_at, navigate
from factorgraph_dvl.baselines.outcome import Outcome
from factorgraph_dvl.baselines.summary import (
    left_out,
    sensor_motion,
    summarise,
    treated_as_white,
)
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.estimates import Residuals, Trajectory
from factorgraph_dvl.geometry.rotations import (
    BodyAxes,
    exp_so3,
    rotation_from_rph,
    rph_from_rotation,
    rph_jacobian,
)
from factorgraph_dvl.geometry.vectors import Array, interpolate
from factorgraph_dvl.solution import Progress, Solution
from factorgraph_dvl.trial import Trial


def calibrate_beams(trial: Trial, *, rate_hz: float, report: Progress) -> tuple[Solution, Outcome]:
    """Calibrate single beams against the velocity of SINS/GNSS.

    Parameters
    ----------
    trial : Trial
        Trial with IMU, GNSS and beams.
    rate_hz : float
        Rate of the trajectory in the solution.
    report : callable
        Called with stage, iteration and cost.

    Raises
    ------
    ConfigError, DataError
        If the trial has no beams, or a parametrisation other than single beams.
    """
    sensor = trial.beams
    if sensor is None:
        raise DataError(
            "the trial has no beams", where="trial.yaml", expected="a dvl_beams section"
        )
    if sensor.settings.parametrisation != "beams":
        raise ConfigError(
            "the filter estimates every beam on its own",
            where="trial.yaml dvl_beams.parametrisation",
            expected="beams",
            hint="For a common misalignment and scale take another --method",
        )
    report("SINS/GNSS", 0, None)
    received = np.logical_not(sensor.missing)
    navigation = navigate(trial, sensor.time[received])
    report("beams", 0, None)
    everywhere = motion_at(navigation, sensor.time)
    covered = received & everywhere.covered
    used = received & attitude_is_known(everywhere)
    motion = motion_at(navigation, sensor.time[used])
    pings = BeamPings(motion, sensor.nominal_b, sensor.velocity[used], sensor.sigma()[used])
    outcome = beam_filter(pings, sensor.mounting_parameters())
    report("summary", 0, None)
    outcome = replace(outcome, estimated=without_spurious_information(pings, outcome.estimated))
    residual, sigma = beam_residuals(pings, outcome.estimated)
    components = tuple(f"beam {i}" for i in range(1, residual.shape[1] + 1))
    findings = [*navigation.findings, treated_as_white(outcome.estimated)]
    findings += left_out(sensor, int(np.sum(received & ~covered)), int(np.sum(covered & ~used)))
    solution = summarise(
        trial,
        navigation,
        outcome,
        aid=sensor,
        measured=Residuals("Beam velocity", "m/s", components, motion.time, residual, sigma),
        motion=sensor_motion(motion),
        solver="kalman-beams",
        rate_hz=rate_hz,
        findings=findings,
    )
    time, phi, covariance = attitude_errors(pings, outcome.estimated)
    corrected = _with_attitude(solution.trajectory, trial.body_axes, time, phi, covariance)
    return replace(solution, trajectory=corrected), outcome


def _with_attitude(
    trajectory: Trajectory, axes: BodyAxes, time: Array, phi: Array, covariance: Array
) -> Trajectory:
    """Return a trajectory with the attitude errors taken off that the filter found at times (H,).

    Before the first ping and after the last one the attitude is that of SINS/GNSS.
    """
    if time.size < 2:
        return trajectory
    at = np.flatnonzero((trajectory.time >= time[0]) & (trajectory.time <= time[-1]))
    t = trajectory.time[at]
    nRb = exp_so3(interpolate(t, time, phi)) @ rotation_from_rph(trajectory.rph[at], axes)
    rph, rph_cov = trajectory.rph.copy(), trajectory.rph_cov.copy()
    rph[at] = rph_from_rotation(nRb, axes)
    J = rph_jacobian(rph[at], axes) @ nRb.transpose(0, 2, 1)
    P = interpolate(t, time, covariance.reshape(-1, 9)).reshape(-1, 3, 3)
    rph_cov[at] = J @ P @ J.transpose(0, 2, 1)
    return replace(trajectory, rph=rph, rph_cov=rph_cov)
