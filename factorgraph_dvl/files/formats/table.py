"""Tables of text, read by a mapping of their columns."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.formats.clocks import gps_to_utc
from factorgraph_dvl.files.formats.format import Batch, Format, Kind, empty, left_out
from factorgraph_dvl.files.formats.framing import Records, Source, map_file, number
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.mapping import (
    COORDINATES,
    FIELDS,
    UNITS,
    ColumnName,
    MappingSettings,
    TableMapping,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.settings.convert import from_plain

# Bytes that are parsed at a time.
_BLOCK = 1 << 23
# Line ends of text, of which a block ends with one; a longer line is no line of a table.
_LONGEST_LINE = 1 << 20
_TRUE = (b"true", b"yes", b"y", b"t")
_OTHER_CELLS = "row with another number of cells"
_SEPARATORS = {",": b",", ";": b";", "tab": b"\t", "space": b" "}


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read the records that a mapping names.

    Parameters
    ----------
    path : Path
        A text file.
    mapping : mapping
        Content of a mapping YAML.

    Yields
    ------
    Batch

    Raises
    ------
    ConfigError
        If no mapping was given.
    DataError
        If a column is missing.
    """
    settings = None if mapping is None else from_plain(mapping, MappingSettings)
    tables = () if settings is None else settings.of(path)
    if settings is None or not tables:
        raise ConfigError(
            "no mapping says what its columns are",
            where=path.name,
            expected="`--map MAPPING.yaml`",
        )
    for table in tables:
        yield from _batches(path, table, settings.source_of(table))


def _batches(path: Path, table: TableMapping, stream: str) -> Iterator[Batch]:
    source = map_file(path)
    separator = _SEPARATORS[table.separator] if table.separator else separator_of(source)
    names, start = header(source, separator, table.header_lines)
    place = {
        name: _index(name, names, path.name)
        for name in (
            *(table.column(field).column for field in table.columns),
            *table.time.names,
            *(() if table.valid is None else (table.valid,)),
        )
    }
    notes = tuple(describe(table))
    losses = Losses()
    for at, block in _blocks(source, start):
        rows, dropped = _parse(block, separator, len(names))
        if dropped:
            losses.add(_OTHER_CELLS, at + _place(block, dropped[0]), len(dropped))
        if not rows.num_rows:
            continue
        out = empty(_kind(table), rows.num_rows)
        out["at"] = at
        out["time"] = _times(table, [rows.column(place[name]) for name in table.time.names])
        out["received"] = out["time"]

        def column(name: ColumnName, rows: pa.Table = rows) -> Array:
            cells = rows.column(place[name])
            return _flags(cells) if name == table.valid else _numbers(cells)

        fill(out, table, column)
        yield Batch(
            _kind(table),
            out,
            table.time.batch_clock,
            stream,
            table.axes,
            table.heading_reference,
            notes,
        )
    yield left_out(losses)


def fill(out: Records, table: TableMapping, column: Callable[[ColumnName], Array]) -> None:
    """Fill records from the columns that a mapping names.

    Parameters
    ----------
    out : Records
        (N,) of the kind of the table, empty.
    table : TableMapping
        What its columns are.
    column : callable
        Returns the values of a column (N,), nan for what is no number.
    """
    for field in table.columns:
        values = column(table.column(field).column)
        lost = np.isin(values, table.invalid)
        if table.valid is not None:
            lost |= np.nan_to_num(column(table.valid)) == 0.0
        values = np.where(lost, np.nan, values)
        name, index, _ = FIELDS[_kind(table)][field]
        target = out[name] if index is None else out[name][:, index]
        if target.dtype.kind == "i":
            target[:] = np.nan_to_num(values, nan=-1.0)
        else:
            target[:] = values * table.factor(field)
    if table.kind in ("dvl", "water"):
        out["axes"], out["alignment"] = COORDINATES[table.coordinates], 0.0
        out["tilts_used"] = True
        if table.beam_angle_deg is not None:
            out["beam_angle"] = table.beam_angle_deg * DEG


def _kind(table: TableMapping) -> Kind:
    return table.kind


def describe(table: TableMapping) -> Iterator[str]:
    """Return what a mapping makes of the columns, a sentence each."""
    for field in table.columns:
        column = table.column(field)
        unit = column.unit or FIELDS[table.kind][field][2]
        unit = "" if unit == "1" else f" in {unit}"
        sign = ", sign reversed" if column.sign < 0 else ""
        yield f"{table.kind}: {field} is column {column.column}{unit}{sign}"


def separator_of(source: Source) -> bytes:
    """Return what separates the cells of a table, by its first lines."""
    head = source[: 1 << 16]
    counts = {mark: head.count(mark) for mark in (b",", b";", b"\t")}
    best = max(counts, key=lambda mark: counts[mark])
    return best if counts[best] else b" "


