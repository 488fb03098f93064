"""The section of a page that shows residuals and dead reckoning before and after calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from factorgraph_dvl.report.html.content import Result
from factorgraph_dvl.report.html.markup import (
    Cell,
    Section,
    both,
    joined,
    paragraph,
    section,
    table,
)
from factorgraph_dvl.report.html.plots import Plot

TITLE = "Before and after calibration"
SOURCES = {
    "second half": "The calibration is that of the first half of the trial, tested with the data "
    "of the second half.",
    "same data": "The first half alone gives no calibration to use. So the calibration is tested "
    "with the data that it was estimated from, which makes errors look smaller.",
}
POSITIONS = {
    "reference": "Positions are compared with the reference.",
    "GNSS": "Positions are compared with GNSS, whose own noise is part of the error.",
    "INS": "Positions are compared with the INS.",
    "nothing": "No positions cover this time.",
}
ATTITUDE = "Attitude and velocity of the vehicle are those of the whole solution."
AXES = ("forward", "starboard", "down")
ERRORS = (
    ("end_point_error_m", "end point error, m"),
    ("end_point_percent", "end point error, % of distance"),
    ("global_error_m", "largest error, m"),
    ("rms_error_m", "RMS error, m"),
    ("distance_m", "distance, m"),
)


def check_plots(result: Result) -> list[Plot]:
    """Return residuals of the DVL before and after calibration, and errors of both tracks."""
    columns = result.check_table
    if not columns:
        return []
    time = columns["time_s"]
    plots = [
        Plot(
            f"check-{when}", f"DVL residual {when} calibration", "m/s", AXES, time,
            np.stack([columns[f"residual_{axis}_{when}_m_s"] for axis in AXES], axis=1),
        )
        for when in ("before", "after")
    ]  # fmt: skip
    if "track_error_after_m" in columns:
        values = np.stack(
            [columns[f"track_error_{when}_m"] for when in ("before", "after")], axis=1
        )
        names = ["before calibration", "after calibration"]
        title = "Position error of dead reckoning"
        plots.append(Plot("check-track", title, "m", names, time, values, log=True))
    return plots


def check_section(result: Result, plots: list[Plot]) -> Section | None:
    """Return numbers and plots before and after calibration; nothing where there is no check."""
    check = result.check
    if not check:
        return None
    rms = check["residual_rms_m_s"]
    after = check["dead_reckoning"]
    before = after.get("uncalibrated", {})
    rows: list[list[Cell]] = [
        [joined(both("RMS residual of the DVL, m/s:"), both(axis)), number(b), number(a)]
        for axis, b, a in zip(rms["axes"], rms["before"], rms["after"], strict=True)
    ]
    if "end_point_error_m" in after:
        rows += error_rows(before, after)
    header = [both("quantity"), both("before calibration"), both("after calibration")]
    texts = (SOURCES[check["data"]], ATTITUDE, POSITIONS[check["positions"]])
    return section(
        TITLE,
        paragraph(joined(*map(both, texts))),
        table(header, rows, label=TITLE, numeric=(1, 2)),
        *(p.html(result.start) for p in plots),
        key="check",
    )


def dead_reckoning_section(result: Result) -> Section | None:
    """Return errors of dead reckoning of another trial, if they were measured."""
    found = result.dead_reckoning
    if not found or "end_point_error_m" not in found:
        return None
    header = [both("quantity"), both("before calibration"), both("after calibration")]
    rows = error_rows(found.get("uncalibrated", {}), found)
    label = "Dead reckoning"
    return section(label, table(header, rows, label=label, numeric=(1, 2)), key="dead-reckoning")


def error_rows(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[list[Cell]]:
    """Return a row for each error of a track."""
    return [[both(name), number(before.get(k)), number(after.get(k))] for k, name in ERRORS]


def number(value: Any) -> str:
    """Return a number as text; a dash where it is not known."""
    return "–" if value is None else f"{value:.4g}"
