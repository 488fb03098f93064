"""Samples of the IMU as they arrive: put in order, checked, and cut into segments."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.imu.increments import MAX_FILLED, increments, unbroken_increments
from factorgraph_dvl.imu.preintegration import Segments, one_segment
from factorgraph_dvl.imu.timestamps import unrounded
from factorgraph_dvl.sensors.imu import Imu, ImuSettings, within_limits

# Samples on each side of a segment that its polynomials may use; chosen: twice their degree.
_SIDE = 8
# Consecutive samples older than those before that show a jump of the clock; chosen: samples that
# merely come out of order are fewer.
_JUMPED = 20
# Fewest samples that can be integrated; the polynomials need them.
LEAST = 6
# Samples by which the sample interval is first estimated; chosen: 1 s at 100 Hz.
_INTERVAL = 100
# Samples whose stamps give the rate of the clock. Measured: stamps in milliseconds leave 1e-6 of
# it open, where those of a single segment leave 4e-3.
_CLOCK = 2000
# Times closer than this, s, are the same; chosen: the resolution of stamps in microseconds.
_SAME_TIME = 1e-6


@dataclass(frozen=True)
class Gap:
    """A gap of the record.

    Parameters
    ----------
    before, after : float
        Times of the samples before and after it, s.
    """

    before: float
    after: float


def _are_possible(table: Array) -> bool:
    """Whether samples are numbers that an IMU can measure."""
    return within_limits(table[:, 1:4], table[:, 4:7]) and bool(np.isfinite(table[:, 0]).all())


class SampleBuffer:
    """Buffer of samples, as long as segments reach back.

    Parameters
    ----------
    settings : ImuSettings or None
        Settings of the IMU; None of a trial without one.

    Attributes
    ----------
    dt : float
        Sample interval, s; 0 until it is known.
    smoothing : tuple of (int, int)
        How gyros and accelerometers are smoothed.
    longest : float
        Length of the longest window over which a sensor averages, s.
    rejected, interpolated : int
        Number of samples that were not used, and of those that were lost and interpolated.
    """

    def __init__(self, settings: ImuSettings | None) -> None:
        self._settings = settings
        self._table = np.empty((0, 7))
        # Their times in a row of memory; and their numbers, lost ones counted, once `dt` is known.
        self._time, self._number = np.empty((2, 0))
        self._stale: list[Array] = []
        self.dt = 0.0
        self.smoothing = 0, 0
        self.longest = 0.0
        self.rejected = 0
        self.interpolated = 0

    @property
    def newest(self) -> float:
        """Time of the newest sample, s."""
        return float(self._time[-1]) if self._time.size else -np.inf

    @property
    def side(self) -> int:
        """Samples needed after a segment before it can be integrated."""
        return self._near + max(self.smoothing) // 2

    @property
    def _near(self) -> int:
        """Samples beside a segment that its polynomials, and windows about its times, reach."""
        averaged = math.ceil(0.5 * self.longest / self.dt) if self.longest else 0
        return _SIDE + averaged

    @property
    def delay(self) -> float:
        """Time needed after a segment before it can be integrated, s."""
        return self.side * self.dt

    def add(self, table: Array) -> tuple[Array, float]:
        """Add samples (N, 7): time, angular rate, specific force.

        Returns
        -------
        ndarray, shape (M, 7)
            Those that are used.
        float
            Jump of the clock back, s; 0 if there was none.
        """
        if self._settings is None:
            raise ConfigError(
                "the trial has no IMU", where="trial.yaml", expected="an imu section"
            )
        if table.shape[0] and not _are_possible(table):
            good = np.all(np.isfinite(table), axis=1)
            self.rejected += int((~good).sum())
            table = table[good]
            if table.shape[0] and not _are_possible(table):
                # The error says what is not.
                Imu(self._settings, table[:1, 0], table[:, 1:4], table[:, 4:7])
        if table.shape[0] == 0:
            return table, 0.0
        jump = 0.0
        if table[0, 0] <= self.newest or (table[1:, 0] <= table[:-1, 0]).any():
            table, jump = self._ordered(table)
        if table.shape[0]:
            self._table = np.concatenate([self._table, table])
            self._time = np.concatenate([self._time, table[:, 0]])
            if self.dt == 0.0 and self._time.size >= _INTERVAL:
                self.dt = float(np.median(np.diff(self._time)))
            if self.dt > 0.0:
                self._count()
        return table, jump

    def _count(self) -> None:
        """Number the samples that have no number yet."""
        known = self._number.size
        first = max(known - 1, 0)
        time = self._time[first:]
        steps = np.rint((time[1:] - time[:-1]) / self.dt)
        last = self._number[-1] if known else 0.0
        if not known:
            steps = np.concatenate([[0.0], steps])
        self._number = np.concatenate([self._number, last + np.maximum(steps, 1.0).cumsum()])

    def _ordered(self, table: Array) -> tuple[Array, float]:
        """Return samples newer than all before, after correction of jumps of the clock back."""
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
                continue
            if self._stale and row[0] <= self._stale[-1][0]:
                self._stale.clear()
            self._stale.append(row)
            self.rejected += 1
            if len(self._stale) >= _JUMPED:
                # Continue as if they had followed at once.
                shift = newest + self.dt - float(self._stale[0][0])
                jump += shift
                self.rejected -= len(self._stale)
                for old in self._stale:
                    old[0] += shift
                    kept.append(old)
                newest = float(kept[-1][0])
                self._stale = []
        return np.array(kept).reshape(-1, 7), jump

    def gap_after(self, time: float) -> Gap | None:
        """Return the first gap after a time, None if there is none."""
        t = self._time
        first = max(int(t.searchsorted(time, side="right")) - 1, 0)
        after = self._after_gaps(slice(first, None))
        if not after.size:
            return None
        return Gap(float(t[first + after[0] - 1]), float(t[first + after[0]]))

    def _after_gaps(self, some: slice) -> IntArray:
        """Return which of some samples in a row follow a gap; none until the interval is known."""
        number = self._number[some]
        if number.size == 0 or number[-1] - number[0] == number.size - 1:
            return np.empty(0, dtype=int)
        return np.flatnonzero(np.diff(number) > MAX_FILLED + 1) + 1

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
            Time, s.
        interval : float
            Interval of the segments, s.
        wanted : float
            Time of an attitude that needs a state, s: a segment that contains it ends there.
        end : bool
            Whether no more samples come.

        Returns
        -------
        Segments or Gap or None
            The segment; the gap that follows the start at once; None if the samples have not
            come so far.
        """
        assert self._settings is not None
        t = self._time
        gap = self.gap_after(start)
        count = t.size if gap is None else int(t.searchsorted(gap.before, side="right"))
        complete = end or gap is not None
        a = min(int(t.searchsorted(start)), count - 1)
        if a and start - t[a - 1] <= t[a] - start:
            a -= 1
        if a + 1 >= count:
            return gap
        cell = np.floor((t[a:count] + 0.5 * self.dt) / interval)
        b = a + int(cell.searchsorted(cell[0], side="right"))
        if b == count:
            if not complete:
                return None
            b = count - 1
        before = int(t.searchsorted(wanted + _SAME_TIME, side="right")) - 1
        if a < before < b:
            b = before
        if not complete and b + self.side >= count:
            return None
        begin = int(self._after_gaps(slice(a + 1)).max(initial=0))
        low, high = max(a - self.side, begin), min(b + self.side + 1, count)
        if high - low < LEAST:
            return gap
        # As `increments` takes the stamps of a whole record.
        regular = unrounded(t[begin:high], self._number[begin:high])
        time = t[begin] + regular[low - begin :]
        part, number = self._table[low:high], self._number[low:high]
        signals = part[:, 1:4], part[:, 4:7]
        if number[-1] - number[0] == high - low - 1:
            # Polynomials need their neighbours only, smoothing all of its window.
            near = slice(max(a - low - self._near, 0), b - low + self._near + 1)
            inc = unbroken_increments(self._settings, time, *signals, self.smoothing, near)
            # Means end at their times.
            before = low + near.start - inc.averaged
            return one_segment(inc, a - before, b - before)
        inc, _ = increments(Imu(self._settings, time, *signals), self.smoothing)
        first = int(np.argmin(np.abs(inc.start - time[a - low])))
        last = int(np.argmin(np.abs(inc.end - time[b - low]))) + 1
        self.interpolated += last - first - (b - a)
        return one_segment(inc, first, last)

    def forget(self, time: float) -> None:
        """Drop what no segment that starts at `time` or later needs."""
        first = int(self._time.searchsorted(time)) - max(_CLOCK, self.side + 1)
        if first > 0:
            self._table, self._time = self._table[first:], self._time[first:]
            self._number = self._number[first:]

    def shift(self, since: float, by: float) -> None:
        """Move the samples at and after a time by some seconds."""
        self._table, self._time = self._table.copy(), self._time.copy()
        self._time[self._time >= since] += by
        self._table[:, 0] = self._time
        self._number = np.empty(0)
        if self.dt > 0.0:
            self._count()

    def since(self, time: float) -> Array:
        """Return the samples at and after a time, (M, 7)."""
        return self._table[self._time.searchsorted(time) :]
