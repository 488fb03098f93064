"""From a trial to a solution by the six-state filter of gyro drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.baselines.liu_2020 import run_printed
from factorgraph_dvl.baselines.navigation import NavigationMotion, motion_at, navigate
from factorgraph_dvl.baselines.outcome import Estimated, Outcome, history_rows
from factorgraph_dvl.baselines.star_filter import (
    AttitudeTrack,
    StarAttitudes,
    attitude_at,
    attitude_before,
    run_filter,
    smooth,
    star_attitudes,
)
from factorgraph_dvl.baselines.strapdown import StrapdownSamples, prepare
from factorgraph_dvl.baselines.summary import gnss_residuals
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.estimates import Residuals, Trajectory, as_estimates
from factorgraph_dvl.geometry.celestial import off_vertical
from factorgraph_dvl.geometry.earth import enu_from_ecef
from factorgraph_dvl.geometry.rotations import (
    inverse_right_jacobian,
    log_so3,
    rph_from_rotation,
    rph_jacobian,
)
from factorgraph_dvl.geometry.units import ARCSEC, DEG
from factorgraph_dvl.geometry.vectors import Array, skew
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import consistency_findings, contradictions, not_observable
from factorgraph_dvl.quality.star_catalogue import star_catalogue_findings
from factorgraph_dvl.sensors.star import Star
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import InitialAttitude, Trial

# Chosen: standard deviation of the stars' attitude as the prior of the SINS/GNSS filter, which
# gives position and velocity only.
_START = 0.3 * DEG
# Chosen: standard deviation, deg, up to which the mounting is taken as known.
_KNOWN_DEG = 5.0
# Chosen: angle, rad, between the vertical of the stars and that of the specific force from which
# on epoch or mounting must be wrong; waves stay below it on average.
_OFF_VERTICAL = 2.0 * DEG
_IN_N = Finding(
    Code.METHOD_LIMITS,
    message("method_limits.liu_in_n"),
)


def calibrate_gyros(
    trial: Trial, *, rate_hz: float, printed: bool = False
) -> tuple[Solution, Outcome]:
    """Estimate the drift of the gyros from SINS and star tracker.

    Position and velocity of the trajectory are those of SINS/GNSS.

    Parameters
    ----------
    trial : Trial
        Trial with IMU, GNSS and star tracker.
    rate_hz : float
        Rate of the trajectory in the solution.
    printed : bool, default False
        Whether to use the filter as Liu et al. (2020) print it.

    Raises
    ------
    ConfigError, DataError
        If the trial has no star tracker, no epoch, no GNSS, or too few attitudes.
    """
    star = _star_of(trial)
    frame = trial.frame()
    inc, _ = increments(trial.inertial)
    samples = prepare(inc, trial.inertial.settings)
    attitudes = star_attitudes(star, trial.epoch, frame.lat, frame.lon)
    (gyro, _) = trial.inertial.parameters(0.0)
    drift, P = gyro.mean, np.diag(gyro.sigma**2)
    (unknown, _) = trial.inertial.nominal().parameters(0.0)
    tracks: list[AttitudeTrack] = []
    history: list[tuple[float, Estimated]] = []
    for a, b in inc.arcs:
        inside = attitudes.within(float(inc.start[a]), float(inc.end[b - 1]))
        if inside.time.size < 2:
            continue
        if tracks:
            gap = inside.time[0] - tracks[-1].time[-1]
            P = P + trial.inertial.settings.gyro_bias_walk_root_psd**2 * gap * np.eye(3)
        if printed:
            # It starts from no drift, whatever an earlier calibration says.
            filtered = run_printed(samples, inside, frame.lat, np.diag(unknown.sigma**2))
            tracks.append(filtered)
        else:
            forward = run_filter(samples, inside, frame.lat, drift, P)
            filtered = forward.track
            tracks.append(smooth(forward))
        drift, P = filtered.drift[-1], filtered.covariance[-1, 3:, 3:]
        history += [
            (float(t), Estimated((gyro,), (xi,), Q[3:, 3:]))
            for t, xi, Q in zip(filtered.time, filtered.drift, filtered.covariance, strict=True)
        ]
    if not tracks:
        raise DataError(
            "there are no two star attitudes in a row while the IMU runs",
            where=star.source,
            expected="times on the clock of the IMU",
        )
    kept = [history[i] for i in history_rows(len(history))]
    estimated = _drift(trial, tracks, drift, P)
    estimated = replace(estimated, covariance=estimated.covariance + _by_mounting(trial, star))
    outcome = Outcome(estimated, 1, tuple(kept))
    solution = _summary(trial, star, samples, tracks, attitudes, estimated, frame.lat, rate_hz)
    if printed:
        solution = replace(
            solution, solver="kalman-liu-2020", findings=(*solution.findings, _IN_N)
        )
    return solution, outcome


def _star_of(trial: Trial) -> Star:
    """Return the star tracker, if this filter can use it.

    Raises
    ------
    ConfigError, DataError
        If there is none, or no epoch, or its mounting is not known.
    """
    star = trial.find(Star)
    if star is None:
        raise DataError(
            "the trial has no star tracker", where="trial.yaml", expected="a star section"
        )
    if not trial.epoch:
        raise ConfigError(
            "the trial has no `epoch`",
            where="trial.yaml key epoch",
            expected="UTC of time_s = 0, such as 2022-10-12T02:00:00Z",
        )
    settings = star.settings
    if max(settings.mounting_std_deg) > _KNOWN_DEG:
        raise ConfigError(
            f"the mounting of the star tracker is not known ({max(settings.mounting_std_deg):g} "
            "deg), and this filter does not estimate it",
            where="trial.yaml star.mounting_std_deg",
            expected=f"at most {_KNOWN_DEG:g}",
            hint="`solve` estimates the mounting",
        )
    return star


def _drift(trial: Trial, tracks: list[AttitudeTrack], drift: Array, P: Array) -> Estimated:
    """Return the drift at the end if constant, else its mean over the trial.

    The covariance of the mean of a random walk is taken as the mean covariance, which is
    an upper bound.
    """
    begin, end = tracks[0].time[0], tracks[-1].time[-1]
    parameter = trial.inertial.parameters(float(end - begin))[0]
    if trial.inertial.settings.gyro_bias_walk_root_psd == 0.0:
        return Estimated((parameter,), (drift,), P)
    mean = np.concatenate([c.drift for c in tracks]).mean(axis=0)
    spread = np.concatenate([c.covariance[:, 3:, 3:] for c in tracks]).mean(axis=0)
    return Estimated((parameter,), (mean,), spread)


def _mounting_covariance(star: Star) -> Array:
    """Return the covariance, (3, 3), rad², of delta in sRb Exp(delta) by the prior."""
    (mounting,) = star.parameters()
    root = np.linalg.inv(inverse_right_jacobian(mounting.mean)) * mounting.sigma
    return np.asarray(root @ root.T)


def _by_mounting(trial: Trial, star: Star) -> Array:
    """Return what the mounting's prior adds to the covariance of the drift.

    By delta the stars see the rate turned, which looks like a drift of omega x delta. What
    counts of a rate is its mean with the weights that fit a slope to white attitudes.
    """
    time = trial.inertial.time
    weight = (time - time[0]) * (time[-1] - time)
    W = skew(weight @ trial.inertial.gyro / weight.sum())
    return np.asarray(W @ _mounting_covariance(star) @ W.T)


def _summary(
    trial: Trial,
    star: Star,
    samples: StrapdownSamples,
    tracks: list[AttitudeTrack],
    attitudes: StarAttitudes,
    estimated: Estimated,
    lat: float,
    rate_hz: float,
) -> Solution:
    begin = float(samples.increments.start[0])
    initial = trial.initial_attitude
    if tracks[0].time[0] <= samples.increments.end[samples.increments.arcs[0, 1] - 1]:
        nRb = attitude_before(samples, tracks[0], lat, begin)
        rph = rph_from_rotation(nRb, trial.body_axes)
        initial = InitialAttitude(rph, np.full(3, _START))
    navigation = navigate(replace(trial, initial_attitude=initial), np.empty(0))
    values, covariance = estimated.reported()
    estimates = as_estimates(estimated.parameters, values, covariance)
    residuals = (_star_residuals(tracks, attitudes), *gnss_residuals(trial, navigation))
    findings = [*navigation.findings, *star_catalogue_findings([star])]
    if np.any(np.array(star.settings.mounting_std_deg) > 0.0):
        text = message(
            "method_limits.fixed",
            method="star",
            name="star_mounting_deg",
            value=str(np.round(star.settings.mounting_deg, 6).tolist()),
        )
        findings.append(Finding(Code.METHOD_LIMITS, text, parameter="star_mounting_deg"))
    tilt = off_vertical(attitudes.time, attitudes.nRb, trial.inertial.time, trial.inertial.accel)
    if tilt > _OFF_VERTICAL:
        findings.append(
            Finding(
                Code.STAR_VERTICAL,
                message("star_vertical.do_not_use", tilt=np.degrees(tilt)),
                sensor=star.label,
            )
        )
    for e in estimates:
        findings += not_observable(e, lambda _: message("not_observable.short_arc"))
    contradicted = contradictions(residuals)
    first = residuals[0]
    motion = motion_at(navigation, samples.increments.ticks(rate_hz))
    return Solution(
        trial=trial.name,
        solver="kalman-star",
        body_axes=trial.body_axes,
        epoch=trial.epoch,
        inputs=trial.inputs,
        converged=not contradicted,
        iterations=1,
        cost=0.5 * float(np.sum((first.residual / first.sigma) ** 2)),
        estimates=estimates,
        covariance=covariance,
        trajectory=_trajectory(trial, star, samples, tracks, motion),
        residuals=residuals,
        findings=(*findings, *contradicted, *consistency_findings(estimates, residuals)),
    )


def _star_residuals(tracks: list[AttitudeTrack], attitudes: StarAttitudes) -> Residuals:
    """Return smoothed - measured attitude in body axes, arcsec."""
    time = np.concatenate([c.time for c in tracks])
    nRb = np.concatenate([c.nRb for c in tracks])
    rows = np.searchsorted(attitudes.time, time)
    residual = log_so3(attitudes.nRb[rows].transpose(0, 2, 1) @ nRb)
    variance = np.diagonal(attitudes.covariance[rows], axis1=1, axis2=2)
    return Residuals(
        "Star attitude",
        "arcsec",
        ("x", "y", "z"),
        time,
        residual / ARCSEC,
        np.sqrt(variance) / ARCSEC,
    )


def _trajectory(
    trial: Trial,
    star: Star,
    samples: StrapdownSamples,
    tracks: list[AttitudeTrack],
    motion: NavigationMotion,
) -> Trajectory:
    """Return position and velocity of SINS/GNSS with the attitude by the stars."""
    frame = trial.frame()
    nRb, P = motion.nRb.copy(), np.zeros_like(motion.nRb)
    known = np.zeros(motion.time.size, dtype=bool)
    mounting = _mounting_covariance(star)
    for track in tracks:
        inside = (motion.time >= track.time[0]) & (motion.time <= track.time[-1])
        inside &= motion.covered
        nRb[inside], P[inside] = attitude_at(samples, track, frame.lat, motion.time[inside])
        P[inside] += nRb[inside] @ mounting @ nRb[inside].transpose(0, 2, 1)
        known |= inside
    level = enu_from_ecef(motion.geodetic[known, 0], motion.geodetic[known, 1])
    lRn = level @ enu_from_ecef(frame.lat, frame.lon).T
    lRb = lRn @ nRb[known]
    rph = rph_from_rotation(lRb, trial.body_axes)
    J = rph_jacobian(rph, trial.body_axes) @ nRb[known].transpose(0, 2, 1)
    return Trajectory(
        time=motion.time[known],
        geodetic=motion.geodetic[known],
        velocity=motion.velocity[known],
        rph=rph,
        position_cov=motion.covariance[known, 0:3, 0:3],
        velocity_cov=motion.covariance[known, 3:6, 3:6],
        rph_cov=J @ P[known] @ J.transpose(0, 2, 1),
    )
