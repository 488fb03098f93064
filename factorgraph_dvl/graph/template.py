"""Empty Jacobian factors of any number of keys, to be filled in place."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array


def jacobian_template(keys: list[int], sizes: Sequence[int], rows: int) -> gtsam.JacobianFactor:
    """Return an empty Jacobian factor; only a custom factor makes one of any number of keys.

    Parameters
    ----------
    keys : list of int
        Of its variables.
    sizes : sequence of int
        Dimensions of the variables.
    rows : int
        Number of rows.
    """

    def nothing(
        this: gtsam.CustomFactor, at: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        if jacobians is not None:
            for i, size in enumerate(sizes):
                jacobians[i] = np.zeros((rows, size), order="F")
        return np.zeros(rows)

    noise = gtsam.noiseModel.Unit.Create(rows)
    factor = gtsam.CustomFactor(noise, keys, nothing).linearize(gtsam.Values())
    assert isinstance(factor, gtsam.JacobianFactor)
    return factor
