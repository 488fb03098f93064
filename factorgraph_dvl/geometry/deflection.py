"""The deflection of the vertical as a random field of the place."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.vectors import Array

# Length over which the deflection changes, m. Chosen: between that of the sea floor, some
# kilometres, and that of what global models of gravity resolve.
_LENGTH = 2e4
# Points of a track at which the field is decomposed. Chosen: closer than the length for a day.
_POINTS = 200
# Share of the variance that the components leave out. Chosen: a hundredth of the deviation.
_LEFT_OUT = 1e-4


def deflection_covariance(place: Array) -> Array:
    """Return the covariance of the deflection at points with unit variance, (M, 2, M, 2).

    The deflection is the slope of a geoid whose covariance is (1 + x + x²/3) exp(-x), with x the
    distance over a length:

        C = ((1 + x) I - x² u uᵀ) exp(-x),

    u the direction from one point to the other (Jordan, Self-consistent statistical models for
    the gravity anomaly, vertical deflections, and undulation of the geoid, J. Geophys. Res. 77
    (20), 1972).

    Parameters
    ----------
    place : ndarray, shape (M, 2), m
        East and north.
    """
    apart = (place[:, None] - place) / _LENGTH
    x = np.linalg.norm(apart, axis=2)[..., None, None]
    same = (1.0 + x) * np.eye(2)
    return np.asarray(
        np.swapaxes((same - apart[..., :, None] * apart[..., None, :]) * np.exp(-x), 1, 2)
    )


def deflection_along(place: Array) -> Array:
    """Return independent components of the deflection along a track, (M, 2, h), of unit variance.

    Their squares add up to the covariance of the field: the first ones are constant and a slope,
    and a short track has few.

    Parameters
    ----------
    place : ndarray, shape (M, 2), m
        East and north, along the track.
    """
    count = len(place)
    some = np.linspace(0.0, count - 1.0, min(count, _POINTS))
    at = np.stack([np.interp(some, np.arange(count), each) for each in place.T], axis=1)
    covariance = deflection_covariance(at).reshape(2 * some.size, 2 * some.size)
    variance, vectors = np.linalg.eigh(covariance)
    kept = np.cumsum(variance) > _LEFT_OUT * variance.sum()
    components = (vectors[:, kept] * np.sqrt(variance[kept])).reshape(some.size, 2, -1)
    whole = np.clip(np.searchsorted(some, np.arange(count), side="right") - 1, 0, some.size - 2)
    if some.size == 1:
        return np.asarray(components)
    share = (np.arange(count) - some[whole]) / (some[whole + 1] - some[whole])
    between = components[whole + 1] - components[whole]
    return np.asarray(components[whole] + share[:, None, None] * between)
