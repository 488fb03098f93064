"""Tables of results for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec import UnsetType
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from factorgraph_dvl.analysis.comparison.halves import Halves
from factorgraph_dvl.analysis.convergence import Convergence
from factorgraph_dvl.analysis.error_statistics import CalibrationErrors
from factorgraph_dvl.errors import printable
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.plausibility.survey import Survey
from factorgraph_dvl.quality.notation import at_precision, fixed, split_unit, with_std
from factorgraph_dvl.quality.verdict import Verdict
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.solution import Solution

# Of findings, by severity.
STYLES = {"error": "red", "warning": "yellow", "note": "", "ok": "green"}
# Of verdicts and grades.
VERDICT_COLOURS = {"good": "green", "doubtful": "yellow", "do not use": "red"}
GRADES = {"green": "green", "orange": "yellow", "red": "red", "grey": "dim"}
# Chosen: wider than any table, in columns.
_UNLIMITED = 10_000
# Chosen: a column of names is at least so wide, in columns.
_LEAST_NAME = 12


def calibration_table(
    solution: Solution, errors: CalibrationErrors | None = None, *, width: int = _UNLIMITED
) -> Table:
    """Return a table of the calibration: value, and standard deviation against the prior's.

    Parameters
    ----------
    solution : Solution
        Solution with the estimates.
    errors : CalibrationErrors, optional
        Errors against the truth, if that is known.
    width : int, optional
        Columns of the terminal. If they are too few, the prior is omitted and the unit joins the
        name; the table may still be wider.
    """
    table = _calibration_table(solution, errors, brief=False)
    if width_of(table) > width:
        return _calibration_table(solution, errors, brief=True)
    return table


def _calibration_table(
    solution: Solution, errors: CalibrationErrors | None, *, brief: bool
) -> Table:
    known = {}
    if errors is not None:
        rows = zip(errors.truth.tolist(), errors.normalised.tolist(), strict=True)
        known = dict(zip(errors.names, rows, strict=True))
    table = Table(title="Calibration")
    add_column(table, "parameter")
    add_column(table, "value ± std", numeric=True)
    if not brief:
        add_column(table, "unit")
        add_column(table, "prior std", numeric=True)
    add_column(table, "grade")
    if known:
        add_column(table, "truth", numeric=True)
        add_column(table, "error/σ", numeric=True)
    grades = solution.grades
    for estimate in solution.estimates:
        for i, component in enumerate(estimate.component_names):
            name, unit = split_unit(component)
            std = float(estimate.std[i])
            value = with_std(float(estimate.value[i]), std)
            row: list[str | Text]
            if brief:
                row = [f"{name}, {unit}" if unit else name, value]
            else:
                row = [name, value, unit, f"{float(estimate.prior_std[i]):.3g}"]
            grade = grades[estimate.name][i]
            row.append(Text(grade, GRADES[grade]))
            if component in known:
                truth, normalised = known[component]
                row.append(at_precision(truth, std))
                row.append(fixed(normalised, 2, signed=True) if math.isfinite(normalised) else "–")
            elif known:
                row += ["", ""]
            table.add_row(*row, end_section=component == estimate.component_names[-1])
    return table


def verdict_line(verdict: Verdict) -> Text:
    """Return the verdict on a result, its first reason, and what to do about it."""
    line = Text.assemble("Verdict: ", (verdict.grade, VERDICT_COLOURS[verdict.grade]))
    if verdict.reasons:
        first, *others = verdict.reasons
        line.append(f": {printable(str(first))}. {first.code.action}")
        if others:
            line.append(f" (Further reasons: {len(others)}.)")
    return line


def halves_table(halves: Halves) -> Table:
    """Return a table of the two halves of a trial against each other."""
    table = Table(title="Halves of the trial, solved apart")
    add_column(table, "parameter")
    for header in ("first", "second", "difference"):
        add_column(table, header, numeric=True)
    add_column(table, "unit")
    add_column(table, "in σ", numeric=True)
    rows = zip(
        halves.names,
        halves.first,
        halves.first_std,
        halves.second,
        halves.second_std,
        halves.difference,
        halves.std,
        strict=True,
    )
    for component, first, first_std, second, second_std, difference, std in rows:
        name, unit = split_unit(component)
        table.add_row(
            name,
            with_std(float(first), float(first_std)),
            with_std(float(second), float(second_std)),
            with_std(float(difference), float(std)),
            unit,
            fixed(float(difference / std), 2, signed=True) if std > 0.0 else "–",
        )
    table.caption = (
        f"χ² {halves.statistic:.1f} with {halves.freedom} degrees of freedom, "
        f"by chance {halves.probability:.2g}"
    )
    return table


def hypothesis_table(solution: Solution) -> Table:
    """Return a table of the hypotheses: trajectories that the data allow, or allowed at first."""
    table = Table(title="Hypotheses")
    for header in ("no.", "weight", "found at s", "until s", "from the first, m"):
        add_column(table, header, numeric=True)
    first = solution.hypotheses[0].trajectory
    for i, h in enumerate(solution.hypotheses, 1):
        end = h.trajectory.geodetic[-1]
        same = int(np.argmin(np.abs(first.time - h.trajectory.time[-1])))
        apart = np.linalg.norm(LocalFrame(*first.geodetic[same]).position(*end))
        table.add_row(
            f"{i}",
            f"{h.weight:.3f}",
            f"{h.born:.6g}",
            Text("alive", "green") if h.died is None else f"{h.died:.6g}",
            "" if i == 1 else f"{apart:.4g}",
        )
    return table


def rejected_line(solution: Solution) -> str:
    """Return the number of rejected measurements, by kind."""
    total = {r.label: r.time.size for r in solution.residuals}
    count: dict[str, int] = {}
    for r in solution.rejected:
        count[r.label] = count.get(r.label, 0) + r.time.size
    parts = [f"{n} of {n + total.get(label, 0)} {label}" for label, n in count.items()]
    return f"Rejected: {', '.join(parts)}; rejected.csv lists them"


def convergence_table(found: Convergence, start: float) -> Table:
    """Return a table of the times from which each component stayed within its limits.

    Parameters
    ----------
    found : Convergence
        Convergence of the calibration.
    start : float
        Start of the trial, s: the origin of the times shown.
    """
    table = Table(title="Convergence: time after which each component stayed within its limits")
    add_column(table, "component")
    for header in ("σ below", "since s", "error below", "since s"):
        add_column(table, header, numeric=True)
    truth = any(math.isfinite(c.error_since) for c in found.components)
    for c in found.components:
        name, unit = split_unit(c.name)
        table.add_row(
            name,
            f"{c.good_std:.3g} {unit}",
            _moment(c.std_since - start),
            f"{c.good_error:.3g} {unit}" if truth else "–",
            _moment(c.error_since - start) if truth else "–",
        )
    return table


def good_enough_line(found: Convergence, start: float) -> str:
    """Return the time after which the calibration stayed within its limits, as a sentence.

    Parameters
    ----------
    found : Convergence
        Convergence of the calibration.
    start : float
        Start of the trial, s.
    """
    if math.isfinite(found.good_since):
        return f"good enough after {found.good_since - start:.0f} s"
    if not found.components:
        return "no limits apply to what was estimated"
    late = [c.name for c in found.components if not math.isfinite(c.std_since)]
    why = ", ".join(late) or "measurements contradicted the estimate"
    return f"not good enough until the end: {why}"


def _moment(time: float) -> str:
    return f"{time:.1f}" if math.isfinite(time) else "never"


def sensor_table(survey: Survey) -> Table:
    """Return a table of the record of each sensor."""
    table = Table(title=Text(f"Trial {survey.trial}"))
    add_column(table, "sensor")
    for header in ("rate Hz", "samples", "from s", "to s", "gaps", "longest s", "missing %"):
        add_column(table, header, numeric=True)
    for s in survey.sensors:
        table.add_row(
            Text(s.label),
            f"{s.rate:.4g}" if math.isfinite(s.rate) else "–",
            f"{s.samples}",
            f"{s.start:.10g}",
            f"{s.end:.10g}",
            f"{s.gaps}",
            f"{s.longest_gap:.4g}" if s.gaps else "–",
            f"{100.0 * s.missing:.3g}",
        )
    return table


def width_of(table: Table) -> int:
    """Return the width of an uncut table, columns."""
    return Console(width=_UNLIMITED).measure(table).maximum


def fitted(table: Table, width: int, leave_out: Sequence[str] = ()) -> Table:
    """Return a table that fits a width, without the first of some columns that are in the way.

    Names that are still too long continue on the next line; numbers are never cut.

    Parameters
    ----------
    table : Table
        Of which all columns are numbers or names.
    width : int
        Columns of the terminal.
    leave_out : sequence of str
        Headers of columns, the least important first.
    """
    for header in leave_out:
        if width_of(table) <= width:
            break
        table = _copied(table, without=header)
    return table if width_of(table) <= width else _copied(table, fold=True)


def least_width_of(table: Table) -> int:
    """Return the width, columns, below which numbers would be cut, or names hard to read."""
    widths = [
        max(map(_width, (column.header, *column.cells)))
        if column.no_wrap
        else max(_width(column.header), _LEAST_NAME)
        for column in table.columns
    ]
    return sum(widths) + 3 * len(widths) + 1


def _width(cell: object) -> int:
    text = cell.plain if isinstance(cell, Text) else str(cell)
    return max(map(cell_len, text.split("\n")))


def _copied(table: Table, *, without: str = "", fold: bool = False) -> Table:
    """Return a table without a column; with `fold`, long names continue on the next line."""
    kept = [column for column in table.columns if column.header != without]
    copy = Table(title=table.title, caption=table.caption)
    for column in kept:
        wraps = fold and column.justify == "left"
        copy.add_column(column.header, justify=column.justify, no_wrap=not wraps, overflow="fold")
    cells = zip(*(column.cells for column in kept), strict=True)
    for row, texts in zip(table.rows, cells, strict=True):
        copy.add_row(*texts, end_section=row.end_section)
    return copy


def motion_line(survey: Survey) -> str:
    """Return duration, distance and speed on one line."""
    parts = [f"duration {survey.duration:.6g} s"]
    if math.isfinite(survey.distance):
        parts.append(f"distance {survey.distance:.6g} m")
    if math.isfinite(survey.speed_max):
        parts.append(f"speed {survey.speed_min:.3g} to {survey.speed_max:.3g} m/s")
    return ", ".join(parts)


def imu_lines(settings: ImuSettings) -> list[str]:
    """Return what a trial assumes of its gyros and accelerometers, one line each."""
    s = settings
    grade = "" if isinstance(s.grade, UnsetType) else f" ({s.grade} where not stated)"
    return [
        f"gyros{grade}: noise {s.gyro_noise_deg_sqrt_h:.4g} deg/√h, "
        f"bias {s.gyro_bias_std_deg_h:.4g} deg/h, walk {s.gyro_bias_walk_deg_h_sqrt_h:.4g} "
        f"deg/h/√h, scale {s.gyro_scale_std_ppm:.4g} ppm, axes {s.gyro_misalignment_std_deg:.4g} "
        f"deg, g-sensitivity {s.gyro_g_sensitivity_std_deg_h_g:.4g} deg/h/g",
        f"accelerometers{grade}: noise {s.accel_noise_ug_sqrt_hz:.4g} µg/√Hz, "
        f"bias {s.accel_bias_std_ug:.4g} µg, walk {s.accel_bias_walk_ug_sqrt_h:.4g} µg/√h, "
        f"scale {s.accel_scale_std_ppm:.4g} ppm, axes {s.accel_misalignment_std_deg:.4g} deg",
    ]


def finding_lines(survey: Survey) -> list[Text]:
    """Return a line for each finding."""
    return [
        Text.assemble((f"{f.severity}: ", STYLES[f.severity]), str(f)) for f in survey.findings
    ]


def add_column(table: Table, header: str, *, numeric: bool = False) -> None:
    """Add a column that is never cut; numbers are aligned to the right."""
    table.add_column(header, justify="right" if numeric else "left", no_wrap=True)
