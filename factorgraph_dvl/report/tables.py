"""Tables and lines of results, for the terminal and for pages."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType

import numpy as np
from msgspec import UnsetType
from rich.text import Text

from factorgraph_dvl.analysis.comparison.halves import Halves
from factorgraph_dvl.analysis.convergence import Convergence
from factorgraph_dvl.analysis.error_statistics import CalibrationErrors
from factorgraph_dvl.analysis.information.marginals import Marginals
from factorgraph_dvl.errors import printable
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.plausibility.survey import Survey
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.quality.notation import at_precision, fixed, sentence, split_unit, with_std
from factorgraph_dvl.quality.verdict import Verdict
from factorgraph_dvl.report.table import Cell, Component, Mark, Table, unit_of
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.solution import Solution

# Of findings, by severity.
STYLES = {"error": "red", "warning": "yellow", "note": "", "ok": "green"}
# Of verdicts and grades.
VERDICT_COLOURS = {"good": "green", "doubtful": "yellow", "do not use": "red"}
GRADES = {"green": "green", "orange": "yellow", "red": "red", "grey": "dim"}
# What the table of the calibration is, where it has a misalignment.
FOR_EXPERTS = (
    "For experts: this table has the numbers of calibration.json. The misalignment is the "
    "rotation vector from body to DVL, and vectors are in the body axes of the trial. "
    "Do not enter them."
)


def calibration_table(
    solution: Solution, known: Mapping[str, tuple[float, float]] = MappingProxyType({})
) -> Table:
    """Return a table of the calibration: values, what was known before, limits and grades.

    Parameters
    ----------
    solution : Solution
        Solution with the estimates.
    known : mapping of str to (float, float), optional
        Truth by component, and the error over its standard deviation.
    """
    table = Table(title="Calibration")
    table.column("parameter")
    table.column("value ± σ", numeric=True)
    table.column("unit")
    table.column("before the trial", numeric=True, detail=True)
    table.column("limit of σ", numeric=True, detail=True)
    table.column("grade")
    if known:
        table.column("truth", numeric=True)
        table.column("error / σ", numeric=True)
    grades = solution.grades
    for e in solution.estimates:
        limit = solution.limits.get(e.name)
        for i, name in enumerate(e.component_names):
            value, std, prior = float(e.value[i]), float(e.std[i]), float(e.prior_std[i])
            row: list[Cell] = [
                Component(name),
                with_std(value, std),
                unit_of(name),
                f"{float(e.prior_value[i]):.4g} ± {prior:.3g}" if math.isfinite(prior) else "–",
                f"{limit:g}" if limit is not None else "",
                Mark(grades[e.name][i], GRADES[grades[e.name][i]]),
            ]
            if name in known:
                truth, error = known[name]
                row.append(at_precision(truth, std))
                row.append(fixed(error, 2, signed=True) if math.isfinite(error) else "–")
            elif known:
                row += ["", ""]
            table.row(*row, end_section=name == e.component_names[-1])
    return table


def known_errors(errors: CalibrationErrors | None) -> dict[str, tuple[float, float]]:
    """Return truth and normalised error by component, as `calibration_table` takes them."""
    if errors is None:
        return {}
    rows = zip(errors.truth.tolist(), errors.normalised.tolist(), strict=True)
    return dict(zip(errors.names, rows, strict=True))


def posterior_table(m: Marginals) -> Table:
    """Return a table of what is known of each component after the trial and before it."""
    table = Table(title="Posterior against prior")
    table.column("parameter")
    table.column("value ± σ", numeric=True, detail=True)
    table.column("unit")
    table.column("before the trial", numeric=True)
    table.column("σ / prior σ", numeric=True)
    table.column("observable")
    table.column("grade")
    for i, name in enumerate(m.names):
        table.row(
            Component(name),
            with_std(float(m.value[i]), float(m.std[i])),
            unit_of(name),
            f"{float(m.prior_std[i]):.3g}",
            f"{float(m.ratio[i]):.2g}",
            Mark("yes", "green") if m.observable[i] else Mark("no", "yellow"),
            Mark(m.grade[i], GRADES[m.grade[i]]),
        )
    return table


def verdict_line(verdict: Verdict) -> Text:
    """Return the verdict on a result, its first reason, and what to do about it."""
    line = Text.assemble("Verdict: ", (verdict.grade, VERDICT_COLOURS[verdict.grade]))
    if verdict.reasons:
        first, *others = verdict.reasons
        line.append(f": {sentence(printable(str(first)))} {first.code.action}")
        if others:
            line.append(f" (Further reasons: {len(others)}.)")
    return line


def halves_table(halves: Halves) -> Table:
    """Return a table of the two halves of a trial against each other."""
    table = Table(title="Halves of the trial, solved apart")
    table.column("parameter")
    for header in ("first", "second", "difference"):
        table.column(header, numeric=True)
    table.column("unit")
    table.column("in σ", numeric=True)
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
        table.row(
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
        table.column(header, numeric=True)
    first = solution.hypotheses[0].trajectory
    for i, h in enumerate(solution.hypotheses, 1):
        end = h.trajectory.geodetic[-1]
        same = int(np.argmin(np.abs(first.time - h.trajectory.time[-1])))
        apart = np.linalg.norm(LocalFrame(*first.geodetic[same]).position(*end))
        table.row(
            f"{i}",
            f"{h.weight:.3f}",
            f"{h.born:.6g}",
            Mark("alive", "green") if h.died is None else f"{h.died:.6g}",
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
    table.column("component")
    for header in ("σ below", "since s", "error below", "since s"):
        table.column(header, numeric=True)
    truth = any(math.isfinite(c.error_since) for c in found.components)
    for c in found.components:
        name, unit = split_unit(c.name)
        table.row(
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
    table = Table(title=(f"Trial {survey.trial}"))
    table.column("sensor")
    for header in ("rate Hz", "samples", "from s", "to s", "gaps", "longest s", "missing %"):
        table.column(header, numeric=True)
    for s in survey.sensors:
        table.row(
            s.label,
            f"{s.rate:.4g}" if math.isfinite(s.rate) else "–",
            f"{s.samples}",
            f"{s.start:.10g}",
            f"{s.end:.10g}",
            f"{s.gaps}",
            f"{s.longest_gap:.4g}" if s.gaps else "–",
            f"{100.0 * s.missing:.3g}",
        )
    return table


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


def finding_lines(findings: Iterable[Finding]) -> list[Text]:
    """Return a line for each finding."""
    return [Text.assemble((f"{f.severity}: ", STYLES[f.severity]), str(f)) for f in findings]


# Causes that are shown of each component. Chosen: they make up nearly all of it.
_SHOWN = 3


def error_budget_table(solution: Solution) -> Table:
    """Return a table of the largest causes of the standard deviation of each component."""
    table = Table(title="Error budget: largest contributions to each σ")
    table.column("parameter")
    table.column("unit")
    table.column("σ", numeric=True)
    table.column("adds", numeric=True)
    table.column("cause")
    std = np.concatenate([e.std for e in solution.estimates])
    for i, name in enumerate(solution.order):
        if std[i] <= 0.0:
            continue
        largest = sorted(solution.error_budget, key=lambda c: -float(c.adds[i]))[:_SHOWN]
        for k, cause in enumerate(largest):
            first = (Component(name), unit_of(name), f"{std[i]:.2g}") if k == 0 else ("", "", "")
            table.row(*first, f"{cause.adds[i]:.2g}", cause.cause)
        table.end_section()
    return table
