"""Whether units, signs, axes and clocks of a trial are plausible.

Checks compare sensors with each other or with gravity, never with a solution, so that
they speak before anything is solved.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.integrate import cumulative_trapezoid

from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, frd_from_body
from factorgraph_dvl.geometry.units import DEG, STANDARD_GRAVITY
from factorgraph_dvl.geometry.vectors import Array, interpolate
from factorgraph_dvl.quality.plausibility_beams import beam_findings
from factorgraph_dvl.quality.plausibility_star import star_findings
from factorgraph_dvl.quality.records import (
    GAP_INTERVALS,
    WINDOW_S,
    SensorSurvey,
    gnss_velocity,
    velocity_between_fixes,
)
from factorgraph_dvl.sensors.beam_geometry import as_dvl
from factorgraph_dvl.sensors.dvl import MISALIGNMENT, Dvl
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.star import Star
from factorgraph_dvl.trial import Trial

_WINDOWS = 20
_MOVING_M_S = 0.3
_KNOT = 1852.0 / 3600.0
# SI value of what a speed may have been written in.
_SPEED_UNITS = {
    "knots": _KNOT,
    "km/h": 1.0 / 3.6,
    "ft/s": 0.3048,
    "cm/s": 0.01,
    "mm/s": 0.001,
}
# What a ping takes, and which sign it has.
_DVL_TERMS = ("a lock", "Moving along +x must give a positive x")
_BEAM_TERMS = ("three beams", "Moving in the direction of a beam must give it a positive velocity")
_RADIANS = "latitude and longitude look like radians, not deg"
_AXIS_NAMES = ("+x", "+y", "+z", "-x", "-y", "-z")


def findings(trial: Trial, sensors: list[SensorSurvey]) -> Iterator[Finding]:
    """Check units, signs, axes and clocks of a trial.

    Parameters
    ----------
    trial : Trial
        As loaded.
    sensors : list of SensorSurvey
        Its records, that of the IMU first.
    """
    yield from _clock_findings(trial, sensors)
    yield from _force_findings(trial.imu, trial.body_axes)
    yield from _gyro_findings(trial.imu)
    if trial.gnss is not None:
        yield from _gnss_findings(trial.gnss)
    if trial.dvl is not None:
        yield from _dvl_findings(trial.dvl, trial.gnss, trial.body_axes, _DVL_TERMS)
    if trial.beams is not None:
        log = as_dvl(trial.beams)
        yield from _dvl_findings(log, trial.gnss, trial.body_axes, _BEAM_TERMS)
        yield from beam_findings(trial.beams)
    for aid in trial.others:
        if isinstance(aid, Star):
            yield from star_findings(aid, trial)


def _clock_findings(trial: Trial, sensors: list[SensorSurvey]) -> Iterator[Finding]:
    imu, *aids = sensors
    interval = 1.0 / imu.rate
    if interval >= 0.5:
        unit = f", or milliseconds ({1000.0 / interval:.4g} Hz)" if interval >= 1.0 else ""
        yield Finding(
            Code.TIME_UNIT,
            f"one sample every {interval:.4g} s: time_s must be in seconds{unit}; "
            "an IMU this slow does not resolve the motion",
            "IMU",
            severity="error",
        )
    elif imu.rate > 2e4:
        text = f"{imu.rate:.4g} samples per second: is time_s in seconds?"
        yield Finding(Code.TIME_UNIT, text, "IMU", severity="error")
    for aid, record in zip(aids, trial.aids, strict=True):
        if aid.missing == 1.0:
            text = "none of its rows holds a measurement"
            yield Finding(Code.NO_MEASUREMENT, text, aid.label, severity="error")
            continue
        inside = min(aid.end, imu.end) - max(aid.start, imu.start)
        if not _meets(record, trial.imu):
            yield Finding(
                Code.NO_OVERLAP,
                f"its times, {aid.start:.10g} to {aid.end:.10g} s, do not overlap those of the "
                f"IMU, {imu.start:.10g} to {imu.end:.10g} s: are they of one clock, in seconds?",
                aid.label,
                severity="error",
            )
        elif inside < 0.5 * (aid.end - aid.start):
            yield Finding(
                Code.PARTIAL_OVERLAP,
                "more than half of its record lies outside that of the IMU",
                aid.label,
            )
        elif inside < 0.5 * (imu.end - imu.start):
            yield Finding(
                Code.PARTIAL_OVERLAP,
                f"it covers {100.0 * inside / (imu.end - imu.start):.3g} % of the IMU's record",
                aid.label,
            )
    for sensor in sensors:
        if sensor.gaps:
            yield Finding(
                Code.GAPS,
                f"{sensor.gaps} gaps longer than {GAP_INTERVALS:g} sample intervals, the longest "
                f"{sensor.longest_gap:.4g} s",
                sensor.label,
            )
        if 0.5 < sensor.missing < 1.0:
            yield Finding(
                Code.MISSING,
                f"{100.0 * sensor.missing:.3g} % of its rows hold no measurement",
                sensor.label,
            )


def _meets(aid: Aid, imu: Imu) -> bool:
    """Whether the IMU runs at any measurement of a sensor."""
    time = aid.time[np.logical_not(aid.missing)] - getattr(aid.settings, "time_offset_s", 0.0)
    after = np.searchsorted(imu.time, time)
    edges = np.concatenate([[-np.inf], imu.time, [np.inf]])
    nearest = np.minimum(time - edges[after], edges[after + 1] - time)
    interval = float(np.median(np.diff(imu.time))) if imu.time.size > 1 else 0.0
    return bool(np.any(nearest <= interval))


def _force_findings(imu: Imu, body_axes: BodyAxes) -> Iterator[Finding]:
    size = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    interval = float(np.median(np.diff(imu.time))) if imu.time.size > 1 else np.nan
    looks = f"the specific force is {size:.4g} in the median, not about 9.8 m/s²"
    for unit, gravity in (
        ("g; multiply by 9.80665", 1.0),
        ("mg; multiply by 0.00980665", 1000.0),
        ("ft/s²; multiply by 0.3048", STANDARD_GRAVITY / 0.3048),
        ("velocity increments; divide by the sample interval", STANDARD_GRAVITY * interval),
    ):
        if abs(size / gravity - 1.0) < 0.05:
            yield Finding(
                Code.FORCE_UNIT, f"{looks}: it looks like {unit}", "IMU", severity="error"
            )
            return
    if abs(size / STANDARD_GRAVITY - 1.0) > 0.05:
        removed = ": was gravity removed? Specific force includes it" if size < 3.0 else ""
        yield Finding(Code.FORCE_UNIT, looks + removed, "IMU", severity="error")
        return
    yield Finding(
        Code.FORCE_UNIT, f"specific force {size:.4g} m/s² in the median", "IMU", severity="ok"
    )
    yield from _axes_findings(imu, body_axes)


def _axes_findings(imu: Imu, body_axes: BodyAxes) -> Iterator[Finding]:
    mean = imu.accel.mean(axis=0)
    mean /= np.linalg.norm(mean)
    up_b = -frd_from_body(body_axes)[2]
    tilt = float(np.degrees(np.arccos(np.clip(mean @ up_b, -1.0, 1.0))))
    if tilt < 30.0:
        yield Finding(
            Code.BODY_AXES,
            f"gravity fits body_axes {body_axes} to {tilt:.2g} deg",
            "IMU",
            severity="ok",
        )
        return
    k = int(np.argmax(np.concatenate([mean, -mean])))
    expected = _AXIS_NAMES[int(np.argmax(np.concatenate([up_b, -up_b])))]
    text = (
        f"the mean specific force points along {_AXIS_NAMES[k]} of the IMU; at rest it points "
        f"up, which body_axes {body_axes} says is {expected}"
    )
    if tilt > 150.0:
        other = "RFU or FLU" if body_axes == "FRD" else "FRD"
        question = f"are the axes {other}, or is the force that of gravity?"
        yield Finding(Code.BODY_AXES, f"{text}: {question}", "IMU", severity="error")
    else:
        yield Finding(
            Code.BODY_AXES,
            f"{text}: is the IMU mounted {tilt:.0f} deg off level?",
            "IMU",
            severity="warning",
        )


def _gyro_findings(imu: Imu) -> Iterator[Finding]:
    rms = float(np.sqrt(np.mean(np.sum(imu.gyro**2, axis=1))))
    if rms == 0.0:
        yield Finding(
            Code.GYRO_FROZEN, "the angular rate is zero throughout", "IMU", severity="error"
        )
        return
    steady = _force_steadiness(imu, 1.0)
    rate = 1.0 / float(np.median(np.diff(imu.time))) if imu.time.size > 1 else 1.0
    candidates = {
        "in deg/s; multiply by pi/180": DEG,
        "in angle increments; divide by the sample interval": rate,
        "of the opposite sign, or in other axes than the specific force": -1.0,
    }
    best, least = "", np.inf
    # Turned by a right gyro, the force keeps the direction of gravity.
    if 1.0 - steady > 0.001:
        losses = {text: 1.0 - _force_steadiness(imu, f) for text, f in candidates.items()}
        best, least = min(losses.items(), key=lambda item: item[1])
    if 1.0 - steady > 4.0 * least:
        yield Finding(
            Code.GYRO_UNIT,
            f"the angular rate does not turn the specific force as it should: it looks {best}",
            "IMU",
            severity="error",
        )
    elif rms > 3.0:
        text = f"the angular rate is {rms:.3g} rad/s rms: is it in deg/s?"
        yield Finding(Code.GYRO_UNIT, text, "IMU", severity="error")
    else:
        yield Finding(
            Code.GYRO_UNIT,
            f"angular rate {rms / DEG:.3g} deg/s rms, fits gravity",
            "IMU",
            severity="ok",
        )


def _force_steadiness(imu: Imu, factor: float) -> float:
    """Return how well the force keeps its direction over 10 s when turned by the gyro.

    The ratio |mean of C f| / mean of |f|, averaged over windows; 1 = perfectly.
    """
    interval = float(np.median(np.diff(imu.time))) if imu.time.size > 1 else 1.0
    size = int(min(max(2, round(WINDOW_S / interval)), imu.time.size, 4000))
    starts = np.unique(np.linspace(0, imu.time.size - size, _WINDOWS).astype(int))
    rows = starts[:, None] + np.arange(size)
    turns = exp_so3(imu.gyro[rows] * factor * interval)
    attitude = np.broadcast_to(np.eye(3), (starts.size, 3, 3))
    total = np.zeros((starts.size, 3))
    for k in range(size):
        attitude = attitude @ turns[:, k]
        total += np.einsum("wij,wj->wi", attitude, imu.accel[rows[:, k]])
    magnitude = np.linalg.norm(imu.accel[rows], axis=2).sum(axis=1)
    return float(np.mean(np.linalg.norm(total, axis=1) / magnitude))


def _gnss_findings(gnss: Gnss) -> Iterator[Finding]:
    geodetic = gnss.geodetic[~np.isnan(gnss.geodetic[:, 0])]
    if geodetic.shape[0] and np.any(np.all(geodetic[:, :2] == 0.0, axis=1)):
        text = "some fixes are at 0, 0: leave the cells of lost fixes empty"
        yield Finding(Code.ZERO_FIXES, text, gnss.label, severity="error")
    begin, end, between = velocity_between_fixes(gnss)
    measured = ~np.isnan(gnss.velocity[:, 0])
    if begin.size < 3 or measured.sum() < 3:
        return
    time, velocity = gnss.time[measured], gnss.velocity[measured]
    mean = _interval_means(time, velocity, begin, end)
    noise = np.sqrt(2.0) * float(np.median(gnss.position_std[:, :2])) / float(
        np.median(end - begin)
    ) + float(np.median(gnss.velocity_std[:, :2]))
    yield from _compare_velocities(gnss, geodetic, between, mean, noise)


def _interval_means(time: Array, values: Array, begin: Array, end: Array) -> Array:
    """Return the means of values (N, 3) over intervals, (M, 3), by trapezoids."""
    integral = cumulative_trapezoid(values, time, axis=0, initial=0)
    duration = np.maximum(end - begin, 1e-9)[:, None]
    return (interpolate(end, time, integral) - interpolate(begin, time, integral)) / duration


def _compare_velocities(
    gnss: Gnss, geodetic: Array, between: Array, mean: Array, noise: float
) -> Iterator[Finding]:
    """Compare velocities between fixes with measured ones, (M, 3) both."""
    speed = _rms(between[:, :2])
    tolerance = 0.1 * speed + 3.0 * noise
    misfit = _rms(between[:, :2] - mean[:, :2])
    if misfit <= tolerance:
        if speed > _MOVING_M_S:
            yield Finding(
                Code.GNSS_VELOCITY,
                f"velocities agree with positions to {misfit:.2g} m/s rms",
                gnss.label,
                severity="ok",
            )
        yield from _compare_vertical(gnss, between, mean)
        return
    if np.abs(geodetic[:, 0]).max() < 90.0 * DEG**2 and _rms(
        mean[:, :2] - between[:, :2] / DEG
    ) < (0.1 * _rms(mean[:, :2]) + 3.0 * noise / DEG):
        yield Finding(Code.RADIANS, _RADIANS, gnss.label, severity="error")
        return
    explained = {
        text: _rms(between[:, :2] - mean[:, :2] @ np.array(matrix, dtype=float).T)
        for text, matrix in _velocity_candidates()
    }
    best = min(explained, key=lambda text: explained[text])
    cause = f": {best}" if explained[best] <= tolerance else ""
    yield Finding(
        Code.GNSS_VELOCITY,
        f"velocities disagree with the differences of positions by {misfit:.3g} m/s rms{cause}",
        gnss.label,
        severity="error",
    )


def _velocity_candidates() -> Iterator[tuple[str, list[list[float]]]]:
    """Return what may be wrong with a velocity, and the matrix that sets it right."""
    yield (
        "east and north look swapped (or latitude and longitude)",
        [[0.0, 1.0], [1.0, 0.0]],
    )
    yield "the velocity has the opposite sign", [[-1.0, 0.0], [0.0, -1.0]]
    yield "the east velocity has the opposite sign", [[-1.0, 0.0], [0.0, 1.0]]
    yield "the north velocity has the opposite sign", [[1.0, 0.0], [0.0, -1.0]]
    for unit, factor in _SPEED_UNITS.items():
        yield f"the velocity looks like {unit}", [[factor, 0.0], [0.0, factor]]


def _compare_vertical(gnss: Gnss, between: Array, mean: Array) -> Iterator[Finding]:
    noise = np.sqrt(2.0) * float(np.median(gnss.position_std[:, 2])) / WINDOW_S
    up, measured = between[:, 2], mean[:, 2]
    if _rms(up) > 5.0 * noise + 0.05 and up @ measured < -0.5 * _rms(up) * up.size * _rms(
        measured
    ):
        text = "vel_u_m_s has the opposite sign of the change of height"
        yield Finding(Code.GNSS_VELOCITY, text, gnss.label, severity="error")


def _dvl_findings(
    dvl: Dvl, gnss: Gnss | None, body_axes: BodyAxes, terms: tuple[str, str]
) -> Iterator[Finding]:
    locked = dvl.locked
    lock, positive = terms
    if not locked.any():
        text = f"there is no ping with {lock}"
        yield Finding(Code.NO_MEASUREMENT, text, dvl.label, severity="warning")
        return
    velocity = dvl.velocity[locked]
    std = float(np.median(dvl.sigma()[locked]))
    speed = float(np.median(np.linalg.norm(velocity, axis=1)))
    if std > max(0.3 * speed, 0.1):
        yield Finding(
            Code.DVL_STD,
            f"its standard deviation, {std:.2g} m/s, is large for a speed of {speed:.2g} m/s",
            dvl.label,
        )
    if np.all(velocity == velocity[0]) and velocity.shape[0] > 2:
        yield Finding(Code.DVL_FROZEN, "the velocity never changes", dvl.label, severity="error")
    if gnss is not None:
        yield from _speed_findings(dvl, gnss)
    yield from _sign_findings(dvl, body_axes, velocity, positive)


def _speed_findings(dvl: Dvl, gnss: Gnss) -> Iterator[Finding]:
    time, velocity = gnss_velocity(gnss)
    if time.size < 2:
        return
    pings = dvl.time[dvl.locked]
    inside = (pings >= time[0]) & (pings <= time[-1])
    at_ping = interpolate(pings[inside], time, velocity)
    gnss_speed = np.linalg.norm(at_ping, axis=1)
    dvl_speed = np.linalg.norm(dvl.velocity[dvl.locked][inside], axis=1)
    if _in_radians(gnss, np.linalg.norm(at_ping[:, :2], axis=1), dvl_speed):
        yield Finding(Code.RADIANS, _RADIANS, gnss.label, severity="error")
        return
    moving = gnss_speed > _MOVING_M_S
    if moving.sum() < 3:
        return
    ratio = float(np.median(dvl_speed[moving] / gnss_speed[moving]))
    allowed = 0.5 if dvl.settings.reference == "water" else 0.25
    # Sway moves DVL and antenna by their lever arms, but not on the average.
    steady = _steady_ratio(pings[inside], dvl.velocity[dvl.locked][inside], at_ping)
    if min(abs(ratio - 1.0), abs(steady - 1.0)) <= allowed:
        yield Finding(
            Code.DVL_UNIT,
            f"its unit is plausible: speed {ratio:.3g} times that of the GNSS, which is not its "
            "scale error: the lever arm, in sway and turns, contributes",
            dvl.label,
            severity="ok",
        )
        return
    cause = ""
    for unit, factor in _SPEED_UNITS.items():
        if abs(ratio * factor - 1.0) < 0.1:
            cause = f": it looks like {unit}"
    yield Finding(
        Code.DVL_UNIT,
        f"its speed is {ratio:.4g} times that of the GNSS{cause or ': is it in m/s?'}",
        dvl.label,
        severity="error",
    )


def _in_radians(gnss: Gnss, gnss_speed: Array, dvl_speed: Array) -> bool:
    """Whether fixes without velocities move as slowly as radians in columns of degrees do."""
    if not np.isnan(gnss.velocity).all():
        return False
    small = np.nanmax(np.abs(gnss.geodetic[:, 0]), initial=0) < 90.0 * DEG**2
    moving = (dvl_speed > _MOVING_M_S) & (gnss_speed > 0.0)
    ratio = dvl_speed[moving] / gnss_speed[moving] * DEG
    return bool(small and moving.sum() > 3 and abs(np.median(ratio) - 1.0) < 0.2)


def _steady_ratio(time: Array, dvl: Array, gnss: Array) -> float:
    """Return the ratio of the speeds of velocities (M, 3) that are averaged over windows.

    1 where the vessel does not get anywhere.
    """
    window = np.floor((time - time[0]) / WINDOW_S)
    first = np.flatnonzero(np.diff(window, prepend=-1.0))
    count = np.diff(np.append(first, time.size))[:, None]
    mean_dvl, mean_gnss = (
        np.linalg.norm(np.add.reduceat(v, first) / count, axis=1) for v in (dvl, gnss)
    )
    moving = mean_gnss > _MOVING_M_S
    return float(np.median(mean_dvl[moving] / mean_gnss[moving])) if moving.any() else 1.0


def _sign_findings(
    dvl: Dvl, body_axes: BodyAxes, velocity_d: Array, positive: str
) -> Iterator[Finding]:
    """Check that the vehicle moves ahead, where the mounting is known well enough."""
    misalignment = next(p for p in dvl.parameters() if p.name == MISALIGNMENT)
    if misalignment.sigma.max() > 30.0 * DEG:
        return
    dRb = exp_so3(misalignment.mean)
    frd = velocity_d @ dRb @ frd_from_body(body_axes).T
    horizontal = np.hypot(frd[:, 0], frd[:, 1])
    moving = horizontal > _MOVING_M_S
    if moving.sum() < 3:
        return
    ahead = float(np.median(frd[moving, 0] / horizontal[moving]))
    if ahead < -0.5:
        yield Finding(
            Code.DVL_SIGN,
            "by its prior misalignment the vehicle moves astern most of the time: is the sign "
            f"that of PD0? {positive}",
            dvl.label,
        )
    elif ahead > 0.5:
        yield Finding(
            Code.DVL_SIGN,
            "by its prior misalignment the vehicle moves ahead",
            dvl.label,
            severity="ok",
        )


def _rms(vectors: Array) -> float:
    squares = vectors**2
    return float(np.sqrt(np.mean(squares.sum(axis=-1) if vectors.ndim > 1 else squares)))
