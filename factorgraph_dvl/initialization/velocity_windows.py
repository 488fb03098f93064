"""Velocities of a sensor, sorted into the windows of the carried IMU.

Within a window a parabola takes gravity, start and biases out of all velocities that are compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.ndimage import median_filter

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.initialization.carried_windows import CarriedMotion, CarriedWindows

# Measurements that a window takes at least. Chosen: twice the unknowns
_LEAST = 10
# Neighbours with whose median a velocity is compared, and what makes an outlier, in usual second
# differences. Chosen: a false lock for a ping or two, and never sway.
_NEIGHBOURS = 5
_OUTLIER = 8.0
# What makes a residual stand out, in lower quartiles of second differences. Chosen: 13 standard
# deviations of white noise.
_ISOLATED = 17.0
# Keeps a division defined where nothing moves, in the unit of what it bounds.
_TINY = 1e-12
# The same against the IMU: times the median of what is left, and passes. Chosen: 7.7 standard
# deviations where noise is white; with a wrong clock or wrong axes all that is left is large.
_GROSS = 5.0
_PASSES = 5
# Least noise of a velocity, m/s. Chosen: digits of records.
_FINEST = 1e-3


@dataclass(frozen=True)
class VelocityWindows:
    """Velocities at N times, sorted into W windows of at most n.

    Parameters
    ----------
    windows : CarriedWindows
        The carried IMU.
    stamp : ndarray, shape (N,), s
        Times of the velocities.
    velocity : ndarray, shape (N, 3), m/s
        The velocities, in the axes that their sensor reports.
    sigma : ndarray, shape (N,), m/s
        Their stated standard deviations.
    rows : ndarray, shape (W, n)
        Which velocities are in a window.
    inside : ndarray of bool, shape (W, n)
        Which of them are meant; the rest fills the table up.
    window : ndarray, shape (W,)
        Which window it is.
    """

    windows: CarriedWindows
    stamp: Array
    velocity: Array
    sigma: Array
    rows: np.ndarray
    inside: np.ndarray
    window: np.ndarray

    @property
    def time(self) -> Array:
        """Times as in the record, (W, n), s."""
        return self.stamp[self.rows]

    @property
    def noise(self) -> float:
        """Stated standard deviation of a component, m/s."""
        return float(np.median(self.sigma[self.rows[self.inside]]))

    def residual(self, offset: float | Array) -> Array:
        """Return what is left of the velocities if the sensor is late by an offset.

        A constant or (..., W, n), s; returns (..., W, n, 3). Each comparison is by itself.
        """
        raise NotImplementedError

    def without_outliers(self, offset: float | Array) -> Self:
        """Return the comparison without what differs from the IMU far more than the rest.

        Those that are late by `offset` to the IMU; a wrong fit shows the largest first.
        """
        kept = self
        for _ in range(_PASSES):
            left = np.linalg.norm(kept.residual(offset), axis=2)
            fits = left <= _GROSS * max(float(np.median(left[kept.inside])), kept.noise, _FINEST)
            if np.all(fits[kept.inside]):
                break
            kept = replace(kept, inside=kept.inside & fits)
            enough = kept.inside.sum(axis=1) >= _LEAST
            if not enough.any():
                return self
            kept = kept.only(enough)
            offset = offset[enough] if isinstance(offset, np.ndarray) else offset
        return kept

    def only(self, lines: np.ndarray) -> Self:
        """Return some of the windows."""
        return replace(
            self, rows=self.rows[lines], inside=self.inside[lines], window=self.window[lines]
        )

    def freedom(self, unknowns: int) -> Array:
        """Return the degrees of freedom that so many unknowns leave in each window, (W,)."""
        return np.asarray(3.0 * self.inside.sum(axis=1) - unknowns)

    def carried(self, offset: float | Array, stamp: Array | None = None) -> CarriedMotion:
        """Return the motion of the IMU at stamps (N,) that are late by an offset (..., W, n).

        Integrals of the mean force are those up to the stamps. Where an offset jumps, they do not,
        so that a trend along the stamps takes gravity out.
        """
        stamps = self.time if stamp is None else stamp[self.rows]
        time = stamps - offset
        window = np.broadcast_to(self.window[:, None], time.shape)
        at = self.windows.at(window.ravel(), time.ravel())
        turn = at.turn.reshape(*time.shape, 3, 3)
        speed, place, rate = (x.reshape(*time.shape, 3) for x in (at.speed, at.place, at.rate))
        missing = self.windows.mean_force[self.window][:, None] * (stamps - time)[..., None]
        since = (stamps - self.windows.begin[self.window][:, None])[..., None]
        return CarriedMotion(turn, speed + missing, place + missing * since, rate)

    def without_trend(self, values: Array) -> Array:
        """Return values (..., W, n, c) without the parabola that fits them best in each window."""
        kept = values * self.inside[..., None]
        return kept - self._basis @ (self._basis.transpose(0, 2, 1) @ kept)

    @cached_property
    def _basis(self) -> Array:
        t = (self.time - self.time[:, :1]) / self.windows.length
        columns = np.stack([np.ones_like(t), t, t**2], axis=2) * self.inside[..., None]
        return np.linalg.qr(columns)[0]


def steady(velocity: Array) -> np.ndarray:
    """Return which velocities (M, 3) are no outliers beside their neighbours, (M,) bool."""
    if velocity.shape[0] < _NEIGHBOURS:
        return np.ones(velocity.shape[0], dtype=bool)
    deviation = np.abs(velocity - median_filter(velocity, size=(_NEIGHBOURS, 1), mode="nearest"))
    usual = np.maximum(np.median(np.abs(np.diff(velocity, n=2, axis=0)), axis=0), _TINY)
    return np.asarray(np.all(deviation <= _OUTLIER * usual, axis=1))


def isolated(residual: Array, inside: np.ndarray) -> np.ndarray:
    """Return which residuals (W, n, 3) stand out beside those just before and after, (W, n) bool.

    What axes and clocks make lasts as long as a turn, or repeats itself with the sway; a gross
    error does neither. The lower quartile of second differences knows noise where a third of the
    measurements are wrong.
    """
    out = np.zeros(inside.shape, dtype=bool)
    for line, use in enumerate(inside):
        rows = np.flatnonzero(use)
        if rows.size < _LEAST:
            continue
        r = residual[line, rows]
        deviation = np.abs(r - median_filter(r, size=(_NEIGHBOURS, 1), mode="nearest"))
        usual = np.quantile(np.abs(np.diff(r, n=2, axis=0)), 0.25, axis=0)
        out[line, rows] = np.any(deviation > _ISOLATED * np.maximum(usual, _TINY), axis=1)
    return out


def sorted_into(
    windows: CarriedWindows, time: Array
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return which of times (M,) are in which window, as a table that is filled up.

    Rows (W, n), which of them are meant (W, n), and the window of each line (W,); None where no
    window has enough.
    """
    window = windows.window_of(time)
    lines = [np.flatnonzero(window == w) for w in range(windows.start.size)]
    used = np.array([w for w, line in enumerate(lines) if line.size >= _LEAST], dtype=int)
    if used.size == 0:
        return None
    width = max(lines[w].size for w in used)
    rows = np.zeros((used.size, width), dtype=int)
    inside = np.zeros((used.size, width), dtype=bool)
    for i, w in enumerate(used):
        rows[i] = lines[w][-1]
        rows[i, : lines[w].size] = lines[w]
        inside[i, : lines[w].size] = True
    return rows, inside, used
