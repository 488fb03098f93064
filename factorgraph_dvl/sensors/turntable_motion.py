"""A body that turns on the ship that carries it, as on a turntable under the hull."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array


@dataclass(frozen=True)
class TurntableMotion:
    """Rotation of the body relative to its carrier, about an axis that both share.

    Between the samples the angle follows monotone cubics, before the first and after the
    last it stays. The axes c of the carrier are those of the body at angle zero.

    Parameters
    ----------
    time : ndarray, shape (K,), s
        Strictly increasing.
    angle : ndarray, shape (K,), rad
        Counter-clockwise seen from above; without jumps.
    up : ndarray, shape (3,)
        Unit vector along the axis, upwards, in body and in c.
    """

    time: Array
    angle: Array
    up: Array

    def at(self, time: Array) -> tuple[Array, Array]:
        """Return bRc (M, 3, 3), and the rate of the body relative to c, (M, 3), rad/s."""
        if self.time.size < 2:
            angle, rate = np.full(time.shape, self.angle[0]), np.zeros(time.shape)
        else:
            inside = np.clip(time, self.time[0], self.time[-1])
            curve = PchipInterpolator(self.time, self.angle)
            angle = curve(inside)
            rate = np.where(inside == time, curve(inside, 1), 0.0)
        return exp_so3(-angle[:, None] * self.up), np.asarray(rate[:, None] * self.up)
