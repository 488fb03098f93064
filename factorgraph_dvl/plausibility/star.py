"""Whether the attitudes of a star tracker are plausible: epoch, convention, identified stars."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.geometry.celestial import off_vertical
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.plausibility.records import GAP_INTERVALS
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.star_catalogue import star_catalogue_findings
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.star import Star
from factorgraph_dvl.trial import Trial

# Attitudes that follow each other are compared, or where their noise is too large those about
# 1 s apart; none further apart than the last.
_SPANS = (0.0, 1.0)
_LONGEST = 1.6
# Noise of a turn between two attitudes, relative to the turns, at which conventions still differ.
_QUIET = 0.5
# Least rms turn rate, rad/s, at which conventions differ: the Earth's alone is too small.
_TURNING = 0.05 * DEG
_AGREE = 0.2
# The same of the vertical, rad, where the mounting is known at least so well, deg.
_OFF_VERTICAL = 2.0 * DEG
_KNOWN_MOUNTING_DEG = 0.5


def star_findings(star: Star, trial: Trial) -> Iterator[Finding]:
    """Check epoch, stars and convention of a star tracker."""
    if not trial.epoch:
        yield Finding(Code.NO_EPOCH, message("no_epoch.missing"), star.label, severity="error")
    yield from star_catalogue_findings([star])
    convention = list(_convention(star, trial.inertial))
    yield from convention
    # What mixes up the quaternion turns the vertical too.
    if trial.epoch and not any(f.severity == "error" for f in convention):
        yield from _vertical(star, trial)


def _vertical(star: Star, trial: Trial) -> Iterator[Finding]:
    """Compare the vertical by the stars with that of the specific force."""
    unknown = max(star.settings.mounting_std_deg) > _KNOWN_MOUNTING_DEG
    if unknown or (trial.gnss is None and trial.initial_position is None):
        return
    seen = star.attitudes(trial.frame())
    imu = trial.inertial
    use = (seen.time >= imu.time[0]) & (seen.time <= imu.time[-1])
    if not use.any():
        return
    sRb = Rotation.from_rotvec(np.array(star.settings.mounting_deg) * DEG).as_matrix()
    tilt = off_vertical(seen.time[use], seen.nRs[use] @ sRb, imu.time, imu.accel)
    if tilt > _OFF_VERTICAL:
        yield Finding(
            Code.STAR_VERTICAL,
            message("star_vertical.off", tilt=np.degrees(tilt)),
            star.label,
            severity="error",
        )


def _convention(star: Star, imu: Imu) -> Iterator[Finding]:
    """Compare the turns between attitudes with those of the gyros."""
    if max(star.settings.mounting_std_deg) > 30.0:
        return
    known = np.logical_not(star.missing)
    time, quaternion = star.time[known], star.quaternion[known]
    sRb = Rotation.from_rotvec(np.array(star.settings.mounting_deg) * DEG)
    variance = np.trace(star.covariance[known], axis1=1, axis2=2)
    for span in _SPANS:
        first, second = _pairs(time, imu.time, span)
        if first.size < 3:
            return
        begin, end = time[first], time[second]
        turns = _turns(imu, begin, end)
        size = _rms(turns.as_rotvec())
        walk = 3.0 * imu.settings.gyro_noise_root_psd**2 * (end - begin)
        noise = float(np.sqrt(np.mean(variance[first] + variance[second] + walk))) / size
        if noise < _QUIET:
            break
    else:
        return
    if _rms(turns.as_rotvec() / (end - begin)[:, None]) < _TURNING:
        return

    def misfit(scalar_last: Array, inverse: bool) -> float:
        iRs = Rotation.from_quat(scalar_last)
        iRb = (iRs.inv() if inverse else iRs) * sRb
        return _rms((turns.inv() * iRb[first].inv() * iRb[second]).as_rotvec()) / size

    # The mean of squares of noise scatters itself.
    limit = float(np.hypot(_AGREE, noise * np.sqrt(1.0 + 4.0 / np.sqrt(first.size))))
    right = quaternion[:, [1, 2, 3, 0]]
    stated = misfit(right, False)
    if stated < limit:
        text = message("star_convention.agree", percent=100.0 * stated)
        yield Finding(Code.STAR_CONVENTION, text, star.label, severity="ok")
        return
    candidates = {
        message("star_convention.inverse"): misfit(right, True),
        message("star_convention.scalar_last"): misfit(quaternion, False),
        message("star_convention.both"): misfit(quaternion, True),
    }
    best = min(candidates, key=lambda text: candidates[text])
    cause = best if candidates[best] < limit else message("star_convention.mounting")
    text = message("star_convention.differ", percent=100.0 * stated, cause=cause)
    yield Finding(Code.STAR_CONVENTION, text, star.label, severity="error")


def _pairs(time: Array, imu_time: Array, span: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of attitudes at least `span` s apart, but not by much, while the IMU runs."""
    first = np.arange(time.size - 1)
    second = np.maximum(np.searchsorted(time, time[:-1] + span - 1e-6), first + 1)
    inside = second < time.size
    first, second = first[inside], second[inside]
    begin, end = time[first], time[second]
    # Not across a gap of the gyros.
    steps = np.diff(imu_time)
    gaps = np.append(0, np.cumsum(steps > GAP_INTERVALS * np.median(steps)))
    i, j = (np.clip(np.searchsorted(imu_time, t), 0, gaps.size - 1) for t in (begin, end))
    use = (end - begin < _LONGEST) & (begin >= imu_time[0]) & (end <= imu_time[-1])
    use &= gaps[i] == gaps[j]
    return first[use], second[use]


def _turns(imu: Imu, begin: Array, end: Array) -> Rotation:
    """Return the rotations by the gyros from `begin` to `end`, (M,), s, sample by sample."""
    rate = imu.gyro
    if imu.settings.sampling == "instantaneous":
        rate = np.vstack([rate[:1], 0.5 * (rate[1:] + rate[:-1])])
    first, last = (np.searchsorted(imu.time, t) for t in (begin, end))
    turn = Rotation.identity(begin.size)
    for j in range(int((last - first).max()) + 1):
        i = np.minimum(first + j, last)
        since = np.maximum(begin, imu.time[np.maximum(i - 1, 0)])
        until = np.minimum(end, imu.time[i])
        over = np.where(first + j <= last, np.maximum(until - since, 0.0), 0.0)
        turn = turn * Rotation.from_rotvec(rate[i] * over[:, None])
    return turn


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
