"""Probability that the largest of many correlated normal statistics is as large by chance."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, ndtri, stdtr

from factorgraph_dvl.geometry.vectors import Array

# Nodes of the quadrature over the correlation. Chosen: 1e-10 at correlations up to 0.9999.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(48)


def supremum_probability(largest: float, neighbours: Array) -> float:
    """Return an upper bound of the probability that any |Z| of a chain exceeds a number.

    P(any) ≤ Σ P(i) - Σ P(i and i + 1), for standard normal Z with correlations between neighbours
    (Worsley 1982, Biometrika 69, 297-302): for a chain of steps it is close to the probability.

    Parameters
    ----------
    largest : float
        The number.
    neighbours : ndarray, shape (M - 1,)
        Correlation of each of the M statistics with the next.
    """
    single = 2.0 * float(ndtr(-largest))
    pairs = _both_exceed(largest, neighbours)
    return min(single * (neighbours.size + 1) - float(pairs.sum()), 1.0)


def normal_equivalent(statistic: float, freedom: float) -> float:
    """Return the normal statistic of the same tail probability as one of Student's t."""
    tail = float(stdtr(freedom, -abs(statistic)))
    return float(-ndtri(max(tail, 1e-300)))


def _both_exceed(z: float, correlation: Array) -> Array:
    """Return P(|X| > z and |Y| > z) of standard normal X, Y by their correlation, (M,).

    By Plackett's identity, P(X > z, Y > z) = Q(z)² + ∫ exp(-z² / (1 + sin θ)) dθ / 2π from 0 to
    arcsin ρ.
    """
    end = np.arcsin(np.clip(correlation, -1.0, 1.0))
    theta = 0.5 * end[:, None] * (_NODES + 1.0)
    total = np.zeros(end.size)
    for sign in (1.0, -1.0):
        # 1 + sin θ vanishes where one is minus the other.
        below = np.maximum(1.0 + np.sin(sign * theta), 1e-300)
        integral = 0.5 * end * (np.exp(-(z**2) / below) @ _WEIGHTS)
        total += 2.0 * (float(ndtr(-z)) ** 2 + sign * integral / (2.0 * np.pi))
    return np.clip(total, 0.0, 2.0 * float(ndtr(-z)))
