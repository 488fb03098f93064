"""SINS/GNSS navigation of a complete trial: events, start, filter and smoother of every arc."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from factorgraph_dvl.baselines.coarse_alignment import CoarseAttitude, coarse_attitude
from factorgraph_dvl.baselines.ins_gnss import (
    FilteredTrack,
    FilterState,
    Fixes,
    run_filter,
    smooth,
)
from factorgraph_dvl.baselines.strapdown import (
    Steps,
    StrapdownSamples,
    at_times,
    compose,
    exp_small,
    prepare,
)
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import RATE, radii
from factorgraph_dvl.geometry.records import concatenated
from factorgraph_dvl.geometry.rotations import (
    exp_so3,
    log_so3,
    rotation_from_rph,
    rph_jacobian,
    wrapped,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, cross_variance, interpolate, rotate, skew
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.trial import Trial

# Chosen: longest step, s, over which gravity and Coriolis terms count as constant.
_LONGEST_STEP = 0.5
# Chosen: times closer than this, s, are one.
_SAME_TIME = 1e-6
# Stands for an infinite standard deviation, m/s. Chosen: an update by it changes nothing.
_UNMEASURED_STD = 1e4
# Chosen: span, s, of the difference of fixes that stands for a velocity that is not reported.
_BASELINE = 5.0
# Chosen: change of the initial attitude from which on the filter runs again; linearisation errors
# are below it squared.
_CLOSE = 0.3 * DEG
_PASSES = 4
# Chosen: standard deviations of the initial position, m, and velocity, m/s, beyond the fix's own.
_POSITION_UNKNOWN = 10.0
_VELOCITY_UNKNOWN = 3.0
# Chosen: standard deviation of an attitude beyond which a filter that is linear in its error does
# not describe it: of a prior, where alignment is better, and of what was found.
_WIDE = 6.0 * DEG


@dataclass(frozen=True)
class Navigation:
    """Motion of a trial, smoothed unless that was not wanted.

    Parameters
    ----------
    samples : StrapdownSamples
        Increments of the IMU.
    track : FilteredTrack
        States at the events of all arcs, one after the other.
    arc : ndarray, shape (K,)
        Arc of each event.
    findings : tuple of Finding
        What the user must know.
    """

    samples: StrapdownSamples
    track: FilteredTrack
    arc: np.ndarray
    findings: tuple[Finding, ...]

    def at(self, time: Array) -> NavigationMotion:
        """Return the motion at times (M,), as `motion_at`."""
        return motion_at(self, time)

    def ticks(self, rate_hz: float) -> Array:
        """Return the multiples of 1 / rate that the samples cover."""
        return self.samples.increments.ticks(rate_hz)


@dataclass(frozen=True)
class NavigationMotion:
    """Motion at M times.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times on the clock of the IMU.
    geodetic, velocity, nRb : ndarray
        Local-level, as in `FilteredTrack`.
    covariance : ndarray, shape (M, 9, 9)
        Covariances of the errors of position, velocity, attitude.
    omega_b : ndarray, shape (M, 3), rad/s
        Rate relative to the Earth.
    omega_sigma : ndarray, shape (M, 3), rad/s
        Its standard deviation from the gyro's noise and from motion that the samples do not
        resolve.
    covered : ndarray, shape (M,)
        Whether the arcs of the trial cover the time.
    """

    time: Array
    geodetic: Array
    velocity: Array
    nRb: Array
    covariance: Array
    omega_b: Array
    omega_sigma: Array
    covered: np.ndarray

    @cached_property
    def v_b(self) -> Array:
        """Velocity over the Earth in body, (M, 3), m/s."""
        return rotate(self.nRb.transpose(0, 2, 1), self.velocity)

    @cached_property
    def v_b_covariance(self) -> Array:
        """Covariance of `v_b`, (M, 3, 3), m²/s²."""
        bRn = self.nRb.transpose(0, 2, 1)
        J = np.concatenate([bRn, bRn @ skew(self.velocity)], axis=2)
        return np.asarray(J @ self.covariance[:, 3:, 3:] @ J.transpose(0, 2, 1))


def navigate(trial: Trial, pings: Array, *, smoothed: bool = True) -> Navigation:
    """Return the smoothed motion of a trial, with states at fixes and pings.

    Parameters
    ----------
    trial : Trial
        Trial with GNSS.
    pings : ndarray, shape (M,), s
        True times of the pings.
    smoothed : bool, default True
        False = the motion as the filter knew it at each time.

    Raises
    ------
    DataError
        If there is no GNSS, or no fix while the IMU runs.
    """
    gnss = trial.gnss
    if gnss is None or np.isnan(gnss.geodetic[:, 0]).all():
        raise DataError(
            "the SINS/GNSS filter needs GNSS positions, and the trial has none",
            where=gnss.source if gnss is not None else "trial.yaml",
            expected="a gnss section with positions",
            hint="`solve` does not need them",
        )
    inc, gaps = increments(trial.inertial)
    findings = [*trial.notes, *gaps]
    samples = prepare(inc, trial.inertial.settings)
    if np.any(np.array(gnss.settings.lever_arm_std_m) > 0.0):
        findings.append(
            Finding(
                Code.METHOD_LIMITS,
                message("method_limits.antenna"),
                sensor=gnss.label,
            )
        )
    tracks: list[FilteredTrack] = []
    for a, b in inc.arcs:
        span = (float(inc.start[a]), float(inc.end[b - 1]))
        inside = (gnss.time >= span[0]) & (gnss.time <= span[1])
        if not np.any(inside & ~np.isnan(gnss.geodetic[:, 0])):
            text = message("unused.no_position", start=span[0], end=span[1])
            findings.append(Finding(Code.UNUSED, text, sensor=gnss.label))
            continue
        if tracks:
            text = message("filter_restarted.after_gap", time=span[0])
            findings.append(Finding(Code.FILTER_RESTARTED, text))
        track, note = _navigate_arc(trial, gnss, samples, span, pings, tracks, smoothed)
        tracks.append(track)
        findings += [Finding(Code.HEADING_UNKNOWN, note)] if note is not None else []
    if not tracks:
        raise DataError(
            "no GNSS position while the IMU runs",
            where=gnss.source,
            expected="times on the clock of the IMU",
        )
    joined = concatenated(tracks)
    arc = np.repeat(np.arange(len(tracks)), [t.time.size for t in tracks])
    return Navigation(samples, joined, arc, tuple(findings))


def motion_at(navigation: Navigation, time: Array) -> NavigationMotion:
    """Return the motion at times (M,), carried from the event before by the increments.

    The difference to the state at the next event is distributed in proportion to time; the
    covariances are interpolated.
    """
    track, samples = navigation.track, navigation.samples
    before = np.clip(
        np.searchsorted(track.time, time + _SAME_TIME, side="right") - 1, 0, track.time.size - 2
    )
    # The last event of an arc belongs to the step before it.
    ends = navigation.arc[before] != navigation.arc[before + 1]
    before = np.where(ends, np.maximum(before - 1, 0), before)
    first, last = track.time[before], track.time[before + 1]
    covered = (time >= first - _SAME_TIME) & (time <= last + _SAME_TIME)
    covered &= navigation.arc[before] == navigation.arc[before + 1]
    inside = np.clip(time, first, last)

    used = np.unique(before)
    complete = _carry(track, used, compose(samples, track.time[used], track.time[used + 1]))
    partial = _carry(track, before, compose(samples, first, inside))
    at = np.searchsorted(used, before)
    fraction = (inside - first) / (last - first)
    turn_miss = log_so3(track.nRb[used + 1] @ complete[2].transpose(0, 2, 1))
    nRb = exp_so3(fraction[:, None] * turn_miss[at]) @ partial[2]
    velocity = partial[1] + fraction[:, None] * (track.velocity[used + 1] - complete[1])[at]
    geodetic = partial[0] + fraction[:, None] * (track.geodetic[used + 1] - complete[0])[at]
    # The filter adds up longitude beyond 180 deg.
    geodetic[:, 1] = wrapped(geodetic[:, 1])
    P = track.covariance[before, :9, :9]
    P = P + fraction[:, None, None] * (track.covariance[before + 1, :9, :9] - P)

    _, signal = at_times(samples, inside)
    bias = track.gyro_bias[before] + fraction[:, None] * np.diff(track.gyro_bias, axis=0)[before]
    turning = rotate(nRb.transpose(0, 2, 1), earth_rate(geodetic[:, 0]))
    return NavigationMotion(
        time=time,
        geodetic=geodetic,
        velocity=velocity,
        nRb=nRb,
        covariance=P,
        omega_b=signal.omega - bias - turning,
        omega_sigma=signal.omega_sigma,
        covered=covered,
    )


def attitude_is_known(motion: NavigationMotion) -> Array:
    """Whether motion is covered, and its attitude known well enough to compare velocities, (M,).

    On a short arc, as between two breaks of the IMU's clock, it may not be. What is wrong with its
    heading then goes into the mounting, and no covariance that is linear describes it. Where no
    arc is better, all are good enough: some of the parameters need no heading.
    """
    sigma = np.sqrt(np.diagonal(motion.covariance[:, 6:, 6:], axis1=1, axis2=2).max(axis=1))
    known = motion.covered & (sigma <= _WIDE)
    return known if known.any() else motion.covered


def _carry(track: FilteredTrack, index: np.ndarray, step: Steps) -> tuple[Array, Array, Array]:
    """Return geodetic position, velocity and nRb, carried from events over steps."""
    C, v = track.nRb[index], track.velocity[index]
    T = step.duration[:, None]
    free = rotate(step.bias_jacobian, track.accel_bias[index])
    tilted = np.cross(step.dv * T - step.dp, track.gyro_bias[index])
    gravity = track.apparent_gravity[index]
    velocity = v + rotate(C, step.dv - free + tilted) + gravity * T
    moved = v * T + rotate(C, step.dp - 0.5 * T * free) + 0.5 * gravity * T**2
    lat, lon, height = track.geodetic[index].T
    meridian, east = radii(lat)
    place = np.stack(
        [
            lat + moved[:, 1] / (meridian + height),
            lon + moved[:, 0] / ((east + height) * np.cos(lat)),
            height + moved[:, 2],
        ],
        axis=1,
    )
    turned = exp_small(-T * track.frame_rate[index]) @ C
    bias_turn = exp_small(-rotate(step.bias_jacobian, track.gyro_bias[index]))
    return place, velocity, turned @ bias_turn @ step.turn


def earth_rate(lat: Array) -> Array:
    """Return the Earth's rotation in east, north, up at latitudes (M,), rad, (M, 3), rad/s."""
    return RATE * np.stack([np.zeros_like(lat), np.cos(lat), np.sin(lat)], axis=1)


