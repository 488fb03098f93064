"""Rows of data classes whose every field is an array of them: chosen, and joined."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from factorgraph_dvl.geometry.vectors import BoolArray, IntArray

_Arrays = TypeVar("_Arrays", bound=Any)


def rows_of(arrays: _Arrays, rows: slice | IntArray | BoolArray) -> _Arrays:
    """Return some rows of such a data class."""
    # What a frozen class does to set its fields takes longer than choosing few rows.
    out = object.__new__(type(arrays))
    vars(out).update({name: _rows(values, rows) for name, values in vars(arrays).items()})
    return out


def _rows(values: Any, rows: slice | IntArray | BoolArray) -> Any:
    if values is None:
        return None
    return values[rows] if isinstance(values, np.ndarray) else rows_of(values, rows)


def concatenated(parts: Sequence[_Arrays]) -> _Arrays:
    """Return the rows of several such data classes as one."""
    first = parts[0]
    return type(first)(**{name: _joined([vars(p)[name] for p in parts]) for name in vars(first)})


def _joined(parts: Sequence[Any]) -> Any:
    if parts[0] is None:
        return None
    return np.concatenate(parts) if isinstance(parts[0], np.ndarray) else concatenated(parts)
