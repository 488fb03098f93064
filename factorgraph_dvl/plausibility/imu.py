"""Whether units, axes and channels of an IMU are plausible."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, frd_from_body
from factorgraph_dvl.geometry.units import DEG, STANDARD_GRAVITY
from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.initialization.carried_windows import CarriedWindows, carried_windows
from factorgraph_dvl.initialization.clock_fit import Comparison
from factorgraph_dvl.initialization.clock_offsets import least_misfit
from factorgraph_dvl.message import Message, either, message
from factorgraph_dvl.plausibility.axes import NAMES, in_words, mirrored, swapped
from factorgraph_dvl.plausibility.records import WINDOW_S
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.invalid_values import frozen_samples, runs
from factorgraph_dvl.sensors.imu import COLUMNS, Imu

# Stretches over which the size of the force is compared, at most. Chosen: they show a drift.
_WINDOWS = 20
_AXIS_NAMES = ("+x", "+y", "+z", "-x", "-y", "-z")


def force_findings(imu: Imu, body_axes: BodyAxes) -> Iterator[Finding]:
    """Yield whether the specific force has the size and direction of gravity."""
    size = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    interval = float(np.median(np.diff(imu.time))) if imu.time.size > 1 else np.nan
    for unit, gravity in (
        (message("force_unit.multiply", unit="g", factor="9.80665"), 1.0),
        (message("force_unit.multiply", unit="mg", factor="0.00980665"), 1000.0),
        (
            message("force_unit.multiply", unit="ft/s²", factor="0.3048"),
            STANDARD_GRAVITY / 0.3048,
        ),
        (message("force_unit.increments"), STANDARD_GRAVITY * interval),
    ):
        if abs(size / gravity - 1.0) < 0.05:
            text = message("force_unit.looks_like", size=size, unit=unit)
            yield Finding(Code.FORCE_UNIT, text, "IMU", severity="error")
            return
    if abs(size / STANDARD_GRAVITY - 1.0) > 0.05:
        text = message("force_unit.removed" if size < 3.0 else "force_unit.wrong", size=size)
        yield Finding(Code.FORCE_UNIT, text, "IMU", severity="error")
        return
    yield Finding(Code.FORCE_UNIT, message("force_unit.right", size=size), "IMU", severity="ok")
    yield from _axes_findings(imu, body_axes)


def _axes_findings(imu: Imu, body_axes: BodyAxes) -> Iterator[Finding]:
    mean = imu.accel.mean(axis=0)
    mean /= np.linalg.norm(mean)
    up_b = -frd_from_body(body_axes)[2]
    tilt = float(np.degrees(np.arccos(np.clip(mean @ up_b, -1.0, 1.0))))
    if tilt < 30.0:
        yield Finding(
            Code.BODY_AXES,
            message("body_axes.fit", axes=body_axes, tilt=tilt),
            "IMU",
            severity="ok",
        )
        return
    k = int(np.argmax(np.concatenate([mean, -mean])))
    expected = _AXIS_NAMES[int(np.argmax(np.concatenate([up_b, -up_b])))]
    upside_down = tilt > 150.0
    if upside_down:
        other = either(["RFU", "FLU"] if body_axes == "FRD" else ["FRD"])
        question = message("body_axes.other", axes=other)
    else:
        question = message("body_axes.off_level", tilt=tilt)
    text = message(
        "body_axes.points_along",
        along=_AXIS_NAMES[k],
        axes=body_axes,
        expected=expected,
        question=question,
    )
    yield Finding(Code.BODY_AXES, text, "IMU", severity="error" if upside_down else "warning")


def gyro_findings(imu: Imu) -> Iterator[Finding]:
    """Yield whether the angular rate turns the specific force as it should."""
    rms = float(np.sqrt(np.mean(np.sum(imu.gyro**2, axis=1))))
    if rms == 0.0:
        yield Finding(Code.GYRO_FROZEN, message("gyro_frozen.zero"), "IMU", severity="error")
        return
    loss = 1.0 - _force_steadiness(imu, np.eye(3))
    # Turned by a right gyro, the force keeps the direction of gravity.
    cause = _steadier(imu, 0.25 * loss) if loss > 0.001 else None
    if cause is not None:
        text = message("gyro_unit.contradicts", cause=cause)
        yield Finding(Code.GYRO_UNIT, text, "IMU", severity="error")
    elif rms > 3.0:
        text = message("gyro_unit.fast", rate=rms)
        yield Finding(Code.GYRO_UNIT, text, "IMU", severity="error")
    else:
        text = message("gyro_unit.right", rate=rms / DEG)
        yield Finding(Code.GYRO_UNIT, text, "IMU", severity="ok")


def _steadier(imu: Imu, enough: float) -> Message | None:
    """Return what the angular rate looks like if that turns the force better, else None."""
    eye = np.eye(3)
    rate = 1.0 / float(np.median(np.diff(imu.time))) if imu.time.size > 1 else 1.0
    candidates = {
        message("gyro_unit.in_degrees"): DEG * eye,
        message("gyro_unit.in_increments"): rate * eye,
        message("gyro_unit.opposite"): -eye,
    }
    # Turned about a horizontal axis, a mirrored force looks the same.
    up = int(np.argmax(np.abs(imu.accel.mean(axis=0))))
    for k in range(3):
        text = message("gyro_unit.as_if", axes=in_words(mirrored(k)))
        if k != up:
            (other,) = {0, 1, 2} - {up, k}
            text = message("gyro_unit.as_if_or", axis=NAMES[k], other=NAMES[other])
        candidates[text] = mirrored(k)
        candidates[message("gyro_unit.as_if", axes=in_words(swapped(k)))] = swapped(k)
    losses = {text: 1.0 - _force_steadiness(imu, matrix) for text, matrix in candidates.items()}
    best = min(losses, key=lambda text: losses[text])
    return best if losses[best] < enough else None


def _force_steadiness(imu: Imu, matrix: Array) -> float:
    """Return how well the force keeps its direction over 10 s when turned by matrix gyro.

    The ratio |mean of C f| / mean of |f|, averaged over windows; 1 = perfectly.
    """
    interval = float(np.median(np.diff(imu.time))) if imu.time.size > 1 else 1.0
    size = int(min(max(2, round(WINDOW_S / interval)), imu.time.size, 4000))
    starts = np.unique(np.linspace(0, imu.time.size - size, _WINDOWS).astype(int))
    rows = starts[:, None] + np.arange(size)
    turns = exp_so3(imu.gyro[rows] @ matrix.T * interval)
    attitude = np.broadcast_to(np.eye(3), (starts.size, 3, 3))
    total = np.zeros((starts.size, 3))
    for k in range(size):
        attitude = attitude @ turns[:, k]
        total += np.einsum("wij,wj->wi", attitude, imu.accel[rows[:, k]])
    magnitude = np.linalg.norm(imu.accel[rows], axis=2).sum(axis=1)
    return float(np.mean(np.linalg.norm(total, axis=1) / magnitude))


# Samples that repeat, of all channels and of a single one, from which on they are frozen, and for
# how long at least, s. Chosen: digits of a quiet gyro repeat for a while.
_ALL = 20
_SINGLE = 100
_LEAST_S = 0.5
# Samples at the very end of a channel's range, in all, in one run, and against those at the next
# value, from which on it is saturated. Chosen: the largest of many digits is met once or twice.
_AT_THE_END = 20
_RUN = 3
_PILED = 5.0
# Deviation from the mean of both neighbours, in the usual one, that makes a spike, and spikes that
# are no chance. Chosen: white noise reaches 7 in an hour at 100 Hz; blows last several samples.
_SPIKE = 30.0
_SPIKES = 3
# Share of the variance of the integrated noise that spikes must add. Chosen: below it they change
# neither attitude nor velocity by a σ. A blow on a hull added 0.09 to six minutes.
_ADDED = 0.25
# The same of fewer spikes than that. Chosen: ten blows such as that one, in one sample.
_ADDED_BY_FEW = 9.0
# Interval from which on it is a gap, in usual ones.
_GAP = 1.5
# Square of the median deviation from the mean of both neighbours, over the variance of noise.
_MEDIAN_SQUARED = 1.5 * 0.6745**2


def channel_findings(imu: Imu) -> Iterator[Finding]:
    """Yield channels that do not measure, always or for a while."""
    channels = [*imu.gyro.T, *imu.accel.T]
    moves = np.array([np.ptp(channel) > 0.0 for channel in channels])
    if imu.time.size < _SINGLE or not moves.any():
        return
    constant = [k for k in range(6) if not moves[k]]
    if not moves[:3].any():
        # That all three gyros rest is a finding of its own.
        constant = [k for k in constant if k >= 3]
    if constant:
        found = [
            message("words.is_always", name=COLUMNS[k + 1], value=channels[k][0]) for k in constant
        ]
        text = message("imu_channel.constant", channels=found)
        yield Finding(Code.IMU_CHANNEL, text, "IMU", severity="error")
    ends = [e for k in np.flatnonzero(moves).tolist() for e in _ends(COLUMNS[k + 1], channels[k])]
    if ends:
        text = message("saturated.ends", ends=ends)
        yield Finding(Code.SATURATED, text, "IMU", severity="error")
    moving = [channels[k] for k in np.flatnonzero(moves).tolist()]
    yield from _spikes(moving)
    yield from _jitter(imu)
    same = [np.diff(channel) == 0.0 for channel in moving]
    interval = float(np.median(np.diff(imu.time)))
    begin, length = _longest(np.logical_and.reduce(same))
    if length >= max(_ALL, _LEAST_S / interval):
        yield _frozen(message("frozen_values.all"), imu, begin, length)
        return
    for what, some in (
        (message("frozen_values.gyros"), slice(0, 3)),
        (message("frozen_values.accelerometers"), slice(3, 6)),
    ):
        frozen = frozen_samples(channels[some]) & moves[some].all()
        begin, length = _longest(frozen[1:])
        if length:
            yield _frozen(what, imu, begin, length)
            return
    for column, k in enumerate(np.flatnonzero(moves).tolist()):
        begin, length = _longest(same[column])
        if length >= max(_SINGLE, 2.0 * _LEAST_S / interval):
            what = message("frozen_values.one", name=COLUMNS[k + 1])
            yield _frozen(what, imu, begin, length)


def _spikes(channels: Sequence[Array]) -> Iterator[Finding]:
    """Yield that single samples stand out from those before and after."""
    if channels[0].size < 2 * _ALL:
        return
    spikes = [_spikes_of(channel) for channel in channels]
    ratio = np.concatenate([size for _, size in spikes])
    count = np.unique(np.concatenate([place for place, _ in spikes])).size
    squares = max(float(np.sum(np.square(size))) for _, size in spikes)
    added = _MEDIAN_SQUARED * squares / (channels[0].size - 4)
    if added > (_ADDED if count >= _SPIKES else _ADDED_BY_FEW):
        yield Finding(
            Code.IMU_SPIKES,
            message("imu_spikes.single", count=count, size=ratio.max()),
            "IMU",
            severity="error",
        )


def _spikes_of(channel: Array) -> tuple[IntArray, Array]:
    """Return where single samples of a channel stand out, and by how many usual deviations."""
    signed = channel[1:-1] - 0.5 * (channel[2:] + channel[:-2])
    deviation = np.abs(signed)
    rounding = np.finfo(float).eps * np.abs(channel).max()
    usual = np.maximum(np.median(deviation), rounding)
    place = np.flatnonzero(deviation[1:-1] > _SPIKE * usual)
    spike = signed[place + 1]
    # A spike makes both its neighbours deviate half as much to the other side; a corner does not.
    alone = [
        np.abs(signed[place + beside] + 0.5 * spike) < 0.2 * np.abs(spike) for beside in (0, 2)
    ]
    hit = alone[0] & alone[1]
    return place[hit], np.abs(spike[hit]) / usual


def _jitter(imu: Imu) -> Iterator[Finding]:
    """Yield that stamps scatter about an even grid, and move the motion between them.

    A stamp that is late by d gives d of the change of the rate to the wrong sample, which adds to
    the noise that an attitude integrates.
    """
    interval = np.diff(imu.time)
    usual = float(np.median(interval))
    whole = (interval[1:] < _GAP * usual) & (interval[:-1] < _GAP * usual)
    if np.count_nonzero(whole) < _SINGLE:
        return
    squared = float(np.median(np.diff(interval)[whole] ** 2)) / (4.0 * _MEDIAN_SQUARED)
    settings = imu.settings
    added = max(
        squared * float(np.mean(np.diff(values, axis=0) ** 2, axis=0).max()) / (psd**2 * usual)
        for values, psd in (
            (imu.gyro, settings.gyro_noise_root_psd),
            (imu.accel, settings.accel_noise_root_psd),
        )
    )
    if added > _ADDED:
        text = message(
            "clock_jitter.scatter",
            scatter_ms=1e3 * np.sqrt(squared),
            interval_ms=1e3 * usual,
            added=added,
        )
        yield Finding(Code.CLOCK_JITTER, text, "IMU", severity="error")


def _ends(name: str, values: Array) -> Iterator[Message]:
    """Yield the ends of a channel's range at which samples pile up."""
    for end, key in ((values.max(), "saturated.above"), (values.min(), "saturated.below")):
        at_end = values == end
        count = int(at_end.sum())
        if count < _AT_THE_END or _longest(at_end)[1] < _RUN:
            continue
        others = values[~at_end]
        following = others.max() if end == values.max() else others.min()
        if count > _PILED * np.count_nonzero(others == following):
            yield message(key, name=name, end=end, count=count)


