"""Where whole records lie in a stream of bytes, damaged or not, in bounded memory."""

from __future__ import annotations

import math
import mmap
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.settings.files import open_file

# What every reader takes: a memory map of a file, or bytes in memory.
Source = bytes | mmap.mmap
Bytes = NDArray[np.uint8]
Index = NDArray[np.int64]
# Structured arrays of named fields.
Records = NDArray[Any]

# Bytes that are searched at a time. Chosen: some ms, and some MB with what is made of them.
WINDOW = 1 << 21
# Records, and short ones, that are read at a time. Chosen: some MB.
BLOCK = 10_000
BLOCK_OF_LINES = 100_000
# Bytes behind which pages of a file are dropped. Chosen: some windows.
_KEPT = 1 << 24
# Text without a line end for longer than this is no text.
LONGEST_LINE = 1 << 16


class _Map(mmap.mmap):
    """A memory map whose pages do not stay in memory once they were read.

    The system counts them as memory of the process until then: as much as the file.
    """

    _near = 0

    def __getitem__(self, key: Any) -> Any:
        start = (key.start or 0) if isinstance(key, slice) else key
        if abs(start - self._near) > _KEPT:
            self._near = start
            self.madvise(mmap.MADV_DONTNEED)
        return super().__getitem__(key)


def map_file(path: Path) -> Source:
    """Map a file into memory, read-only.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    Source
        Its bytes; pages are read when they are used.

    Raises
    ------
    DataError
        If it is missing, no regular file, or unreadable.
    """
    with open_file(path, expected=f"a file of an instrument at {path}", where=path.name) as file:
        if os.fstat(file.fileno()).st_size == 0:
            return b""
        try:
            # Only some systems can be asked to drop pages.
            kind = _Map if hasattr(mmap, "MADV_DONTNEED") else mmap.mmap
            return kind(file.fileno(), 0, access=mmap.ACCESS_READ)
        except OSError as error:
            reason = error.strerror or str(error)
            raise DataError(f"cannot be read ({reason})", where=path.name) from error


def as_bytes(source: Source, start: int, stop: int) -> Bytes:
    """Return bytes [start, stop) of a source, or what it has of them."""
    return np.frombuffer(source[start:stop], np.uint8)


def u16(data: Bytes, at: Index) -> Index:
    """Return little-endian 16-bit unsigned integers at positions (N,)."""
    return data[at].astype(np.int64) | data[at + 1].astype(np.int64) << 8


def summed_frames(
    source: Source,
    sync: bytes,
    length: Callable[[Bytes, Index], Index],
    shortest: int,
    longest: int,
) -> Iterator[Index]:
    """Find frames that end with the sum of all their bytes, modulo 65536.

    Frames do not overlap. Bytes that belong to none are passed over, so that every
    frame that is whole is found, whatever precedes it.

    Parameters
    ----------
    source : Source
        The stream.
    sync : bytes
        Bytes that every frame starts with.
    length : callable
        Given a window and positions (N,) in it with `shortest` bytes behind each,
        returns the numbers (N,) of bytes from the sync to the checksum; 0 where no
        frame can start.
    shortest, longest : int
        Bounds of these numbers.

    Yields
    ------
    (K, 2) starts and stops (checksum excluded) of frames; one block for each window.
    """
    free = 0
    size = len(source)
    for begin in range(0, size, WINDOW):
        data = as_bytes(source, begin, begin + WINDOW + longest + 2)
        last = min(WINDOW, len(data) - shortest - 1)
        if last <= 0:
            continue
        begins = [data[i : last + i] == byte for i, byte in enumerate(sync)]
        at = np.flatnonzero(np.logical_and.reduce(begins))
        if not len(at):
            continue
        stop = at + length(data, at)
        fits = (stop >= at + shortest) & (stop <= at + longest) & (stop + 2 <= len(data))
        at, stop = at[fits], stop[fits]
        # Sums that wrap at 2**32 are still right modulo 2**16.
        total = np.concatenate([np.zeros(1, np.uint32), np.cumsum(data, dtype=np.uint32)])
        whole = ((total[stop] - total[at]) & 0xFFFF) == u16(data, stop)
        found = []
        for first, end in (np.stack([at, stop], axis=1)[whole] + begin).tolist():
            if first >= free:
                found.append((first, end))
                free = end + 2
        if found:
            yield np.array(found, np.int64)


def lines(source: Source) -> Iterator[tuple[int, bytes]]:
    """Split text into lines.

    Parameters
    ----------
    source : Source
        The text.

    Yields
    ------
    Position and content of each line, without its end; lines over `LONGEST_LINE` bytes,
    which no format here has, are left out.
    """
    start = 0
    size = len(source)
    while start < size:
        stop = source.find(b"\n", start)
        stop = size if stop < 0 else stop
        if stop - start <= LONGEST_LINE:
            yield start, source[start:stop].rstrip(b"\r")
        start = stop + 1


def number(text: bytes | str) -> float:
    """Return a decimal number, or nan for whatever is none."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    # Python also reads "1_000" and "nan".
    is_plain = (b"_" if isinstance(text, bytes) else "_") not in text  # type: ignore[operator]
    return value if is_plain and math.isfinite(value) else math.nan
