"""GNSS velocities against the carried IMU, window by window.

Within a window the velocity that the IMU carries, turned to level axes, is that of the antenna
but for a polynomial, which takes the biases in. Gravity gives the tilt and the velocities the
heading, so that attitude is known too where the vessel manoeuvres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.units import STANDARD_GRAVITY
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.initialization.carried_windows import CarriedWindows
from factorgraph_dvl.initialization.velocity_windows import (
    VelocityWindows,
    sorted_into,
    steady,
)
from factorgraph_dvl.sensors.gnss import Gnss

# Fixes this far apart, s, give a mean velocity where the receiver reports none. Chosen: a
# metre of noise is then 0.3 m/s.
_BASELINE_S = 5.0
# What is known of the lever arm that trial.yaml states, m: it may have been forgotten. Chosen: a
# vessel's length; and steps in which arm and heading are found together.
_ARM_SIGMA_M = 5.0
_ARM_STEPS = 2
_TINY = 1e-12
_NUDGE = np.array([1e-4, 2e-4, 3e-4])


@dataclass(frozen=True)
class LevelVelocities:
    """Velocities of the antenna, east, north, up: at N times, or the means over N spans.

    `begin`, `end` (N,) s, equal for a velocity at one time; `velocity` (N, 3) and `sigma` (N,)
    m/s.
    """

    begin: Array
    end: Array
    velocity: Array
    sigma: Array

    @property
    def middle(self) -> Array:
        """Middle of the spans, (N,), s."""
        return 0.5 * (self.begin + self.end)

    def only(self, rows: np.ndarray) -> LevelVelocities:
        """Return some of them."""
        return LevelVelocities(
            self.begin[rows], self.end[rows], self.velocity[rows], self.sigma[rows]
        )


def level_velocities(gnss: Gnss) -> LevelVelocities:
    """Return the velocities that a receiver measured, or else those between its fixes."""
    measured = ~np.isnan(gnss.velocity[:, 0])
    if measured.any():
        time = gnss.time[measured]
        sigma = gnss.mean_velocity_std[measured]
        found = LevelVelocities(time, time, gnss.velocity[measured], sigma)
        return found.only(steady(found.velocity))
    has_fix = ~np.isnan(gnss.geodetic[:, 0])
    time, geodetic = gnss.time[has_fix], gnss.geodetic[has_fix]
    if time.size < 2:
        return LevelVelocities(np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros(0))
    place = LocalFrame(*geodetic[0]).position(*geodetic.T)
    later = np.searchsorted(time, time + _BASELINE_S - 1e-6)
    first = np.flatnonzero(later < time.size)
    last = later[first]
    near = time[last] - time[first] < 2.0 * _BASELINE_S
    first, last = first[near], last[near]
    span = (time[last] - time[first])[:, None]
    sigma = np.sqrt(np.mean(gnss.position_std[has_fix] ** 2, axis=1))
    found = LevelVelocities(
        time[first],
        time[last],
        (place[last] - place[first]) / span,
        np.sqrt(2.0) * sigma[first] / span[:, 0],
    )
    return found.only(steady(found.velocity))


@dataclass(frozen=True)
class WindowFit:
    """How GNSS fits the carried IMU in W windows of at most n measurements.

    Parameters
    ----------
    residual : ndarray, shape (W, n, 3), m/s
        Measured less carried, polynomial and heading taken out; 0 where there is none.
    level_R : ndarray, shape (W, 3, 3)
        Axes of the window to east, north, up.
    heading_sigma : ndarray, shape (W,), rad
        Standard deviation of its heading, by the residuals or the stated noise.
    arm_error : ndarray, shape (3,), m
        Lever arm of the antenna in body, less the stated one.
    arm_covariance : ndarray, shape (3, 3), m²
        Covariance of the lever arm by the residuals.
    """

    residual: Array
    level_R: Array
    heading_sigma: Array
    arm_error: Array
    arm_covariance: Array


@dataclass(frozen=True)
class GnssWindows(VelocityWindows):
    """Velocities of GNSS, east, north, up, sorted into the windows of the carried IMU.

    Parameters
    ----------
    begin, end : ndarray, shape (N,), s
        Spans whose mean the velocities are, stamped at their middle.
    arm, omega_cb_b : ndarray, shape (N, 3)
        Lever arm of the antenna in body, m, and the rate of the body relative to what carries
        the antenna, rad/s, at the velocities.
    """

    begin: Array
    end: Array
    arm: Array
    omega_cb_b: Array

    @property
    def count(self) -> Array:
        """Degrees of freedom of each window, (W,)."""
        return self.freedom(10)

    @cached_property
    def measured(self) -> Array:
        """Velocities, (W, n, 3), without their polynomial."""
        return self.without_trend(self.velocity[self.rows])

    def antenna(self, offset: float | Array) -> Array:
        """Return the carried velocity if GNSS is late by an offset, (..., W, n, 3, 4).

        That of the antenna, and what each component of its lever arm adds to it.
        """
        arm, omega_cb_b = self.arm[self.rows], self.omega_cb_b[self.rows]
        first = self.carried(offset, self.begin)
        if np.array_equal(self.begin, self.end):
            speed, by_arm = first.speed, first.turn @ skew(first.rate - omega_cb_b)
        else:
            last = self.carried(offset, self.end)
            span = np.maximum(self.end - self.begin, 1e-6)[self.rows][..., None]
            speed = (last.place - first.place) / span
            by_arm = (last.turn - first.turn) / span[..., None]
        speed = speed + rotate(by_arm, arm)
        return np.concatenate([speed[..., None], by_arm], axis=-1)

    @cached_property
    def signal(self) -> Array:
        """Sum of squares of the velocity's changes in each window, (W,)."""
        return np.asarray(np.sum(self.measured**2, axis=(1, 2)))

    def attitude(self, offset: float | Array, level_R: Array) -> Array:
        """Return body to east, north, up at the velocities, (W, n, 3, 3), by a fit's level_R."""
        return level_R[:, None] @ self.carried(offset).turn

    def residual(self, offset: float | Array) -> Array:
        """Return what is left of the velocities if GNSS is late by offsets, (..., W, n, 3)."""
        return self.fit(offset).residual

    def fit(self, offset: float | Array) -> WindowFit:
        """Return how GNSS fits if it is late by an offset, s, constant or (..., W, n)."""
        carried = self.antenna(offset)
        level_R = self._tilt(carried[..., 0])
        kept = self.without_trend(carried.reshape(*carried.shape[:-2], 12))
        leveled = level_R[..., None, :, :] @ kept.reshape(carried.shape)
        arm = np.zeros((*carried.shape[:-4], 3))
        for _ in range(_ARM_STEPS):
            antenna = leveled[..., 0] + _by_arm(leveled[..., 1:], arm)
            turn = _about_up(_heading(antenna, self.measured))
            level_R, leveled = turn @ level_R, turn[..., None, :, :] @ leveled
            antenna = rotate_rows(turn, antenna)
            across = np.stack(
                [-antenna[..., 1], antenna[..., 0], np.zeros_like(antenna[..., 0])], axis=-1
            )
            power = np.sum(across**2, axis=(-2, -1))
            columns = np.concatenate(
                [(self.measured - leveled[..., 0])[..., None], leveled[..., 1:]], axis=-1
            )
            share = np.einsum("...ni,...nij->...j", across, columns)
            share /= np.maximum(power, _TINY)[..., None]
            columns = columns - across[..., None] * share[..., None, None, :]
            y, A = columns[..., 0], columns[..., 1:]
            squares = np.sum((y - _by_arm(A, arm)) ** 2, axis=(-2, -1))
            weight = np.maximum(self.count, 1.0) / np.maximum(squares, _TINY)
            flat = A.reshape(*arm.shape[:-1], -1, 3)
            weighted = (A * weight[..., None, None, None]).reshape(flat.shape).swapaxes(-1, -2)
            covariance = np.linalg.inv(weighted @ flat + np.eye(3) / _ARM_SIGMA_M**2)
            arm = rotate(covariance, (weighted @ y.reshape(*flat.shape[:-1], 1))[..., 0])
        residual = y - _by_arm(A, arm)
        variance = np.sum(residual**2, axis=(-2, -1)) / np.maximum(self.count, 1.0)
        variance = np.maximum(variance, self.noise**2)
        return WindowFit(
            residual,
            level_R,
            np.sqrt(variance / np.maximum(power, _TINY)),
            arm,
            covariance,
        )

    def _tilt(self, carried: Array) -> Array:
        """Return the rotations that level the carried force, by its mean, (..., W, 3, 3)."""
        up = np.array([0.0, 0.0, STANDARD_GRAVITY])
        wanted = self._slope(self.velocity[self.rows]) + up
        return _shortest(self._slope(carried), wanted)

    def _slope(self, values: Array) -> Array:
        """Return the mean rate of change of values (..., W, n, 3), (..., W, 3)."""
        weight = self.inside.astype(float)
        n = weight.sum(axis=1, keepdims=True)
        t = self.time - (weight * self.time).sum(axis=1, keepdims=True) / n
        t = t * weight
        return np.einsum("wn,...wnc->...wc", t, values) / np.sum(t**2, axis=1)[:, None]


