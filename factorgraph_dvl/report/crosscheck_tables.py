"""A cross-check for the terminal: tables, and an explanation of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph_dvl.analysis.comparison.calibration_difference import AGREE_SIGMAS, Component
from factorgraph_dvl.analysis.comparison.crosscheck import AgainstTruth, CrossCheck
from factorgraph_dvl.analysis.comparison.motion_difference import (
    TWO_SIGMA_SHARE,
    MotionDifference,
    error_spreads,
    mean_nees,
)
from factorgraph_dvl.analysis.error_statistics import nees_band
from factorgraph_dvl.quality.notation import at_precision, split_unit, with_std
from factorgraph_dvl.report.table import Component as Named
from factorgraph_dvl.report.table import Mark, Table, unit_of

_STYLES = {"agree": "green", "differ": "red", "not comparable": "yellow"}


def component_table(check: CrossCheck) -> Table:
    """Return a table of every calibration component of both results, with its verdict."""
    table = Table(title="Calibration: A − B")
    table.column("parameter")
    for header in ("A ± σ", "B ± σ"):
        table.column(header, numeric=True, detail=True)
    table.column("A − B ± σ", numeric=True)
    table.column("in σ", numeric=True)
    table.column("which σ", detail=True)
    table.column("unit")
    table.column("verdict")
    table.column("reason", detail=True)
    components = check.components
    for i, c in enumerate(components):
        scale = _resolution(c)
        last = i + 1 == len(components) or components[i + 1].parameter != c.parameter
        table.row(
            Named(c.name),
            _value(c.a, c.std_a, scale),
            _value(c.b, c.std_b, scale),
            _value(c.difference, c.std, c.std if np.isfinite(c.std) else scale),
            _or_dash(c.in_sigmas, "+.2f"),
            "" if c.kind == "none" else c.kind,
            unit_of(c.name),
            Mark(c.verdict, _STYLES[c.verdict]),
            c.reason,
            end_section=last,
        )
    return table


def motion_table(motion: MotionDifference) -> Table:
    """Return a table of the differences of the trajectories, component by component."""
    span = f"{motion.time.size} epochs, {motion.time[0] + 0.0:.10g} to {motion.time[-1]:.10g} s"
    table = Table(title=f"Trajectory: A − B at {span}")
    table.column("component")
    for header in ("unit", "RMS", "largest", "at s", "RMS in σ", "largest in σ", "within 2σ %"):
        table.column(header, numeric=header != "unit")
    table.column("which σ")
    for i, (s, kind) in enumerate(zip(motion.spreads, motion.kinds, strict=True)):
        name, unit = split_unit(s.name)
        table.row(
            name,
            unit,
            f"{s.rms:.3g}",
            f"{s.largest:.3g}",
            f"{s.time_of_largest:.10g}",
            _or_dash(s.rms_sigmas, ".2f"),
            _or_dash(s.largest_sigmas, ".2f"),
            _or_dash(100.0 * s.within_2_sigma, ".1f"),
            "" if kind == "none" else kind,
            end_section=i % 3 == 2,
        )
    return table


def truth_tables(check: CrossCheck) -> list[Table]:
    """Return tables of the errors of both results against the known truth."""
    sides = (("A", check.truth_a), ("B", check.truth_b))
    out = []
    if any(side.calibration is not None for _, side in sides):
        out.append(_calibration_truth(sides))
    if any(side.trajectory is not None for _, side in sides):
        out.append(_trajectory_truth(sides))
    return out


def paragraph(check: CrossCheck) -> str:
    """Return text that explains the standard deviation, the verdicts and the joint test."""
    text = (
        "Both results come from the same data, so their errors are correlated: var(A − B) = "
        "σ_A² + σ_B² − 2 cov, with an unknown covariance. It is not negative for two sound "
        "estimates from the same data, so √(σ_A² + σ_B²) is an upper bound of the σ of A − B. A "
        "difference flagged here is significant; agreement may still fail a sharper test."
    )
    if check.efficient is None:
        text += " The table shows this bound; `--efficient A` or `B` selects the sharper test."
    else:
        other = "B" if check.efficient == "A" else "A"
        text += (
            f" {check.efficient} was declared efficient, so var(A − B) = σ_{other}² − "
            f"σ_{check.efficient}² (Hausman 1978). The table shows it where σ_{other} is larger, "
            "and the upper bound elsewhere."
        )
    text += f" Results agree within {AGREE_SIGMAS:g} times the σ shown."
    if any(c.kind in ("A alone", "B alone") for c in check.components):
        text += (
            " If one result states no σ, the σ of the other alone is shown: within it the results "
            "agree, beyond it they cannot be compared."
        )
    joint = check.joint
    if joint is not None:
        text += (
            f" Joint test of {len(joint.names)} components: χ² = {joint.statistic:.3g}, "
            f"limit {joint.limit:.3g}: they {joint.verdict}."
        )
        if not joint.correlations:
            text += " One result states no correlations; they were taken as zero."
    for name, angle in check.angles.items():
        text += f" Angle between the rotations of {name}: {angle:.3g}°."
    return text


def verdict_line(components: Sequence[Component]) -> str:
    """Return the number of components with each verdict."""
    counts = {v: sum(c.verdict == v for c in components) for v in _STYLES}
    return ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)


def _calibration_truth(sides: Sequence[tuple[str, AgainstTruth]]) -> Table:
    table = Table(title="Calibration: error against the truth")
    table.column("parameter")
    table.column("truth", numeric=True)
    for side, _ in sides:
        table.column(f"error of {side}", numeric=True)
        table.column("in its σ", numeric=True)
    table.column("unit")
    rows: dict[str, list[str]] = {}
    for k, (_, against) in enumerate(sides):
        errors = against.calibration
        if errors is None:
            continue
        for i, name in enumerate(errors.names):
            row = rows.setdefault(name, [f"{errors.truth[i]:.6g}", "–", "–", "–", "–"])
            row[1 + 2 * k] = _or_dash(float(errors.error[i]), "+.3g")
            row[2 + 2 * k] = _or_dash(float(errors.normalised[i]), "+.2f")
    for name, row in rows.items():
        short, unit = split_unit(name)
        table.row(short, *row, unit)
    table.end_section()
    nees, inside = ["NEES (expected)", ""], ["within 2σ (expected 95.4 %)", ""]
    for _, against in sides:
        errors = against.calibration
        if errors is None or errors.dof == 0:
            nees, inside = [*nees, "–", "–"], [*inside, "–", "–"]
            continue
        low, high = nees_band(errors.dof, 1)
        nees += [f"{errors.nees:.3g}", f"{low:.3g} to {high:.3g}"]
        z = np.abs(errors.normalised[errors.tested])
        inside += [f"{int((z <= 2.0).sum())} of {z.size}", f"{100.0 * (z <= 2.0).mean():.0f} %"]
    table.row(*nees, "")
    table.row(*inside, "")
    return table


def _trajectory_truth(sides: Sequence[tuple[str, AgainstTruth]]) -> Table:
    table = Table(title="Trajectory: error against the reference")
    table.column("component")
    table.column("unit")
    for side, _ in sides:
        for header in (f"RMS of {side}", f"largest of {side}", f"{side} in 2σ, %"):
            table.column(header, numeric=True)
    found = [
        None if against.trajectory is None else error_spreads(against.trajectory)
        for _, against in sides
    ]
    known = next(spreads for spreads in found if spreads is not None)
    for i in range(len(known)):
        name, unit = split_unit(known[i].name)
        cells: list[str] = []
        for spreads in found:
            if spreads is None:
                cells += ["–"] * 3
                continue
            s = spreads[i]
            share = _or_dash(100.0 * s.within_2_sigma, ".1f")
            cells += [f"{s.rms:.3g}", f"{s.largest:.3g}", share]
        table.row(name, unit, *cells, end_section=i % 3 == 2)
    for k, group in enumerate(("position", "velocity", "attitude")):
        cells = []
        for _, against in sides:
            errors = against.trajectory
            nees = "–" if errors is None else _or_dash(float(mean_nees(errors)[k]), ".2f")
            cells += [nees, "", ""]
        table.row(f"{group}: NEES (expected 3)", "", *cells)
    table.caption = f"Expected within 2σ: {100.0 * TWO_SIGMA_SHARE:.1f} %, over many trials"
    return table


def _or_dash(value: float, spec: str) -> str:
    if not np.isfinite(value):
        return "–"
    text = format(value, spec)
    # Never a negative zero.
    return text if float(text) != 0.0 else format(0.0, spec)


def _resolution(c: Component) -> float:
    """Return the σ that determines the digits to show."""
    known = [s for s in (c.std, c.std_a, c.std_b) if np.isfinite(s) and s > 0.0]
    return min(known) if known else float("nan")


def _value(value: float, std: float, resolution: float) -> str:
    if not np.isfinite(value):
        return "–"
    if not np.isfinite(std):
        return at_precision(value, resolution)
    return with_std(value, std) if std > 0.0 else f"{value:.6g} fixed"
