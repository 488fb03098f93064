"""Polynomials through IMU samples, and the rotation and velocity that they integrate to."""

from __future__ import annotations

from functools import lru_cache
from math import factorial

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, cross, median

# Gauss-Legendre quadrature with three nodes on [0, 1]: exact up to degree five.
_GAUSS_NODES = np.array([0.5 - np.sqrt(15.0) / 10.0, 0.5, 0.5 + np.sqrt(15.0) / 10.0])
_GAUSS_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
# What takes differences of rates there to their first and second derivative over an interval.
_SLOPE, _CURVATURE = np.sqrt(15.0) / 3.0, 10.0 / 3.0


def highest_difference(
    values: Array, edges: Array, width: int, averaged: bool, step: Array | float | None = None
) -> Array:
    """Return differences of order width - 1 of means over intervals or values at their ends.

    As they would be at regular intervals of length `step`, by default the median: by divided
    differences, that of the integral for means. Along the first axis of values (N, ..., n) and
    edges (E, ...).
    """
    reach = 1 if averaged else 0
    out = values
    for order in range(1, width):
        span = edges[order + reach :] - edges[: -order - reach]
        out = (out[1:] - out[:-1]) / span[..., None]
    factor = factorial(width) if averaged else factorial(width - 1)
    if step is None:
        step = median(np.diff(edges))
    return np.asarray(out * factor * step ** (width - 1))


def interpolation(edges: Array, averaged: bool) -> Array:
    """Return (B, K, K) matrices from samples to polynomial coefficients.

    Parameters
    ----------
    edges : ndarray, shape (B, E)
        Ends of the intervals; K = E - 1 means over them, or K = E values.
    averaged : bool
        Which of the two.
    """
    power = np.arange(edges.shape[1] - 1 if averaged else edges.shape[1])
    if averaged:
        upper, lower = edges[:, 1:, None], edges[:, :-1, None]
        rows = (upper ** (power + 1) - lower ** (power + 1)) / ((power + 1) * (upper - lower))
    else:
        rows = edges[:, :, None] ** power
    return np.asarray(np.linalg.inv(rows))


@lru_cache(maxsize=64)
def regular_interpolations(count: int, averaged: bool) -> Array:
    """Return `interpolation` (S, K, K) at `count` edges one apart, from -s on for each s."""
    edges = np.arange(count, dtype=float)
    return interpolation(edges - edges[:-1, None], averaged)


def powers(u: Array, count: int) -> Array:
    """Return the powers 0 to count - 1 of numbers (...), as (..., count)."""
    out = np.empty((*u.shape, count))
    out[..., 0] = 1.0
    out[..., 1:] = u[..., None]
    return np.asarray(np.multiply.accumulate(out, axis=-1))


def evaluate(c: Array, u: Array) -> Array:
    """Return polynomials c (M, K, n) at u (M,), as (M, n)."""
    return np.asarray((powers(u, c.shape[1])[:, None] @ c)[:, 0])


def rate_and_slope(c: Array, since: Array, dt: Array) -> tuple[Array, Array]:
    """Return the rate and its derivative, (M, 3), `since` seconds into intervals."""
    order = np.arange(c.shape[1])
    rows = np.zeros((dt.size, 2, order.size))
    rows[:, 0] = powers(since / dt, order.size)
    rows[:, 1, 1:] = rows[:, 0, :-1] * order[1:]
    at = rows @ c[:, :, :3]
    return at[:, 0], at[:, 1] / dt[:, None]


def integrate(c: Array, dt: Array, u: Array | None = None) -> tuple[Array, Array]:
    """Return rotation vector and velocity increment over [0, u] of intervals, or over all of them.

    The rotation by the sixth-order Magnus expansion at Gauss points (Blanes, Casas,
    Oteo, Ros, Phys. Rep. 470 (2009), eq. 253), the velocity by Gauss quadrature of the
    force rotated to the start.
    """
    count = c.shape[1]
    rows, integral = _whole_rows(count) if u is None else _node_rows(u, count)
    at = _at_nodes(rows, c)
    w1, w2, w3 = at[:, :, :3]
    h = (dt if u is None else dt * u)[:, None]
    a1 = h * w2
    a2 = _SLOPE * h * (w3 - w1)
    a3 = _CURVATURE * h * (w3 - 2.0 * w2 + w1)
    # R' = R [w x] mirrors the textbook's Y' = A Y: every commutator changes sign.
    c1 = -cross(a1, a2)
    c2 = cross(a1, 2.0 * a3 + c1) / 60.0
    phi = a1 + a3 / 12.0 - cross(-20.0 * a1 - a3 + c1, a2 + c2) / 240.0

    turned = dt[:, None] * _at_nodes(integral, c[:, :, :3])
    force = at[:, :, 3:]
    once = cross(turned, force)
    twice = cross(turned, once)
    rotated = force + once + twice / 2.0 + cross(turned, twice) / 6.0
    mean = rotated.transpose(1, 2, 0) @ _GAUSS_WEIGHTS
    return phi, h * mean


def _node_rows(u: Array | float, count: int) -> tuple[Array, Array]:
    """Return what takes coefficients to values at Gauss points of [0, u], and to integrals there.

    Of shape (..., 3, count) for numbers u (...).
    """
    nodes = np.multiply.outer(u, _GAUSS_NODES)
    rows = powers(nodes, count)
    return rows, rows * nodes[..., None] / np.arange(1, count + 1)


@lru_cache(maxsize=8)
def _whole_rows(count: int) -> tuple[Array, Array]:
    return _node_rows(1.0, count)


def _at_nodes(rows: Array, c: Array) -> Array:
    """Return combinations (3, M, n) of coefficients (M, K, n), by rows (3, K) or (M, 3, K)."""
    if rows.ndim == 3:
        return np.asarray((rows @ c).transpose(1, 0, 2))
    # One product of two large matrices instead of many small ones.
    together = rows @ c.transpose(1, 0, 2).reshape(c.shape[1], -1)
    return np.asarray(together.reshape(rows.shape[0], c.shape[0], -1))
