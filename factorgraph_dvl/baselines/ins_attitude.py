"""The attitude of a strapdown INS aided by GNSS, and by a rough height without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.baselines.navigation import navigate
from factorgraph_dvl.baselines.summary import trajectory_of
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.timestamps import without_restarted_clock
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.trial import Trial

# Chosen: gap of GNSS, s, from which on the height is aided. The vertical channel of an INS
# diverges by a factor of e in ten minutes, and corrupts the attitude.
_GAP = 10.0
# Chosen: interval, s, and standard deviation, m, of the aiding by the height of the last fix.
_HEIGHT_INTERVAL = 1.0
_HEIGHT_STD = 100.0
# Chosen: standard deviation, m, of the horizontal position there: it carries no information.
_UNKNOWN_POSITION = 1e6


def sins(
    trial: Trial, *, align_s: float | None = None, rate_hz: float = 10.0
) -> tuple[Trajectory, Array, tuple[Finding, ...]]:
    """Return motion, gyro bias (3,), rad/s, and findings of an INS aided by GNSS alone.

    Where GNSS is missing the INS runs free but for its height, which is aided by that of
    the last fix. Its position drifts by kilometres in an hour, its attitude hardly.

    Parameters
    ----------
    trial : Trial
        Trial with IMU and GNSS.
    align_s : float, optional
        Time from the first fix on during which GNSS is used, s; all by default.
    rate_hz : float, default 10.0
        Rate of the motion.

    Raises
    ------
    DataError
        If there is no GNSS position, or none while the IMU runs.
    """
    trial = without_restarted_clock(replace(trial, notes=()))
    gnss = trial.gnss
    fixes = np.zeros(0) if gnss is None else gnss.time[~np.isnan(gnss.geodetic[:, 0])]
    if gnss is None or fixes.size == 0:
        raise DataError(
            "alignment of the SINS needs GNSS positions, and the trial has none",
            where="trial.yaml" if gnss is None else gnss.source,
            expected="GNSS positions",
            hint="Take the attitude of a solution, or of the reference: --attitude",
        )
    last = fixes[-1] if align_s is None else fixes[0] + align_s
    aided = _with_height_aiding(_rows(gnss, gnss.time <= last), trial.inertial.time)
    navigation = navigate(replace(trial, gnss=aided), np.zeros(0))
    bias = navigation.track.gyro_bias.mean(axis=0)
    return trajectory_of(trial, navigation, rate_hz), bias, navigation.findings


def _with_height_aiding(gnss: Gnss, running: Array) -> Gnss:
    """Return a record with positions in its gaps that carry a rough height only.

    Parameters
    ----------
    gnss : Gnss
        GNSS with fixes.
    running : ndarray, shape (M,)
        Times of the IMU's samples, s: elsewhere no aiding is needed.
    """
    fixes = np.flatnonzero(~np.isnan(gnss.geodetic[:, 0]))
    time = gnss.time[fixes]
    added, source = [], []
    for i, (a, b) in enumerate(zip(time, np.append(time[1:], running[-1]), strict=True)):
        if b - a > _GAP:
            inside = running[np.searchsorted(running, a) : np.searchsorted(running, b)]
            times = a + _HEIGHT_INTERVAL * np.unique(np.floor((inside - a) / _HEIGHT_INTERVAL))
            times = times[times > a]
            added.append(times)
            source.append(np.full(times.size, fixes[i]))
    if not added:
        return gnss
    new, of = np.concatenate(added), np.concatenate(source)
    new, kept = new[~np.isin(new, gnss.time)], of[~np.isin(new, gnss.time)]
    order = np.argsort(np.concatenate([gnss.time, new]), kind="stable")
    unknown = np.full((new.size, 3), np.nan)
    std = np.tile([_UNKNOWN_POSITION, _UNKNOWN_POSITION, _HEIGHT_STD], (new.size, 1))

    def merged(old: Array, other: Array) -> Array:
        return np.concatenate([old, other])[order]

    return replace(
        gnss,
        time=merged(gnss.time, new),
        geodetic=merged(gnss.geodetic, gnss.geodetic[kept]),
        velocity=merged(gnss.velocity, unknown),
        position_std=merged(gnss.position_std, std),
        velocity_std=merged(gnss.velocity_std, np.ones_like(std)),
    )


def _rows(gnss: Gnss, keep: np.ndarray) -> Gnss:
    names = ("time", "geodetic", "velocity", "position_std", "velocity_std")
    return replace(gnss, **{name: getattr(gnss, name)[keep] for name in names})
