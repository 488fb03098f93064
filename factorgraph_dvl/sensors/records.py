"""Records of sensors: rows chosen and joined, tables taken apart, values checked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.vectors import Array, spread
from factorgraph_dvl.settings.ranges import SWAPPED, could_be_longitude, range_of

# Weights of the samples two before, one before, one after and two after, through which a cubic
# passes.
_NEIGHBOURS = np.array([-1.0, 4.0, 4.0, -1.0]) / 6.0

_AnyRecord = TypeVar("_AnyRecord")

# Share of a column outside its range from which on it is no glitch. Chosen: sensors lose fewer.
_SYSTEMATIC = 0.1
# Share of a column that lies in range in its true unit. Chosen: glitches are fewer than the rest.
_USUAL = 0.9
# Units that instruments write in place of a column's own, with the number of them in one of it.
_OTHER_UNITS = {
    "m/s": {"cm/s": 100.0, "mm/s": 1000.0},
    "rad/s": {"deg/s": np.degrees(1.0), "mdeg/s": 1e3 * np.degrees(1.0)},
    "m/s²": {"mg": 1e3 / 9.80665, "µm/s²": 1e6},
    "m": {"cm": 100.0, "mm": 1000.0},
}


def rows_of(record: _AnyRecord, rows: slice | NDArray[Any] | list[int]) -> _AnyRecord:
    """Return some rows of a sensor's record, in the order of time: of every array in it."""
    return with_arrays(record, {name: values[rows] for name, values in arrays_of(record).items()})


def joined(records: Sequence[_AnyRecord]) -> _AnyRecord:
    """Return records of one sensor as one, in the order of time.

    Of rows at the same time the first is kept.
    """
    if len(records) == 1:
        return records[0]
    columns = [arrays_of(record) for record in records]
    whole = {name: np.concatenate([c[name] for c in columns]) for name in columns[0]}
    _, rows = np.unique(whole["time"], return_index=True)
    return with_arrays(records[0], {name: values[rows] for name, values in whole.items()})


def with_arrays(record: _AnyRecord, arrays: Mapping[str, Array]) -> _AnyRecord:
    """Return a record with other arrays, by name, which must have been checked."""
    out = object.__new__(type(record))
    vars(out).update(vars(record), **arrays)
    return out


def arrays_of(record: Any) -> dict[str, Array]:
    """Return the arrays of a record, by name; each has a row for each time."""
    return {name: value for name, value in vars(record).items() if isinstance(value, np.ndarray)}


def check_times(time: Array, source: str) -> None:
    """Raise DataError unless (M,) times are finite and strictly increasing."""
    if time.ndim != 1 or time.size == 0:
        raise DataError("no samples", where=source, expected="at least one row")
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise DataError("time_s is not a number", where=at_row(source, bad[0]))
    check_possible({"time_s": time}, source)
    bad = np.flatnonzero(np.diff(time) <= 0.0)
    if bad.size:
        i = int(bad[0]) + 1
        raise DataError(
            f"time_s does not increase ({time[i - 1]:.9g} is followed by {time[i]:.9g})",
            where=at_row(source, i),
            expected="strictly increasing times",
        )


def check_finite(columns: Mapping[str, Array], source: str) -> None:
    """Raise DataError, naming row and column, unless all values are finite."""
    for name, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise DataError(
                f"{name} is empty or not a number",
                where=at_row(source, bad[0]),
                expected="a finite number in every row",
            )


def check_range(
    columns: Mapping[str, Array], low: float, high: float, unit: str, source: str
) -> None:
    """Raise DataError where a value that is present lies outside [low, high].

    Where many do, the error says which other unit they may have.
    """
    for name, values in columns.items():
        bad = np.flatnonzero((values < low) | (values > high))
        if bad.size:
            raise DataError(
                f"{name} = {values[bad[0]]:.6g} is out of range",
                where=at_row(source, bad[0]),
                expected=f"{low:g} to {high:g} {unit}{_other_unit(values, high, unit)}",
                hint=SWAPPED if could_be_longitude(name, float(values[bad[0]])) else "",
            )


def _other_unit(values: Array, high: float, unit: str) -> str:
    """Return the units that would bring most values of a column into range, as words."""
    size = np.abs(values[np.isfinite(values)])
    outside = int(np.count_nonzero(size > high))
    if outside == 0 or outside < _SYSTEMATIC * size.size:
        return ""
    usual = float(np.quantile(size, _USUAL))
    fitting = [
        f"{name} (divide it by {factor:.6g})"
        for name, factor in _OTHER_UNITS.get(unit, {}).items()
        if usual <= factor * high
    ]
    if not fitting:
        return ""
    return (
        f"; {outside} of {size.size} values are outside: "
        f"the column may be in {' or '.join(fitting)}"
    )


def check_possible(columns: Mapping[str, Array], source: str) -> None:
    """Raise DataError where a value that is present cannot be, by the name of its column."""
    for name, values in columns.items():
        if limits := range_of(name):
            check_range({name: values}, limits.low, limits.high, limits.unit, source)


def check_all_or_none(columns: Mapping[str, Array], source: str) -> None:
    """Raise DataError where some of the columns are empty in a row and others are not."""
    missing = np.isnan(np.stack(list(columns.values()), axis=1))
    bad = np.flatnonzero(missing.any(axis=1) & ~missing.all(axis=1))
    if bad.size:
        raise DataError(
            f"only some of {', '.join(columns)} are given",
            where=at_row(source, bad[0]),
            expected="all of them, or none",
        )


def at_row(source: str, row: int | np.integer[Any]) -> str:
    """Name a row of a record so that it is found in the file (one header line)."""
    return f"{source} line {int(row) + 2}"


def stack(columns: Mapping[str, Array], names: Sequence[str]) -> Array:
    """Return the columns of those names side by side, (M, n)."""
    return np.column_stack([columns[name] for name in names])


def named_columns(names: Iterable[str], values: Array) -> dict[str, Array]:
    """Pair names with the columns of an (M, n) array."""
    return {name: values[:, i] for i, name in enumerate(names)}


def white_noise(values: Array) -> Array:
    """Return the white noise of samples (M, n) in order, M of five or more, (n,).

    It is what a cubic through the neighbours misses, by the median absolute deviation.
    """
    before = _NEIGHBOURS[0] * values[:-4] + _NEIGHBOURS[1] * values[1:-3]
    after = _NEIGHBOURS[2] * values[3:-1] + _NEIGHBOURS[3] * values[4:]
    missed = values[2:-2] - before - after
    gain = np.sqrt(1.0 + _NEIGHBOURS @ _NEIGHBOURS)
    return spread(missed) / gain
