"""Empty Jacobian factors of any number of keys, to be filled in place."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array


def jacobian_template(keys: list[int], sizes: Sequence[int], rows: int) -> gtsam.JacobianFactor:
    """Return an empty Jacobian factor; only a custom factor makes one of any number of keys.

    Parameters
    ----------
    keys : list of int
        Keys of its variables.
    sizes : sequence of int
        Dimensions of the variables.
    rows : int
        Number of rows.
    """
    noise = gtsam.noiseModel.Unit.Create(rows)
    zeros = _zeros(tuple(sizes), rows)
    factor = gtsam.CustomFactor(noise, keys, zeros).linearize(_NO_VALUES)
    assert isinstance(factor, gtsam.JacobianFactor)
    return factor


# What factors that are zero everywhere are evaluated at.
_NO_VALUES = gtsam.Values()


class _Zeros:
    """Zero error with zero Jacobians; GTSAM copies them."""

    def __init__(self, sizes: tuple[int, ...], rows: int) -> None:
        self._error = np.zeros(rows)
        zeros = [np.zeros((rows, size), order="F") for size in sizes]
        self._jacobians = gtsam.gtsam.JacobianVector(zeros)

    def __call__(
        self, this: gtsam.CustomFactor, at: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        if jacobians is not None:
            jacobians[:] = self._jacobians
        return self._error


# Factors of a trial have the same few shapes over and over.
_zeros = lru_cache(maxsize=64)(_Zeros)
