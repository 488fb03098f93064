"""Whether units, signs, axes and beams of a DVL are plausible."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, frd_from_body, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, interpolate
from factorgraph_dvl.initialization.dvl_windows import DvlFit
from factorgraph_dvl.message import Message, either, message
from factorgraph_dvl.plausibility.axes import in_words, mirrored, side_of_bow, swapped
from factorgraph_dvl.plausibility.gnss import MOVING_M_S, RADIANS, SPEED_UNITS
from factorgraph_dvl.plausibility.records import WINDOW_S, covered, gnss_velocity
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.scale_causes import beam_angles
from factorgraph_dvl.sensors.beam_geometry import as_dvl, error_velocity
from factorgraph_dvl.sensors.dvl import MISALIGNMENT, VELOCITY_COLUMNS, Dvl
from factorgraph_dvl.sensors.dvl_beams import DvlBeams
from factorgraph_dvl.sensors.gnss import Gnss

# What a ping takes, and which sign it has.
DVL_TERMS = (message("no_measurement.lock"), message("dvl_sign.along_x"))
BEAM_TERMS = (message("no_measurement.beams"), message("dvl_sign.along_beam"))

# Pings that do not agree in any component by chance.
_FEW = 10
# Chosen: how far the ratio of speeds may be from 1 over the bottom; and the ratio that a current
# makes of the speeds through water and over ground.
_ALLOWED, _FASTEST_CURRENT = 0.25, 3.0
# How far sway may take that ratio from the one of averages where a beam angle explains both.
_SWAY = 0.1
# Misalignment, rad, up to whose σ a mounting is known well enough to show where the vehicle moves.
# Beyond that from the bow, it is likely another mounting. Chosen: drift in a current is less.
_KNOWN = 30.0 * DEG


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
    inside = covered(time, pings, pings)
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
    angles = beam_angles(steady)
    if not in_water and angles is not None and abs(ratio / steady - 1.0) < _SWAY:
        right, assumed = angles
        text = message("dvl_unit.beam_angle", ratio=steady, right=right, assumed=assumed)
        far = abs(steady - 1.0) > _ALLOWED
        yield Finding(Code.DVL_UNIT, text, dvl.label, severity="error" if far else "warning")
        return
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
    """Check where the vehicle moves to, where the mounting is known well enough."""
    misalignment = next(p for p in dvl.parameters() if p.name == MISALIGNMENT)
    if misalignment.sigma.max() > _KNOWN:
        return
    dRb = exp_so3(misalignment.mean)
    frd = velocity_d @ dRb @ frd_from_body(body_axes).T
    horizontal = np.hypot(frd[:, 0], frd[:, 1])
    moving = horizontal > MOVING_M_S
    if moving.sum() < 3:
        return
    ahead, starboard = np.median(frd[moving, :2] / horizontal[moving, None], axis=0)
    if ahead < -0.5:
        yield Finding(
            Code.DVL_SIGN,
            message("dvl_sign.astern", positive=positive),
            dvl.label,
        )
    elif ahead > 0.5:
        angle = float(np.arctan2(starboard, ahead))
        yield Finding(
            Code.DVL_SIGN,
            message("dvl_sign.ahead", where=side_of_bow(angle)),
            dvl.label,
            severity="ok" if abs(angle) < _KNOWN else "note",
        )


# Misalignments that differ by less, rad, are equally likely by their size. Chosen.
_ALIKE = 20.0 * DEG


def mirrored_finding(dvl: Dvl, fit: DvlFit) -> Finding:
    """Return the error that the DVL's axes can only be mirrored ones, and which.

    Parameters
    ----------
    dvl : Dvl
        Record of the DVL.
    fit : DvlFit
        Fit of its pings to the carried IMU, with mirrored axes.
    """
    prior = next(p for p in dvl.parameters() if p.name == MISALIGNMENT)
    explained = []
    for P in (-np.eye(3), *(mirrored(k) for k in range(3)), *(swapped(k) for k in range(3))):
        dRb = P @ fit.dRb
        deviation = float(np.linalg.norm(log_so3(exp_so3(prior.mean).T @ dRb)))
        explained.append((deviation, P, log_so3(dRb) / DEG))
    least = min(deviation for deviation, _, _ in explained)
    likely = [each for each in explained if each[0] < least + _ALIKE]
    return Finding(
        Code.DVL_AXES,
        message("dvl_axes.mirrored", causes=either([_cause(P, a) for _, P, a in likely])),
        dvl.label,
        severity="error",
    )


def _cause(P: Array, angles: Array) -> Message:
    if np.array_equal(P, -np.eye(3)):
        return message("dvl_axes.as_pd0", angles=angles)
    return message("dvl_axes.cause", axes=in_words(P), angles=angles)


# Times what noise and priors make of the error velocity from which on it is too large, and share
# of lost pings that is worth a word. Chosen: no honest instrument comes near; half are left.
_TOO_LARGE = 3.0
_MOSTLY = 0.5


def beam_findings(beams: DvlBeams) -> Iterator[Finding]:
    """Check how often each beam is lost, and how well nominal beams agree."""
    lost = np.isnan(beams.velocity).mean(axis=0)
    if lost.any():
        yield Finding(
            Code.BEAMS_LOST,
            message("beams_lost.shares", shares=100.0 * lost),
            beams.label,
            severity="note" if lost.max() > _MOSTLY else "ok",
        )
    yield from _agreement(beams)


def _agreement(beams: DvlBeams) -> Iterator[Finding]:
    """Compare the error velocity with what noise, and errors as the priors allow, make of it."""
    s = beams.settings
    scale = np.broadcast_to(np.array(s.scale_error, dtype=float), (len(s.nominal_d),))
    gain = (1.0 + scale)[:, None] * s.nominal_d
    error = error_velocity(gain, beams.velocity)
    log = as_dvl(beams)
    known = np.isfinite(error) & log.locked
    if known.sum() < 3:
        return
    rms = float(np.sqrt(np.mean(error[known] ** 2)))
    speed = float(np.sqrt(np.mean(np.sum(log.velocity[known] ** 2, axis=1))))
    noise = float(np.sqrt(np.nanmean(beams.sigma()[known] ** 2)))
    prior = speed * float(np.hypot(s.direction_std_deg * DEG, s.scale_error_std))
    allowed = _TOO_LARGE * np.hypot(noise, prior)
    if rms > allowed:
        text = message("beams_disagree.more", rms=rms, speed=speed)
        signs = 1.0 - 2.0 * np.eye(len(gain))
        left = [error_velocity(gain, beams.velocity[known] * sign) for sign in signs]
        agree = [str(k + 1) for k, e in enumerate(left) if np.sqrt(np.nanmean(e**2)) < allowed]
        if agree:
            text = message("beams_disagree.reversed", rms=rms, speed=speed, beams=either(agree))
        yield Finding(Code.BEAMS_DISAGREE, text, beams.label)
    else:
        text = message("beams_disagree.explained", rms=rms)
        yield Finding(Code.BEAMS_DISAGREE, text, beams.label, severity="ok")
