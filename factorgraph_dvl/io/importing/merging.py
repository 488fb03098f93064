"""Streams of one kind in one order of time: overlaps, repeats, gaps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.io.formats.framing import Index, Records
from factorgraph_dvl.io.importing.decisions import Decisions
from factorgraph_dvl.io.importing.time_base import Timed

# Records at a time.
# Records by which a stream is judged. Chosen: enough for shares of a percent.
SAMPLE = 20_000
CHUNK = 100_000
# Difference of stamps, s, that is one instant. Chosen: the digits of formats.
_SAME = 1e-3
# Usual intervals that make a gap. Chosen: some lost samples are none.
_GAP = 10.0


@dataclass(frozen=True)
class Merged:
    """Records in the order of strictly increasing times.

    Parameters
    ----------
    streams : tuple of Timed
        Where they are.
    time : ndarray, shape (N,), s
        UTC.
    order : ndarray of int, shape (N,)
        Their places in all streams, one after the other.
    """

    streams: tuple[Timed, ...]
    time: Array
    order: Index

    def chunks(self, size: int = CHUNK) -> Iterator[tuple[Array, Records]]:
        """Yield times (M,) and records (M,), M at most `size`."""
        for begin in range(0, len(self.order), size):
            part = self.order[begin : begin + size]
            yield self.time[begin : begin + size], self._take(part)

    def sample(self, most: int) -> tuple[Array, Records]:
        """Return times and records, evenly thinned out to about `most`."""
        step = max(len(self.order) // most, 1)
        return self.time[::step], self._take(self.order[::step])

    def _take(self, places: Index) -> Records:
        out = np.empty(len(places), self.streams[0].stream.records.dtype)
        start = 0
        for timed in self.streams:
            here = (places >= start) & (places < start + len(timed.time))
            out[here] = timed.stream.records[places[here] - start]
            start += len(timed.time)
        return out

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


def merge(streams: Sequence[Timed], decisions: Decisions) -> Merged | None:
    """Put records of one kind in order.

    Records at the time of another one are dropped: repeats, as of files that overlap, and of
    those that differ all but the first.

    Parameters
    ----------
    streams : sequence of Timed
        Of one kind.
    decisions : Decisions
        Takes counts of what was dropped, and gaps.

    Returns
    -------
    Merged or None
        None if no record has a time.
    """
    if not streams:
        return None
    time = np.concatenate([timed.time for timed in streams])
    # Where two have one time, the one that says when it was received comes first.
    unstamped = np.concatenate([np.isnan(timed.stream.records["received"]) for timed in streams])
    order = np.lexsort((unstamped, np.round(time / _SAME)))
    order = order[np.isfinite(time[order])]
    label = ", ".join(dict.fromkeys(timed.stream.label for timed in streams))
    if len(order) < len(time):
        decisions.add(label, f"{len(time) - len(order)} records without a time were left out")
    if not len(order):
        return None
    ordered = time[order]
    keep = np.diff(ordered, prepend=-np.inf) > _SAME
    if not keep.all():
        decisions.add(
            label, f"{int((~keep).sum())} records repeat the time of another one: left out"
        )
    merged = Merged(tuple(streams), ordered[keep], order[keep])
    _say_gaps(merged, label, decisions)
    return merged


def _say_gaps(merged: Merged, label: str, decisions: Decisions) -> None:
    steps = np.diff(merged.time)
    if not len(steps):
        return
    gaps = steps[steps > _GAP * np.median(steps)]
    if len(gaps):
        decisions.add(
            label,
            f"{len(gaps)} gaps longer than {_GAP * np.median(steps):.3g} s, {gaps.sum():.0f} s in "
            f"all, the longest {gaps.max():.0f} s",
        )