def _events(span: tuple[float, float], times: Array) -> Array:
    """Return the distinct times within a span, its ends, and no step longer than allowed."""
    inside = times[(times > span[0]) & (times < span[1])]
    events = np.unique(np.concatenate([span, inside]))
    events = events[np.concatenate([[True], np.diff(events) > _SAME_TIME])]
    gap = np.diff(events)
    pieces = np.maximum(np.ceil(gap / _LONGEST_STEP - 1e-9).astype(int), 1)
    start = np.repeat(events[:-1], pieces)
    piece = np.arange(start.size) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    return np.append(start + piece * np.repeat(gap / pieces, pieces), events[-1])


def _navigate_arc(
    trial: Trial,
    gnss: Gnss,
    samples: StrapdownSamples,
    span: tuple[float, float],
    pings: Array,
    earlier: list[FilteredTrack],
    smoothed: bool,
) -> tuple[FilteredTrack, Message | None]:
    time = _events(span, np.concatenate([gnss.time, pings]))
    steps = compose(samples, time[:-1], time[1:])
    fixes = _fixes_at(gnss, samples, time)
    s = trial.inertial.settings
    walk = (s.gyro_bias_walk_root_psd**2, s.accel_bias_walk_root_psd**2)
    given = trial.initial_attitude if not earlier else None
    if given is not None and given.std.max() <= _WIDE:
        nRb = rotation_from_rph(given.rph, trial.body_axes)
        J = nRb @ np.linalg.inv(rph_jacobian(given.rph, trial.body_axes))
        attitude = CoarseAttitude(nRb, J @ np.diag(given.std**2) @ J.T)
        passes = 1
    else:
        velocity, sigma = _velocities(fixes, time)
        attitude = coarse_attitude(
            time,
            steps,
            _filled(fixes.geodetic, time),
            velocity,
            sigma,
            np.cross(fixes.turning, fixes.lever_arm),
            s,
            trial.body_axes,
        )
        attitude = replace(
            attitude, covariance=4.0 * attitude.covariance + (0.2 * DEG) ** 2 * np.eye(3)
        )
        passes = _PASSES
    start = _start(trial, fixes, time, attitude, earlier, walk)
    for _ in range(passes):
        forward = run_filter(time, steps, fixes, start, walk)
        track = smooth(forward)
        moved = np.linalg.norm(log_so3(track.nRb[0] @ start.nRb.T))
        # A heading that moves by less than is known of it would only take its prior along.
        if moved < max(_CLOSE, np.sqrt(track.covariance[0].diagonal()[6:9].max())):
            break
        start = replace(start, nRb=track.nRb[0])
    return track if smoothed else forward.track, attitude.note


