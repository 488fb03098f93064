"""CSV and Parquet tables: named columns of numbers, and a few of text."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.settings.files import check_file, open_file

_EMPTY = ("", "nan", "NaN", "NAN")
_PARQUET = (".parquet", ".pq")
# Texts that are encoded at once. Chosen: some megabytes.
_TEXTS_AT_ONCE = 100_000
# Tables in memory, by section of trial.yaml: mappings of columns, or DataFrames.
Tables = Mapping[str, Any]
# Columns that hold text, in whatever table.
TEXT = ("beacon", "measurement", "unit", "sensor", "component", "reason")


def read_table(
    path: Path,
    required: Sequence[str],
    optional: Sequence[Sequence[str]] = (),
    *,
    source: str = "",
) -> dict[str, Any]:
    """Read columns of numbers from a CSV or, by its suffix, a Parquet file.

    Those in `TEXT` contain text.

    Parameters
    ----------
    path : path-like
        Path of the file. A CSV has one header line; a cell that is empty or `nan` is nan.
    required : sequence of str
        Columns that must be there. Others than those asked for are not read.
    optional : sequence of sequence of str, optional
        Groups of columns; of each, all or none are there. Absent ones are nan.
    source : str, optional
        Name of the file in messages; by default that of `path`.

    Returns
    -------
    dict of str to ndarray, shape (N,)
        Every required and optional column by its name.

    Raises
    ------
    DataError
        If the file is missing, unreadable or empty, a column is missing or given
        twice, or a cell is not a number.
    """
    source = source or path.name
    # Arrow opens the file by its name.
    check_file(path, expected=f"a table at {path}", where=source)
    is_parquet = path.suffix.lower() in _PARQUET
    try:
        header = _parquet_header(path, source) if is_parquet else _csv_header(path, source)
        names = _choose(header, required, optional, source)
        table = (_read_parquet if is_parquet else _read_csv)(path, header, names, source)
        columns = {
            name: _text(table, name) if name in TEXT else _numbers(table, name) for name in names
        }
        rows = table.num_rows
        del table
        # Arrow keeps what it read with otherwise, about as much as the columns take.
        release_memory()
    except MemoryError:
        raise
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        # Damage shows at any step, and Arrow says the same by many exceptions.
        reason = getattr(error, "strerror", None) or str(error).partition("\n")[0]
        expected = "a Parquet file that is whole" if is_parquet else ""
        raise DataError(f"cannot be read ({reason})", where=source, expected=expected) from None
    absent = np.full(rows, np.nan)
    return {name: columns.get(name, absent) for group in (required, *optional) for name in group}


def columns_of(
    table: Any, required: Sequence[str], optional: Sequence[Sequence[str]] = (), *, source: str
) -> dict[str, Any]:
    """Return columns of a table in memory, as `read_table` does those of a file.

    Parameters
    ----------
    table : mapping of str to array_like, or DataFrame
        Whatever has columns by name.
    required, optional : sequence of str, sequence of sequence of str
        Columns as of `read_table`.
    source : str
        Name of the table in messages.

    Raises
    ------
    DataError
        If a column is missing, contains no numbers, or differs in length from the others.
    """
    header = [str(name) for name in table]
    names = _choose(header, required, optional, source)
    out: dict[str, Any] = {}
    for name in names:
        kind = str if name in TEXT else float
        try:
            out[name] = np.array(table[name], dtype=kind)
        except (TypeError, ValueError):
            raise DataError(
                f"column {name} contains no numbers",
                where=source,
                expected="numbers, nan if missing",
            ) from None
        size = out[names[0]].shape
        if out[name].ndim != 1 or out[name].shape != size:
            raise DataError(
                f"column {name} has the shape {out[name].shape}",
                where=source,
                expected=f"{size[0] if size else 'N'} numbers, one for each row",
            )
    absent = np.full(out[names[0]].size, np.nan)
    return {name: out.get(name, absent) for group in (required, *optional) for name in group}


def read_header(path: Path) -> list[str]:
    """Return the names of the columns of a CSV file; raise DataError if it has none."""
    return _csv_header(path, str(path))


def count_rows(path: Path) -> int:
    """Return about how many rows a table has, without reading them."""
    with open_file(path, expected="a table") as file:
        if path.suffix.lower() in _PARQUET:
            return int(pyarrow.parquet.read_metadata(file).num_rows)
        lines = sum(block.count(b"\n") for block in iter(lambda: file.read(1 << 20), b""))
    return lines - 1


def release_memory() -> None:
    """Give memory that is free back to the system, as far as Arrow's allocator can."""
    pa.default_memory_pool().release_unused()


