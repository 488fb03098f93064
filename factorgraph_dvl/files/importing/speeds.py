"""Speeds in raw files, over ground by GNSS and by velocity logs; and rates of turning."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from factorgraph_dvl.files.formats.format import FIXES
from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.files.formats.janus import from_beams
from factorgraph_dvl.files.formats.velocities import BEAM
from factorgraph_dvl.files.importing.spool import Stored, Stream
from factorgraph_dvl.geometry.vectors import Array

# Mean radius of the Earth, m: near enough for the speed between two fixes.
_EARTH = 6.371e6
# Time between fixes, s, beyond which they give no speed. Chosen: a vessel turns meanwhile.
_LONGEST_STEP = 5.0
# Speeds beyond this are thinned out. Chosen: some MB; twelve days at 1 Hz.
_MOST = 1 << 20
Series = tuple[Array, Array]


def ground_speed(streams: Sequence[tuple[Stream, Stored]]) -> Series | None:
    """Return stamps and speeds over ground, in order, of what has most of them; None if nothing.

    Parameters
    ----------
    streams : sequence of (Stream, Stored)
        Streams and their times (N,), s.
    """
    found = [_joined(_over_ground(stream, time), stream) for stream, time in streams]
    found = [series for series in found if len(series[0]) > 1]
    return max(found, key=lambda series: len(series[0])) if found else None


def log_speed(streams: Sequence[Stream]) -> Series | None:
    """Return own stamps and speeds of the first velocity log, over the bottom if it has that."""
    for kind in ("dvl", "water"):
        for stream in streams:
            if stream.kind == kind:
                parts = ((part["time"], speed_of(part)) for part in stream.records.chunks())
                series = _joined(parts, stream)
                if len(series[0]) > 1:
                    return series
    return None


def turn_rate(streams: Sequence[Stream], times: Sequence[Stored | None]) -> Series | None:
    """Return stamps and rates of the heading, rad/s, of what has most of them; None if nothing.

    Parameters
    ----------
    streams : sequence of Stream
        Streams of all kinds.
    times : sequence of Stored or None
        Their times (N,), s; None for their own stamps.
    """
    found = []
    for stream, time in zip(streams, times, strict=True):
        if stream.kind in ("attitude", "ins"):
            headings = (part["heading"] for part in stream.records.chunks())
            own = (part["time"] for part in stream.records.chunks())
            stamps = own if time is None else time.chunks()
            found.append(_rate(*_joined(zip(stamps, headings, strict=True), stream)))
    found = [series for series in found if len(series[0]) > 1]
    return max(found, key=lambda series: len(series[0])) if found else None


def _rate(time: Array, heading: Array) -> Series:
    """Return times and rates of headings (N,) over a second, in which noise is small."""
    if len(time) < 2:
        return time[:0], heading[:0]
    step = max(1.0, (time[-1] - time[0]) / _MOST)
    grid = np.arange(time[0], time[-1], step)
    rate = np.diff(np.interp(grid, time, np.unwrap(heading))) / step
    place = np.clip(np.searchsorted(time, grid[1:]), 1, len(time) - 1)
    near = np.diff(time)[place - 1] <= _LONGEST_STEP
    return grid[:-1][near] + step / 2.0, rate[near]


def _over_ground(stream: Stream, times: Stored) -> Iterator[Series]:
    if stream.kind not in ("course", "ins", *FIXES):
        return
    last, last_time = stream.records[:0], np.empty(0)
    for part, time in zip(stream.records.chunks(), times.chunks(), strict=True):
        if stream.kind == "course":
            yield time, part["speed"]
        elif stream.kind == "ins":
            yield time, np.linalg.norm(part["velocity"][:, :2], axis=1)
        else:
            part, time = np.concatenate([last, part]), np.concatenate([last_time, time])
            yield _between_fixes(part, time)
            last, last_time = part[-1:], time[-1:]


def _joined(parts: Iterator[Series], stream: Stream) -> Series:
    step = max(len(stream.records) // _MOST, 1)
    # Views would keep all records.
    thin = [(time[::step].copy(), speed[::step].copy()) for time, speed in parts]
    if not thin:
        return np.empty(0), np.empty(0)
    return _series(*(np.concatenate(column) for column in zip(*thin, strict=True)))


def speed_of(pings: Records) -> Array:
    """Return the magnitude (N,) of pings' velocities, m/s, nan without lock."""
    velocity = np.array(pings["velocity"])
    beams = pings["axes"] == BEAM
    if beams.any():
        part = pings[beams]
        known = np.isfinite(part["velocity"]).all(axis=1)[:, None]
        angle = np.where(np.isnan(part["beam_angle"]), np.pi / 6.0, part["beam_angle"])
        turned = from_beams(np.array(part["beams"]), angle)[:, :3]
        velocity[beams] = np.where(known, part["velocity"], turned)
    return np.asarray(np.linalg.norm(velocity, axis=1))


def _series(time: Array, speed: Array) -> Series:
    known = np.flatnonzero(np.isfinite(time) & np.isfinite(speed))
    unique, first = np.unique(np.asarray(time)[known], return_index=True)
    return unique, np.asarray(speed)[known][first]


def _between_fixes(fixes: Records, time: Array) -> Series:
    at, first = np.unique(time, return_index=True)
    first = first[np.isfinite(at)]
    at = at[np.isfinite(at)]
    lat, lon = np.array(fixes["lat"])[first], np.array(fixes["lon"])[first]
    north, east = np.diff(lat), (np.diff(lon) + np.pi) % (2.0 * np.pi) - np.pi
    step = np.diff(at)
    near = (step > 0.0) & (step <= _LONGEST_STEP)
    distance = _EARTH * np.hypot(north, east * np.cos(lat[:-1]))
    speed = distance / np.where(near, step, np.nan)
    return _series((at[:-1] + at[1:]) / 2.0, speed)