def _fixes_at(gnss: Gnss, samples: StrapdownSamples, time: Array) -> Fixes:
    """Return the GNSS measurements at the events they belong to."""
    inside = np.flatnonzero((gnss.time >= time[0] - _SAME_TIME) & (gnss.time <= time[-1]))
    at = np.searchsorted(time, gnss.time[inside] + 2.0 * _SAME_TIME) - 1
    out = {name: np.full((time.size, 3), np.nan) for name in ("p", "v", "sp", "sv")}
    out["p"][at], out["v"][at] = gnss.geodetic[inside], gnss.velocity[inside]
    lever_arm, omega_cb_b = gnss.lever_arm(time)
    arm_std = float(np.max(gnss.settings.lever_arm_std_m))
    _, signal = at_times(samples, time)
    omega_sigma = signal.omega_sigma
    gyro_noise = cross_variance(omega_sigma, lever_arm**2)
    turned = arm_std**2 * np.sum(signal.omega**2, axis=1)
    out["sp"][at] = gnss.position_std[inside] ** 2 + arm_std**2
    variance = np.minimum(gnss.velocity_std[inside], _UNMEASURED_STD) ** 2
    out["sv"][at] = variance + (gyro_noise + turned)[at, None]
    turning = signal.omega - omega_cb_b
    return Fixes(out["p"], out["v"], out["sp"], out["sv"], turning, lever_arm)


