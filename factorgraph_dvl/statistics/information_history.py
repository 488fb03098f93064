"""Information of the data on the calibration as it grows along a trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from factorgraph_dvl.geometry.vectors import Array


@dataclass(frozen=True)
class InformationHistory:
    """Joint covariance of the constants of a trial, given all data up to some times.

    Parameters
    ----------
    time : ndarray, shape (K,)
        Time of the entries, s; the first is before any data.
    names : tuple of str
        (P,) components as in `covariance.order`. Biases that walk are no constants, and not among
        them.
    root : ndarray, shape (K, P, P)
        Square roots S of the covariances S Sᵀ, in reported units. Kept as roots because a product
        of priors of hundreds of degrees and posteriors of arc seconds leaves a matrix of
        information few digits.
    halfway : mapping of str to ndarray, optional
        Calibration by the data of the first half, by name in reported units.
    """

    time: Array
    names: tuple[str, ...]
    root: Array
    halfway: Mapping[str, Array] = field(default_factory=dict)

    @property
    def std(self) -> Array:
        """Standard deviations, (K, P), in reported units."""
        return np.asarray(np.linalg.norm(self.root, axis=2))

    def covariance(self, k: int) -> Array:
        """Return the covariance at entry k, (P, P)."""
        return np.asarray(self.root[k] @ self.root[k].T)