def header(source: Source, separator: bytes, lines: int) -> tuple[list[str], int]:
    """Return the names of columns, numbers from 1 without a header, and where the data start.

    Parameters
    ----------
    source : Source
        The table.
    separator : bytes
        Separator of its cells.
    lines : int
        Number of lines before the data; the last one has the names.
    """
    start, line = 3 if source[:3] == b"\xef\xbb\xbf" else 0, b""
    for _ in range(lines):
        stop = source.find(b"\n", start)
        if stop < 0:
            return [], len(source)
        line, start = source[start:stop], stop + 1
    if not lines:
        stop = source.find(b"\n", start)
        first = source[start : stop if stop >= 0 else len(source)]
        return [str(i + 1) for i in range(len(_cells(first, separator)))], start
    text = line.lstrip(b"#% ")
    names = [cell.decode("utf-8", "replace").strip(' "') for cell in _cells(text, separator)]
    return names, start


def _cells(line: bytes, separator: bytes) -> list[bytes]:
    line = line.strip(b"\r\n")
    return line.split() if separator == b" " else line.split(separator)


def _index(name: ColumnName, names: list[str], source: str) -> int:
    if isinstance(name, int):
        if 1 <= name <= len(names):
            return name - 1
    elif name in names:
        return names.index(name)
    raise DataError(
        f"has no column {name}",
        where=f"{source}, its header",
        expected=f"one of {', '.join(names[:40])}; or a number from 1 to {len(names)}",
    )


def _blocks(source: Source, start: int) -> Iterator[tuple[int, bytes]]:
    """Yield position and content of blocks of whole lines."""
    size = len(source)
    while start < size:
        stop = min(start + _BLOCK, size)
        if stop < size:
            end = source.find(b"\n", stop, stop + _LONGEST_LINE)
            stop = size if end < 0 else end + 1
        yield start, source[start:stop]
        start = stop


def _place(block: bytes, row: bytes) -> int:
    """Return where the line of a row starts, whose spaces may be fewer than in the block."""
    cells = rb"[ \t]+".join(re.escape(cell) for cell in row.split())
    found = re.search(rb"(?m)^[ \t]*" + cells + rb"[ \t]*\r?$", block)
    return 0 if found is None else found.start()


def _parse(block: bytes, separator: bytes, count: int) -> tuple[pa.Table, list[bytes]]:
    """Return the rows of a block as text, and those that have another number of cells."""
    if separator == b" ":
        block = re.sub(rb"[ \t]+", b" ", re.sub(rb"(?m)^[ \t]+|[ \t]+(?=\r?$)", b"", block))
    # The library takes UTF-8 only; what is no number need not be readable.
    text = block if block.isascii() else block.decode("latin-1").encode()
    dropped: list[bytes] = []

    def skip(row: Any) -> str:
        dropped.append(row.text.encode("latin-1"))
        return "skip"

    names = [str(i) for i in range(count)]
    try:
        table = pyarrow.csv.read_csv(
            io.BytesIO(text),
            read_options=pyarrow.csv.ReadOptions(
                column_names=names, block_size=_BLOCK + _LONGEST_LINE
            ),
            parse_options=pyarrow.csv.ParseOptions(
                delimiter=separator.decode(), quote_char=False, invalid_row_handler=skip
            ),
            convert_options=pyarrow.csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.binary()), strings_can_be_null=False
            ),
        )
    except pa.ArrowInvalid:
        return pa.table({name: pa.array([], pa.binary()) for name in names}), block.splitlines()
    return table, dropped


def _numbers(cells: pa.ChunkedArray) -> Array:
    """Return cells as numbers (N,), nan for what is none."""
    try:
        text = cells.cast(pa.string())
        filled = pa.compute.utf8_trim_whitespace(text)
        filled = pa.compute.if_else(pa.compute.equal(filled, ""), "nan", filled)
        values = filled.cast(pa.float64()).to_numpy()
    except pa.ArrowInvalid:
        values = np.array([number(cell.strip()) for cell in cells.to_pylist()])
    return np.where(np.isfinite(values), values, np.nan)


def _flags(cells: pa.ChunkedArray) -> Array:
    """Return cells as numbers (N,), 1 for those that say `true` in a word."""
    words = np.array([cell.strip(b' "\r').lower() in _TRUE for cell in cells.to_pylist()], bool)
    return np.where(words, 1.0, _numbers(cells))


def _times(table: TableMapping, cells: list[pa.ChunkedArray]) -> Array:
    time = table.time
    if time.unit != "iso":
        values = _numbers(cells[0]) * UNITS[time.unit]
        if len(cells) > 1:
            values += _numbers(cells[1]) * UNITS[time.unit]
    else:
        parts = [column.to_pylist() for column in cells]
        values = np.array([_iso(b"T".join(row)) for row in zip(*parts, strict=True)])
    return on_clock(table, values)


def on_clock(table: TableMapping, seconds: Array) -> Array:
    """Return times (N,), s, on the clock of the batch, of what a column of time has."""
    seconds = seconds + table.time.offset_s
    return gps_to_utc(0.0, seconds) if table.time.clock == "gps" else seconds


def _iso(text: bytes) -> float:
    plain = text.decode("ascii", "replace").strip(' "\r').replace("/", "-").replace("Z", "")
    try:
        return float(np.datetime64(plain.replace(" ", "T"), "ns").astype(np.int64)) * 1e-9
    except ValueError:
        return float("nan")


FORMAT = Format(
    "table",
    "table",
    "Table of text with a mapping",
    lambda path, sample: 0.0,
    read,
    "tables that are written in other ways",
    (".csv", ".txt", ".tsv"),
)