def write_table(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write columns (N,) of numbers or text as CSV or, by its suffix, Parquet; nan as empty.

    CSV cells have as many digits as it takes to read the same numbers back.
    """
    table = pa.table(
        {
            name: _texts(values) if values.dtype.kind in "UO" else _floats(values)
            for name, values in columns.items()
        }
    )
    if path.suffix.lower() in _PARQUET:
        with _arrow_file(path, "w") as out:
            pyarrow.parquet.write_table(table, out, write_page_checksum=True)
        return
    with path.open("wb") as file:
        file.write((",".join(columns) + "\n").encode())
        pyarrow.csv.write_csv(table, file, pyarrow.csv.WriteOptions(include_header=False))


def _arrow_file(path: Path, mode: Literal["r", "w"] = "r") -> pa.OSFile:
    """Return a file that Arrow opens; by itself it knows names in UTF-8 only."""
    return pa.OSFile(os.fsencode(path), mode)


def _floats(values: NDArray[Any]) -> pa.Array:
    """Return numbers (N,) as Arrow's, nan as null. `pyarrow.array` would load Pandas."""
    values = np.ascontiguousarray(values, dtype=float)
    known = ~np.isnan(values)
    mask = None if known.all() else pa.py_buffer(np.packbits(known, bitorder="little"))
    return pa.Array.from_buffers(pa.float64(), values.size, [mask, pa.py_buffer(values)])


def _texts(values: NDArray[Any]) -> pa.ChunkedArray:
    """Return texts (N,) as Arrow's."""
    parts = range(0, values.size, _TEXTS_AT_ONCE)
    return pa.chunked_array(
        [_some_texts(values[a : a + _TEXTS_AT_ONCE]) for a in parts], pa.string()
    )


def _some_texts(values: NDArray[Any]) -> pa.Array:
    texts = values.tolist()
    # Names and labels are few, and come again and again.
    of_text = {text: text.encode() for text in set(texts)}
    encoded = [of_text[text] for text in texts]
    ends = np.cumsum([0, *map(len, encoded)], dtype=np.int32)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(b"".join(encoded))]
    return pa.Array.from_buffers(pa.string(), values.size, buffers)


