"""Whether unit and sign of a DVL agree with GNSS and its mounting."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, interpolate
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.plausibility.gnss_units import RADIANS
from factorgraph_dvl.plausibility.records import WINDOW_S, gnss_velocity
from factorgraph_dvl.plausibility.speed_units import MOVING_M_S, SPEED_UNITS
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.dvl import MISALIGNMENT, VELOCITY_COLUMNS, Dvl
from factorgraph_dvl.sensors.gnss import Gnss

# What a ping takes, and which sign it has.
DVL_TERMS = (message("no_measurement.lock"), message("dvl_sign.along_x"))
BEAM_TERMS = (message("no_measurement.beams"), message("dvl_sign.along_beam"))

# Pings that do not agree in any component by chance.
_FEW = 10
# Chosen: how far the ratio of speeds may be from 1 over the bottom; and the ratio that a current
# makes of the speeds through water and over ground.
_ALLOWED, _FASTEST_CURRENT = 0.25, 3.0


def dvl_findings(
    dvl: Dvl, gnss: Gnss | None, body_axes: BodyAxes, terms: tuple[Message, Message]
) -> Iterator[Finding]:
    """Yield whether unit and sign of a DVL are plausible; `terms` as DVL_TERMS."""
    locked = dvl.locked
    lock, positive = terms
    if not locked.any():
        yield Finding(Code.NO_MEASUREMENT, lock, dvl.label, severity="warning")
        return
    velocity = dvl.velocity[locked]
    std = float(np.median(dvl.sigma()[locked]))
    speed = float(np.median(np.linalg.norm(velocity, axis=1)))
    if std > max(0.3 * speed, 0.1):
        text = message("dvl_std.large", std=std, speed=speed)
        yield Finding(Code.DVL_STD, text, dvl.label)
    if np.all(velocity == velocity[0]) and velocity.shape[0] > 2:
        yield Finding(Code.DVL_FROZEN, message("dvl_frozen.all"), dvl.label, severity="error")
    elif velocity.shape[0] > _FEW:
        stuck = [k for k in range(3) if np.ptp(velocity[:, k]) == 0.0]
        if stuck:
            constant = [
                message("words.is_always", name=VELOCITY_COLUMNS[k], value=velocity[0, k])
                for k in stuck
            ]
            text = message("dvl_frozen.some", constant=constant)
            yield Finding(Code.DVL_FROZEN, text, dvl.label, severity="error")
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
        yield Finding(Code.RADIANS, RADIANS, gnss.label, severity="error")
        return
    moving = gnss_speed > MOVING_M_S
    if moving.sum() < 3:
        return
    ratio = float(np.median(dvl_speed[moving] / gnss_speed[moving]))
    # Sway moves DVL and antenna by their lever arms, but not on the average.
    steady = _steady_ratio(pings[inside], dvl.velocity[dvl.locked][inside], at_ping)
    in_water = dvl.settings.reference == "water"
    in_current = in_water and 1.0 / _FASTEST_CURRENT < ratio < _FASTEST_CURRENT
    if in_current or min(abs(ratio - 1.0), abs(steady - 1.0)) <= _ALLOWED:
        yield Finding(
            Code.DVL_UNIT,
            message("dvl_unit.plausible", ratio=ratio),
            dvl.label,
            severity="ok",
        )
        return
    text = message("dvl_unit.unknown", ratio=ratio)
    for unit, factor in SPEED_UNITS.items():
        if abs(ratio * factor - 1.0) < 0.1:
            text = message("dvl_unit.looks_like", ratio=ratio, unit=unit)
    yield Finding(Code.DVL_UNIT, text, dvl.label, severity="error")


def _in_radians(gnss: Gnss, gnss_speed: Array, dvl_speed: Array) -> bool:
    """Whether fixes without velocities move as slowly as radians in columns of degrees do."""
    if not np.isnan(gnss.velocity).all():
        return False
    small = np.nanmax(np.abs(gnss.geodetic[:, 0]), initial=0) < 90.0 * DEG**2
    moving = (dvl_speed > MOVING_M_S) & (gnss_speed > 0.0)
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
    moving = mean_gnss > MOVING_M_S
    return float(np.median(mean_dvl[moving] / mean_gnss[moving])) if moving.any() else 1.0


def _sign_findings(
    dvl: Dvl, body_axes: BodyAxes, velocity_d: Array, positive: Message
) -> Iterator[Finding]:
    """Check that the vehicle moves ahead, where the mounting is known well enough."""
    misalignment = next(p for p in dvl.parameters() if p.name == MISALIGNMENT)
    if misalignment.sigma.max() > 30.0 * DEG:
        return
    dRb = exp_so3(misalignment.mean)
    frd = velocity_d @ dRb @ frd_from_body(body_axes).T
    horizontal = np.hypot(frd[:, 0], frd[:, 1])
    moving = horizontal > MOVING_M_S
    if moving.sum() < 3:
        return
    ahead = float(np.median(frd[moving, 0] / horizontal[moving]))
    if ahead < -0.5:
        yield Finding(
            Code.DVL_SIGN,
            message("dvl_sign.astern", positive=positive),
            dvl.label,
        )
    elif ahead > 0.5:
        yield Finding(
            Code.DVL_SIGN,
            message("dvl_sign.ahead"),
            dvl.label,
            severity="ok",
        )
