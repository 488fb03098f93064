"""Streams of one kind in one order of time: overlaps, repeats, gaps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.files.importing.spool import CHUNK
from factorgraph_dvl.files.importing.time_base import Timed
from factorgraph_dvl.geometry.vectors import Array

# Records by which a stream is judged. Chosen: enough for shares of a percent.
SAMPLE = 20_000
# Difference of stamps, s, that is one instant. Chosen: the digits of formats.
_SAME = 1e-3
# Usual intervals that make a gap. Chosen: some lost samples are none.
_GAP = 10.0
# Intervals that say what is usual. Chosen: some MB.
_USUAL = 1 << 20


@dataclass(frozen=True)
class Merged:
    """Records in the order of strictly increasing times.

    Parameters
    ----------
    streams : tuple of Timed
        Where they are.
    count : int
        Their number N.
    sample_time : ndarray, shape (M,), s
        UTC of records, evenly thinned out to about `SAMPLE`.
    sample : Records
        (M,) these records.
    """

    streams: tuple[Timed, ...]
    count: int
    sample_time: Array
    sample: Records

    def chunks(self) -> Iterator[tuple[Array, Records]]:
        """Yield times (M,) and records (M,), some `CHUNK`s at a time."""
        return _without_repeats(self.streams)

    @property
    def offset_std(self) -> float:
        """Largest of what may be left of an offset, s."""
        return max(timed.offset_std for timed in self.streams)

    @property
    def rate_std(self) -> float:
        """Largest of what may be left of a rate, ppm."""
        return max(timed.rate_std for timed in self.streams)

    @property
    def label(self) -> str:
        """Names of the sources, for people."""
        return ", ".join(dict.fromkeys(timed.stream.label for timed in self.streams))


class Beside:
    """Records of one source at the times of another, as both are read in order.

    Parameters
    ----------
    merged : Merged
        The source.
    margin : float, s
        What is wanted before and behind these times.
    """

    def __init__(self, merged: Merged, margin: float = 0.0) -> None:
        self._chunks, self._margin = merged.chunks(), margin
        self._time, self._records = merged.sample_time[:0], merged.sample[:0]

    def around(self, time: Array) -> tuple[Array, Records]:
        """Return times and records around times (N,), with one more on each side.

        Parameters
        ----------
        time : ndarray, shape (N,), s
            Times in order, and behind those of the call before.
        """
        begin, end = time[0] - self._margin, time[-1] + self._margin
        while not len(self._time) or self._time[-1] <= end:
            more = next(self._chunks, None)
            if more is None:
                break
            self._time = np.concatenate([self._time, more[0]])
            self._records = np.concatenate([self._records, more[1]])
        first = max(int(np.searchsorted(self._time, begin)) - 1, 0)
        self._time, self._records = self._time[first:], self._records[first:]
        return self._time, self._records


def merge(streams: Sequence[Timed], decisions: Decisions) -> Merged | None:
    """Put records of one kind in order.

    Records at the time of another one are dropped: repeats, as of files that overlap, and of
    those that differ all but the first.

    Parameters
    ----------
    streams : sequence of Timed
        Streams of one kind.
    decisions : Decisions
        Takes counts of what was dropped, and gaps.

    Returns
    -------
    Merged or None
        None if no record has a time.
    """
    if not streams:
        return None
    total, known = (sum(n) for n in zip(*((len(t.time), t.known) for t in streams), strict=True))
    label = ", ".join(dict.fromkeys(timed.stream.label for timed in streams))
    if known < total:
        decisions.add(label, f"{total - known} records without a time were left out")
    if not known:
        return None
    thin = max(known // SAMPLE, 1)
    count, times, parts, intervals = 0, [], [], _Intervals()
    for time, records in _without_repeats(streams):
        begin = -count % thin
        # Views would keep all records.
        times.append(time[begin::thin].copy())
        parts.append(records[begin::thin].copy())
        intervals.add(time)
        count += len(time)
    if count < known:
        decisions.add(label, f"{known - count} records repeat the time of another one: left out")
    if text := str(intervals):
        decisions.add(label, text)
    return Merged(tuple(streams), count, np.concatenate(times), np.concatenate(parts))


def _without_repeats(streams: Sequence[Timed]) -> Iterator[tuple[Array, Records]]:
    last = -np.inf
    for time, records in _in_order(streams):
        if len(time):
            keep = np.diff(time, prepend=last) > _SAME
            last = time[-1]
            if keep.any():
                yield time[keep], records[keep]


def _in_order(streams: Sequence[Timed]) -> Iterator[tuple[Array, Records]]:
    """Yield the records that have a time in its order, from as few chunks as are out of order."""
    blocks = sorted(
        (first, which, start)
        for which, timed in enumerate(streams)
        for first, start in timed.blocks
    )
    # Columns: time, whether it lacks when it was received, stream, place, record.
    waiting = [np.empty(0), np.empty(0, bool), np.empty(0, int), np.empty(0, int)]
    records = streams[0].stream.records[:0]
    following = [first for first, _, _ in blocks[1:]] + [np.inf]
    for (_, which, start), limit in zip(blocks, following, strict=True):
        chunk = slice(start, start + CHUNK)
        time, part = streams[which].time[chunk], streams[which].stream.records[chunk]
        place = np.flatnonzero(np.isfinite(time))
        part = part[place]
        new = (time[place], np.isnan(part["received"]), np.full(len(place), which), start + place)
        waiting = [np.concatenate(pair) for pair in zip(waiting, new, strict=True)]
        records = np.concatenate([records, part])
        # Where two have one time, the one that says when it was received comes first.
        instant = np.round(waiting[0] / _SAME)
        order = np.lexsort((*reversed(waiting[1:]), instant))
        is_final = (instant < np.round(limit / _SAME))[order]
        yield waiting[0][order[is_final]], records[order[is_final]]
        rest = order[~is_final]
        waiting, records = [column[rest] for column in waiting], records[rest]


class _Intervals:
    """Intervals between times, as these come: which are gaps."""

    def __init__(self) -> None:
        self._last, self._first = np.nan, [np.empty(0)]
        self._limit = np.nan
        self._gaps = [np.empty(0)]

    def add(self, time: Array) -> None:
        """Add times in order."""
        steps = np.diff(time, prepend=self._last)
        self._last = time[-1]
        steps = steps[np.isfinite(steps)]
        if np.isnan(self._limit):
            self._first.append(steps)
            if sum(map(len, self._first)) >= _USUAL:
                self._close()
        else:
            self._gaps.append(steps[steps > self._limit])

    def _close(self) -> None:
        first = np.concatenate(self._first)
        if len(first):
            self._limit = _GAP * float(np.median(first))
            self._gaps = [first[first > self._limit]]
        self._first = []

    def __str__(self) -> str:
        """Return a sentence about gaps, empty if there are none."""
        if self._first:
            self._close()
        gaps = np.concatenate(self._gaps)
        if not len(gaps):
            return ""
        if len(gaps) == 1:
            return f"1 gap of {gaps[0]:.3g} s"
        return (
            f"{len(gaps)} gaps longer than {self._limit:.3g} s, {gaps.sum():.3g} s in all, the "
            f"longest {gaps.max():.3g} s"
        )
