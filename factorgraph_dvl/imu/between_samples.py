"""Motion between the samples of an IMU, whose derivative does not jump where one ends.

At the edges of its intervals the motion is that of the samples, and its slope the smoothed rate
and force: a clock that moves a time over a sample finds no jump, and not the noise of the sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, IntArray, cross, rotate
from factorgraph_dvl.imu.increments import Increments, Partial


def between_samples(inc: Increments, index: IntArray, since: Array) -> Partial:
    """Return the motion `since` seconds after the start of intervals `index`, (M,).

    Cubics of Hermite between the edges of the interval, in the axes at its start. The specific
    force is that of the cubic.
    """
    (rate, force), (rate_after, force_after) = (
        inc.edge_signals(index, after=after) for after in (False, True)
    )
    phi, dv = inc.over(index)
    dt = inc.dt[index]
    values, slopes = hermite(since / dt, dt)
    rate_after, force_after = _at_the_start(phi, rate_after, force_after)
    phi_at, dv_at = _cubic(values, phi, rate, rate_after), _cubic(values, dv, force, force_after)
    moved = 0.5 * dv * dt[:, None], np.zeros_like(dv), dv
    turning = _cubic(slopes, phi, rate, rate_after)
    across = cross(phi_at, turning)
    turning = turning - 0.5 * across + cross(phi_at, across) / 6.0
    signals = inc.rate_at(index, since)
    return Partial(
        phi=phi_at,
        dv=dv_at,
        dp=_cubic(values, *moved),
        force=rotate(exp_so3(-phi_at), _cubic(slopes, dv, force, force_after)),
        rough=turning - signals["omega"],
        moving=_cubic(slopes, *moved) - dv_at,
        **signals,
    )


@dataclass(frozen=True)
class Cubics:
    """What the cubics of `between_samples` have beyond their chords, over M parts of intervals.

    Parameters
    ----------
    rate : ndarray, shape (M, 3), rad/s
        Slope of the angle at the end.
    angle, velocity : ndarray, shape (M, 3), rad s, m
        Integrals of angle and velocity, less those of the chords.
    """

    rate: Array
    angle: Array
    velocity: Array


def cubics_between(inc: Increments, index: IntArray, since: Array) -> Cubics:
    """Return the cubics from the start of intervals (M,) to `since` seconds after it."""
    before, after = (inc.edge_signals(index, after=after) for after in (False, True))
    phi, dv = inc.over(index)
    dt = inc.dt[index]
    _, slopes = hermite(since / dt, dt)
    rate_after, force_after = _at_the_start(phi, *after)
    rate = _cubic(slopes, phi, before[0], rate_after)
    force = _cubic(slopes, dv, before[1], force_after)
    # Of a cubic, the mean is that of its ends and a twelfth of the change of its slope.
    part = since[:, None] ** 2 / 12.0
    return Cubics(rate, part * (before[0] - rate), part * (before[1] - force))


def _at_the_start(phi: Array, rate: Array, force: Array) -> tuple[Array, Array]:
    """Return slopes of rotation vector and velocity at the ends of intervals, in axes before."""
    across = cross(phi, rate)
    # Rotation vectors turn by Jr^-1(phi) rate.
    return rate + 0.5 * across + cross(phi, across) / 12.0, rotate(exp_so3(phi), force)


def hermite(u: Array, length: Array) -> tuple[Array, Array]:
    """Return weights (4, M, 1, 1) of values and slopes at both ends of steps, in a cubic.

    Of its value at shares u (M,) of steps of some lengths, and of its derivative.
    """
    v = 1.0 - u
    last, change = u**2 * (3.0 - 2.0 * u), 6.0 * u * v / length
    return (
        np.array([1.0 - last, last, length * u * v**2, -length * u**2 * v])[..., None, None],
        np.array([-change, change, v * (1.0 - 3.0 * u), u * (3.0 * u - 2.0)])[..., None, None],
    )


def _cubic(weights: Array, *parts: Array) -> Array:
    """Return the cubic with a value of 0 before, a value after, and slopes, (M, 3) each."""
    return np.asarray(sum(w[:, :, 0] * part for w, part in zip(weights[1:], parts, strict=True)))