def _filled(geodetic: Array, time: Array) -> Array:
    known = ~np.isnan(geodetic[:, 0])
    lat, lon, height = geodetic[known].T
    return interpolate(time, time[known], np.stack([lat, np.unwrap(lon), height], axis=1))


def _velocities(fixes: Fixes, time: Array) -> tuple[Array, Array]:
    """Return antenna velocities (K, 3), nan where unknown, and their standard deviations."""
    if not np.isnan(fixes.velocity).all():
        return fixes.velocity, np.sqrt(fixes.velocity_variance)
    known = np.flatnonzero(~np.isnan(fixes.geodetic[:, 0]))
    t, place = time[known], fixes.geodetic[known]
    a = np.searchsorted(t, t - 0.5 * _BASELINE)
    b = np.clip(np.searchsorted(t, t + 0.5 * _BASELINE), 0, t.size - 1)
    span = np.maximum(t[b] - t[a], 1e-3)
    meridian, east = radii(place[:, 0])
    metres = np.stack([(east * np.cos(place[:, 0])), meridian, np.ones_like(east)], axis=1)
    velocity, sigma = np.full((time.size, 3), np.nan), np.full((time.size, 3), np.nan)
    change = (place[b] - place[a])[:, [1, 0, 2]]
    change[:, 0] = wrapped(change[:, 0])
    velocity[known] = np.where((b > a)[:, None], change * metres / span[:, None], np.nan)
    sigma[known] = np.sqrt(2.0 * fixes.position_variance[known]) / span[:, None]
    return velocity, sigma


def _start(
    trial: Trial,
    fixes: Fixes,
    time: Array,
    attitude: CoarseAttitude,
    earlier: list[FilteredTrack],
    walk: tuple[float, float],
) -> FilterState:
    """Return the state at the first event: wide, as the fixes determine it."""
    P = np.zeros((15, 15))
    velocity, _ = _velocities(fixes, time)
    moving = np.flatnonzero(~np.isnan(velocity[:, 0]))
    v = np.zeros(3)
    waited = 0.0
    if moving.size:
        first = moving[0]
        waited = float(time[first] - time[0])
        v = velocity[first] - attitude.nRb @ np.cross(fixes.turning[first], fixes.lever_arm[first])
    P[3:6, 3:6] = (_VELOCITY_UNKNOWN + waited) ** 2 * np.eye(3)
    fix = np.flatnonzero(~np.isnan(fixes.geodetic[:, 0]))[0]
    waited = float(time[fix] - time[0])
    lat, lon, height = fixes.geodetic[fix]
    meridian, east = radii(lat)
    back = v * waited + attitude.nRb @ fixes.lever_arm[fix]
    place = np.array(
        [lat - back[1] / meridian, lon - back[0] / (east * np.cos(lat)), height - back[2]]
    )
    P[0:3, 0:3] = np.diag(fixes.position_variance[fix]) + (
        _POSITION_UNKNOWN + _VELOCITY_UNKNOWN * waited
    ) ** 2 * np.eye(3)
    if trial.initial_position is not None and not earlier:
        place = trial.initial_position.geodetic
        P[0:3, 0:3] = np.diag(trial.initial_position.std**2)
    if trial.initial_velocity is not None and not earlier:
        v = trial.initial_velocity.velocity
        P[3:6, 3:6] = np.diag(trial.initial_velocity.std**2)
    P[6:9, 6:9] = attitude.covariance
    bg, ba = (p.mean for p in trial.inertial.parameters(0.0))
    if earlier:
        last = earlier[-1]
        gap = float(time[0] - last.time[-1])
        bg, ba = last.gyro_bias[-1], last.accel_bias[-1]
        P[9:, 9:] = last.covariance[-1, 9:, 9:] + np.diag(np.repeat(walk, 3)) * gap
    else:
        P[9:, 9:] = trial.inertial.bias_covariance()
    return FilterState(place, v, attitude.nRb, bg, ba, P)
