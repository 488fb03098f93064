"""Gravity near the vehicle, by linear interpolation."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array

# Distance, m, over which gravity is taken as linear. Measured against the full model: the error
# stays below 3e-9 m/s².
_LINEAR = 100.0


class LocalGravity:
    """`LocalFrame.gravity_without_rotation`, expanded to first order about a recent position.

    Parameters
    ----------
    frame : LocalFrame
        Navigation frame in which positions are given.
    """

    def __init__(self, frame: LocalFrame) -> None:
        self._frame = frame
        self._origin = np.full(3, np.inf)

    def at(self, p_n: Array) -> Array:
        """Return gravity (1, 3), m/s², at a position (1, 3), m."""
        shift = p_n[0] - self._origin
        if shift @ shift > _LINEAR**2:
            self._origin = p_n[0]
            nearby = p_n + _LINEAR * np.vstack([np.zeros(3), np.eye(3)])
            found = self._frame.gravity_without_rotation(nearby)
            self._value, self._gradient = found[0], (found[1:] - found[0]) / _LINEAR
        return self._value + (p_n - self._origin) @ self._gradient
