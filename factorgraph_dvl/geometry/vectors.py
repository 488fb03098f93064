"""Vectors in arrays: products of many at once, linear interpolation, robust deviations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = np.ndarray

# Matrices and vectors up to which there are few. Measured: products of few matrices with matrices
# of one column take half the time of a sum over indices, which takes half of theirs for many.
_FEW = 100
# Axes after and before each, in turn, and what takes a vector to the rows of its matrix.
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
# Standard deviation of normal errors, in their median magnitude.
_BY_MEDIAN = 1.4826
# Made once: few vectors take less time than a matrix.
IDENTITY: Array = np.eye(3)
IDENTITY.setflags(write=False)
_SKEW = np.zeros((3, 9))
_SKEW[_NEXT, 3 * np.arange(3) + _LAST] = 1.0
_SKEW[_LAST, 3 * np.arange(3) + _NEXT] = -1.0


def median(values: Array) -> float:
    """Return the median of numbers (N,); of few, in a tenth of the time of NumPy's."""
    below, above = (values.size - 1) // 2, values.size // 2
    placed = np.partition(values, (below, above))
    return 0.5 * float(placed[below] + placed[above])


def skew(v: ArrayLike) -> Array:
    """Return the cross-product matrices [v x] of vectors (..., 3), as (..., 3, 3)."""
    v = np.asarray(v, dtype=float)
    rows: Array = v @ _SKEW
    return rows.reshape(*v.shape, 3)


def cross(a: Array, b: Array) -> Array:
    """Return the cross products of vectors (..., 3), faster than NumPy's."""
    if max(a.size, b.size) <= 6 * _FEW:
        # Component i is the difference of products with the indices i + 1 and i + 2.
        differences: Array = a * b.take(_NEXT, -1) - a.take(_NEXT, -1) * b
        return differences.take(_NEXT, -1)
    # For many, a quarter of the time.
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[..., j], b[..., k], out=out[..., i])
        out[..., i] -= a[..., k] * b[..., j]
    return out


def interpolate(time: Array, knots: Array, values: Array) -> Array:
    """Return values (K, ...) at times (M,), linear between knots (K,), constant beyond them."""
    columns = values.reshape(knots.size, -1).T
    at = np.stack([np.interp(time, knots, column) for column in columns], axis=1)
    return at.reshape(time.size, *values.shape[1:])


def spread(errors: Array) -> Array:
    """Return the standard deviation of normal errors (M, ...) about zero, nan where there is none.

    By their median magnitude: outliers do not count.
    """
    return np.asarray(_BY_MEDIAN * np.nanmedian(np.abs(errors), axis=0))


def sums_before(steps: Array) -> Array:
    """Return the sums of all steps (N, ...) before each; before the first, zero."""
    out = np.zeros_like(steps)
    np.cumsum(steps[:-1], axis=0, out=out[1:])
    return out


def cross_variance(omega_sigma: Array, squares: Array) -> Array:
    """Return the variance, (M,), of omega x l across l, where it is largest.

    Half the trace of the covariance, by standard deviations of omega (M, 3) and the squared
    components of l, (3,) or (M, 3).
    """
    across = squares.sum(axis=-1, keepdims=True) - squares
    return np.asarray(0.5 * (omega_sigma**2 * across).sum(axis=1))


def rotate(matrices: Array, vectors: Array) -> Array:
    """Return the products of matrices (M, 3, 3) and vectors (M, 3) or (3,), as (M, 3)."""
    if matrices.size <= 9 * _FEW:
        columns: Array = matrices @ vectors[..., None]
        return columns[..., 0]
    return np.asarray(np.einsum("...ij,...j->...i", matrices, vectors))
