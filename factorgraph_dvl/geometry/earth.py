"""The Earth: WGS-84 ellipsoid, normal gravity, rotation, local tangent frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from factorgraph_dvl.geometry.vectors import Array, skew

# Defining and derived constants of WGS-84, SI: NIMA TR8350.2, third edition, chapter 3.
RATE = 7.292115e-5
SEMI_MAJOR = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
_SEMI_MINOR = SEMI_MAJOR * (1.0 - FLATTENING)
# What takes sine and cosine of a reduced latitude to those of the latitude and back, but for a
# factor that they share; and their cubes to the centre of curvature.
_TO_REDUCED = np.array([_SEMI_MINOR, SEMI_MAJOR])
_CENTRE = ECCENTRICITY_SQUARED * np.array([SEMI_MAJOR**2 / _SEMI_MINOR, -SEMI_MAJOR])
# Steps of the latitude. Measured: the third leaves rounding up to 10,000 km above the ellipsoid.
_LATITUDE_STEPS = 3
_GRAVITY_EQUATOR = 9.7803253359
_GRAVITY_POLE = 9.8321849379
_CENTRIFUGAL_RATIO = 0.00344978650684


def radii(lat: ArrayLike) -> tuple[Array, Array]:
    """Return the meridian and the prime-vertical radius of curvature, m.

    Parameters
    ----------
    lat : array_like
        (...) geodetic latitude, rad.
    """
    root = 1.0 - ECCENTRICITY_SQUARED * np.sin(lat) ** 2
    east = SEMI_MAJOR / np.sqrt(root)
    return east * (1.0 - ECCENTRICITY_SQUARED) / root, east


def normal_gravity(lat: ArrayLike, height: ArrayLike) -> Array:
    """Return the magnitude of normal gravity (gravitation and centrifugal), m/s².

    Somigliana's formula with the second-order free-air reduction: NIMA TR8350.2,
    third edition, eqs. 4-1 and 4-3.

    Parameters
    ----------
    lat : array_like
        (...) geodetic latitude, rad.
    height : array_like
        (...) above the ellipsoid, m.
    """
    s2 = np.sin(lat) ** 2
    k = (1.0 - FLATTENING) * _GRAVITY_POLE / _GRAVITY_EQUATOR - 1.0
    surface = _GRAVITY_EQUATOR * (1.0 + k * s2) / np.sqrt(1.0 - ECCENTRICITY_SQUARED * s2)
    h = np.asarray(height, dtype=float) / SEMI_MAJOR
    linear = 1.0 + FLATTENING + _CENTRIFUGAL_RATIO - 2.0 * FLATTENING * s2
    return np.asarray(surface * (1.0 - 2.0 * linear * h + 3.0 * h**2))


def enu_from_ecef(lat: ArrayLike, lon: ArrayLike) -> Array:
    """Return the (..., 3, 3) rotation from ECEF to local-level ENU at lat, lon (rad)."""
    sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    out = np.zeros((*np.broadcast(sl, so).shape, 3, 3))
    out[..., 0, 0], out[..., 0, 1] = -so, co
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = -sl * co, -sl * so, cl
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = cl * co, cl * so, sl
    return out


def _ecef(lat: ArrayLike, lon: ArrayLike, height: ArrayLike) -> Array:
    """Return positions in ECEF, (..., 3), m, of geodetic coordinates (rad, rad, m)."""
    height = np.asarray(height, dtype=float)
    s, c = np.sin(lat), np.cos(lat)
    east = SEMI_MAJOR / np.sqrt(1.0 - ECCENTRICITY_SQUARED * s**2)
    along = (east + height) * c
    out = np.empty((*np.broadcast(along, lon).shape, 3))
    out[..., 0], out[..., 1] = along * np.cos(lon), along * np.sin(lon)
    out[..., 2] = ((1.0 - ECCENTRICITY_SQUARED) * east + height) * s
    return out


def _unit(vectors: Array) -> Array:
    """Return vectors (..., 2) of unit length."""
    return np.asarray(vectors / np.hypot(vectors[..., 0], vectors[..., 1])[..., None])


@dataclass(frozen=True)
class LocalFrame:
    """Tangent east-north-up frame, fixed to the Earth at an origin: the `n` of the graph.

    Parameters
    ----------
    lat, lon : float
        Geodetic latitude and longitude of the origin, rad.
    height : float
        Ellipsoidal height of the origin, m.
    epoch : str, optional
        UTC of the trial's time zero, ISO 8601, which fixes how the frame lies among the stars at
        any time; empty if not known.

    Examples
    --------
    >>> import numpy as np
    >>> from factorgraph_dvl import LocalFrame
    >>> frame = LocalFrame(np.radians(36.0), np.radians(121.0), 0.0)
    >>> frame.position(np.radians(36.0), np.radians(121.0), 5.0).round(6) + 0.0
    array([0., 0., 5.])
    """

    lat: float
    lon: float
    height: float
    epoch: str = ""

    @cached_property
    def _enu_from_ecef(self) -> Array:
        return enu_from_ecef(self.lat, self.lon)

    @cached_property
    def _origin(self) -> Array:
        """Origin in ECEF, (3,), m."""
        return _ecef(self.lat, self.lon, self.height)

    @cached_property
    def earth_rate(self) -> Array:
        """Earth rotation resolved in n, (3,), rad/s."""
        return RATE * np.array([0.0, np.cos(self.lat), np.sin(self.lat)])

    def position(self, lat: ArrayLike, lon: ArrayLike, height: ArrayLike) -> Array:
        """Return positions in n, (..., 3), m, of geodetic coordinates (rad, rad, m)."""
        return (_ecef(lat, lon, height) - self._origin) @ self._enu_from_ecef.T

    def geodetic(self, p_n: ArrayLike) -> tuple[Array, Array, Array]:
        """Return latitude, longitude (rad) and height (m) of positions (..., 3) in n.

        By the reduced latitude, step by step: Bowring, Survey Review 23(181), 1976.
        """
        ecef = np.asarray(p_n, dtype=float) @ self._enu_from_ecef + self._origin
        # Above the equator, and from the axis.
        place = np.empty((*ecef.shape[:-1], 2))
        place[..., 0] = z = ecef[..., 2]
        place[..., 1] = out = np.hypot(ecef[..., 0], ecef[..., 1])
        # Sine and cosine of a latitude, but for a factor that they share.
        reduced = place * _TO_REDUCED[::-1]
        for _ in range(_LATITUDE_STEPS):
            latitude = place + _CENTRE * _unit(reduced) ** 3
            reduced = latitude * _TO_REDUCED
        latitude = _unit(latitude)
        s, c = latitude[..., 0], latitude[..., 1]
        height = out * c + z * s - SEMI_MAJOR * np.sqrt(1.0 - ECCENTRICITY_SQUARED * s**2)
        return np.arctan2(s, c), np.arctan2(ecef[..., 1], ecef[..., 0]), height

    def level_from_tangent(self, lat: ArrayLike, lon: ArrayLike) -> Array:
        """Return the (..., 3, 3) rotation from n to the local-level ENU at lat, lon (rad)."""
        return enu_from_ecef(lat, lon) @ self._enu_from_ecef.T

    def gravity(self, p_n: ArrayLike) -> Array:
        """Return gravity at positions (..., 3) in n, resolved in n, m/s²."""
        lat, lon, height = self.geodetic(p_n)
        up = self.level_from_tangent(lat, lon)[..., 2, :]
        return -normal_gravity(lat, height)[..., None] * up

    def gravity_without_rotation(self, p_n: ArrayLike) -> Array:
        """Return gravitation at p plus the centrifugal acceleration of the origin alone.

        Equations of motion that carry the term -w x (w x p) themselves (GTSAM's, with
        p from the origin) need gravity without it.
        """
        cross = skew(self.earth_rate)
        return self.gravity(p_n) + np.asarray(p_n, dtype=float) @ (cross @ cross).T
