"""The section of a page that shows residuals and dead reckoning before and after calibration."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from factorgraph_dvl.geometry.rotations import FRD_NAMES
from factorgraph_dvl.report.check import (
    TITLE,
    Row,
    check_rows,
    check_texts,
    error_rows,
)
from factorgraph_dvl.report.html.content import Result
from factorgraph_dvl.report.html.markup import (
    Html,
    Section,
    both,
    joined,
    paragraph,
    section,
    table,
)
from factorgraph_dvl.report.html.plots import Plot


def check_plots(result: Result) -> list[Plot]:
    """Return residuals of the DVL before and after calibration, and errors of both tracks."""
    columns = result.check_table
    if not columns:
        return []
    time = columns["time_s"]
    plots = [
        Plot(
            f"check-{when}", f"DVL residual {when} calibration", "m/s", FRD_NAMES, time,
            np.stack([columns[f"residual_{axis}_{when}_m_s"] for axis in FRD_NAMES], axis=1),
            axis="DVL residual",
        )
        for when in ("before", "after")
    ]  # fmt: skip
    if np.isfinite(columns.get("track_error_after_m", np.nan)).any():
        values = np.stack(
            [columns[f"track_error_{when}_m"] for when in ("before", "after")], axis=1
        )
        names = ["before calibration", "after calibration"]
        title = "Position error of dead reckoning"
        plots.append(
            Plot("check-track", title, "m", names, time, values, log=True, axis="position error")
        )
    return plots


def check_section(result: Result, plots: Sequence[Plot]) -> Section | None:
    """Return numbers and plots before and after calibration; nothing where there is no check."""
    if not result.check:
        return None
    return section(
        TITLE,
        paragraph(joined(*map(both, check_texts(result.check)))),
        _table(check_rows(result.check), TITLE),
        *(p.html(result.start) for p in plots),
        key="check",
    )


def dead_reckoning_section(result: Result) -> Section | None:
    """Return errors of dead reckoning of another trial, if they were measured."""
    found = result.dead_reckoning
    if not found or "end_point_error_m" not in found:
        return None
    title = "Dead reckoning"
    return section(title, _table(error_rows(found), title), key="dead-reckoning")


def _table(rows: Iterable[Row], label: str) -> Html:
    header = [both("quantity"), both("before calibration"), both("after calibration")]
    cells = [[joined(*map(both, names)), before, after] for names, before, after in rows]
    return table(header, cells, label=label, numeric=(1, 2))
