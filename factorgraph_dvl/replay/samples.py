"""The IMU's samples as they arrive: put in order, checked, and cut into segments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.increments import MAX_FILLED, increments
from factorgraph_dvl.imu.preintegration import Segments, one_segment
from factorgraph_dvl.imu.timestamps import unrounded
from factorgraph_dvl.sensors.imu import Imu, ImuSettings

# Samples on each side of a segment that its polynomials may reach for.
_SIDE = 8
# Samples in a row that are older than those before, from which on the clock has jumped.
_JUMPED = 20
# Fewer samples than these cannot be integrated.
LEAST = 6
# Samples whose stamps tell the rate of the clock: stamps in milliseconds leave 1e-6 of it
# open, where those of a single segment leave 4e-3.
_CLOCK = 2000
# Times closer than this, s, are the same.
_SAME_TIME = 1e-6


@dataclass(frozen=True)
class Gap:
    """A gap of the record: times of the samples before and after, s."""

    before: float
    after: float


class SampleBuffer:
    """A buffer of samples, as long as segments reach back.

    Parameters
    ----------
    settings : ImuSettings
        Of the IMU.
    """

    def __init__(self, settings: ImuSettings) -> None:
        self._settings = settings
        self._table = np.empty((0, 7))
        self._stale: list[Array] = []
        self.dt = 0.0
        self.windows: tuple[int, int] = (0, 0)
        self.refused = 0
        self.duplicates = 0
        self.interpolated = 0

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
        wide = np.flatnonzero(self._wide(t) & (t > time))
        if wide.size == 0:
            return None
        return Gap(float(t[wide[0] - 1]), float(t[wide[0]]))

    def segment_after(
        self, start: float, interval: float, wanted: float, *, end: bool
    ) -> Segments | Gap | None:
        """Return the segment from the sample nearest to a time to a later one.

        Sample times t fall into cells, floor((t + dt / 2) / interval). A segment ends at the
        first sample of a later cell than its start's, so it always ends after it: the same
        rounding decides where it starts and where it ends.

        Parameters
        ----------
        start : float
            S.
        interval : float
            Of the segments, s.
        wanted : float
            Time, s, before which the segment ends if it is in it.
        end : bool
            Whether no more samples come.

        Returns
        -------
        The segment; the gap that follows the start at once; None if the samples have not come
        so far.
        """
        t = self._table[:, 0]
        gap = self.gap_after(start)
        count = t.size if gap is None else int(np.searchsorted(t, gap.before, side="right"))
        complete = end or gap is not None
        a = int(np.argmin(np.abs(t[:count] - start)))
        if a + 1 >= count:
            return gap
        cell = np.floor((t[a:count] + 0.5 * self.dt) / interval)
        later = np.flatnonzero(cell > cell[0])
        if later.size == 0 and not complete:
            return None
        b = a + int(later[0]) if later.size else count - 1
        before = int(np.searchsorted(t, wanted + _SAME_TIME, side="right")) - 1
        if a < before < b:
            b = before
        if not complete and b + self.side >= count:
            return None
        begin = int(np.max(np.flatnonzero(self._wide(t[: a + 1])), initial=0))
        low, high = max(a - self.side, begin), min(b + self.side + 1, count)
        if high - low < LEAST:
            return gap
        time = self._regular(t[begin:high])[low - begin :]
        part = self._table[low:high]
        imu = Imu(self._settings, time, part[:, 1:4], part[:, 4:7])
        inc, _ = increments(imu, self.windows)
        first = int(np.argmin(np.abs(inc.start - time[a - low])))
        last = int(np.argmin(np.abs(inc.end - time[b - low]))) + 1
        self.interpolated += last - first - (b - a)
        return one_segment(inc, first, last)

    def _wide(self, time: Array) -> np.ndarray:
        """Whether a gap is before each of some samples."""
        return np.diff(time, prepend=time[:1]) > (MAX_FILLED + 1.5) * self.dt

    def _regular(self, time: Array) -> Array:
        """Return stamps without gaps as `increments` takes those of a whole record."""
        steps = np.rint(np.diff(time, prepend=time[:1]) / self.dt)
        return np.asarray(time[0] + unrounded(time, np.cumsum(np.maximum(steps, 1.0))))

    def forget(self, time: float) -> None:
        """Drop what no segment that starts at `time` or later needs."""
        first = int(np.searchsorted(self._table[:, 0], time)) - max(_CLOCK, self.side + 1)
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
