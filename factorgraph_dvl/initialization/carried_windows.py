"""The IMU's record carried through windows: attitude and velocity since the start of each.

Windows are short, so that biases stay small, and overlap by a margin, within which the clocks
of other sensors can be moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, cross
from factorgraph_dvl.sensors.imu import Imu

# Length of a window and margin on both sides, s. Chosen: a gyro bias of 100 deg/h turns gravity
# by 1 deg in a window, which a parabola of the velocity takes out; clocks are off by less.
WINDOW_S = 30.0
MARGIN_S = 5.0
# Samples per second that are kept, and windows at most. Chosen: vessels sway at up to 2 Hz; half
# an hour says what is wrong with a trial.
_RATE_HZ = 100.0
_MOST_WINDOWS = 40
# A window whose samples miss more than this, s, is left out. Chosen: a few samples.
_LONGEST_GAP = 0.1


@dataclass(frozen=True)
class CarriedWindows:
    """W windows of K samples at equal steps, all of body quantities in the axes at its start.

    Parameters
    ----------
    start : ndarray, shape (W,), s
        Where the windows begin, margins left out.
    length : float
        Length of a window, margins left out, s.
    begin : ndarray, shape (W,), s
        Time of the first sample, margin included.
    step : float
        Step between samples, s.
    turn : ndarray, shape (W, K, 3, 3)
        Body to body at the start.
    speed, place : ndarray, shape (W, K, 3)
        First and second integral of the specific force, m/s, m.
    rate : ndarray, shape (W, K, 3), rad/s
        Mean angular rate of the step before each sample, in body.
    """

    start: Array
    length: float
    begin: Array
    step: float
    turn: Array
    speed: Array
    place: Array
    rate: Array

    @property
    def mean_force(self) -> Array:
        """Mean specific force of each window in the axes at its start, (W, 3), m/s²."""
        duration = self.step * (self.speed.shape[1] - 1)
        return np.asarray((self.speed[:, -1] - self.speed[:, 0]) / duration)

    def window_of(self, time: Array) -> np.ndarray:
        """Return the window of each time (M,), -1 where there is none."""
        k = np.searchsorted(self.start, time, side="right") - 1
        inside = (k >= 0) & (time < self.start[k] + self.length)
        return np.where(inside, k, -1)

    def at(self, window: np.ndarray, time: Array) -> CarriedMotion:
        """Return the motion at times (M,) in windows (M,), margins included."""
        samples = self.turn.shape[1]
        exact = (time - self.begin[window]) / self.step
        k = np.clip(exact.astype(int), 0, samples - 2)
        part = np.clip(exact - k, 0.0, 1.0)[:, None]
        # A rate is the mean over the step before it: that of a time lies between two means.
        j = np.clip((exact + 0.5).astype(int), 0, samples - 2)
        near = np.clip(exact + 0.5 - j, 0.0, 1.0)[:, None]
        # One index for window and sample: NumPy takes rows by two in twice the time.
        k, j = window * samples + k, window * samples + j
        turn = self.turn.reshape(-1, 3, 3).take(k, axis=0)
        speed, place, rate = (x.reshape(-1, 3) for x in (self.speed, self.place, self.rate))
        return CarriedMotion(
            turn @ exp_so3(rate.take(k + 1, axis=0) * (part * self.step)),
            _between(speed, k, part),
            _between(place, k, part),
            _between(rate, j, near),
        )


@dataclass(frozen=True)
class CarriedMotion:
    """Motion at times (...): `turn` (..., 3, 3), `speed`, `place`, `rate` (..., 3)."""

    turn: Array
    speed: Array
    place: Array
    rate: Array


def carried_windows(imu: Imu, most: int = _MOST_WINDOWS) -> CarriedWindows | None:
    """Carry the record of an IMU through windows spread over it.

    Parameters
    ----------
    imu : Imu
        Record of the IMU.
    most : int
        Windows at most.

    Returns
    -------
    CarriedWindows or None
        The windows, None where the record is too short or too broken for one.
    """
    if imu.time.size < 3:
        return None
    interval = float(np.median(np.diff(imu.time)))
    pooled = max(int(1.0 / (_RATE_HZ * interval) + 0.01), 1)
    step = pooled * interval
    whole = float(imu.time[-1] - imu.time[0])
    count = int((whole - 2.0 * MARGIN_S) / WINDOW_S)
    if count < 1 or interval > 0.5:
        return None
    length = min((whole - 2.0 * MARGIN_S) / count, 1.5 * WINDOW_S)
    start = imu.time[0] + MARGIN_S + length * np.arange(count)
    if count > most:
        start = start[np.unique(np.linspace(0, count - 1, most).astype(int))]
    samples = int((length + 2.0 * MARGIN_S) / step)
    first = np.searchsorted(imu.time, start - MARGIN_S, side="right")
    first = np.clip(first, 1, max(imu.time.size - 1 - samples * pooled, 1))
    rows = first[:, None] + np.arange(samples * pooled)
    rows = np.minimum(rows, imu.time.size - 1)
    good = np.max(imu.time[rows] - imu.time[rows - 1], axis=1) < _LONGEST_GAP + 2.0 * interval
    good &= np.abs(np.ptp(imu.time[rows], axis=1) - samples * step) < 2.0 * _LONGEST_GAP + step
    if not good.any():
        return None
    start, first, rows = start[good], first[good], rows[good]
    gyro, force = (
        values[rows].reshape(first.size, samples, pooled, 3).mean(axis=2)
        for values in (imu.gyro, imu.accel)
    )
    # A sample is the mean over the interval that ends at its time, or half a step either side.
    early = 0.5 * interval if imu.settings.sampling == "instantaneous" else 0.0
    begin = imu.time[first - 1] + early
    turn, speed, place = _integrals(gyro, force, step)
    rate = np.concatenate([gyro[:, :1], gyro], axis=1)
    return CarriedWindows(start, length, begin, step, turn, speed, place, rate)


def _between(values: Array, row: np.ndarray, part: Array) -> Array:
    """Return what lies between rows (M,) of values and the next."""
    return (1.0 - part) * values.take(row, axis=0) + part * values.take(row + 1, axis=0)


def _integrals(gyro: Array, force: Array, step: float) -> tuple[Array, Array, Array]:
    """Return attitude, first and second integral of the force at the edges of samples."""
    count, samples, _ = gyro.shape
    increments = exp_so3(gyro * step)
    turn = np.empty((samples + 1, count, 3, 3))
    turn[0] = np.eye(3)
    for k in range(samples):
        np.matmul(turn[k], increments[:, k], out=turn[k + 1])
    turn = turn.transpose(1, 0, 2, 3)
    # Force at the middle of the step: half a turn further.
    middle = force + 0.5 * step * cross(gyro, force)
    change = np.einsum("wkij,wkj->wki", turn[:, :-1], middle) * step
    speed = np.concatenate([np.zeros((count, 1, 3)), np.cumsum(change, axis=1)], axis=1)
    mean = 0.5 * (speed[:, 1:] + speed[:, :-1]) * step
    place = np.concatenate([np.zeros((count, 1, 3)), np.cumsum(mean, axis=1)], axis=1)
    return np.ascontiguousarray(turn), speed, place
