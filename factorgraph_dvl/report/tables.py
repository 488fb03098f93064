"""Tables of results for the terminal."""

from __future__ import annotations

import math

from rich.table import Table
from rich.text import Text

from factorgraph_dvl.analysis.consistency import CalibrationErrors
from factorgraph_dvl.analysis.survey import Survey
from factorgraph_dvl.solution import Solution

_UNITS = {"deg_h": "deg/h", "m_s": "m/s", "deg": "deg", "ug": "µg", "m": "m", "s": "s"}
_STYLES = {"error": "red", "warning": "yellow", "ok": "green"}


def calibration_table(solution: Solution, errors: CalibrationErrors | None = None) -> Table:
    """Render the calibration: value and standard deviation against the prior's.

    Parameters
    ----------
    solution : with the estimates.
    errors : against the truth, if that is known.
    """
    known = {}
    if errors is not None:
        normalised = errors.normalised
        known = {
            name: (float(errors.truth[i]), float(normalised[i]))
            for i, name in enumerate(errors.names)
        }
    table = Table(title="Calibration")
    for header in ("parameter", "value ± std", "unit", "prior std", "observable"):
        numeric = header in ("value ± std", "prior std")
        table.add_column(header, justify="right" if numeric else "left", no_wrap=True)
    if known:
        table.add_column("truth", justify="right", no_wrap=True)
        table.add_column("error/σ", justify="right", no_wrap=True)
    for estimate in solution.estimates:
        for i, component in enumerate(estimate.component_names):
            name, unit = split_unit(component)
            value, std = float(estimate.value[i]), float(estimate.std[i])
            observable = bool(estimate.observable[i])
            row: list[str | Text] = [
                name,
                with_std(value, std),
                unit,
                f"{float(estimate.prior_std[i]):.3g}",
                Text("yes", "green") if observable else Text("no", "yellow"),
            ]
            if component in known:
                truth, normalised_error = known[component]
                row += [at_precision(truth, std), or_dash(normalised_error, "+.2f")]
            elif known:
                row += ["", ""]
            table.add_row(*row, end_section=component == estimate.component_names[-1])
    return table


def sensor_table(survey: Survey) -> Table:
    """Render what was recorded by each sensor."""
    table = Table(title=f"Trial {survey.trial}")
    table.add_column("sensor")
    for header in ("rate Hz", "samples", "from s", "to s", "gaps", "longest s", "missing %"):
        table.add_column(header, justify="right", no_wrap=True)
    for s in survey.sensors:
        table.add_row(
            s.label,
            or_dash(s.rate, ".4g"),
            f"{s.samples}",
            f"{s.start:.10g}",
            f"{s.end:.10g}",
            f"{s.gaps}",
            f"{s.longest_gap:.4g}" if s.gaps else "–",
            f"{100.0 * s.missing:.3g}",
        )
    return table


def motion_line(survey: Survey) -> str:
    """Render duration, distance and speed on one line."""
    parts = [f"duration {survey.duration:.6g} s"]
    if math.isfinite(survey.distance):
        parts.append(f"distance {survey.distance:.6g} m")
    if math.isfinite(survey.speed_max):
        parts.append(f"speed {survey.speed_min:.3g} to {survey.speed_max:.3g} m/s")
    return ", ".join(parts)


def finding_lines(survey: Survey) -> list[Text]:
    """Render the findings, one line each."""
    return [
        Text.assemble((f"{f.severity}: ", _STYLES[f.severity]), f"{f.sensor}: {f.text}")
        for f in survey.findings
    ]


def split_unit(component: str) -> tuple[str, str]:
    """Split `lever_arm_x_m` into `lever_arm_x` and a unit to show."""
    for suffix, unit in _UNITS.items():
        if component.endswith(f"_{suffix}"):
            return component.removesuffix(f"_{suffix}"), unit
    return component, ""


def with_std(value: float, std: float) -> str:
    """Write a value and its standard deviation, to two digits of the latter."""
    return f"{at_precision(value, std)} ± {at_precision(std, std)}"


def at_precision(value: float, std: float) -> str:
    """Write a value to two digits of its standard deviation."""
    if not (math.isfinite(std) and std > 0.0 and math.isfinite(value)):
        return f"{value:.6g}"
    decimals = 1 - math.floor(math.log10(std))
    return f"{value:.{min(max(decimals, 0), 12)}f}"


def or_dash(value: float, spec: str) -> str:
    """Write a number; nan and infinity as a dash."""
    return format(value, spec) if math.isfinite(value) else "–"