def _frozen(what: Message, imu: Imu, begin: int, length: int) -> Finding:
    start, end = imu.time[begin], imu.time[begin + length]
    return Finding(
        Code.FROZEN_VALUES,
        message("frozen_values.repeat", what=what, start=start, end=end),
        "IMU",
        severity="error",
    )


def _longest(true: BoolArray) -> tuple[int, int]:
    """Return where the longest run of true begins, and its length."""
    begin, end = runs(true)
    if begin.size == 0:
        return 0, 0
    k = int(np.argmax(end - begin))
    return int(begin[k]), int(end[k] - begin[k])


# The comparisons that there are, each with the offset of its clock around which to look.
Compare = Callable[[CarriedWindows], Sequence[tuple[Comparison, float]]]

# Windows in which candidates are compared. Chosen: six minutes separate them.
_COMPARED_WINDOWS = 9
# Cosine of the angle between gravity and down up to which a body is upright. Chosen: 45°.
UPRIGHT = 0.7
# Share of velocity changes that neither IMU nor noise explains, from which on sensors contradict
# the IMU. Chosen: what good trials leave.
CONTRADICTS = 0.1
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
    windows = carried_windows(imu, _COMPARED_WINDOWS)
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
        Up in body, by `body_axes`: gravity that is right already is not to be turned.
    """
    nominal = _misfits(compare, imu, _FINE_S)
    if nominal is None or nominal.excess.max() == 0.0:
        return []
    force = imu.accel.mean(axis=0)
    least = min(float(up_b @ force), UPRIGHT * float(np.linalg.norm(force)))
    upright = [c for c in candidates(imu) if up_b @ c.accel @ force >= least]
    worst, anything = int(np.argmax(nominal.excess)), np.full(nominal.excess.size, np.inf)
    found = _ranked(compare, imu, upright, worst, anything, _COARSE_S)[:_TRIED]
    best = [candidate for *_, candidate in found]
    # By a right candidate, no other sensor contradicts the IMU.
    most = np.maximum(nominal.excess, CONTRADICTS)
    found = _ranked(compare, imu, best, worst, most, _FINE_S)
    if not found:
        return []
    least, left, _ = found[0]
    if nominal.total - least < _GAIN or left > _LEFT * float(nominal.excess.max()):
        return []
    return [candidate for total, _, candidate in found if total < least + _GAIN]


def _ranked(
    compare: Compare,
    imu: Imu,
    tried: Iterable[Candidate],
    worst: int,
    most: Array,
    step: float,
) -> list[tuple[float, float, Candidate]]:
    """Return misfit, and excess of the worst comparison, of candidates, the best first.

    Those with more than the `most` that each comparison may leave are left out.
    """
    found = []
    for candidate in tried:
        misfits = _misfits(compare, candidate.corrected(imu), step)
        if misfits is None or misfits.excess.size <= worst:
            continue
        if misfits.excess.size != most.size or np.all(misfits.excess <= most):
            found.append((misfits.total, float(misfits.excess[worst]), candidate))
    return sorted(found, key=lambda each: each[0])
