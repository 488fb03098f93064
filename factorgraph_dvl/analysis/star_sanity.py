"""Whether the attitudes of a star tracker are plausible: epoch, convention, identified stars."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.analysis.finding import Finding
from factorgraph_dvl.celestial import ARCSEC
from factorgraph_dvl.conventions import DEG, Array
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.star import Star

# Longest interval between two attitudes, s, over which a mean rate tells the turn.
_LONGEST = 1.1
# Least rms turn rate, rad/s, that tells conventions apart: the Earth's alone does not.
_TURNING = 0.05 * DEG
_AGREE = 0.2
_MISFIT = 3.0


def star_findings(star: Star, epoch: str, imu: Imu) -> Iterator[Finding]:
    """Check epoch, stars and convention of a star tracker."""
    if not epoch:
        yield Finding(
            "error",
            star.label,
            "trial.yaml has no `epoch`, and stars tell the attitude only at a known time",
        )
    yield from _identification(star)
    yield from _convention(star, imu)


def _identification(star: Star) -> Iterator[Finding]:
    """Hold the angles between measured directions against the catalogue's."""
    vectors = star.vectors
    if vectors is None:
        return
    count = np.diff(np.append(vectors.first, vectors.time.size))
    iRs = Rotation.from_quat(np.repeat(star.quaternion[:, [1, 2, 3, 0]], count, axis=0))
    away = np.linalg.norm(iRs.apply(vectors.body) - vectors.inertial, axis=1)
    # Two components across each direction, less three of the attitude.
    freedom = 2 * count.sum() - 3 * count.size
    sigma = float(np.max(star.settings.std_arcsec)) * ARCSEC
    misfit = float(np.sqrt(np.sum(away**2) / max(freedom, 1))) / sigma
    if misfit > _MISFIT:
        yield Finding(
            "error",
            star.label,
            f"the angles between stars differ from the catalogue's by {misfit:.0f} times "
            "`std_arcsec`: is a star another one, or are columns mixed up?",
        )


def _convention(star: Star, imu: Imu) -> Iterator[Finding]:
    """Hold the turns between attitudes against those of the gyros."""
    if max(star.settings.mounting_std_deg) > 30.0:
        return
    known = np.logical_not(star.missing)
    time, quaternion = star.time[known], star.quaternion[known]
    begin, end = time[:-1], time[1:]
    use = (end - begin < _LONGEST) & (begin >= imu.time[0]) & (end <= imu.time[-1])
    if use.sum() < 3:
        return
    sums = np.vstack([np.zeros(3), np.cumsum(imu.gyro, axis=0)])
    i, j = (np.searchsorted(imu.time, t[use], side="right") for t in (begin, end))
    rate = (sums[j] - sums[i]) / np.maximum(j - i, 1)[:, None]
    if _rms(rate) < _TURNING:
        return
    sRb = Rotation.from_rotvec(np.array(star.settings.mounting_deg) * DEG)

    def misfit(scalar_last: Array, inverse: bool) -> float:
        iRs = Rotation.from_quat(scalar_last)
        iRb = (iRs.inv() if inverse else iRs) * sRb
        turn = (iRb[:-1].inv() * iRb[1:]).as_rotvec()
        return _rms(turn[use] / (end - begin)[use, None] - rate) / _rms(rate)

    right = quaternion[:, [1, 2, 3, 0]]
    stated = misfit(right, False)
    if stated < _AGREE:
        text = f"its turns agree with those of the gyros to {100.0 * stated:.2g} %"
        yield Finding("ok", star.label, text)
        return
    candidates = {
        "is it that of inertial to body, the inverse?": misfit(right, True),
        "is the scalar last?": misfit(quaternion, False),
        "is the scalar last, and is it that of inertial to body?": misfit(quaternion, True),
    }
    best = min(candidates, key=lambda text: candidates[text])
    cause = best if candidates[best] < _AGREE else "is `mounting_deg` right?"
    yield Finding(
        "error",
        star.label,
        f"its turns differ from those of the gyros by {100.0 * stated:.3g} %: {cause}",
    )


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
