"""Angle and scale of a ship's ADCP over ground or through water (Joyce; Pollard and Read).

With horizontal velocities as complex numbers, east + i north, and the ADCP turned to them by the
heading, the ship's own velocity is c times that of the ADCP, less the current:

    z_s = c z_d + w,    c = exp(-i alpha) / (1 + k),

alpha the misalignment about the vertical, k the scale error. Joyce takes the c that leaves the
least variance, over ground of z_s - c z_d itself, through water of its deviation from a mean: the
current has nothing to do with the motion of the ship. Pollard and Read take differences across
turns, in which the current has no time to change; over ground, the legs themselves.

T. M. Joyce, On in situ "calibration" of shipboard ADCPs, J. Atmos. Oceanic Technol. 6(1),
169-172, 1989. R. Pollard and J. Read, A method for calibrating shipmounted acoustic Doppler
profilers and the limitations of gyro compasses, J. Atmos. Oceanic Technol. 6(6), 859-865, 1989.
"""

from __future__ import annotations

import itertools

import numpy as np

from factorgraph_dvl.baselines.navigation import NavigationMotion
from factorgraph_dvl.baselines.outcome import Estimated, Outcome, prior_of
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.sensors.parameters import Parameter

# Span of a mean, s. Chosen: that of the ensembles which ships average.
_BIN = 60.0
# Turn rate, rad/s, from which on the ship turns, and the span, s, that it is a mean of. Chosen:
# above yaw in a seaway.
_TURNING = 0.3 * DEG
_TURN_SPAN = 20.0
# Least and longest span, s, before and after a turn. Chosen: as cruises use, one to five minutes.
_LEAST_LEG, _LONGEST_LEG = 60.0, 300.0
# Least change of velocity in a turn, as a share of the speed. Chosen: as after turning by 30 deg.
_LEAST_CHANGE = 0.5


def horizontal(
    motion: NavigationMotion, v_d: Array, misalignment: Parameter, lever_arm: Array
) -> tuple[np.ndarray, np.ndarray]:
    """Return velocities of ship and ADCP at pings, east + i north, (M,), m/s.

    Parameters
    ----------
    motion : NavigationMotion
        Motion of the ship.
    v_d : ndarray, shape (M, 3), m/s
        Velocity of the ADCP, in its axes.
    misalignment : Parameter
        Nominal mounting.
    lever_arm : ndarray, shape (3,), m
        Lever arm to the ADCP, in body.
    """
    ship = motion.velocity + rotate(motion.nRb, np.cross(motion.omega_b, lever_arm))
    adcp = rotate(motion.nRb @ exp_so3(misalignment.mean).T, v_d)
    return ship[:, 0] + 1j * ship[:, 1], adcp[:, 0] + 1j * adcp[:, 1]


def joyce(
    time: Array, ship: np.ndarray, adcp: np.ndarray, *, water: bool
) -> tuple[complex, float]:
    """Return c and the standard deviation of its real and imaginary part, by means of a minute.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the pings.
    ship, adcp : ndarray of complex, shape (M,), m/s
        Horizontal velocities.
    water : bool
        Whether the ADCP measures through the water.

    Raises
    ------
    DataError
        If there are fewer than four means.
    """
    _, rows, counts = np.unique(
        np.floor((time - time[0]) / _BIN), return_inverse=True, return_counts=True
    )
    full = counts >= 0.5 * counts.max()
    z_s, z_d = ((np.bincount(rows, z.real) + 1j * np.bincount(rows, z.imag))[full] / counts[full]
                for z in (ship, adcp))  # fmt: skip
    if z_s.size < 4:
        raise DataError(f"{z_s.size} minutes of pings", expected="four or more")
    if water:
        z_s, z_d = z_s - z_s.mean(), z_d - z_d.mean()
    return _ratio(z_s, z_d, z_s.size - 1 - water)


def pollard_read(
    time: Array, heading: Array, ship: np.ndarray, adcp: np.ndarray, *, water: bool
) -> tuple[complex, float]:
    """Return c and the standard deviation of its real and imaginary part, by points at turns.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the pings.
    heading : ndarray, shape (M,), rad
        Heading of the ship.
    ship, adcp : ndarray of complex, shape (M,), m/s
        Horizontal velocities.
    water : bool
        Whether the ADCP measures through the water: points are then changes from leg to leg.

    Raises
    ------
    DataError
        If there are fewer than three points.
    """
    turned = np.unwrap(heading)
    ends = (np.interp(time + s * _TURN_SPAN / 2.0, time, turned) for s in (-1.0, 1.0))
    before, after = ends
    straight = np.abs(after - before) < _TURNING * _TURN_SPAN
    edges = np.flatnonzero(np.diff(np.concatenate([[False], straight, [False]]).astype(int)))
    legs = [(a, b) for a, b in edges.reshape(-1, 2) if time[b - 1] - time[a] >= _LEAST_LEG]

    def mean(z: np.ndarray, a: int, b: int, *, last: bool) -> complex:
        inside = time[a:b]
        near = inside >= inside[-1] - _LONGEST_LEG if last else inside <= inside[0] + _LONGEST_LEG
        return complex(z[a:b][near].mean())

    if water:
        pairs = list(itertools.pairwise(legs))
        z_s, z_d = (
            np.array([mean(z, *q, last=False) - mean(z, *p, last=True) for p, q in pairs])
            for z in (ship, adcp)
        )
        enough = np.abs(z_d) > _LEAST_CHANGE * np.median(np.abs(adcp))
        z_s, z_d = z_s[enough], z_d[enough]
    else:
        z_s, z_d = (np.array([z[a:b].mean() for a, b in legs]) for z in (ship, adcp))
    if z_s.size < 3:
        raise DataError(
            f"{z_s.size} points",
            expected="three or more legs of a minute, with turns between them",
        )
    return _ratio(z_s, z_d, z_s.size - 1)


def outcome_of(
    c: complex, sigma: float, misalignment: Parameter, scale: Parameter, body_axes: BodyAxes
) -> Outcome:
    """Return misalignment and scale error from c; about level axes the prior stays."""
    up = -frd_from_body(body_axes)[2]
    # C = C_nominal Exp(alpha up): the velocity that the nominal mounting gives is turned by alpha.
    turn = exp_so3(-np.angle(c) * up)
    prior = prior_of((misalignment, scale))
    covariance = prior.covariance.copy()
    level = np.eye(3) - np.outer(up, up)
    own = (sigma / abs(c)) ** 2
    covariance[:3, :3] = level @ covariance[:3, :3] @ level + own * np.outer(up, up)
    covariance[3:, 3:] = (sigma / abs(c) ** 2) ** 2
    values = (exp_so3(misalignment.mean) @ turn, np.array([1.0 / abs(c) - 1.0]))
    return Outcome(Estimated((misalignment, scale), values, covariance), 1)


def _ratio(z_s: np.ndarray, z_d: np.ndarray, freedom: int) -> tuple[complex, float]:
    """Return the least-squares ratio of complex numbers, and the standard deviation of a part."""
    power = float(np.sum(np.abs(z_d) ** 2))
    c = complex(np.sum(z_s * z_d.conj()) / power)
    left = float(np.sum(np.abs(z_s - c * z_d) ** 2)) / (2.0 * freedom)
    return c, float(np.sqrt(left / power))
