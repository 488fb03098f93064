"""From smoothed motion and a calibration to a solution."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from factorgraph_dvl.baselines.navigation import Navigation, NavigationMotion
from factorgraph_dvl.baselines.outcome import Estimated, Outcome
from factorgraph_dvl.baselines.point_sets import Points, residuals
from factorgraph_dvl.baselines.recorded_navigation import RecordedNavigation
from factorgraph_dvl.estimates import Estimate, Residuals, Trajectory, as_estimates
from factorgraph_dvl.geometry.earth import radii
from factorgraph_dvl.geometry.rotations import rph_from_rotation, rph_jacobian, wrapped
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import (
    TOO_LARGE,
    consistency_findings,
    contradictions,
    not_observable,
    windows_left_out,
)
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.protocol import Motion as SensorMotion
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import Trial


def treated_as_white(estimated: Estimated, factors: Array | None = None) -> Finding:
    """Say that errors of the motion count as white noise, and what that may do to deviations.

    Parameters
    ----------
    estimated : Estimated
        The calibration, of n components.
    factors : ndarray, shape (n,), optional
        Factors by which their standard deviations may be too small.
    """
    if factors is None or factors.max(initial=1.0) <= TOO_LARGE:
        return Finding(Code.METHOD_LIMITS, message("method_limits.white_noise"))
    worst = int(np.argmax(factors))
    name = [name for p in estimated.parameters for name in p.component_names][worst]
    text = message("method_limits.lasting_attitude", name=name, factor=float(factors[worst]))
    return Finding(Code.METHOD_LIMITS, text, severity="warning")


def summarise(
    trial: Trial,
    navigation: Navigation | RecordedNavigation,
    outcome: Outcome,
    *,
    aid: Aid,
    measured: Residuals,
    motion: SensorMotion | None,
    solver: str,
    rate_hz: float,
    findings: Sequence[Finding],
) -> Solution:
    """Return the solution of a calibrator.

    Parameters
    ----------
    trial : Trial
        Trial that was solved.
    navigation : Navigation or RecordedNavigation
        Navigation of SINS/GNSS, or what instruments report.
    outcome : Outcome
        Outcome of the calibrator.
    aid : Aid
        The sensor that was calibrated.
    measured : Residuals
        Residuals of that sensor.
    motion : Motion or None
        Motion at its measurements.
    solver : str
        Name.
    rate_hz : float
        Rate of the trajectory.
    findings : sequence of Finding
        What is already known.
    """
    dvl_values, dvl_covariance = outcome.estimated.reported()
    parameters, values, covariance = list(outcome.estimated.parameters), dvl_values, dvl_covariance
    all_residuals: tuple[Residuals, ...] = (measured,)
    if isinstance(navigation, Navigation):
        imu = _imu_biases(trial, navigation)
        imu_values, imu_covariance = imu.reported()
        covariance = block_diag(dvl_covariance, imu_covariance)
        parameters += imu.parameters
        values = np.concatenate([dvl_values, imu_values])
        all_residuals = (measured, *gnss_residuals(trial, navigation))
    estimates = as_estimates(parameters, values, covariance, outcome.unseparated)
    contradicted = contradictions(all_residuals)
    found = (
        *findings,
        *contradicted,
        *consistency_findings(estimates, all_residuals),
        *_unobservable(aid, motion, estimates),
    )
    return Solution(
        trial=trial.name,
        solver=solver,
        body_axes=trial.body_axes,
        epoch=trial.epoch,
        inputs=trial.inputs,
        converged=outcome.converged and not contradicted,
        iterations=outcome.iterations,
        cost=0.5 * float(np.nansum((measured.residual / measured.sigma) ** 2)),
        estimates=estimates,
        covariance=covariance,
        trajectory=trajectory_of(trial, navigation, rate_hz),
        residuals=all_residuals,
        findings=found,
        limits=trial.limits,
    )


def _imu_biases(trial: Trial, navigation: Navigation) -> Estimated:
    """Return the biases: at the end if constant, else their mean over the trial.

    The covariance of the mean of a random walk is taken as the mean covariance, which is
    an upper bound.
    """
    track = navigation.track
    parameters = trial.inertial.parameters(float(track.time[-1] - track.time[0]))
    if not trial.inertial.settings.bias_walks:
        values = (track.gyro_bias[-1], track.accel_bias[-1])
        return Estimated(parameters, values, track.covariance[-1, 9:, 9:])
    step = np.where(np.diff(navigation.arc) == 0, np.diff(track.time), 0.0)
    weight = np.append(step, 0.0) + np.append(0.0, step)
    weight /= weight.sum()
    values = (weight @ track.gyro_bias, weight @ track.accel_bias)
    P = np.einsum("k,kij->ij", weight, track.covariance[:, 9:, 9:])
    return Estimated(parameters, values, P)


def trajectory_of(
    trial: Trial, navigation: Navigation | RecordedNavigation, rate_hz: float
) -> Trajectory:
    """Return the motion at the multiples of 1 / rate that it covers."""
    motion = navigation.at(navigation.ticks(rate_hz))
    at = motion.covered
    P = motion.covariance[at]
    rph = rph_from_rotation(motion.nRb[at], trial.body_axes)
    J = rph_jacobian(rph, trial.body_axes) @ motion.nRb[at].transpose(0, 2, 1)
    return Trajectory(
        time=motion.time[at],
        geodetic=motion.geodetic[at],
        velocity=motion.velocity[at],
        rph=rph,
        position_cov=P[:, 0:3, 0:3],
        velocity_cov=P[:, 3:6, 3:6],
        rph_cov=J @ P[:, 6:9, 6:9] @ J.transpose(0, 2, 1),
    )


def dvl_residuals(
    dvl: Dvl, navigation: Navigation | RecordedNavigation, outcome: Outcome, points: Points
) -> Residuals:
    """Return the residuals of a DVL's velocity.

    Parameters
    ----------
    dvl : Dvl
        DVL that was calibrated.
    navigation : Navigation or RecordedNavigation
        Navigation of SINS/GNSS, or what instruments report.
    outcome : Outcome
        Outcome of the calibrator.
    points : Points
        The point sets at the prior's time offset.
    """
    prior = {p.stem: p.mean for p in dvl.parameters()}
    before = float(prior["time_offset"][0])
    offset = float(outcome.estimated.value("time_offset", prior["time_offset"])[0])
    if offset != before:
        motion = navigation.at(points.time + before - offset)
        points = Points(
            motion.time,
            motion.v_b,
            motion.v_b_covariance,
            motion.omega_b,
            motion.omega_sigma,
            points.v_d,
            points.sigma_d,
        )
    residual, sigma = residuals(points, outcome.estimated, prior["lever_arm"])
    return Residuals("DVL velocity", "m/s", ("x", "y", "z"), points.time + offset, residual, sigma)


def gnss_residuals(trial: Trial, navigation: Navigation) -> tuple[Residuals, ...]:
    """Return predicted - measured position and velocity of the antenna."""
    gnss = trial.gnss
    assert gnss is not None
    motion = navigation.at(gnss.time)
    arm, omega_cb_b = gnss.lever_arm(gnss.time)
    meridian, east = radii(motion.geodetic[:, 0])
    height = motion.geodetic[:, 2]
    apart = motion.geodetic - gnss.geodetic
    apart[:, 1] = wrapped(apart[:, 1])
    metres = np.stack(
        [
            apart[:, 1] * (east + height) * np.cos(motion.geodetic[:, 0]),
            apart[:, 0] * (meridian + height),
            apart[:, 2],
        ],
        axis=1,
    )
    position = metres + rotate(motion.nRb, arm)
    turning = np.cross(motion.omega_b - omega_cb_b, arm)
    velocity = motion.velocity + rotate(motion.nRb, turning) - gnss.velocity
    out = []
    for label, unit, residual, sigma in (
        ("GNSS position", "m", position, gnss.position_std),
        ("GNSS velocity", "m/s", velocity, gnss.velocity_std),
    ):
        known = motion.covered & ~np.isnan(residual[:, 0])
        if known.any():
            out.append(
                Residuals(
                    label,
                    unit,
                    ("east", "north", "up"),
                    gnss.time[known],
                    residual[known],
                    sigma[known],
                )
            )
    return tuple(out)


def left_out(sensor: Aid, outside: int, vague: int) -> list[Finding]:
    """Say how many pings of a sensor were not used, and why, and that a window is left out.

    They are outside the motion, or vague.
    """
    reasons = {
        "unused.pings_outside": outside,
        "unused.pings_vague": vague,
    }
    unused = [
        Finding(Code.UNUSED, message(key, count=pings), sensor=sensor.label)
        for key, pings in reasons.items()
        if pings
    ]
    return [*windows_left_out([sensor]), *unused]


def _unobservable(
    aid: Aid, motion: SensorMotion | None, estimates: Sequence[Estimate]
) -> list[Finding]:
    """Say which components the data did not determine, and why."""
    own = {p.name for p in aid.parameters()}
    out: list[Finding] = []

    def why(name: str, component: int) -> Message | str:
        if name in own:
            return aid.explain(name, component, motion)
        return message("not_observable.no_better")

    for e in estimates:
        out += not_observable(e, partial(why, e.name))
    return out


def sensor_motion(at: Points | NavigationMotion) -> SensorMotion | None:
    """Return the motion at the pings, with the body's axes for n."""
    if at.time.size == 0:
        return None
    zero: Array = np.zeros_like(at.v_b)
    return SensorMotion(
        nRb=np.broadcast_to(np.eye(3), (at.time.size, 3, 3)),
        p_n=zero,
        v_n=at.v_b,
        omega_eb_b=at.omega_b,
        a_n=zero,
        alpha_b=zero,
        omega_sigma=at.omega_sigma,
    )
