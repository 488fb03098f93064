"""Whether the positions of a USBL follow the vehicle, and what was mistaken where they do not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.integrate import cumulative_trapezoid

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.rotations import exp_so3, frd_from_body
from factorgraph_dvl.geometry.vectors import Array, BoolArray, interpolate, median
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.invalid_values import runs
from factorgraph_dvl.sensors.dvl import MISALIGNMENT, Dvl
from factorgraph_dvl.sensors.usbl import Usbl
from factorgraph_dvl.trial import Trial

# Fewest fixes that make a track. Chosen.
_FEWEST = 20
# Share of the size of a track from which on another one is not the same, and how much better than
# as it is recorded one must fit to be it. Noise may be as many times what is stated. Chosen: dead
# reckoning drifts by a tenth.
_SAME, BETTER = 0.3, 3.0
# Chosen: fixes in a row, and usual distances from the track, that make a run elsewhere.
_IN_A_ROW, _FAR = 5, 10.0
# Rounds in which far fixes lose weight. Chosen: more change nothing.
_ROUNDS = 10
# Part of an angle up to which another is the same. Chosen: of mounts that are known to 2 deg, four
# in a hundred look by chance as a convergence of 1 deg makes them look.
_SAME_ANGLE = 0.1
_MISALIGNMENT = "usbl_misalignment_deg"
# Range, m, beyond which no system hears a reply.
_FARTHEST = 1.2e4
# What a range is multiplied by where it was recorded as a time, one way or both, by 1500 m/s.
TIMES = (
    (message("usbl_axes.range_s"), 1500.0),
    (message("usbl_axes.range_two_way_s"), 750.0),
    (message("usbl_axes.range_ms"), 1.5),
    (message("usbl_axes.range_two_way_ms"), 0.75),
)


def usbl_findings(trial: Trial, usbl: Usbl) -> Iterator[Finding]:
    """Yield how the fixes differ from the track that DVL and heading make, where they do."""
    reckoned = _reckoned(trial)
    if reckoned is None:
        return
    as_recorded = _misfit(trial, usbl, *reckoned)
    if as_recorded is None:
        return
    size, noise, distance, time = as_recorded
    misfit = median(distance)
    best, cause = misfit / BETTER, None
    for text, changed in _candidates(usbl):
        found = _misfit(trial, changed, *reckoned)
        if found is not None and median(found[2]) < best:
            best, cause = median(found[2]), text
    if cause is not None:
        text = message("usbl_axes.because", misfit=misfit, left=best, cause=cause)
        yield Finding(Code.USBL_AXES, text, usbl.label)
    elif misfit > max(_SAME * size, BETTER * noise):
        text = message("usbl_track.other_vehicle", misfit=misfit, size=size)
        yield Finding(Code.USBL_TRACK, text, usbl.label)
    elif elsewhere := list(_elsewhere(usbl, distance, time)):
        yield from elsewhere
    else:
        text = message("usbl_track.follows", misfit=misfit)
        yield Finding(Code.USBL_TRACK, text, usbl.label, severity="ok")


def grid_north_findings(trial: Trial, estimates: Sequence[Estimate]) -> Iterator[Finding]:
    """Yield that the transceiver is turned as a heading in grid north makes it look, if it is.

    Nothing else distinguishes the two: grid north is where the mount may be, too.
    """
    usbl = trial.find(Usbl)
    found = {e.name: e for e in estimates}.get(_MISALIGNMENT)
    if usbl is None or found is None:
        return
    lat, lon, _ = usbl.place()
    zone = int(np.floor(np.degrees(lon) / 6.0)) + 31
    from_middle = lon - np.radians(6.0 * zone - 183.0)
    # A heading from grid north is smaller by the convergence: the bow seems turned back by it, and
    # the transceiver, relative to the bow, to the other side. C takes the body to the transceiver.
    grid = float(np.degrees(np.arctan(np.tan(from_middle) * np.sin(lat))))
    down = frd_from_body(trial.body_axes)[2]
    angle, std = -float(down @ found.value), float(np.linalg.norm(down * found.std))
    if max(abs(angle - grid), 3.0 * std) < _SAME_ANGLE * abs(grid):
        text = message("usbl_grid_north.as_large", angle=angle, std=std, zone=zone, grid=grid)
        yield Finding(Code.USBL_GRID_NORTH, text, usbl.label, _MISALIGNMENT)


def _elsewhere(usbl: Usbl, distance: Array, time: Array) -> Iterator[Finding]:
    """Yield the runs of fixes that lie beside the track."""
    begin, end = runs(distance > _FAR * max(median(distance), usbl.settings.range_std_m))
    long = end - begin >= _IN_A_ROW
    for a, b in zip(begin[long].tolist(), end[long].tolist(), strict=True):
        far = median(distance[a:b])
        text = message("usbl_run.far", count=b - a, start=time[a], end=time[b - 1], distance=far)
        yield Finding(Code.USBL_RUN, text, usbl.label)


def _candidates(usbl: Usbl) -> Iterator[tuple[Message, Usbl]]:
    """Yield what may be wrong with the measurements of a transceiver, and them set right."""
    raw, ship = usbl.in_transceiver, usbl.ship
    if not usbl.raw.any() or ship is None:
        return

    def seen(changed: Array) -> Usbl:
        return replace(usbl, polar=np.full_like(changed, np.nan), cartesian=changed)

    yield message("usbl_axes.mirrored"), seen(raw * [1.0, -1.0, 1.0])
    yield message("usbl_axes.astern"), seen(raw * [-1.0, -1.0, 1.0])
    yield message("usbl_axes.swapped"), seen(raw[:, [1, 0, 2]])
    north = replace(ship, rph=ship.rph * [1.0, 1.0, 0.0])
    yield message("usbl_axes.from_north"), replace(usbl, ship=north)
    farthest = float(np.nanmax(np.linalg.norm(raw, axis=1)))
    for text, factor in TIMES:
        if factor * farthest < _FARTHEST:
            yield text, seen(raw * factor)


def _misfit(
    trial: Trial, usbl: Usbl, time: Array, track: Array
) -> tuple[float, float, Array, Array] | None:
    """Return size of a track (m), noise, distances (M,) and times of fixes from it; None if few.

    The track is turned and shifted to fit: its heading has an unknown constant.
    """
    fixes = usbl.fixes(trial.frame(), trial.body_axes)
    if fixes is None:
        return None
    inside = (fixes.time >= time[0]) & (fixes.time <= time[-1])
    if inside.sum() < _FEWEST:
        return None
    at = fixes.time[inside]
    fix = trial.frame().position(*fixes.geodetic[inside].T)[:, :2]
    own = interpolate(at, time, track)
    # Complex numbers turn by a factor of unit size.
    a, b = own @ [1.0, 1.0j], fix @ [1.0, 1.0j]
    weight = np.ones(at.size)
    for _ in range(_ROUNDS):
        a_mean, b_mean = (np.average(x, weights=weight) for x in (a, b))
        turn = np.vdot(weight * (a - a_mean), b - b_mean)
        turn = turn / max(float(abs(turn)), 1e-12)
        distance = np.abs(b - b_mean - turn * (a - a_mean))
        usual = max(median(distance), 1e-6)
        weight = usual / np.maximum(distance, usual)
    size = float(np.sqrt(np.mean(np.abs(a - a.mean()) ** 2)))
    noise = median(np.linalg.norm(fixes.position_std[inside, :2], axis=1))
    return size, noise, distance, at


def _reckoned(trial: Trial) -> tuple[Array, Array] | None:
    """Return times, and east and north by DVL and heading, (K, 2), m, but for a constant turn."""
    log, heading = trial.log, _heading(trial)
    if log is None or heading is None or log.settings.reference == "water":
        return None
    time, psi = heading
    pings: BoolArray = np.asarray(log.locked & (log.time >= time[0]) & (log.time <= time[-1]))
    if pings.sum() < _FEWEST:
        return None
    at = log.time[pings]
    forward, starboard, _ = (_in_body(log, pings) @ frd_from_body(trial.body_axes).T).T
    angle = np.interp(at, time, psi)
    east = forward * np.sin(angle) + starboard * np.cos(angle)
    north = forward * np.cos(angle) - starboard * np.sin(angle)
    return at, cumulative_trapezoid(np.column_stack([east, north]), at, axis=0, initial=0)


def _in_body(log: Dvl, pings: BoolArray) -> Array:
    """Return velocities in the body by the stated mounting, (M, 3), m/s."""
    return log.velocity[pings] @ exp_so3(log.prior_means()[MISALIGNMENT])


def _heading(trial: Trial) -> tuple[Array, Array] | None:
    """Return times, and the heading by a compass or, but for a constant, by the gyros, rad."""
    seen = trial.attitude
    if seen is not None:
        known = np.isfinite(seen.rph[:, 2])
        return (seen.time[known], np.unwrap(seen.rph[known, 2])) if known.any() else None
    imu = trial.imu
    if imu is None:
        return None
    down = imu.gyro @ frd_from_body(trial.body_axes)[2]
    return imu.time, cumulative_trapezoid(down, imu.time, initial=0)
