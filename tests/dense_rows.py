"""Rows of a linearised graph as dense matrices."""

from __future__ import annotations

import numpy as np


def place_of(evaluation):
    """Return the columns of each variable, by key."""
    sizes = evaluation.values.dims()
    edges = np.cumsum([0, *(sizes[key] for key in sorted(sizes))])
    return {key: slice(a, b) for key, a, b in zip(sorted(sizes), edges, edges[1:], strict=False)}


def dense(rows, place):
    """Return the Jacobian of rows by all variables, (M, d, n)."""
    out = np.zeros((*rows.vector.shape, width_of(place)))
    edges = np.cumsum([0, *rows.sizes])
    for i, keys in enumerate(rows.keys):
        for j, key in enumerate(keys.tolist()):
            out[i, :, place[key]] += rows.matrix[i, :, edges[j] : edges[j + 1]]
    return out


def width_of(place):
    """Return how many columns there are."""
    return max(where.stop for where in place.values())
