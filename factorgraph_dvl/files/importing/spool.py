"""Records on disk while files are read: so that memory does not grow with the files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from factorgraph_dvl.files.formats.format import KINDS, Batch, Clock, HeadingReference, Kind
from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.geometry.vectors import Array

# Records at a time. Chosen: some MB.
CHUNK = 50_000
Directions = tuple[tuple[float, ...], ...]


class Stored:
    """An array on disk, read in parts: pages of a memory map would count as memory.

    Parameters
    ----------
    path : Path
        File of the records.
    dtype : dtype
        Of one record.
    convert : callable, optional
        Applied to records that were read.
    """

    def __init__(
        self,
        path: Path,
        dtype: np.dtype[Any],
        convert: Callable[[Records], Records] | None = None,
    ) -> None:
        self._path, self._dtype, self._convert = path, dtype, convert
        self._count = path.stat().st_size // dtype.itemsize

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, part: slice) -> Records:
        start, stop, step = part.indices(self._count)
        count, offset = max(stop - start, 0), start * self._dtype.itemsize
        out = np.fromfile(self._path, self._dtype, count, offset=offset)
        # A view would keep all of what was read.
        out = out if step == 1 else out[::step].copy()
        return out if self._convert is None else self._convert(out)

    def chunks(self) -> Iterator[Records]:
        """Yield the records, `CHUNK` at a time."""
        for start in range(0, self._count, CHUNK):
            yield self[start : start + CHUNK]

    def thinned(self, most: int) -> Records:
        """Return the records, or every n-th, so that less than twice `most` remain."""
        step = max(self._count // most, 1)
        size = CHUNK - CHUNK % step or step
        parts = [self[start : start + size : step] for start in range(0, self._count, size)]
        return np.concatenate(parts) if parts else self[:0]

    def converted(self, convert: Callable[[Records], Records]) -> Stored:
        """Return the same records, to be converted as they are read."""
        return Stored(self._path, self._dtype, convert)


@dataclass(frozen=True)
class Stream:
    """All records of one kind from one source in one file.

    Parameters
    ----------
    file : str
        Name of the raw file.
    format : str
        Name of its format.
    kind, clock, stream, axes, heading : str
        As in `Batch`.
    directions : tuple of tuple of float
        As in `Batch`.
    records : Stored
        (N,) of `KINDS[kind]`.
    """

    file: str
    format: str
    kind: Kind
    clock: Clock
    stream: str
    axes: str
    heading: HeadingReference
    directions: Directions
    records: Stored

    @property
    def label(self) -> str:
        """Name for people."""
        return f"{self.file} {self.stream}".rstrip()


_Key = tuple[str, str, Kind, Clock, str, str, HeadingReference, Directions]


class Spool:
    """Streams as they grow.

    Parameters
    ----------
    folder : Path
        For the records; it exists.
    note : callable
        Takes the name of a file and a sentence that its reader decided.
    """

    def __init__(self, folder: Path, note: Callable[[str, str], None]) -> None:
        self._folder, self._note = folder, note
        self._files: dict[_Key, BinaryIO] = {}
        self._stored = 0

    def append(self, file: str, form: str, batch: Batch) -> None:
        """Add the records of a batch, and pass on its notes."""
        for note in batch.notes:
            self._note(file, note)
        if not len(batch.records):
            return
        key = (
            *(file, form, batch.kind, batch.clock),
            *(batch.stream, batch.axes, batch.heading, batch.directions),
        )
        if key not in self._files:
            self._files[key] = self._new().open("wb")
        self._files[key].write(np.ascontiguousarray(batch.records).tobytes())

    def store(self, parts: Iterable[Array]) -> Stored:
        """Write numbers, part by part."""
        path = self._new()
        with path.open("wb") as file:
            for part in parts:
                file.write(np.ascontiguousarray(part, float).tobytes())
        return Stored(path, np.dtype(float))

    def streams(self) -> list[Stream]:
        """Return what was added, in the order of the first records."""
        out = []
        for key, handle in self._files.items():
            handle.close()
            out.append(Stream(*key, Stored(Path(handle.name), KINDS[key[2]])))
        return out

    def _new(self) -> Path:
        self._stored += 1
        return self._folder / str(self._stored)
