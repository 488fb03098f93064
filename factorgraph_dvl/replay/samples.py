"""The IMU's samples as they arrive: put in order, checked, and cut into segments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.conventions import Array
from factorgraph_dvl.increments import MAX_FILLED, increments
from factorgraph_dvl.preintegration import Segments, one_segment
from factorgraph_dvl.sensors.imu import Imu, ImuSettings

# Samples on each side of a segment that its polynomials may reach for.
_SIDE = 8
# Samples in a row that are older than those before, from which on the clock has jumped.
_JUMPED = 20
_LEAST = 6
# Times closer than this, s, are the same.
_SAME_TIME = 1e-6


@dataclass(frozen=True)
class Gap:
    """A gap of the record: times of the samples before and after, s."""

    before: float
    after: float


class Samples:
    """A buffer of samples, as long as segments reach back.

    Parameters
    ----------
    settings : of the IMU.
    """

    def __init__(self, settings: ImuSettings) -> None:
        self._settings = settings
        self._table = np.empty((0, 7))
        self._stale: list[Array] = []
        self.dt = 0.0
        self.windows: tuple[int, int] = (0, 0)
        self.refused = 0
        self.duplicates = 0

    @property
    def newest(self) -> float:
        """Time of the newest sample, s."""
        return float(self._table[-1, 0]) if self._table.size else -np.inf

    @property
    def side(self) -> int:
        """Samples needed after a segment before it can be integrated."""
        return _SIDE + max(self.windows) // 2

    @property
    def delay(self) -> float:
        """The same in time, s."""
        return self.side * self.dt

    def add(self, table: Array) -> tuple[Array, float]:
        """Take samples (N, 7): time, rate, force.

        Returns
        -------
        those that are used, (M, 7), and by how much the clock was found to have jumped back,
        s; 0 = not.
        """
        good = np.all(np.isfinite(table), axis=1)
        self.refused += int((~good).sum())
        table = table[good]
        if table.shape[0] == 0:
            return table, 0.0
        jump = 0.0
        if table[0, 0] <= self.newest or np.any(np.diff(table[:, 0]) <= 0.0):
            table, jump = self._ordered(table)
        if table.shape[0]:
            self._table = np.concatenate([self._table, table])
            if self.dt == 0.0 and self._table.shape[0] >= 100:
                self.dt = float(np.median(np.diff(self._table[:, 0])))
        return table, jump

    def _ordered(self, table: Array) -> tuple[Array, float]:
        """Return samples that are newer than all before, once the clock has been set right."""
        kept: list[Array] = []
        newest, jump = self.newest, 0.0
        for row in table:
            row = row.copy()
            row[0] += jump
            if row[0] > newest:
                newest = float(row[0])
                kept.append(row)
                self._stale.clear()
                continue
            if row[0] == newest:
                self.duplicates += 1
                continue
            if self._stale and row[0] <= self._stale[-1][0]:
                self._stale.clear()
            self._stale.append(row)
            self.refused += 1
            if len(self._stale) >= _JUMPED:
                # They go on as if they had followed at once.
                jump += newest + self.dt - float(self._stale[0][0])
                self.refused -= len(self._stale)
                shift = newest + self.dt - float(self._stale[0][0])
                for old in self._stale:
                    old[0] += shift
                    kept.append(old)
                newest = float(kept[-1][0])
                self._stale = []
        return np.array(kept).reshape(-1, 7), jump

    def gap_after(self, time: float) -> Gap | None:
        """Return the first gap after a time, None if there is none."""
        if self.dt == 0.0:
            return None
        t = self._table[:, 0]
        wide = np.flatnonzero((np.diff(t) > (MAX_FILLED + 1.5) * self.dt) & (t[1:] > time))
        if wide.size == 0:
            return None
        return Gap(float(t[wide[0]]), float(t[wide[0] + 1]))

    def segment(self, start: float, end: float) -> Segments | None:
        """Return the segment between the samples nearest to two times, None if it is empty."""
        t = self._table[:, 0]
        gap = self.gap_after(start)
        count = t.size if gap is None else int(np.searchsorted(t, gap.before, side="right"))
        a = int(np.argmin(np.abs(t[:count] - start)))
        b = int(np.argmin(np.abs(t[:count] - end)))
        if b <= a:
            return None
        low, high = max(a - self.side, 0), min(b + self.side + 1, count)
        if high - low < _LEAST:
            return None
        part = self._table[low:high]
        imu = Imu(self._settings, part[:, 0], part[:, 1:4], part[:, 4:7])
        inc, _ = increments(imu, self.windows)
        first = int(np.argmin(np.abs(inc.start - t[a])))
        last = int(np.argmin(np.abs(inc.end - t[b]))) + 1
        return one_segment(inc, first, last)

    def until(self, time: float) -> float:
        """Return the time of the newest sample at or before a time, s."""
        i = int(np.searchsorted(self._table[:, 0], time + _SAME_TIME, side="right"))
        return float(self._table[i - 1, 0])

    def forget(self, time: float) -> None:
        """Drop what no segment that starts at `time` or later needs."""
        first = int(np.searchsorted(self._table[:, 0], time)) - self.side - 1
        if first > 0:
            self._table = self._table[first:]

    def set_back(self, since: float, by: float) -> None:
        """Move the samples at and after a time by some seconds into the past."""
        later = self._table[:, 0] >= since
        self._table = self._table.copy()
        self._table[later, 0] -= by

    def since(self, time: float) -> Array:
        """Return the samples at and after a time, (M, 7)."""
        return self._table[np.searchsorted(self._table[:, 0], time) :]
