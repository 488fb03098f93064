"""A solution in a few lines: as text, and as HTML for notebooks."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

from factorgraph_dvl.errors import printable
from factorgraph_dvl.report.text import split_unit, with_std
from factorgraph_dvl.solution import Solution

_HEADER = ("parameter", "value ± std", "unit", "grade")


def overview(solution: Solution) -> str:
    """Return verdict and calibration as lines of text; see `Solution.summary`."""
    rows = [_HEADER, *_rows(solution)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEADER))]
    table = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return "\n".join([*_head(solution), *table])


def html_overview(solution: Solution) -> str:
    """Return the same as HTML."""
    head = "".join(f"<p>{escape(line)}</p>" for line in _head(solution))
    header = "".join(f"<th>{escape(cell)}</th>" for cell in _HEADER)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in _rows(solution)
    )
    return f"{head}<table><tr>{header}</tr>{body}</table>"


def _head(solution: Solution) -> tuple[str, ...]:
    first, *reasons = str(solution.verdict).split(": ", 1)
    name = printable(solution.trial or "unnamed")
    lines = [f"{name}, solved by {printable(solution.solver or 'an unnamed solver')}: {first}"]
    return (*lines, *(printable(reason) for reason in reasons))


def _rows(solution: Solution) -> Iterator[tuple[str, str, str, str]]:
    """Yield a row for each component of the calibration."""
    grades = solution.grades
    for e in solution.estimates:
        for i, component in enumerate(e.component_names):
            name, unit = split_unit(component)
            yield name, with_std(float(e.value[i]), float(e.std[i])), unit, grades[e.name][i]