def gnss_windows(windows: CarriedWindows, gnss: Gnss, later: float = 0.0) -> GnssWindows | None:
    """Sort the velocities of a receiver into windows.

    Parameters
    ----------
    windows : CarriedWindows
        The carried IMU.
    gnss : Gnss
        Record of the receiver.
    later : float
        Offset of its clock around which others are tried, s.

    Returns
    -------
    GnssWindows or None
        The comparison, None where no window has enough velocities.
    """
    v = level_velocities(gnss)
    if v.begin.size == 0:
        return None
    table = sorted_into(windows, v.middle - later)
    if table is None:
        return None
    arms = gnss.lever_arm(v.middle)
    return GnssWindows(windows, v.middle, v.velocity, v.sigma, *table, v.begin, v.end, *arms)


def rotate_rows(rotations: Array, vectors: Array) -> Array:
    """Turn vectors (..., W, n, 3) by one rotation for each line, (..., W, 3, 3)."""
    return vectors @ rotations.swapaxes(-1, -2)


def _by_arm(columns: Array, arm: Array) -> Array:
    """Return products of columns (..., W, n, 3, 3) and a lever arm (..., 3)."""
    return np.asarray((columns @ arm[..., None, None, :, None])[..., 0])


def _heading(carried: Array, measured: Array) -> Array:
    """Return the angles about the vertical that turn (..., W, n, 3) best to others, (..., W)."""
    x, y = carried, measured
    along = np.sum(x[..., :2] * y[..., :2], axis=(-2, -1))
    across = np.sum(x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0], axis=-1)
    return np.arctan2(across, along)


def _about_up(angle: Array) -> Array:
    out = np.zeros((*angle.shape, 3, 3))
    out[..., 0, 0] = out[..., 1, 1] = np.cos(angle)
    out[..., 1, 0] = np.sin(angle)
    out[..., 0, 1] = -out[..., 1, 0]
    out[..., 2, 2] = 1.0
    return out


def _shortest(a: Array, b: Array) -> Array:
    """Return the shortest rotations that take directions a to b, (..., 3) both."""
    a = a / np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-12)
    b = b / np.maximum(np.linalg.norm(b, axis=-1, keepdims=True), 1e-12)
    # Opposite directions have no shortest rotation: a little off, any will do.
    a = np.where(np.sum((a + b) ** 2, axis=-1, keepdims=True) < 1e-12, a + _NUDGE, a)
    axis = np.cross(a, b)
    c = skew(axis)
    cosine = np.sum(a * b, axis=-1)[..., None, None]
    return np.eye(3) + c + c @ c / np.maximum(1.0 + cosine, 1e-9)
