"""Whether units, order and signs of GNSS agree with each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.integrate import cumulative_trapezoid

from factorgraph_dvl.geometry.units import DEG, KNOT
from factorgraph_dvl.geometry.vectors import Array, interpolate
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.plausibility.records import WINDOW_S, covered, velocity_between_fixes
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.gnss import Gnss

# Below this speed, m/s, a vehicle is not called moving. Chosen: drift by wind and sea.
MOVING_M_S = 0.3
# SI value of what a speed may have been written in.
SPEED_UNITS = {
    "knots": KNOT,
    "km/h": 1.0 / 3.6,
    "ft/s": 0.3048,
    "cm/s": 0.01,
    "mm/s": 0.001,
}


# Share of the intervals in which velocities agree, from which on fixes jump, and no unit is wrong.
# Chosen: of 30 % outliers half of the intervals have one at an end.
_JUMPS = 0.25
# What fixes in the wrong unit look like.
RADIANS = message("radians.fixes")


def gnss_findings(gnss: Gnss) -> Iterator[Finding]:
    """Yield whether velocities of GNSS agree with its positions."""
    geodetic = gnss.geodetic[~np.isnan(gnss.geodetic[:, 0])]
    if geodetic.shape[0] and np.any(np.all(geodetic[:, :2] == 0.0, axis=1)):
        yield Finding(Code.ZERO_FIXES, message("zero_fixes.some"), gnss.label, severity="error")
    begin, end, between = velocity_between_fixes(gnss)
    measured = ~np.isnan(gnss.velocity[:, 0])
    if begin.size < 3 or measured.sum() < 3:
        return
    time, velocity = gnss.time[measured], gnss.velocity[measured]
    common = covered(time, begin, end)
    if common.sum() < 3:
        return
    begin, end, between = begin[common], end[common], between[common]
    mean = _interval_means(time, velocity, begin, end)
    noise = np.sqrt(2.0) * float(np.median(gnss.position_std[:, :2])) / float(
        np.median(end - begin)
    ) + float(np.median(gnss.velocity_std[:, :2]))
    # Fixes that jump are no matter of units: they stand out from the usual deviation.
    deviation = np.linalg.norm(between - mean, axis=1)
    usual = deviation <= 5.0 * np.median(deviation)
    yield from _compare_velocities(gnss, geodetic, between[usual], mean[usual], noise)


def _interval_means(time: Array, values: Array, begin: Array, end: Array) -> Array:
    """Return the means of values (N, 3) over intervals, (M, 3), by trapezoids."""
    integral = cumulative_trapezoid(values, time, axis=0, initial=0)
    duration = np.maximum(end - begin, 1e-9)[:, None]
    return (interpolate(end, time, integral) - interpolate(begin, time, integral)) / duration


def _compare_velocities(
    gnss: Gnss, geodetic: Array, between: Array, mean: Array, noise: float
) -> Iterator[Finding]:
    """Compare velocities between fixes with measured ones, (M, 3) both."""
    speed = rms(between[:, :2])
    tolerance = 0.1 * speed + 3.0 * noise
    misfit = rms(between[:, :2] - mean[:, :2])
    if misfit <= tolerance:
        if speed > MOVING_M_S:
            yield Finding(
                Code.GNSS_VELOCITY,
                message("gnss_velocity.agree", misfit=misfit),
                gnss.label,
                severity="ok",
            )
        yield from _compare_vertical(gnss, between, mean)
        return
    if np.abs(geodetic[:, 0]).max() < 90.0 * DEG**2 and rms(mean[:, :2] - between[:, :2] / DEG) < (
        0.1 * rms(mean[:, :2]) + 3.0 * noise / DEG
    ):
        yield Finding(Code.RADIANS, RADIANS, gnss.label, severity="error")
        return
    explained = {
        mistake: rms(between[:, :2] - mean[:, :2] @ np.array(matrix, dtype=float).T)
        for mistake, matrix in _velocity_candidates()
    }
    best = min(explained, key=lambda mistake: explained[mistake])
    text = message("gnss_velocity.disagree", misfit=misfit)
    if explained[best] <= tolerance:
        text = message("gnss_velocity.disagree_because", misfit=misfit, cause=best)
    elif _agreeing_share(between[:, :2], mean[:, :2], noise) > _JUMPS:
        return
    yield Finding(Code.GNSS_VELOCITY, text, gnss.label, severity="error")


def _agreeing_share(between: Array, mean: Array, noise: float) -> float:
    """Return the share of intervals in motion in which velocities agree with positions."""
    speed = np.linalg.norm(mean, axis=1)
    moving = speed > MOVING_M_S
    if not moving.any():
        return 0.0
    agree = np.linalg.norm(between - mean, axis=1) <= 0.1 * speed + 3.0 * noise
    return float(np.mean(agree[moving]))


def _velocity_candidates() -> Iterator[tuple[Message, list[list[float]]]]:
    """Return what may be wrong with a velocity, and the matrix that sets it right."""
    yield message("gnss_velocity.swapped"), [[0.0, 1.0], [1.0, 0.0]]
    yield message("gnss_velocity.opposite"), [[-1.0, 0.0], [0.0, -1.0]]
    yield message("gnss_velocity.east_opposite"), [[-1.0, 0.0], [0.0, 1.0]]
    yield message("gnss_velocity.north_opposite"), [[1.0, 0.0], [0.0, -1.0]]
    for unit, factor in SPEED_UNITS.items():
        yield message("gnss_velocity.unit", unit=unit), [[factor, 0.0], [0.0, factor]]


def _compare_vertical(gnss: Gnss, between: Array, mean: Array) -> Iterator[Finding]:
    noise = np.sqrt(2.0) * float(np.median(gnss.position_std[:, 2])) / WINDOW_S
    up, measured = between[:, 2], mean[:, 2]
    if rms(up) > 5.0 * noise + 0.05 and up @ measured < -0.5 * rms(up) * up.size * rms(measured):
        text = message("gnss_velocity.up_opposite")
        yield Finding(Code.GNSS_VELOCITY, text, gnss.label, severity="error")


def rms(vectors: Array) -> float:
    """Return the root mean square of vectors (M, c) or numbers (M,)."""
    squares = vectors**2
    return float(np.sqrt(np.mean(squares.sum(axis=-1) if vectors.ndim > 1 else squares)))
