"""Segments of a trial by motion: drifting, steady, accelerating, turning, and mixtures.

A manoeuvre changes heading or speed permanently, sway does not. So both signals are smoothed
over longer than any wave, manoeuvres are found as lasting changes, and their ends, which
smoothing blurs, are then found in the signal itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, interpolate
from factorgraph_dvl.imu.timestamps import JUMP
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.trial import Reference

# Chosen: a Hann window, s, removes periods below half its length; most waves are shorter than
# 10 s, and the short window only removes noise.
_WINDOW_S = 20.0
_SHORT_WINDOW_S = 2.0
# Chosen: short against any manoeuvre, s.
_STEP_S = 0.1
# Chosen: least rate and total change of heading and of speed of a manoeuvre; slow turns of ships
# exceed them, drift and swell do not.
_TURN_RATE = 0.25 * DEG
_LEAST_TURN = 10.0 * DEG
_ACCELERATION = 0.01
_LEAST_CHANGE = 0.4
# Chosen: a turn this wide determines the current from the speed through the water, which is
# constant in it.
_WIDE_TURN = 60.0 * DEG
# Chosen: a vessel below this speed through the water, m/s, drifts: it has no steerage way.
_DRIFTING = 0.5
# Chosen: shorter segments, s, hold too few pings.
_LEAST_S = 3.0


@dataclass(frozen=True)
class Segment:
    """A part of a trial in which the motion is of one kind.

    Parameters
    ----------
    start, end : float
        Time, s.
    label : str
        Kind of motion, or the name that the user gave.
    """

    start: float
    end: float
    label: str

    def covers(self, time: Array) -> np.ndarray:
        """Return which times (M,) lie in the segment: after its start, up to its end."""
        return (time > self.start) & (time <= self.end)


def find_segments(motion: Trajectory | Reference) -> tuple[Segment, ...]:
    """Divide a trial by motion.

    Parameters
    ----------
    motion : Trajectory or Reference
        Motion of the whole trial.

    Returns
    -------
    tuple of Segment
        Segments without gaps from the first epoch to the last. Hours without data, as at a
        jump of a clock, are a segment.
    """
    jumps = np.flatnonzero(np.diff(motion.time) > JUMP) + 1
    parts = [
        _segments(rows_of(motion, rows)) for rows in np.split(np.arange(motion.time.size), jumps)
    ]
    out = [*parts[0]]
    for part in parts[1:]:
        out += [Segment(out[-1].end, part[0].start, "other"), *part]
    return tuple(out)


def _segments(motion: Trajectory | Reference) -> list[Segment]:
    """Divide a motion without jumps."""
    first, last = float(motion.time[0]), float(motion.time[-1])
    count = max(round((last - first) / _STEP_S), 1) + 1
    time = np.linspace(first, last, count)
    heading = np.interp(time, motion.time, np.unwrap(motion.rph[:, 2]))
    level = interpolate(time, motion.time, motion.velocity[:, :2])
    turns = _changes(time, heading, _TURN_RATE, _LEAST_TURN)
    speed = np.linalg.norm(level - _current(time, heading, level, turns), axis=1)
    accelerations = _changes(time, speed, _ACCELERATION, _LEAST_CHANGE)
    edges = _separate([first, last, *(t for pair in turns + accelerations for t in pair)])
    out = []
    for start, end in pairwise(edges):
        inside = (time >= start) & (time <= end)
        slow = float(np.mean(speed[inside])) < _DRIFTING if inside.any() else False
        turning = _covered(turns, start, end)
        accelerating = _covered(accelerations, start, end)
        out.append(Segment(start, end, _label(slow, turning, accelerating)))
    return out


def given_segments(
    parts: Sequence[tuple[float, float, str]], first: float, last: float
) -> tuple[Segment, ...]:
    """Return the segments of the user, with the times between them as `other`.

    Parameters
    ----------
    parts : sequence of tuple of (float, float, str)
        Start and end, s, and label, in the order of time.
    first, last : float
        Start and end of the trial, s; segments are cut there.

    Raises
    ------
    ConfigError
        If a segment lies outside the trial.
    """
    out: list[Segment] = []
    at = first
    for start, end, label in parts:
        if end <= first or start >= last:
            raise ConfigError(
                f"segment `{label}`, {start:g} to {end:g} s, is outside the trial",
                where="segments",
                expected=f"times between {first:g} and {last:g} s",
            )
        start, end = max(start, at), min(end, last)
        if start > at:
            out.append(Segment(at, start, "other"))
        out.append(Segment(start, end, label))
        at = end
    if at < last:
        out.append(Segment(at, last, "other"))
    return tuple(out)


def _label(slow: bool, turning: bool, accelerating: bool) -> str:
    kinds = []
    if slow and not accelerating:
        kinds.append("drifting")
    if turning:
        kinds.append("turning")
    if accelerating:
        kinds.append("accelerating")
    return " and ".join(kinds) or "steady"


def _changes(time: Array, value: Array, rate: float, least: float) -> list[tuple[float, float]]:
    """Return when a signal (M,) changes permanently, by `least` and at `rate` or more."""
    smoothed = _smooth(time, value, _WINDOW_S)
    fine = _smooth(time, value, _SHORT_WINDOW_S)
    slope = np.gradient(smoothed, time)
    sign = np.where(np.abs(slope) > rate, np.sign(slope), 0.0)
    cuts = np.flatnonzero(np.diff(sign)) + 1
    out = []
    for a, b in zip([0, *cuts], [*cuts, time.size], strict=True):
        change = float(smoothed[b - 1] - smoothed[a])
        if sign[a] == 0.0 or abs(change) < least:
            continue
        # Fraction of the change that is complete.
        done = (fine[a:b] - smoothed[a]) / change
        begun = float(time[a + int(np.argmax(done > 0.1))])
        ended = float(time[b - 1 - int(np.argmax(done[::-1] < 0.9))])
        rest = max(ended - begun, 0.0) / 8.0
        start, end = max(begun - rest, float(time[a])), min(ended + rest, float(time[b - 1]))
        if end > start:
            out.append((start, end))
    return out


def _smooth(time: Array, value: Array, window: float) -> Array:
    """Return a signal (M,) smoothed by a Hann window, with odd reflection at both ends."""
    step = float(time[1] - time[0])
    half = min(round(0.5 * window / step), (value.size - 1) // 2)
    if half < 1:
        return value
    before = 2.0 * value[0] - value[half:0:-1]
    after = 2.0 * value[-1] - value[-2 : -2 - half : -1]
    kernel = np.hanning(2 * half + 3)[1:-1]
    padded = np.concatenate([before, value, after])
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")


def _current(
    time: Array, heading: Array, velocity: Array, turns: Sequence[tuple[float, float]]
) -> Array:
    """Return the current (2,), m/s, for which the speed in each wide turn is constant.

    |v - c|² = s² of each turn is linear in c and |c|² - s²: |v|² = 2 v·c + d. The means over a
    turn take d out.
    """
    rows, right = [np.zeros((0, 2))], [np.zeros(0)]
    for start, end in turns:
        inside = slice(*np.searchsorted(time, [start, end + 1e-9]))
        if np.ptp(heading[inside]) >= _WIDE_TURN:
            v = velocity[inside]
            squared = np.sum(v**2, axis=1)
            rows.append(2.0 * (v - v.mean(axis=0)))
            right.append(squared - squared.mean())
    found = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return np.asarray(found)


def _separate(edges: Sequence[float]) -> list[float]:
    """Return sorted edges, at least the shortest segment apart."""
    ordered = sorted(edges)
    out = [ordered[0]]
    for edge in ordered[1:-1]:
        if edge - out[-1] >= _LEAST_S and ordered[-1] - edge >= _LEAST_S:
            out.append(edge)
    return [*out, ordered[-1]]


def _covered(intervals: Sequence[tuple[float, float]], start: float, end: float) -> bool:
    """Whether intervals cover more than half of the time from start to end."""
    covered = sum(max(min(b, end) - max(a, start), 0.0) for a, b in intervals)
    return covered > 0.5 * (end - start)
