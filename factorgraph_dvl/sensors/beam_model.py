"""Where beams point and how their scales are off: the rows that a velocity is multiplied by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from factorgraph_dvl.geometry.unit_vectors import turned, turned_jacobian
from factorgraph_dvl.geometry.vectors import Array, skew


class Geometry(Protocol):
    """Where beams point, and how their scales are off, as functions of parameters."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""

    def gain(self, values: Mapping[str, Array]) -> Array:
        """Return the rows (1 + k_i) d_i^T in body, (N, 3)."""

    def derivatives(self, values: Mapping[str, Array], u_b: Array) -> dict[str, Array]:
        """Return those of gain u, (M, N, n) each, for velocities u_b (M, 3)."""


@dataclass(frozen=True)
class FreeGeometry:
    """Every beam has a direction and a scale error of its own.

    Parameters
    ----------
    nominal_b : ndarray, shape (N, 3)
        Unit vectors in body, of which the directions are turns.
    direction, scale : str
        Names of the parameters, (2N,) and (N,).
    """

    nominal_b: Array
    direction: str
    scale: str

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return (self.direction, self.scale)

    def gain(self, values: Mapping[str, Array]) -> Array:
        """Return the rows (1 + k_i) d_i^T in body, (N, 3)."""
        d_b = turned(self.nominal_b, values[self.direction].reshape(-1, 2))
        return (1.0 + values[self.scale])[:, None] * d_b

    def derivatives(self, values: Mapping[str, Array], u_b: Array) -> dict[str, Array]:
        """Return those of gain u, (M, N, n) each, for velocities u_b (M, 3)."""
        eta = values[self.direction].reshape(-1, 2)
        n = len(eta)
        by_eta = (1.0 + values[self.scale])[:, None, None] * turned_jacobian(self.nominal_b, eta)
        by_direction = np.zeros((len(u_b), n, n, 2))
        by_scale = np.zeros((len(u_b), n, n))
        own = np.arange(n)
        by_direction[:, own, own] = np.einsum("mi,nij->mnj", u_b, by_eta)
        by_scale[:, own, own] = u_b @ turned(self.nominal_b, eta).T
        return {self.direction: by_direction.reshape(-1, n, 2 * n), self.scale: by_scale}


@dataclass(frozen=True)
class CommonGeometry:
    """All beams share a misalignment and a scale error; among each other they are nominal.

    Parameters
    ----------
    nominal_d : ndarray, shape (N, 3)
        Unit vectors in d.
    misalignment, scale : str
        Names of the parameters, a rotation and one number.
    """

    nominal_d: Array
    misalignment: str
    scale: str

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return (self.misalignment, self.scale)

    def gain(self, values: Mapping[str, Array]) -> Array:
        """Return the rows (1 + k) d_i^T in body, (N, 3)."""
        return (1.0 + values[self.scale]) * (self.nominal_d @ values[self.misalignment])

    def derivatives(self, values: Mapping[str, Array], u_b: Array) -> dict[str, Array]:
        """Return those of gain u, (M, N, n) each, for velocities u_b (M, 3).

        R Exp(delta) u is R u - R [u x] delta to first order.
        """
        unscaled = self.nominal_d @ values[self.misalignment]
        return {
            self.misalignment: -self.gain(values) @ skew(u_b),
            self.scale: (u_b @ unscaled.T)[:, :, None],
        }