class TableWriter:
    """A Parquet file of numbers that is written part by part.

    Parameters
    ----------
    path : path-like
        Path of the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writer: pyarrow.parquet.ParquetWriter | None = None
        self.rows = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        if self._writer is not None:
            self._writer.close()
            self._file.close()

    def write(self, columns: Mapping[str, Array]) -> None:
        """Append columns (N,); nan is written as empty."""
        table = pa.table({name: _floats(x) for name, x in columns.items()})
        if self._writer is None:
            self._file = _arrow_file(self._path, "w")
            self._writer = pyarrow.parquet.ParquetWriter(
                self._file, table.schema, write_page_checksum=True
            )
        self._writer.write_table(table)
        self.rows += table.num_rows


def _choose(
    header: Sequence[str],
    required: Sequence[str],
    optional: Sequence[Sequence[str]],
    source: str,
) -> list[str]:
    """Return the names of the columns to read."""
    where = f"{source} line 1"
    chosen = list(required)
    for group in optional:
        present = [name for name in group if name in header]
        if present and len(present) < len(group):
            raise DataError(
                f"there is {', '.join(present)} but not "
                f"{', '.join(name for name in group if name not in header)}",
                where=where,
                expected="all of them, or none",
            )
        chosen += present
    missing = [name for name in chosen if name not in header]
    if missing:
        raise DataError(
            f"missing column {', '.join(missing)}",
            where=where,
            expected=f"columns {', '.join(required)}",
            hint=_separator_hint(header) or f"Found {', '.join(header[:20])}",
        )
    for name in chosen:
        if header.count(name) > 1:
            raise DataError(
                f"column {name} is given {header.count(name)} times", where=where, expected="one"
            )
    return chosen


def _separator_hint(header: Sequence[str]) -> str:
    for mark, name in ((";", "semicolons"), ("\t", "tabs"), (" ", "spaces")):
        if len(header) == 1 and mark in header[0]:
            return f"The cells seem to be separated by {name}; commas are needed"
    return ""


def _csv_header(path: Path, source: str) -> list[str]:
    with open_file(path, expected="a table", where=source) as file:
        line = file.readline(1_000_000)
    try:
        header = next(csv.reader([line.decode("utf-8-sig").strip()]), [])
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(
            "is not a CSV text file", where=f"{source} line 1", expected="a line of column names"
        ) from error
    if not header:
        what = "has an empty first line" if line else "is empty"
        raise DataError(
            f"the file {what}", where=f"{source} line 1", expected="a line of column names"
        )
    return [name.strip() for name in header]


def _read_csv(path: Path, header: list[str], names: list[str], source: str) -> pa.Table:
    # Columns that are not read may bear any name, or the same one twice.
    unique = [name if name in names else f"unread {i}" for i, name in enumerate(header)]
    try:
        with _arrow_file(path) as file:
            return pyarrow.csv.read_csv(
                file,
                read_options=pyarrow.csv.ReadOptions(column_names=unique, skip_rows=1),
                convert_options=pyarrow.csv.ConvertOptions(
                    column_types={
                        name: pa.string() if name in TEXT else pa.float64() for name in names
                    },
                    include_columns=names,
                    null_values=list(_EMPTY),
                ),
            )
    except pa.ArrowInvalid as error:
        raise _explain_csv(path, header, names, source, error) from None


def _explain_csv(
    path: Path, header: list[str], names: list[str], source: str, error: Exception
) -> DataError:
    """Return what is wrong with the first row that cannot be read, and its line."""
    rows = 0
    with (
        open_file(path, expected="a table", where=source) as raw,
        io.TextIOWrapper(raw, "utf-8-sig", "replace", newline="") as file,
    ):
        reader = csv.reader(file)
        next(reader)
        try:
            for row in reader:
                if not row:
                    continue
                rows += 1
                where = f"{source} line {reader.line_num}"
                if len(row) != len(header):
                    return DataError(
                        f"there are {len(row)} cells",
                        where=where,
                        expected=f"{len(header)}, as in the header line",
                    )
                for name, cell in zip(header, row, strict=True):
                    if name in names and name not in TEXT and not _is_number(cell):
                        shown = cell if len(cell) <= 40 else cell[:40] + "…"
                        return DataError(f"{name} is '{shown}'", where=where, expected="a number")
        except csv.Error as csv_error:
            return DataError(str(csv_error), where=f"{source} line {reader.line_num}")
    if rows == 0:
        return DataError("no samples", where=source, expected="at least one row")
    return DataError("cannot be read as CSV", where=source, hint=str(error))


def _is_number(cell: str) -> bool:
    if cell.strip() in _EMPTY:
        return True
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _parquet_header(path: Path, source: str) -> list[str]:
    try:
        with _arrow_file(path) as file:
            return list(pyarrow.parquet.read_schema(file).names)
    except pa.ArrowInvalid as error:
        raise DataError(
            "is not a Parquet file", where=source, expected="a table of numbers"
        ) from error


def _read_parquet(path: Path, header: list[str], names: list[str], source: str) -> pa.Table:
    with _arrow_file(path) as file:
        # `read_table` would load the parts of Arrow that are for data of many files.
        opened = pyarrow.parquet.ParquetFile(file, page_checksum_verification=True)
        table = opened.read(columns=names)
    for field in table.schema:
        if field.name in TEXT:
            continue
        if not (pa.types.is_floating(field.type) or pa.types.is_integer(field.type)):
            raise DataError(
                f"column {field.name} contains {field.type}", where=source, expected="numbers"
            )
    return table


def _numbers(table: pa.Table, name: str) -> Array:
    """Return a column, (N,), writable, with nan where it is null.

    Arrow's own conversion would load Pandas.
    """
    column = table.column(name)
    if column.type != pa.float64():
        column = column.cast(pa.float64(), safe=False)
    return np.concatenate([np.empty(0), *map(_chunk, column.chunks)])


def _chunk(chunk: pa.Array) -> Array:
    """Return the numbers of an array of Arrow's, (N,), with nan where it is null."""
    known, data = chunk.buffers()
    if not len(chunk):
        return np.empty(0)
    end = chunk.offset + len(chunk)
    values = np.frombuffer(data, dtype=float, count=end)[chunk.offset :]
    if not chunk.null_count:
        return values
    bits = np.frombuffer(known, dtype=np.uint8)
    is_known = np.unpackbits(bits, count=end, bitorder="little")[chunk.offset :]
    return np.where(is_known, values, np.nan)


def _text(table: pa.Table, name: str) -> NDArray[np.str_]:
    """Return a column of text, (N,); empty where it is null."""
    encoded = table.column(name).cast(pa.string()).fill_null("").combine_chunks()
    encoded = encoded.dictionary_encode()
    return np.array(encoded.dictionary.to_pylist(), dtype=str)[encoded.indices.to_numpy()]
