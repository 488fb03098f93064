"""Some rows of data classes whose every field is an array of them."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

from factorgraph_dvl.geometry.vectors import IntArray

_Arrays = TypeVar("_Arrays", bound=Any)


def rows_of(arrays: _Arrays, rows: slice | IntArray) -> _Arrays:
    """Return some rows of such a data class."""
    return type(arrays)(**{f.name: getattr(arrays, f.name)[rows] for f in fields(arrays)})
