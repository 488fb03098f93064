"""What the sensors of a trial recorded: rates, gaps, distance and speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array, BoolArray
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.speed_log import SpeedLog

# Usual intervals that make a gap. Chosen: two measurements in a row were lost.
GAP_INTERVALS = 3.0
# Time over which forces and speeds are averaged, s. Chosen: a few periods of a swell.
WINDOW_S = 10.0


@dataclass(frozen=True)
class SensorSurvey:
    """Record of one sensor.

    Parameters
    ----------
    label : str
        Label of the sensor.
    rate : float
        Median, Hz; nan for a single sample.
    samples : int
        Number of rows.
    start, end : float
        First and last time, s.
    gaps : int
        Number of intervals longer than three median ones.
    longest_gap : float
        Longest of them, s; 0 if there are none.
    missing : float
        Fraction of rows without a measurement (no lock, no fix).
    """

    label: str
    rate: float
    samples: int
    start: float
    end: float
    gaps: int
    longest_gap: float
    missing: float


def record_of(label: str, time: Array, missing: Array) -> SensorSurvey:
    """Survey the record of a sensor.

    Parameters
    ----------
    label : str
        Label of the sensor.
    time : ndarray, shape (N,), s
        Times of the rows.
    missing : ndarray of bool, shape (N,)
        Rows without a measurement.
    """
    intervals = np.diff(time)
    median = float(np.median(intervals)) if intervals.size else np.nan
    gaps = intervals[intervals > GAP_INTERVALS * median]
    return SensorSurvey(
        label=label,
        rate=1.0 / median,
        samples=int(time.size),
        start=float(time[0]),
        end=float(time[-1]),
        gaps=int(gaps.size),
        longest_gap=float(gaps.max(initial=0.0)),
        missing=float(np.mean(missing)),
    )


def covered(time: Array, begin: Array, end: Array) -> BoolArray:
    """Whether spans from begin to end (M,), s, are within a record, and none has a gap of it.

    Parameters
    ----------
    time : ndarray, shape (N,), s
        Times of the record.
    begin, end : ndarray, shape (M,), s
        Spans; instants where both are the same.
    """
    intervals = np.diff(time)
    gaps = np.append(0, np.cumsum(intervals > GAP_INTERVALS * np.median(intervals)))
    first = np.searchsorted(time, begin, side="right") - 1
    last = np.searchsorted(time, end)
    inside = (first >= 0) & (last < time.size)
    return np.asarray(inside & (gaps[np.minimum(last, gaps.size - 1)] == gaps[first]))


def travel(gnss: Gnss | None, dvl: Dvl | None, log: SpeedLog | None = None) -> tuple[float, Array]:
    """Return the distance, m, and the speeds, (M,), m/s, by the best sensor there is."""
    if gnss is not None:
        time, velocity = gnss_velocity(gnss)
        has_fix = ~np.isnan(gnss.geodetic[:, 0])
        speed = np.linalg.norm(velocity, axis=1)
        if has_fix.sum() > 1:
            step = _thinned_steps(gnss, has_fix)
            return float(step.sum()), speed
        if time.size > 1:
            return float(np.trapezoid(speed, time)), speed
    if dvl is not None and dvl.locked.sum() > 1:
        speed = np.linalg.norm(dvl.velocity[dvl.locked], axis=1)
        return float(np.trapezoid(speed, dvl.time[dvl.locked])), speed
    if log is not None:
        known = ~np.isnan(log.speed)
        speed = np.hypot(log.speed[known], np.nan_to_num(log.starboard[known]))
        return float(np.trapezoid(speed, log.time[known])) if speed.size > 1 else np.nan, speed
    return np.nan, np.zeros(0)


def _thinned_steps(gnss: Gnss, has_fix: Array) -> Array:
    """Return the distances between fixes far enough apart to be more than noise, m."""
    p_n = _positions(gnss, has_fix)
    least = max(1.0, 10.0 * float(np.median(gnss.position_std[has_fix, :2])))
    kept = [p_n[0]]
    for p in p_n[1:]:
        if np.hypot(p[0] - kept[-1][0], p[1] - kept[-1][1]) >= least:
            kept.append(p)
    return np.asarray(np.linalg.norm(np.diff(np.array(kept), axis=0), axis=1))


def _positions(gnss: Gnss, has_fix: Array) -> Array:
    geodetic = gnss.geodetic[has_fix]
    return LocalFrame(*geodetic[0]).position(*geodetic.T)


def gnss_velocity(gnss: Gnss) -> tuple[Array, Array]:
    """Return times (M,) and velocities (M, 3): measured, or else between fixes."""
    measured = ~np.isnan(gnss.velocity[:, 0])
    if measured.any():
        return gnss.time[measured], gnss.velocity[measured]
    begin, end, velocity = velocity_between_fixes(gnss)
    return 0.5 * (begin + end), velocity


def velocity_between_fixes(gnss: Gnss) -> tuple[Array, Array, Array]:
    """Return begin and end times (M,) of intervals of about 10 s, and the mean velocities."""
    has_fix = ~np.isnan(gnss.geodetic[:, 0])
    time = gnss.time[has_fix]
    if time.size < 2:
        return np.zeros(0), np.zeros(0), np.zeros((0, 3))
    p_n = _positions(gnss, has_fix)
    step = max(1, round(WINDOW_S / float(np.median(np.diff(time)))))
    step = min(step, time.size - 1)
    duration = time[step:] - time[:-step]
    velocity = (p_n[step:] - p_n[:-step]) / duration[:, None]
    near = duration < 2.0 * np.median(duration)
    return time[:-step][near], time[step:][near], velocity[near]
