"""Strapdown steps: the increments of the IMU composed from one event to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.imu.increments import Increments, Partial
from factorgraph_dvl.sensors.imu import ImuSettings


@dataclass(frozen=True)
class StrapdownSamples:
    """Increments of an IMU with the motion over each whole interval.

    Parameters
    ----------
    increments : Increments
        Increments of N intervals.
    turn : ndarray, shape (N, 3, 3)
        Rotation over each interval, end to start.
    dv : ndarray, shape (N, 3), m/s
        Velocity increment in the axes at the start.
    open_variance : ndarray, shape (N + 1, 2)
        Sum, before each interval, of the variances of rotation (rad²) and velocity (m²/s²) that
        the samples leave open.
    settings : ImuSettings
        Settings of the IMU, for its noise.
    """

    increments: Increments
    turn: Array
    dv: Array
    open_variance: Array
    settings: ImuSettings


@dataclass(frozen=True)
class Steps:
    """Motion by the specific force alone over M steps, in the body axes at their start.

    Parameters
    ----------
    duration : ndarray, shape (M,), s
        Duration of the steps.
    turn : ndarray, shape (M, 3, 3)
        Rotation, body axes at the end to those at the start.
    dv, dp : ndarray, shape (M, 3)
        First and second integral of the specific force, m/s, m.
    bias_jacobian : ndarray, shape (M, 3, 3)
        Integral of the rotation to the start, s: what a bias adds up to.
    gyro_variance, accel_variance : ndarray, shape (M,)
        Variances of rotation (rad²) and velocity (m²/s²), per axis.
    """

    duration: Array
    turn: Array
    dv: Array
    dp: Array
    bias_jacobian: Array
    gyro_variance: Array
    accel_variance: Array


def prepare(increments: Increments, settings: ImuSettings) -> StrapdownSamples:
    """Return the samples of an IMU, ready to be composed."""
    phi, dv = increments.over(np.arange(increments.start.size))
    variance = (increments.open_sigma * increments.dt[:, None]) ** 2
    largest = np.stack([variance[:, :3].max(axis=1), variance[:, 3:].max(axis=1)], axis=1)
    total = np.concatenate([np.zeros((1, 2)), np.cumsum(largest, axis=0)])
    return StrapdownSamples(increments, exp_so3(phi), dv, total, settings)


def at_times(samples: StrapdownSamples, time: Array) -> tuple[np.ndarray, Partial]:
    """Return the intervals that contain times (M,), and the motion within them up to there."""
    inc = samples.increments
    index, since, _ = inc.locate(time)
    return index, inc.partial(index, np.clip(since, 0.0, inc.dt[index]))


def compose(samples: StrapdownSamples, begin: Array, end: Array) -> Steps:
    """Return the motion over steps from times `begin` (M,) to `end` (M,) of the same arc.

    Partial intervals at both ends go through the same polynomials as whole ones, so that
    steps may be cut anywhere and still add up to the same motion.
    """
    inc = samples.increments
    first, head = at_times(samples, begin)
    last, tail = at_times(samples, end)
    head_span = begin - inc.start[first]
    tail_span = end - inc.start[last]

    at = _Sum(begin.size)
    for j in range(int((last - first).max(initial=0))):
        active = np.flatnonzero(first + j < last)
        i = first[active] + j
        at.add(active, samples.turn[i], samples.dv[i], inc.dt[i])
    at.add(np.arange(begin.size), exp_so3(tail.phi), tail.dv, tail_span)

    offset = _Sum(begin.size)
    offset.add(np.arange(begin.size), exp_so3(head.phi), head.dv, head_span)
    duration = end - begin
    to_start = offset.turn.transpose(0, 2, 1)
    noise = samples.open_variance[last + 1] - samples.open_variance[first]
    s = samples.settings
    return Steps(
        duration=duration,
        turn=to_start @ at.turn,
        dv=rotate(to_start, at.dv - offset.dv),
        dp=rotate(to_start, at.dp - offset.dp - offset.dv * duration[:, None]),
        bias_jacobian=to_start @ (at.bias_jacobian - offset.bias_jacobian),
        gyro_variance=s.gyro_noise_root_psd**2 * duration + noise[:, 0],
        accel_variance=s.accel_noise_root_psd**2 * duration + noise[:, 1],
    )


class _Sum:
    """Motion added up over consecutive pieces, for M steps at once."""

    def __init__(self, size: int) -> None:
        self.turn = np.broadcast_to(np.eye(3), (size, 3, 3)).copy()
        self.dv = np.zeros((size, 3))
        self.dp = np.zeros((size, 3))
        self.bias_jacobian = np.zeros((size, 3, 3))

    def add(self, which: np.ndarray, turn: Array, dv: Array, span: Array) -> None:
        """Append pieces to the steps `which`."""
        R, h = self.turn[which], span[:, None]
        rotated = rotate(R, dv)
        self.dp[which] += self.dv[which] * h + rotated * (h / 2.0)
        self.dv[which] += rotated
        # The mean rotation over a piece, to second order: half of [phi x] from I - turn'.
        half = (turn - turn.transpose(0, 2, 1)) / 4.0
        self.bias_jacobian[which] += R @ (np.eye(3) + half) * h[:, :, None]
        self.turn[which] = R @ turn


def exp_small(phi: Array) -> Array:
    """Return Exp([phi x]), (..., 3, 3), to 1e-12 for |phi| below 0.01."""
    cross = skew(phi)
    square = np.sum(phi * phi, axis=-1)[..., None, None]
    return np.eye(3) + (1.0 - square / 6.0) * cross + (0.5 - square / 24.0) * (cross @ cross)
