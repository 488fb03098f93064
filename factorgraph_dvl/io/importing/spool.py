"""Records on disk while files are read: so that memory does not grow with the files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from factorgraph_dvl.io.formats.format import KINDS, Batch, Clock, HeadingReference, Kind
from factorgraph_dvl.io.formats.framing import Records


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
    records : Records
        (N,) of `KINDS[kind]`, on disk.
    """

    file: str
    format: str
    kind: Kind
    clock: Clock
    stream: str
    axes: str
    heading: HeadingReference
    records: Records

    @property
    def label(self) -> str:
        """Name for people."""
        return f"{self.file} {self.stream}".rstrip()


_Key = tuple[str, str, Kind, Clock, str, str, HeadingReference]


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

    def append(self, file: str, form: str, batch: Batch) -> None:
        """Add the records of a batch, and pass on its notes."""
        for note in batch.notes:
            self._note(file, note)
        if not len(batch.records):
            return
        key = (
            *(file, form, batch.kind, batch.clock),
            *(batch.stream, batch.axes, batch.heading),
        )
        if key not in self._files:
            self._files[key] = (self._folder / str(len(self._files))).open("wb")
        self._files[key].write(np.ascontiguousarray(batch.records).tobytes())

    def streams(self) -> list[Stream]:
        """Return what was added, in the order of the first records."""
        out = []
        for key, handle in self._files.items():
            handle.close()
            records = np.memmap(handle.name, KINDS[key[2]], mode="r")
            out.append(Stream(*key, records))
        return out
