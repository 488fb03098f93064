"""Records on disk while files are read: so that memory does not grow with the files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.files.formats.format import (
    KINDS,
    Batch,
    Clock,
    HeadingReference,
    Kind,
    faults,
    type_name,
)
from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.files.formats.losses import STATUS
from factorgraph_dvl.files.importing.account import Tally
from factorgraph_dvl.geometry.rotations import BodyAxes

# Records at a time. Chosen: some MB.
CHUNK = 50_000
_NEVER_SET = (
    "{file}: {kind}: the status calls all {count} records invalid → kept, as a status that is "
    "never set says nothing"
)
Directions = tuple[tuple[float, ...], ...]


class Stored:
    """An array on disk, read in parts: pages of a memory map would count as memory.

    Parameters
    ----------
    path : Path
        File of the records.
    dtype : dtype
        Data type of one record.
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
        Kind, clock, stream, axes and heading as in `Batch`.
    directions : tuple of tuple of float
        Directions as in `Batch`.
    records : Stored
        (N,) of `KINDS[kind]`.
    """

    file: str
    format: str
    kind: Kind
    clock: Clock
    stream: str
    axes: BodyAxes | Literal[""]
    heading: HeadingReference
    directions: Directions
    records: Stored

    @property
    def label(self) -> str:
        """Name for people."""
        return f"{self.file} {self.stream}".rstrip()


_Key = tuple[str, str, Kind, Clock, str, BodyAxes | Literal[""], HeadingReference, Directions]


class Spool:
    """Streams as they grow.

    Parameters
    ----------
    folder : Path
        Folder for the records; it exists.
    note : callable
        Takes the name of a file and a sentence that its reader decided.
    warn : callable, optional
        Takes a warning.
    """

    def __init__(
        self,
        folder: Path,
        note: Callable[[str, str], None],
        warn: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._folder, self._note, self._warn = folder, note, warn
        self._files: dict[_Key, BinaryIO] = {}
        self._tallies: dict[tuple[str, str], Tally] = {}
        # Of streams with a status: those in which it was set, the number that it calls invalid,
        # and all records of those in which it was not.
        self._seen: set[_Key] = set()
        self._invalid: dict[_Key, int] = {}
        self._aside: dict[_Key, BinaryIO] = {}
        self._stored = 0

    def append(self, file: str, form: str, batch: Batch) -> None:
        """Add the records of a batch, and pass on its notes.

        Records whose status says that they are invalid are kept aside until the stream has a
        valid one: a status that an instrument never sets says nothing.
        """
        for note in batch.notes:
            self._note(file, note)
        if not len(batch.records):
            return
        batch = replace(batch, records=_without_infinity(batch.records))
        tally = self._tallies.setdefault((file, batch.type), Tally())
        bad = np.zeros(len(batch.records), bool)
        for reason, found in faults(batch).items():
            tally.skip(reason, int(found.sum()))
            bad |= found
        key = (
            *(file, form, batch.kind, batch.clock),
            *(batch.stream, batch.axes, batch.heading, batch.directions),
        )
        if key not in self._files:
            self._files[key] = self._new().open("wb")
        keep = np.ones(len(bad), bool) if batch.valid is None else batch.valid | bad
        self._files[key].write(batch.records[keep].tobytes())
        tally.read += int((keep & ~bad).sum())
        if batch.valid is not None:
            self._set_aside(key, batch, keep, is_set=bool((batch.valid & ~bad).any()))

    def _set_aside(
        self, key: _Key, batch: Batch, keep: NDArray[np.bool_], *, is_set: bool
    ) -> None:
        """Keep all records of a stream as long as its status was never set."""
        if is_set:
            self._seen.add(key)
            if (aside := self._aside.pop(key, None)) is not None:
                aside.close()
                Path(aside.name).unlink()
        self._invalid[key] = self._invalid.get(key, 0) + int((~keep).sum())
        if key not in self._seen:
            if key not in self._aside:
                self._aside[key] = self._new().open("wb")
            self._aside[key].write(batch.records.tobytes())

    def tallies(self, file: str) -> dict[str, Tally]:
        """Return the records of a file that was read, by type."""
        for key in [key for key in self._invalid if key[0] == file]:
            count = self._invalid.pop(key)
            tally = self._tallies[file, type_name(key[2], key[4])]
            if not count:
                continue
            if key in self._seen:
                tally.skip(STATUS, count)
                continue
            tally.read += count
            self._files.pop(key).close()
            self._files[key] = self._aside.pop(key)
            self._warn(_NEVER_SET.format(file=file, kind=type_name(key[2], key[4]), count=count))
        return {kind: tally for (name, kind), tally in self._tallies.items() if name == file}

    def store(self, parts: Iterable[Records], kind: np.dtype[Any] | None = None) -> Stored:
        """Write numbers, or records of a kind, part by part."""
        path, kind = self._new(), np.dtype(float) if kind is None else kind
        with path.open("wb") as file:
            for part in parts:
                file.write(np.ascontiguousarray(part, kind).tobytes())
        return Stored(path, kind)

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


def _without_infinity(records: Records) -> Records:
    """Return records with nan in place of infinite values, as which damaged bytes are read."""
    out = records
    for name in records.dtype.names or ():
        infinite = np.isinf(records[name])
        if infinite.any():
            out = records.copy() if out is records else out
            out[name][infinite] = np.nan
    return out
