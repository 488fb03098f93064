"""Luo et al. (2024), measured: observability of four manoeuvres, table 3."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.report.figures.drawing import ACCENT, DARK, GREY, new_figure, new_grid, style
from factorgraph_dvl.reproduce.entry import Entry, Result, judged, table
from factorgraph_dvl.reproduce.luo_2024_equations import ZERO, stack_of

_MANOEUVRES = ("drifting", "steady", "accelerating", "turning")
_STATES = ("α_x", "α_y", "α_z", "δK", "l_x", "l_y", "l_z")
_TABLE_3 = np.array(
    [
        [3.13e-20, 7.39e-17, 7.80e-21, 4.49e-20, 1.42e-18, 9.76e-19, 4.73e-23],
        [1.83e-19, 3.42e-16, 6.30e-19, 1.41e-20, 1.03e-18, 9.85e-19, 3.14e-23],
        [0.017, 2.17e-4, 0.097, 0.011, 2.94e-15, 8.88e-16, 8.09e-22],
        [2.95e-3, 9.24e-3, 0.013, 4.16e-3, 0.27, 0.46, 4.03e-15],
    ]
)
# What the rows H of a ping are reduced by, each a reading of the printed argument.
_READINGS: dict[str, Callable[[Array], Array | float]] = {
    "as they are": lambda rows: 0.0,
    "less their mean": lambda rows: rows.mean(axis=0),
    "less the first": lambda rows: rows[0],
}
# Where the axes of the figure begin; a value of zero is drawn there.
_LEAST = 1e-23


def _own_parts(reading: str) -> Array:
    """Return what is left of each state's column beside the other six, over √N, (4, 7)."""
    out = np.zeros((4, 7))
    for row, name in enumerate(_MANOEUVRES):
        pings = stack_of(f"luo-2024-{name}").reshape(-1, 3, 7)
        H = (pings - _READINGS[reading](pings)).reshape(-1, 7)
        for i in range(7):
            others = np.delete(H, i, axis=1)
            left = H[:, i] - others @ np.linalg.lstsq(others, H[:, i], rcond=None)[0]
            out[row, i] = np.linalg.norm(left) / np.sqrt(len(pings))
    return np.where(out > ZERO, out, 0.0)


def _agreeing(found: Array) -> int:
    """Return for how many of the six states that a manoeuvre shows the best one is the printed."""
    best = np.argmax(found[:, :6], axis=0)
    return int(np.sum(best == np.argmax(_TABLE_3[:, :6], axis=0)))


def _drawn(parts: dict[str, Array]) -> Figure:
    """Draw the printed table and its readings on the same axes."""
    tables = {"as printed": _TABLE_3, **{f"rows {name}": values for name, values in parts.items()}}
    figure = new_figure(16.0, 4.2)
    grid = new_grid(figure, 1, 4)
    for place, (title, values) in enumerate(tables.items()):
        ax = figure.add_subplot(grid[0, place])
        for row, (name, color, marker) in enumerate(
            zip(_MANOEUVRES, (GREY, DARK, "tab:orange", ACCENT), "svo^", strict=True)
        ):
            where = np.arange(7.0) + 0.12 * (row - 1.5)
            shown = np.maximum(values[row], _LEAST)
            ax.semilogy(where, shown, marker, color=color, ms=4, label=name)
        ax.set_ylim(_LEAST / 3.0, 10.0)
        ax.set_xticks(range(7), _STATES)
        ax.set_title(title, fontsize=9, loc="left")
        style(ax, "", "" if place else f"observability (0 is drawn at {_LEAST:g})")
    figure.axes[0].legend(fontsize=7)
    return figure


def _table_3(seeds: int) -> Result:
    parts = {reading: _own_parts(reading) for reading in _READINGS}
    found = parts["less their mean"]
    same = {reading: _agreeing(values) for reading, values in parts.items()}
    at_rest = bool(np.all(found[:2] == 0.0))
    lever = bool(np.all(found[:3, 4:6] == 0.0) and np.all(found[3, 4:6] > 0.0))
    vertical = bool(np.all(found[:, 6] == 0.0))
    steady = np.linalg.svd(stack_of("luo-2024-steady"), compute_uv=False)
    header = ["", *_STATES]
    lines: list[str] = []
    for title, values in (*parts.items(), ("printed", _TABLE_3)):
        heading = title if title == "printed" else f"rows {title}"
        rows = [
            [name, *(f"{x:.3g}" if x > 0.0 else "0" for x in row)]
            for name, row in zip(_MANOEUVRES, values, strict=True)
        ]
        lines += [f"{heading[0].upper()}{heading[1:]}:", "", *table(header, rows), ""]

    def said(holds: bool) -> str:
        return "yes" if holds else "no"

    return Result(
        "best manoeuvre as printed for "
        + ", ".join(f"{count} of 6 states with rows {name}" for name, count in same.items())
        + f". Less their mean: drifting and steady zero for all: {said(at_rest)}; l_x and l_y in "
        f"the turn alone: {said(lever)}; l_z nowhere: {said(vertical)}; sizes differ (α_x "
        f"accelerating {found[2, 0]:.2g}, printed {_TABLE_3[2, 0]:g})",
        judged(
            bool(np.allclose(found, _TABLE_3, rtol=0.5, atol=ZERO)),
            same["less their mean"] == 6 and at_rest and lever and vertical,
        ),
        (
            *lines,
            "Each value is that part of the column of a state in H that the other six columns "
            "cannot replace, over √N. 0: the manoeuvre does not show the state. The paper argues "
            "by the change of H, and two readings follow it. Rows less their mean: the velocity "
            "has a constant offset that nobody knows. Rows less the first: only what changes "
            "after the first ping counts. The turn begins with 1 s straight ahead. The printed "
            "values are no singular values of the stacked matrix: a steady 4 m/s has three of "
            f"4 √N = {steady[2]:.0f}.",
        ),
        _drawn(parts),
    )


TABLE_3 = Entry(
    "table 3",
    "singular values of four manoeuvres",
    "`configs/luo-2024-*.yaml`",
    _table_3,
)
