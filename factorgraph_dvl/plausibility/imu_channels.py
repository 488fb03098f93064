"""Whether each channel of an IMU measures: constant, frozen, saturated, spikes, jitter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.invalid_values import frozen_samples, runs
from factorgraph_dvl.sensors.imu import COLUMNS, Imu

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
