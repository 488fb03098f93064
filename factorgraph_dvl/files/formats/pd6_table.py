"""Lines of PD6 that a computer stamped as it received them, as tables: a row for each line.

Source: the rows that a logger of a DVL H1000 writes, `Timestamp(s)` in seconds and `RawLine`. The
lines are those of Teledyne PD6. A line may have lost characters on its way; where lines of its
type have one length, others are damaged. The clock of the instrument is not used.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.format import Batch, Format, left_out
from factorgraph_dvl.files.formats.framing import BLOCK_OF_LINES, Records, map_file, number
from factorgraph_dvl.files.formats.headed_table import find_header, rows
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.pd6 import has_water, read_pd6, water_pings
from factorgraph_dvl.files.formats.velocities import attitude, pings

_STAMP, _LINE = "Timestamp(s)", "RawLine"
_TYPE = re.compile(rb":[A-Z]{2},")
_START = b":SA,"
# Rows by which lengths are judged, and the share of a type that has one length.
_JUDGED, _SAME_LENGTH = 20_000, 0.9
_CLOCK = "pings have the times at which a computer received them; the clock of the DVL is not used"
_WIDTHS = "whole lines have {} characters: lines of other lengths were left out"


def share(path: Path, sample: bytes) -> float:
    """Return whether a sample is such a table, with lines of PD6."""
    header = find_header(sample, {_STAMP, _LINE})
    return float(header is not None and _START in sample)


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    source = map_file(path)
    header = find_header(source, {_STAMP, _LINE})
    if header is None:
        return
    losses = Losses()
    stamp, line = header.names.index(_STAMP), header.names.index(_LINE)
    widths = _widths(cells[line] for _, cells in islice(rows(source, header), _JUDGED))
    each = (f"{width} (`{kind.decode()[:-1]}`)" for kind, width in sorted(widths.items()))
    notes = (_CLOCK, _WIDTHS.format(", ".join(each)))
    lines: list[tuple[int, float, bytes]] = []
    for at, cells in rows(source, header, losses):
        text, kind = cells[line], cells[line][:4]
        if _TYPE.fullmatch(kind) is None:
            losses.add("line of no type", at)
            continue
        if len(text) != widths.get(kind, len(text)):
            losses.add("line of another length", at)
            continue
        if kind == _START and len(lines) >= BLOCK_OF_LINES:
            yield from _batches(lines, losses, notes)
            lines = []
        lines.append((at, number(cells[stamp]), text))
    yield from _batches(lines, losses, notes)
    yield left_out(losses)


def _widths(lines: Iterator[bytes]) -> dict[bytes, int]:
    """Return the lengths of lines by their types, where nearly all of a type have one."""
    lengths: dict[bytes, Counter[int]] = {}
    for line in lines:
        if _TYPE.match(line):
            lengths.setdefault(line[:4], Counter())[len(line)] += 1
    out = {}
    for kind, counts in lengths.items():
        usual, count = counts.most_common(1)[0]
        if count >= _SAME_LENGTH * counts.total():
            out[kind] = usual
    return out


def _batches(
    lines: list[tuple[int, float, bytes]], losses: Losses, notes: tuple[str, ...]
) -> Iterator[Batch]:
    """Yield the pings of some lines, with the stamps of those that their ensembles begin with."""
    text = b"".join(line + b"\n" for _, _, line in lines)
    starts = np.cumsum([0, *(len(line) + 1 for _, _, line in lines)])

    def stamped(found: Records) -> Records:
        which = np.searchsorted(starts, found["at"], "right") - 1
        found["at"] = [lines[i][0] for i in which]
        found["time"] = [lines[i][1] for i in which]
        return found

    for found in read_pd6(text, losses=losses):
        if len(found):
            found = stamped(found)
            batch = pings(found, "own", "RFU", "")
            yield Batch("dvl", batch.records, "own", axes="RFU", notes=notes)
            yield from attitude(found, "own")
    if has_water(text):
        for found in read_pd6(text, track="W"):
            yield water_pings(stamped(found), "own")


FORMAT = Format(
    name="pd6-table",
    family="dvl",
    title="Teledyne PD6 with stamps, as a table: `Timestamp(s)`, `RawLine`",
    share=share,
    read=read,
    verified="a recording of a DVL H1000 in a pool (590 s), counts by type by a script",
    endings=(".csv",),
)
