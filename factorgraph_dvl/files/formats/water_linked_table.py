"""Logs of Water Linked DVLs as tables: the reports of the JSON protocol, a row each.

Programs that log these instruments flatten a report to columns of the same names: `time`, `vx`,
`vy`, `vz`, `fom`, `altitude`, `velocity_valid`, and `transducers_0_velocity` and so on for beams.
Units and axes are those of the protocol. `time` is either that of the protocol, the milliseconds
since the report before, or a stamp: stamps increase from row to row. `timestamp` and `log_time`
are stamps.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.clocks import seconds_of
from factorgraph_dvl.files.formats.format import Batch, Format, left_out
from factorgraph_dvl.files.formats.framing import BLOCK_OF_LINES, map_file, number
from factorgraph_dvl.files.formats.headed_table import find_header
from factorgraph_dvl.files.formats.headed_table import rows as table_rows
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.water_linked import Row, batches_of, by_track, velocity_of
from factorgraph_dvl.geometry.vectors import Array

# Columns of the time, the best first, and all of those of which one is needed.
_STAMP_COLUMNS = ("timestamp", "log_time", "time")
_NEEDED = [
    frozenset((name, "vx", "vy", "vz", "fom", "velocity_valid"))
    for name in (*_STAMP_COLUMNS, "time_of_validity")
]
_BEAM = re.compile(r"transducers?[^0-9A-Za-z]*(\d)[^0-9A-Za-z]+(velocity|distance|beam_valid)")
_TRUE = (b"true", b"1", b"1.0", b"y", b"yes", b"t")
# Rows by which `time` is judged.
_JUDGED = 200
# Stamps from 1973 on in each unit, the largest first; smaller ones are seconds.
_UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
_STAMPS = "`{name}` increases from row to row → stamps in {unit:g} s"
_STEPS = "no stamps that increase → `time` is milliseconds since the row before, by the protocol"


def share(path: Path, sample: bytes) -> float:
    """Return whether the first lines of a sample name the columns of such a table."""
    return float(find_header(sample, *_NEEDED) is not None)


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    source = map_file(path)
    header = find_header(source, *_NEEDED)
    if header is None:
        return
    names, losses = header.names, Losses()
    first = [line for _, line in islice(table_rows(source, header), _JUDGED)]
    column, unit, note = 0, None, _STEPS
    for name in reversed([name for name in _STAMP_COLUMNS if name in names]):
        found = _unit_of_stamps(
            np.array([seconds_of(cells[names.index(name)]) for cells in first])
        )
        if found is not None:
            column, unit = names.index(name), found
            note = _STAMPS.format(name=name, unit=unit)
    rows: list[Row] = []
    elapsed = 0.0
    for at, cells in table_rows(source, header, losses):
        row = velocity_of(_message(names, cells))
        step = row.pop("step")
        if unit is not None:
            elapsed = row["time"] = seconds_of(cells[column]) * unit
        else:
            elapsed += step if 0.0 <= step < 3600.0 else 0.0
        rows.append({**row, "at": at, "second": elapsed})
        if len(rows) >= BLOCK_OF_LINES:
            yield from batches_of(*by_track(rows), note)
            rows = []
    yield from batches_of(*by_track(rows), note)
    yield left_out(losses)


def _unit_of_stamps(time: Array) -> float | None:
    """Return the unit of stamps, s, None for the times since the row before."""
    time = time[np.isfinite(time)]
    if len(time) < 2 or (np.diff(time) <= 0.0).any():
        return None
    size = float(np.median(time))
    return next((unit for least, unit in _UNITS if size >= least), 1.0)


def _message(names: list[str], cells: list[bytes]) -> dict[str, Any]:
    """Return the report that a row was made of."""
    beams: dict[int, dict[str, Any]] = {}
    message: dict[str, Any] = {}
    for name, cell in zip(names, cells, strict=True):
        if match := _BEAM.fullmatch(name):
            index, name = int(match[1]), match[2]
            target = beams.setdefault(index, {"id": index})
        else:
            target = message
        if name in ("type", "tracking_mode"):
            target[name] = cell.decode("latin-1")
        else:
            target[name] = cell.lower() in _TRUE if name.endswith("_valid") else number(cell)
    return {**message, "transducers": list(beams.values())}


FORMATS = (
    Format(
        "water-linked-table",
        "dvl",
        "Water Linked reports as a table: `time`, `vx`, `vy`, `vz`, `fom`, `altitude`, "
        "`velocity_valid`",
        share,
        read,
        "by its document only: reports as a table, against the same as JSON",
        (".csv", ".txt", ".tsv"),
    ),
)
