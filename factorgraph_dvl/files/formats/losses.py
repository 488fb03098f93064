"""What a reader left out of a file: damage, from where on, and records by type with the reason."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from factorgraph_dvl.files.formats.framing import Bytes, Index, Source, as_bytes

_WRONG = "{} with a wrong checksum"
_BYTES = "byte outside records"
# Why a whole record is skipped. A type that no reader here knows is no fault of the file.
UNKNOWN_TYPE = "type not read"
REPEATED = "repeats another one"
NO_FIX = "no fix"
NO_LOCK = "no lock"
NO_VALUE = "no value"
NO_TIME = "no time"
STATUS = "status"


@dataclass
class Losses:
    """Counts of what was left out.

    Parameters
    ----------
    counts : dict of str to int
        Damage, by what it is, in the singular, its noun first.
    first : int or None
        Position of the first damage in the file.
    used : dict of str to int
        Whole records by type that were read and stand in no batch of their own, as those that
        date others.
    skipped : dict of str to dict of str to int
        Whole records that stand in no batch: by type, then by the reason.
    """

    counts: dict[str, int] = field(default_factory=dict)
    first: int | None = None
    used: dict[str, int] = field(default_factory=dict)
    skipped: dict[str, dict[str, int]] = field(default_factory=dict)

    def use(self, kind: str, count: int = 1) -> None:
        """Count whole records of a type that were read for the sake of others."""
        if count:
            self.used[kind] = self.used.get(kind, 0) + count

    def skip(self, kind: str, reason: str, count: int = 1) -> None:
        """Count whole records of a type that were skipped; nothing if `count` is 0."""
        if count:
            reasons = self.skipped.setdefault(kind, {})
            reasons[reason] = reasons.get(reason, 0) + count

    def add(self, what: str, at: int, count: int = 1) -> None:
        """Count what was left out at a position of the file; nothing if `count` is 0."""
        if count:
            self.counts[what] = self.counts.get(what, 0) + count
            self.first = at if self.first is None else min(self.first, at)

    def include(self, other: Losses) -> None:
        """Add the counts of another one, of the same file."""
        for what, count in other.counts.items():
            self.add(what, other.first or 0, count)
        for kind, count in other.used.items():
            self.use(kind, count)
        for kind, reasons in other.skipped.items():
            for reason, count in reasons.items():
                self.skip(kind, reason, count)

    def __str__(self) -> str:
        """Return a phrase such as `2 rows without a time, the first at byte 3,400`."""
        if self.first is None:
            return ""
        *parts, last = [_counted(what, count) for what, count in self.counts.items()]
        listed = f"{', '.join(parts)} and {last}" if parts else last
        place = "at byte" if sum(self.counts.values()) == 1 else "the first at byte"
        return f"{listed}, {place} {self.first:,}"


def _counted(what: str, count: int) -> str:
    noun, _, rest = what.partition(" ")
    return f"{count:,} {noun}{'' if count == 1 else 's'} {rest}"


@dataclass(frozen=True)
class Frame:
    """How records of a binary format are recognised where their checksum is wrong.

    Parameters
    ----------
    noun : str
        What they are called, in the singular.
    sync : bytes
        What each begins with.
    size : callable
        Given the source and the position of a `sync`, returns the number of bytes that a record
        there has, checksum included; 0 if none can start there.
    """

    noun: str
    sync: bytes
    size: Callable[[Source, int], int]


def summed(
    noun: str, sync: bytes, length: Callable[[Bytes, Index], Index], shortest: int
) -> Frame:
    """Return how to recognise the records that `summed_frames` finds, by its parameters."""

    def size(source: Source, at: int) -> int:
        head = as_bytes(source, at, at + shortest)
        stated = int(length(head, np.zeros(1, np.int64))[0]) if len(head) == shortest else 0
        return stated + 2 if stated >= shortest else 0

    return Frame(noun, sync, size)


def count_outside(
    source: Source,
    blocks: Iterable[Index],
    losses: Losses,
    frame: Frame | None = None,
    tail: int = 0,
) -> Iterator[Index]:
    """Pass on records, and count what lies outside them.

    Parameters
    ----------
    source : Source
        The file.
    blocks : iterable of ndarray of int, shape (K, 2)
        Where records start and stop, in order.
    losses : Losses
        Takes the counts.
    frame : Frame, optional
        How to recognise records with a wrong checksum; without, all outside counts as bytes.
    tail : int, default 0
        Bytes of a record behind where it stops.

    Yields
    ------
    The blocks.
    """
    free = 0
    for block in blocks:
        if not len(block):
            continue
        starts = block[:, 0]
        stops = np.concatenate([[free], block[:-1, 1] + tail])
        for gap in np.flatnonzero(starts > stops):
            count_stretch(source, int(stops[gap]), int(starts[gap]), losses, frame)
        free = int(block[-1, 1]) + tail
        yield block
    count_stretch(source, free, len(source), losses, frame)


def count_stretch(
    source: Source, start: int, stop: int, losses: Losses, frame: Frame | None = None
) -> None:
    """Count what bytes [start, stop) are, which lie outside records; see `count_outside`."""
    rest, at = max(stop - start, 0), start
    while frame is not None and (at := source.find(frame.sync, at, stop)) >= 0:
        size = frame.size(source, at)
        if size and at + size <= stop:
            losses.add(_WRONG.format(frame.noun), at)
            rest -= size
            at += size
        else:
            at += 1
    losses.add(_BYTES, start, rest)
