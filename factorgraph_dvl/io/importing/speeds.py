"""Speeds in raw files: over ground by GNSS, and by velocity logs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.io.formats.framing import Records
from factorgraph_dvl.io.formats.janus import from_beams
from factorgraph_dvl.io.formats.velocities import BEAM
from factorgraph_dvl.io.importing.spool import Stream

# Mean radius of the Earth, m: near enough for the speed between two fixes.
_EARTH = 6.371e6
# Time between fixes, s, beyond which they give no speed. Chosen: a vessel turns meanwhile.
_LONGEST_STEP = 5.0


def ground_speed(streams: Sequence[tuple[Stream, Array]]) -> tuple[Array, Array] | None:
    """Return stamps and speeds over ground, in order, of what has most of them; None if nothing.

    Parameters
    ----------
    streams : sequence of (Stream, ndarray)
        Streams and their times (N,), s.
    """
    found = []
    for stream, time in streams:
        if stream.kind == "course":
            found.append(_series(time, np.array(stream.records["speed"])))
        elif stream.kind == "fix":
            found.append(_between_fixes(stream.records, time))
        elif stream.kind == "ins":
            found.append(_series(time, np.linalg.norm(stream.records["velocity"][:, :2], axis=1)))
    found = [series for series in found if len(series[0]) > 1]
    return max(found, key=lambda series: len(series[0])) if found else None


def log_speed(streams: Sequence[Stream]) -> tuple[Array, Array] | None:
    """Return own stamps and speeds of the first velocity log, over the bottom if it has that."""
    for kind in ("dvl", "water"):
        for stream in streams:
            if stream.kind == kind:
                series = _series(stream.records["time"], speed_of(stream.records))
                if len(series[0]) > 1:
                    return series
    return None


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


def _series(time: Array, speed: Array) -> tuple[Array, Array]:
    known = np.flatnonzero(np.isfinite(time) & np.isfinite(speed))
    unique, first = np.unique(np.asarray(time)[known], return_index=True)
    return unique, np.asarray(speed)[known][first]


def _between_fixes(fixes: Records, time: Array) -> tuple[Array, Array]:
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
