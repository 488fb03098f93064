"""Tables of text whose first lines name their columns."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Set
from dataclasses import dataclass
from itertools import islice

from factorgraph_dvl.files.formats.framing import Source, lines
from factorgraph_dvl.files.formats.losses import Losses

# Lines among which the names of columns stand.
_FIRST_LINES = 5
_OTHER_CELLS = "row with another number of cells"


@dataclass(frozen=True)
class Header:
    """The line that names the columns.

    Parameters
    ----------
    separator : bytes
        Between cells.
    names : list of str
        Of the columns.
    start : int
        Where the rows start.
    """

    separator: bytes
    names: list[str]
    start: int


def find_header(source: Source, *needed: Set[str]) -> Header | None:
    """Return the header that names all columns of one of these sets; None if there is none."""
    for at, line in islice(lines(source), _FIRST_LINES):
        for separator in (b",", b";", b"\t"):
            cells = line.removeprefix(b"\xef\xbb\xbf").split(separator)
            names = [cell.strip(b' "').decode("latin-1") for cell in cells]
            if any(set(names) >= one for one in needed):
                return Header(separator, names, at + len(line) + 1)
    return None


def rows(
    source: Source, header: Header, losses: Losses | None = None
) -> Iterator[tuple[int, list[bytes]]]:
    """Yield positions and cells of the rows behind a header.

    Parameters
    ----------
    source : Source
        The file.
    header : Header
        Of the table.
    losses : Losses, optional
        Takes counts of what was left out.
    """
    for at, line in lines(source):
        if at < header.start or not line.strip():
            continue
        cells = _cells(line, header.separator)
        if len(cells) == len(header.names):
            yield at, cells
        elif losses is not None:
            losses.add(_OTHER_CELLS, at)


def _cells(line: bytes, separator: bytes) -> list[bytes]:
    if b'"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    try:
        found = next(csv.reader([line.decode("latin-1")], delimiter=separator.decode()), [])
    except csv.Error:
        return []
    return [cell.strip().encode("latin-1") for cell in found]
