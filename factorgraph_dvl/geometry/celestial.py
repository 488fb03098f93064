"""The sky: the Earth's attitude in inertial space, and attitudes from star vectors."""

from __future__ import annotations

from datetime import UTC, datetime

import erfa
import numpy as np
from erfa import ufunc

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.rotations import best_rotation
from factorgraph_dvl.geometry.units import DAY
from factorgraph_dvl.geometry.vectors import Array, interpolate, rotate

# Before that, UTC had no leap seconds.
_FIRST_YEAR = 1972
# The celestial pole is interpolated between epochs this far apart, s: nutation bends by less
# than 1e-6 arcsec meanwhile.
_POLE_STEP = 600.0


def earth_from_inertial(epoch: str, time: Array, ut1_utc: float = 0.0) -> Array:
    """Return the (M, 3, 3) rotations from GCRS to ITRS, without polar motion.

    IAU 2006/2000A precession and nutation, and the Earth rotation angle of UT1 (IERS
    Conventions 2010, chapter 5), by ERFA.

    Parameters
    ----------
    epoch : str
        UTC of time zero, ISO 8601.
    time : ndarray, shape (M,)
        SI seconds since then.
    ut1_utc : float, default 0.0
        UT1 - UTC at the epoch, s. UT1 is continuous: a leap second within the trial changes
        nothing.

    Raises
    ------
    ConfigError
        If there is no epoch, or one before 1972.
    """
    day, fraction = _utc(epoch)
    # `erfa.utctai` warns of years beyond the leap seconds it knows: a second is 1e-6 arcsec of
    # precession. To catch that would change the warnings of all threads.
    *tai, _ = ufunc.utctai(day, fraction)
    tt = erfa.taitt(*tai)
    steps = np.unique(np.floor(time / _POLE_STEP))
    grid = _POLE_STEP * np.union1d(steps, steps + 1.0)
    pole = np.stack(erfa.xys06a(tt[0], np.asarray(tt[1]) + grid / DAY), axis=1)
    x, y, s = interpolate(time, grid, pole).T
    angle = erfa.era00(day, fraction + (time + ut1_utc) / DAY)
    return np.asarray(erfa.c2tcio(erfa.c2ixys(x, y, s), angle, np.eye(3)))


def seconds_between(earlier: str, later: str) -> float:
    """Return the time from one epoch to another, s; leap seconds do not count."""
    (day, fraction), (last_day, last_fraction) = _utc(earlier), _utc(later)
    return (last_day - day + last_fraction - fraction) * DAY


def _utc(epoch: str) -> tuple[float, float]:
    """Return the Julian day at midnight, and the fraction of the day, of an epoch."""
    if not epoch:
        raise ConfigError(
            "the trial has no `epoch`, and stars give the attitude only at a known time",
            where="trial.yaml key epoch",
            expected="UTC of time_s = 0, such as 2022-10-12T02:00:00Z",
        )
    moment = datetime.fromisoformat(epoch)
    moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
    if moment.year < _FIRST_YEAR:
        raise ConfigError(
            f"`epoch` is in the year {moment.year}",
            where="trial.yaml key epoch",
            expected=f"UTC as it is since {_FIRST_YEAR}",
        )
    midnight = moment.replace(hour=0, minute=0, second=0, microsecond=0)
    day = erfa.cal2jd(moment.year, moment.month, moment.day)
    return float(day[0] + day[1]), (moment - midnight).total_seconds() / DAY


def attitudes_from_vectors(
    measured: Array, catalogue: Array, first: np.ndarray
) -> tuple[Array, Array]:
    """Return the rotation from measured to catalogue directions, epoch by epoch.

    Wahba's problem, sum |c - R m|² = min. With an error of sigma across each direction, per
    axis, the covariance of phi in R Exp(phi) is sigma² P with P = (sum (I - m mᵀ))⁻¹ (Shuster
    and Oh, J. Guidance and Control 4(1), 1981).

    Parameters
    ----------
    measured, catalogue : ndarray, shape (K, 3)
        Unit vectors.
    first : ndarray, shape (M,)
        First row of each epoch.

    Returns
    -------
    R : ndarray, shape (M, 3, 3)
        Rotations.
    P : ndarray, shape (M, 3, 3)
        Covariance as above.
    """
    moments = np.add.reduceat(catalogue[:, :, None] * measured[:, None, :], first)
    across = np.eye(3) - measured[:, :, None] * measured[:, None, :]
    return best_rotation(moments), np.linalg.inv(np.add.reduceat(across, first))


def spread(directions: Array, first: np.ndarray) -> Array:
    """Return how far directions (K, 3) leave one line, epoch by epoch, (M,), rad.

    The smallest root mean square angle to any line: 0 where all are parallel or opposite.
    """
    outer = np.add.reduceat(directions[:, :, None] * directions[:, None, :], first)
    count = np.diff(np.append(first, directions.shape[0]))
    rest = np.linalg.eigvalsh(outer)[:, :2].sum(axis=1)
    return np.sqrt(np.maximum(rest, 0.0) / count)


def off_vertical(time: Array, nRb: Array, force_time: Array, force: Array) -> float:
    """Return the angle between up and the mean specific force as attitudes turn it, rad.

    The mean of nRb f is gravity's reaction but for the change of velocity: 0.01 m/s² of mean
    acceleration turn it by 0.06 deg.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the attitudes.
    nRb : ndarray, shape (M, 3, 3)
        Body to east, north, up.
    force_time : ndarray, shape (N,), s
        Times of the specific force.
    force : ndarray, shape (N, 3), m/s²
        Specific force in body.
    """
    at = interpolate(time, force_time, force)
    mean = rotate(nRb, at).mean(axis=0)
    return float(np.arctan2(np.hypot(mean[0], mean[1]), mean[2]))
