"""Tables of residuals: what was used, and what was rejected."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.estimates import Residuals
from factorgraph_dvl.files.tables import read_table

_COLUMNS = ("time_s", "sensor", "component", "residual", "std", "unit")
# Why a measurement was rejected.
_REASON = "reason"


def residual_columns(residuals: Sequence[Residuals]) -> dict[str, Any]:
    """Return residuals as columns, a row for each component; nan where it was not measured.

    Parameters
    ----------
    residuals : sequence of Residuals
        Residuals; at least one.
    """
    parts = []
    for r in residuals:
        # Texts as objects take eight bytes each, and as many as the longest has otherwise.
        size = r.residual.size
        parts.append(
            (
                np.repeat(r.time, len(r.components)),
                np.full(size, r.label, dtype=object),
                np.tile(np.array(r.components, dtype=object), r.time.size),
                r.residual.ravel(),
                r.sigma.ravel(),
                np.full(size, r.unit, dtype=object),
            )
        )
    return {
        name: np.concatenate(values)
        for name, values in zip(_COLUMNS, zip(*parts, strict=True), strict=True)
    }


def rejected_columns(rejected: Sequence[Residuals]) -> dict[str, Any]:
    """Return rejected measurements as columns, by time, without what was not measured."""
    columns = residual_columns(rejected)
    reasons = [np.full(r.residual.size, r.reason, dtype=object) for r in rejected]
    columns = columns | {_REASON: np.concatenate(reasons)}
    order = np.argsort(columns["time_s"], kind="stable")
    order = order[np.isfinite(columns["residual"][order])]
    names = (*_COLUMNS[:3], _REASON, *_COLUMNS[3:])
    return {name: columns[name][order] for name in names}


def read_residuals(path: Path) -> tuple[Residuals, ...]:
    """Read residuals as `residual_columns` has them; nothing where there is no such file.

    Raises
    ------
    DataError
        If the file cannot be read or misses a column.
    """
    if not os.path.lexists(path):
        return ()
    columns = read_table(path, _COLUMNS, [(_REASON,)], source=str(path))
    if columns[_REASON].dtype.kind == "f":
        # Measurements that were used have none.
        columns[_REASON] = np.full(columns["sensor"].size, Residuals.reason)
    _, first, group = np.unique(
        np.char.add(np.char.add(columns["sensor"], "\n"), columns[_REASON]),
        return_index=True,
        return_inverse=True,
    )
    return tuple(
        _group({name: values[group == k] for name, values in columns.items()})
        for k in np.argsort(first, kind="stable")
    )


def _group(columns: dict[str, Any]) -> Residuals:
    """Return the residuals of one sensor and reason from its rows."""
    names, first, inverse = np.unique(columns["component"], return_index=True, return_inverse=True)
    # Components in the order in which the table names them.
    component = np.argsort(np.argsort(first, kind="stable"), kind="stable")[inverse]
    time, epoch = np.unique(columns["time_s"], return_inverse=True)
    # Two measurements may bear one time: the second has a component that was there before.
    order = np.lexsort((component, epoch))
    same = np.zeros(order.size, dtype=bool)
    same[1:] = (np.diff(epoch[order]) == 0) & (np.diff(component[order]) == 0)
    place = np.arange(order.size)
    repeat = np.empty(order.size, dtype=np.intp)
    repeat[order] = place - np.maximum.accumulate(np.where(same, 0, place))
    key, row = np.unique(epoch * (repeat.max() + 1) + repeat, return_inverse=True)
    residual, sigma = np.full((2, key.size, names.size), np.nan)
    residual[row, component] = columns["residual"]
    sigma[row, component] = columns["std"]
    return Residuals(
        label=str(columns["sensor"][0]),
        unit=str(columns["unit"][0]),
        components=tuple(map(str, names[np.argsort(first, kind="stable")])),
        time=time[key // (repeat.max() + 1)],
        residual=residual,
        sigma=sigma,
        reason=str(columns[_REASON][0]),
    )
