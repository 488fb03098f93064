"""Which axes or units of IMU and GNSS are wrong: what makes the two agree.

Each candidate is one mistake. The IMU's record is set right as if it had been made, carried
through windows anew and compared with GNSS, or with the DVL where there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.initialization.carried_windows import CarriedWindows, carried_windows
from factorgraph_dvl.initialization.clock_fit import Comparison
from factorgraph_dvl.initialization.clock_offsets import least_misfit
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.plausibility.axis_permutations import in_words, mirrored, swapped
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.imu import Imu

# The comparisons that there are, each with the offset of its clock around which to look.
Compare = Callable[[CarriedWindows], Sequence[tuple[Comparison, float]]]

# Windows in which candidates are compared. Chosen: six minutes separate them.
_WINDOWS = 9
# Share of what is unexplained that a candidate must leave at most, and its gain in log-likelihood.
# Chosen: a right cause explains nearly all.
_LEFT = 0.5
_GAIN = 30.0
# Turn rate beyond which a record is not one, rad/s. Chosen: what gyros measure at most.
_FASTEST = 50.0
# Clocks that are off at the same time, s, are allowed for; steps of their scan, for all candidates
# and for the best of them. Chosen: turns last some seconds, sway half a second.
_REACH_S = 1.5
_COARSE_S = 0.5
_FINE_S = 0.1
_TRIED = 4


@dataclass(frozen=True)
class Candidate:
    """One mistake: what it is, and what sets gyro and accelerometer right, (3, 3) each."""

    code: Code
    message: Message
    gyro: Array
    accel: Array

    def corrected(self, imu: Imu) -> Imu:
        """Return the record as it would be without the mistake."""
        return replace(imu, gyro=imu.gyro @ self.gyro.T, accel=imu.accel @ self.accel.T)


# A mirrored axis of the whole IMU: whichever axis it is, the fit is the same.
HANDEDNESS = Candidate(Code.IMU_AXES, in_words(mirrored(1)), mirrored(1), mirrored(1))


def candidates(imu: Imu) -> Iterator[Candidate]:
    """Yield single mistakes that may have been made with the record of an IMU."""
    eye = np.eye(3)
    rate = 1.0 / float(np.median(np.diff(imu.time)))
    yield HANDEDNESS
    for text, factor in (
        (message("gyro_unit.looks_like_degrees"), DEG),
        (message("gyro_unit.looks_like_increments"), rate),
    ):
        if np.abs(imu.gyro).max() * factor > _FASTEST:
            continue
        yield Candidate(Code.GYRO_UNIT, text, factor * eye, eye)
    for code, key, which in (
        (Code.GYRO_AXES, "axes.of_gyros", 0),
        (Code.ACCEL_AXES, "axes.of_accelerometers", 1),
    ):
        changes = [-eye]
        changes += [mirrored(k) for k in range(3)]
        changes += [swapped(k) for k in range(3)]
        # Two mirrored axes of the gyros are, but for gravity, one of the accelerometers.
        changes += [-mirrored(k) for k in range(3)] if which == 0 else []
        for P in changes:
            pair = (P, eye) if which == 0 else (eye, P)
            yield Candidate(code, message(key, axes=in_words(P)), *pair)


@dataclass(frozen=True)
class _Misfits:
    """What the IMU leaves of the velocity changes that others see.

    `share` of each comparison; `noise`, the share that stated noise makes; `total`, minus the
    log-likelihood of all.
    """

    share: Array
    noise: Array
    total: float

    @property
    def excess(self) -> Array:
        """Share beyond noise of each comparison."""
        return np.maximum(self.share - 1.5 * self.noise, 0.0)


def _misfits(compare: Compare, imu: Imu, step: float) -> _Misfits | None:
    windows = carried_windows(imu, _WINDOWS)
    compared = [] if windows is None else compare(windows)
    if not compared:
        return None
    found = [least_misfit(c, around, _REACH_S, step) for c, around in compared]
    noise = [
        c.noise**2 * float(c.count.sum()) / max(float(c.signal.sum()), 1e-12) for c, _ in compared
    ]
    return _Misfits(
        np.array([share for share, _ in found]), np.array(noise), sum(m for _, m in found)
    )


def diagnosis(compare: Compare, imu: Imu, up_b: Array) -> list[Candidate]:
    """Return the mistakes that explain a misfit best, none where there is none to explain.

    Parameters
    ----------
    compare : callable
        Makes the comparisons of GNSS and DVL with carried windows.
    imu : Imu
        Record of the IMU.
    up_b : ndarray, shape (3,)
        Up in body, by `body_axes`: gravity that is right already is not to be turned over.
    """
    nominal = _misfits(compare, imu, _FINE_S)
    if nominal is None or nominal.excess.max() == 0.0:
        return []
    worst = int(np.argmax(nominal.excess))
    force = imu.accel.mean(axis=0)
    upright = [c for c in candidates(imu) if up_b @ c.accel @ force >= min(up_b @ force, 0.0)]
    found = _ranked(compare, imu, upright, worst, _COARSE_S)[:_TRIED]
    found = _ranked(compare, imu, [candidate for *_, candidate in found], worst, _FINE_S)
    if not found:
        return []
    least, left, _ = found[0]
    if nominal.total - least < _GAIN or left > _LEFT * float(nominal.excess[worst]):
        return []
    return [candidate for total, _, candidate in found if total < least + _GAIN]


def _ranked(
    compare: Compare, imu: Imu, tried: Iterable[Candidate], worst: int, step: float
) -> list[tuple[float, float, Candidate]]:
    """Return misfit, and excess of the worst comparison, of candidates, the best first."""
    found = []
    for candidate in tried:
        misfits = _misfits(compare, candidate.corrected(imu), step)
        if misfits is not None and misfits.excess.size > worst:
            found.append((misfits.total, float(misfits.excess[worst]), candidate))
    return sorted(found, key=lambda each: each[0])
