"""Local cubics through samples, which take noise down and follow the motion.

Savitzky and Golay, Anal. Chem. 36 (1964).
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from math import factorial

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval, polyvander
from scipy.ndimage import correlate1d

from factorgraph_dvl.geometry.vectors import Array

# Degree of the local polynomials. Chosen: follows a slope and its change.
_ORDER = 3
# Span, s, of a local cubic. Chosen: waves that move a ship are longer.
_SMOOTHED = 1.5
# Signals up to this length, samples, are smoothed by matrices that are kept: a replay smooths a
# second at a time, and SciPy's filters take more time to begin than to filter so few.
SHORT = 300


def wave_width(interval: float) -> int:
    """Return the samples, an odd number, over which a record is smoothed; 0 = it is not."""
    width = 2 * int(0.5 * _SMOOTHED / interval) + 1
    return width if width > _ORDER + 1 else 0


def smoothed_arcs(time: Array, values: Array, width: int, gap: float) -> Array:
    """Return values (M, 3) with local cubics in place of samples, apart for each arc.

    A spline through white noise has slopes that follow it: a clock that moves would climb them.
    """
    out = values.copy()
    if not width:
        return out
    edges = np.concatenate([[0], np.flatnonzero(np.diff(time) > gap) + 1, [time.size]])
    for a, b in itertools.pairwise(edges.tolist()):
        if b - a >= width:
            out[a:b] = local_cubics(values[a:b], width)
    return out


def local_cubics(values: Array, width: int) -> Array:
    """Return the values (N, 3) of local cubics."""
    if values.shape[0] > SHORT:
        return filtered(values, width)
    return np.asarray(filter_matrix(values.shape[0], width) @ values)


@lru_cache(maxsize=64)
def filter_matrix(count: int, width: int) -> Array:
    """Return the filter of so many samples as a matrix."""
    return filtered(np.eye(count), width)


def filtered(values: Array, width: int, deriv: int = 0) -> Array:
    """Return the filter of Savitzky and Golay; the first and last window serve their ends.

    As `scipy.signal` has it, which takes half as long to load as a short trial to solve.
    """
    half = width // 2
    fit = polynomial(width)
    out = correlate1d(values, fit[deriv] * factorial(deriv), axis=0, mode="nearest")
    place = np.arange(-half, 0.0)
    for ends, at, rows in (
        (values[:width], place, slice(half)),
        (values[-width:], -place[::-1], slice(-half, None)),
    ):
        out[rows] = polyval(at, polyder(fit @ ends, deriv)).T
    return np.asarray(out)


@lru_cache(maxsize=64)
def polynomial(width: int) -> Array:
    """Return what takes samples (width, ...) to coefficients of their polynomial, lowest first.

    Places are counted from the middle.
    """
    half = width // 2
    return np.asarray(np.linalg.pinv(polyvander(np.arange(-half, half + 1.0), _ORDER)))
