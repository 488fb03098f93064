"""Radial velocities of beams to velocities in three axes: what an instrument does itself.

With A the rows (1 + k_i) d_i^T of the beams, the velocities along them are A u. Three
beams give u; more give it by least squares, and by what is left over say how well they
agree: the error velocity.
"""

from __future__ import annotations

from itertools import combinations

import msgspec
import numpy as np
from msgspec import UnsetType

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings
from factorgraph_dvl.sensors.dvl_beams import DvlBeams

# Three beams nearer to one plane than this sine of an angle do not make a group.
_LEAST_SPREAD = 0.05


def instrument_matrix(gain: Array) -> Array:
    """Return the matrix that takes beams to velocity, (3, N): the pseudo-inverse of A.

    Parameters
    ----------
    gain : ndarray, shape (N, 3)
        Rows (1 + k_i) d_i^T, N >= 3.
    """
    return np.asarray(np.linalg.pinv(gain))


def error_rows(gain: Array) -> Array:
    """Return orthonormal rows (N - 3, N) that no velocity reaches: B A = 0.

    With four beams the one row gives the error velocity; its first element is positive.
    """
    u = np.linalg.svd(gain)[0]
    rows = u[:, 3:].T
    return np.asarray(rows * np.where(rows[:, :1] < 0.0, -1.0, 1.0))


def velocities(gain: Array, beams: Array, sigma: Array) -> tuple[Array, Array]:
    """Return velocities by least squares over the valid beams, and standard deviations.

    All valid beams of a ping count the same, as they do in an instrument matrix.

    Parameters
    ----------
    gain : ndarray, shape (N, 3)
        Rows (1 + k_i) d_i^T.
    beams : ndarray, shape (M, N), m/s
        Velocities along the beams; nan where lost.
    sigma : ndarray, shape (M, N), m/s
        Their standard deviations; those of lost beams are ignored.

    Returns
    -------
    velocity : ndarray, shape (M, 3), m/s
        Least squares; nan where the valid beams do not span three axes.
    std : ndarray, shape (M, 3), m/s
        Standard deviations, likewise.
    """
    out, std = np.full((len(beams), 3), np.nan), np.full((len(beams), 3), np.nan)
    for valid, pings in _by_pattern(beams):
        A = gain[valid]
        if _spans(A):
            inverse = instrument_matrix(A)
            out[pings] = beams[np.ix_(pings, valid)] @ inverse.T
            std[pings] = np.sqrt(sigma[np.ix_(pings, valid)] ** 2 @ (inverse**2).T)
    return out, std


def error_velocity(gain: Array, beams: Array) -> Array:
    """Return by how much the valid beams of each ping disagree, (M,), m/s.

    With four valid beams the component that no velocity explains, B b, with its sign; with
    more of them the root mean square of such components; nan with three or fewer. It
    scatters as much as a beam does.
    """
    out = np.full(len(beams), np.nan)
    for valid, pings in _by_pattern(beams):
        A = gain[valid]
        if len(A) > 3 and _spans(A):
            left = beams[np.ix_(pings, valid)] @ error_rows(A).T
            out[pings] = left[:, 0] if len(A) == 4 else np.sqrt(np.mean(left**2, axis=1))
    return out


def groups(gain: Array) -> list[tuple[int, int, int]]:
    """Return the groups of three beams that span three axes, as indices."""
    return [g for g in combinations(range(len(gain)), 3) if _spans(gain[list(g)])]


def group_velocities(gain: Array, beams: Array) -> Array:
    """Return the velocity of each group of three beams, (M, G, 3), m/s; nan where one is lost."""
    found = groups(gain)
    out = np.empty((len(beams), len(found), 3))
    for i, g in enumerate(found):
        out[:, i] = beams[:, g] @ np.linalg.inv(gain[list(g)]).T
    return out


def as_dvl(beams: DvlBeams, calibration: tuple[Array, Array, Array] | None = None) -> Dvl:
    """Return the record of a DVL that reports what its beams amount to, in the axes d.

    Parameters
    ----------
    beams : DvlBeams
        Record of the beams.
    calibration : tuple of (ndarray, ndarray, ndarray), optional
        Directions in body (N, 3), scale errors (N,) and lever arm (3,), m. What is left between
        body and d is then the nominal misalignment, exactly, and nothing is to be estimated. None
        = nominal beams, and the priors of the beams.
    """
    s = beams.settings
    common = s.parametrisation == "common"
    none = (0.0, 0.0, 0.0)
    std = s.misalignment_std_deg
    settings = DvlSettings(
        velocity_std_m_s=s.velocity_std_m_s,
        velocity_std_fraction=s.velocity_std_fraction,
        misalignment_deg=s.misalignment_deg,
        misalignment_std_deg=(s.direction_std_deg,) * 3 if isinstance(std, UnsetType) else std,
        scale_error=float(np.mean(s.scale_error)) if common else 0.0,
        scale_error_std=s.scale_error_std,
        lever_arm_m=s.lever_arm_m,
        lever_arm_std_m=s.lever_arm_std_m,
        bias_std_m_s=none,
        time_offset_s=s.time_offset_s,
        time_offset_std_s=s.time_offset_std_s,
        clock_rate_std_ppm=s.clock_rate_std_ppm,
    )
    directions_d = s.nominal_d
    scale = np.zeros(1) if common else np.atleast_1d(np.array(s.scale_error, dtype=float))
    if calibration is not None:
        directions_b, scale, arm = calibration
        directions_d = directions_b @ exp_so3(np.array(s.misalignment_deg) * DEG).T
        settings = msgspec.structs.replace(
            settings,
            misalignment_std_deg=none,
            scale_error=0.0,
            scale_error_std=0.0,
            lever_arm_m=tuple(arm.tolist()),
            lever_arm_std_m=none,
            time_offset_std_s=0.0,
            clock_rate_std_ppm=0.0,
        )
    gain = (1.0 + np.broadcast_to(scale, len(directions_d)))[:, None] * directions_d
    velocity, std_d = velocities(gain, beams.velocity, beams.sigma())
    return Dvl(settings, beams.time, velocity, std_d, source=beams.source, label=beams.label)


def _by_pattern(beams: Array) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the patterns of valid beams that occur, as indices, with the pings of each."""
    patterns, pattern_of = np.unique(~np.isnan(beams), axis=0, return_inverse=True)
    which = pattern_of.ravel()
    return [(np.flatnonzero(p), np.flatnonzero(which == i)) for i, p in enumerate(patterns)]


def _spans(gain: Array) -> bool:
    return len(gain) > 2 and bool(np.linalg.svd(gain, compute_uv=False)[2] > _LEAST_SPREAD)
