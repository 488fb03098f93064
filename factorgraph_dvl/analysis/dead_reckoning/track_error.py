"""Errors of a track: end point, largest, along and across, growth on straight stretches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicHermiteSpline

from factorgraph_dvl.analysis.dead_reckoning.integration import DeadReckonedTrack
from factorgraph_dvl.geometry.earth import radii
from factorgraph_dvl.geometry.rotations import wrapped
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.trial import Reference

# Chosen: the lengths that DVL data sheets and surveys state errors for.
STRETCHES_M = (1e3, 5e3, 10e3)
# Chosen: the course is that of the displacement over this time, s, longer than the sway; below
# this mean speed, m/s, it is undefined.
_COURSE_S = 30.0
_LEAST_SPEED = 0.25
# Chosen: a stretch is straight if its course stays within this range, wider than a helmsman's
# deviations.
_STRAIGHT = 10.0 * DEG


@dataclass(frozen=True)
class Stretches:
    """Growth of the error over straight stretches of one length.

    Parameters
    ----------
    length : float
        Length of a stretch, m.
    count : int
        Number of consecutive stretches; if 0, the other fields are nan.
    median, largest : float
        Growth of the horizontal error, % of the length.
    along, across : float
        Mean growth along the course and to its right, % of the length: the effects of a scale
        error and of a heading error.
    """

    length: float
    count: int
    median: float
    largest: float
    along: float
    across: float


@dataclass(frozen=True)
class Path:
    """Distance and course of the vehicle at M epochs.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Epochs.
    distance : ndarray, shape (M,)
        Horizontal distance travelled since the first epoch, m.
    course : ndarray, shape (M,)
        Course over ground, unwrapped, rad.
    """

    time: Array
    distance: Array
    course: Array

    @property
    def total(self) -> float:
        """Distance travelled, m."""
        return float(self.distance[-1])


@dataclass(frozen=True)
class Score:
    """Errors of a track, estimate - truth, at the epochs where the truth is known.

    Parameters
    ----------
    path : Path
        Distance and course at those epochs.
    error : ndarray, shape (M, 3)
        Error in local-level east, north, up, m.
    stretches : tuple of Stretches
        Growth of the error for each of `STRETCHES_M`.
    """

    path: Path
    error: Array
    stretches: tuple[Stretches, ...]

    @property
    def time(self) -> Array:
        """Epochs, (M,), s."""
        return self.path.time

    @property
    def horizontal(self) -> Array:
        """Size of the horizontal error, (M,), m."""
        return np.hypot(self.error[:, 0], self.error[:, 1])

    @property
    def along(self) -> Array:
        """Error along the course over ground, (M,), m."""
        return _along_across(self.error, self.path.course)[0]

    @property
    def across(self) -> Array:
        """Error to the right of the course over ground, (M,), m."""
        return _along_across(self.error, self.path.course)[1]

    def percent(self, error_m: float) -> float:
        """Return an error in % of the distance travelled."""
        return 100.0 * error_m / self.path.total if self.path.total > 0.0 else float("nan")


def path_of(track: DeadReckonedTrack, time: Array) -> Path:
    """Return distance and course of a track at times (M,) within it."""
    speed = np.hypot(track.velocity[:, 0], track.velocity[:, 1])
    distance = cumulative_trapezoid(speed, track.time, initial=0)
    east, north = (cumulative_trapezoid(track.velocity[:, i], track.time, initial=0)
                   for i in (0, 1))  # fmt: skip

    def shift(values: Array) -> Array:
        ahead = np.interp(time + 0.5 * _COURSE_S, track.time, values)
        return np.asarray(ahead - np.interp(time - 0.5 * _COURSE_S, track.time, values))

    d_east, d_north = shift(east), shift(north)
    moving = np.flatnonzero(np.hypot(d_east, d_north) > _LEAST_SPEED * _COURSE_S)
    course = np.zeros(time.size)
    if moving.size:
        known = np.unwrap(np.arctan2(d_east[moving], d_north[moving]))
        course = np.interp(time, time[moving], known)
    at = np.interp(time, track.time, distance)
    return Path(time, at - at[:1], course)


def score(track: DeadReckonedTrack, truth: Reference, along: DeadReckonedTrack) -> Score | None:
    """Return the errors of a track; None if it has no epochs in common with the truth.

    Parameters
    ----------
    track : DeadReckonedTrack
        Track to score.
    truth : Reference
        True positions of the IMU.
    along : DeadReckonedTrack
        Track that gives distance and course: the most accurate one.
    """
    first = max(track.time[0], along.time[0])
    last = min(track.time[-1], along.time[-1])
    inside = (truth.time >= first - 1e-6) & (truth.time <= last + 1e-6)
    if inside.sum() < 2:
        return None
    time = np.clip(truth.time[inside], first, last)
    error = difference(track, time, truth.geodetic[inside])
    path = path_of(along, time)
    stretches = tuple(_stretches(path, error, length) for length in STRETCHES_M)
    return Score(path, error, stretches)


def difference(track: DeadReckonedTrack, time: Array, geodetic: Array) -> Array:
    """Return the track minus positions (M, 3) at times (M,), east, north, up, m."""
    lat, _, height = track.geodetic.T
    meridian, east = radii(lat)
    ve, vn, vu = track.velocity.T
    rate = np.stack([vn / (meridian + height), ve / ((east + height) * np.cos(lat)), vu], axis=1)
    at = CubicHermiteSpline(track.time, track.geodetic, rate)(time)
    offset = at - geodetic
    offset[:, 1] = wrapped(offset[:, 1])
    meridian, east = radii(geodetic[:, 0])
    height = geodetic[:, 2]
    return np.stack(
        [
            offset[:, 1] * (east + height) * np.cos(geodetic[:, 0]),
            offset[:, 0] * (meridian + height),
            offset[:, 2],
        ],
        axis=1,
    )


def _along_across(error: Array, course: Array) -> tuple[Array, Array]:
    sine, cosine = np.sin(course), np.cos(course)
    return (
        error[..., 0] * sine + error[..., 1] * cosine,
        error[..., 0] * cosine - error[..., 1] * sine,
    )


def _stretches(path: Path, error: Array, length: float) -> Stretches:
    growth, along, across = [], [], []
    for a, b in _straight(path.course):
        stops = np.arange(path.distance[a], path.distance[b - 1] + 1e-9, length)
        at = a + np.searchsorted(path.distance[a:b], stops)
        for i, j in pairwise(at):
            grown = error[j] - error[i]
            course = float(np.mean(path.course[i : j + 1]))
            growth.append(float(np.hypot(grown[0], grown[1])))
            ahead, right = _along_across(grown, np.asarray(course))
            along.append(float(ahead))
            across.append(float(right))
    if not growth:
        nothing = float("nan")
        return Stretches(length, 0, nothing, nothing, nothing, nothing)

    def percent(value: float) -> float:
        return 100.0 * value / length

    return Stretches(
        length=length,
        count=len(growth),
        median=percent(float(np.median(growth))),
        largest=percent(max(growth)),
        along=percent(float(np.mean(along))),
        across=percent(float(np.mean(across))),
    )


def _straight(course: Sequence[float] | Array) -> Iterator[tuple[int, int]]:
    """Yield first and last-plus-one index of stretches whose course stays within a range."""
    start = 0
    low = high = course[0]
    for i, value in enumerate(course):
        low, high = min(low, value), max(high, value)
        if high - low > _STRAIGHT:
            yield start, i
            start, low, high = i, value, value
    yield start, len(course)
