"""Whether each channel of an IMU measures: frozen and constant ones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.imu import COLUMNS, Imu

# Samples that repeat, of all channels and of a single one, from which on they are frozen, and for
# how long at least, s. Chosen: digits of a quiet gyro repeat for a while.
_ALL = 20
_SINGLE = 100
_LEAST_S = 0.5


def channel_findings(imu: Imu) -> Iterator[Finding]:
    """Yield channels that do not measure, always or for a while."""
    values = np.concatenate([imu.gyro, imu.accel], axis=1)
    moves = np.ptp(values, axis=0) > 0.0
    if imu.time.size < _SINGLE or not moves.any():
        return
    constant = [k for k in range(6) if not moves[k]]
    if not moves[:3].any():
        # That all three gyros rest is a finding of its own.
        constant = [k for k in constant if k >= 3]
    if constant:
        names = ", ".join(f"{COLUMNS[k + 1]} is always {values[0, k]:g}" for k in constant)
        yield Finding(Code.IMU_CHANNEL, names, "IMU", severity="error")
    same = np.diff(values[:, moves], axis=0) == 0.0
    interval = float(np.median(np.diff(imu.time)))
    begin, length = _longest(same.all(axis=1))
    if length >= max(_ALL, _LEAST_S / interval):
        yield _frozen("all its channels repeat", imu, begin, length)
        return
    for column, k in enumerate(np.flatnonzero(moves).tolist()):
        begin, length = _longest(same[:, column])
        if length >= max(_SINGLE, 2.0 * _LEAST_S / interval):
            yield _frozen(f"{COLUMNS[k + 1]} repeats", imu, begin, length)


def _frozen(what: str, imu: Imu, begin: int, length: int) -> Finding:
    start, end = imu.time[begin], imu.time[begin + length]
    return Finding(
        Code.FROZEN_VALUES,
        f"{what} one value from {start:.1f} to {end:.1f} s: leave such rows out",
        "IMU",
        severity="error",
    )


def _longest(true: Array) -> tuple[int, int]:
    """Return where the longest run of true begins, and its length."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], true.astype(int), [0]])))
    if edges.size == 0:
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    k = int(np.argmax(lengths))
    return int(edges[2 * k]), int(lengths[k])
