"""The page of a result, and the page that compares several: one file that works offline."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import msgspec
import numpy as np

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.quality.notation import fixed, with_std
from factorgraph_dvl.quality.texts import component_names
from factorgraph_dvl.report.html.certificate import certificate_section
from factorgraph_dvl.report.html.check import (
    check_plots,
    check_section,
    dead_reckoning_section,
)
from factorgraph_dvl.report.html.content import Result, redact
from factorgraph_dvl.report.html.markup import (
    Cell,
    Html,
    Section,
    both,
    component_cell,
    element,
    grade_cell,
    html,
    labels,
    paragraph,
    section,
    table,
)
from factorgraph_dvl.report.html.plots import shading_legend
from factorgraph_dvl.report.html.sections import (
    budget_section,
    calibration_section,
    clock_section,
    crosscheck_section,
    deviation_plots,
    flat_settings,
    halves_section,
    motion_plots,
    observability_section,
    residual_plots,
    residual_tables,
    segments_of,
    settings_section,
    titled,
    track_section,
    verdict_box,
    verdict_section,
)

UPLOT = "vendor/uplot-1.6.32"
# Nothing may be fetched: the page holds all it needs.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'"
)
# Half width of a drawn interval, in its own units.
_INTERVAL = 100.0


def report_page(result: Result, *, redacted: bool = False) -> str:
    """Return the page of a result.

    Parameters
    ----------
    result : Result
        What to show.
    redacted : bool, default False
        Leave out absolute positions, names of trials, and names of files.
    """
    if redacted:
        result = redact(result)
    segments = segments_of(result.solution)
    motion = motion_plots(result, segments)
    deviations = deviation_plots(result, segments)
    residuals = residual_plots(result)
    checks = check_plots(result)
    note = "Residual = predicted − measured, in units of its own σ. Dashed: ±3."
    sections = [
        verdict_section(result),
        calibration_section(result) if result.solution.estimates else None,
        check_section(result, checks),
        track_section(result),
        titled(motion, result.start, "Motion", "motion", shading_legend(segments)),
        titled(
            deviations,
            result.start,
            "Standard deviations along the trial",
            "deviations",
            shading_legend(segments),
        ),
        budget_section(result),
        observability_section(result, segments),
        titled(
            residuals,
            result.start,
            "Residuals",
            "residuals",
            paragraph(both(note)),
            *residual_tables(result),
        ),
        clock_section(result),
        halves_section(result),
        crosscheck_section(result),
        dead_reckoning_section(result),
        certificate_section(result),
        settings_section(result),
    ]
    plots = [*checks, *motion, *deviations, *residuals]
    data = [p.data(result.start) for p in plots]
    shown = [s for s in sections if s is not None]
    return whole_page("Calibration report", result.trial, shown, data, redacted=redacted)


def comparison_page(results: Sequence[Result], *, redacted: bool = False) -> str:
    """Return a page with several results side by side.

    Parameters
    ----------
    results : sequence of Result
        Results; at least two, with different names; the others are compared with the first.
    redacted : bool, default False
        Leave out absolute positions, names of trials, and names of files.
    """
    if redacted:
        letters = (chr(ord("A") + i % 26) + str(i // 26 or "") for i in range(len(results)))
        results = [_renamed(redact(r), next(letters)) for r in results]
    sections = [_overview(results), _values(results), _different_settings(results)]
    title = " · ".join(r.name for r in results)
    return whole_page("Comparison of results", title, sections, [], redacted=redacted)


def _renamed(result: Result, name: str) -> Result:
    return Result(**{f: getattr(result, f) for f in result.__dataclass_fields__} | {"name": name})


def _overview(results: Sequence[Result]) -> Section:
    boxes = [element("div", element("h3", r.name), verdict_box(r.solution.verdict))
             for r in results]  # fmt: skip
    rows = [
        [r.name, r.trial, r.solution.solver, both("yes" if r.solution.converged else "no")]
        for r in results
    ]
    header = [both(x) for x in ("result", "trial", "solver", "converged")]
    return section("Verdict", *boxes, table(header, rows, label="Verdict"), key="verdict")


def _values(results: Sequence[Result]) -> Section:
    """Return the values of all results, and how far each is from the first."""
    names = list(dict.fromkeys(n for r in results for n in r.solution.order))
    own = [_by_component(r) for r in results]
    rows: list[list[Cell]] = []
    for name in names:
        row: list[Cell] = [component_cell(name), component_names(name)[2]]
        first = own[0].get(name)
        for k, values in enumerate(own):
            found = values.get(name)
            if found is None:
                row += ["–", ""] if k == 0 else ["–", "", ""]
                continue
            value, std, grade = found
            row += [with_std(value, std), grade_cell(grade)]
            if k:
                larger = max(std, first[1]) if first else 0.0
                row.append(fixed((value - first[0]) / larger, 2) if first and larger else "–")
        row.append(_intervals([v.get(name) for v in own]))
        rows.append(row)
    header: list[Cell] = [both("parameter"), both("unit")]
    numeric: list[int] = []
    for k, r in enumerate(results):
        numeric += [len(header)] + ([len(header) + 2] if k else [])
        header += [r.name, both("grade")] + ([both("difference / σ")] if k else [])
    header.append(both("Values, ±1σ (thick) and ±3σ (thin)"))
    text = (
        "Difference from the first result, over the larger σ of the two. Results of the same "
        "data share errors, so check differences above 1."
    )
    return section(
        "Values against each other",
        paragraph(both(text)),
        table(header, rows, label="Values against each other", numeric=numeric),
        key="values",
    )


def _by_component(result: Result) -> dict[str, tuple[float, float, str]]:
    def rows(e: Estimate) -> zip[tuple[Any, ...]]:
        grades = result.solution.grades[e.name]
        return zip(e.component_names, e.value.tolist(), e.std.tolist(), grades, strict=True)

    return {n: (v, s, g) for e in result.solution.estimates for n, v, s, g in rows(e)}


def _intervals(found: Sequence[tuple[float, float, str] | None]) -> Html:
    """Return the values with ±1σ and ±3σ on one axis, one below the other."""
    known = [(v, s) for v, s, _ in (f for f in found if f is not None)]
    if not known or not all(np.isfinite(known).ravel()):
        return Html("")
    low = min(v - 3.0 * s for v, s in known)
    high = max(v + 3.0 * s for v, s in known)
    span = max(high - low, 1e-12)
    lines = []
    height = 10 * len(found)
    for i, f in enumerate(found):
        if f is None:
            continue
        y = 10 * i + 5
        value, std, _ = f

        def x(at: float) -> str:
            return f"{2.0 * _INTERVAL * (at - low) / span:.1f}"

        lines.append(
            f'<line x1="{x(value - 3 * std)}" x2="{x(value + 3 * std)}" y1="{y}" y2="{y}" '
            f'stroke="#0072b2" stroke-width="1"/><line x1="{x(value - std)}" '
            f'x2="{x(value + std)}" y1="{y}" y2="{y}" stroke="#0072b2" stroke-width="4"/>'
            f'<circle cx="{x(value)}" cy="{y}" r="3"/>'
        )
    return Html(
        f'<svg class="interval" style="height:{0.7 * len(found):.1f}rem" aria-hidden="true" '
        f'preserveAspectRatio="none" viewBox="-4 0 {2 * _INTERVAL + 8:g} {height}">'
        f"{''.join(lines)}</svg>"
    )


def _different_settings(results: Sequence[Result]) -> Section:
    own = [{(s, k): v for s, k, v in flat_settings(r.run.get("settings", {}))} for r in results]
    keys = list(dict.fromkeys(key for settings in own for key in settings))
    rows = [
        [f"{s}.{k}", *(settings.get((s, k), "–") for settings in own)]
        for s, k in keys
        if len({settings.get((s, k)) for settings in own}) > 1
    ]
    title = "Settings that differ"
    if not rows:
        return section(title, paragraph(both("All settings are equal.")), key="settings")
    header = [both("key"), *(r.name for r in results)]
    return section(title, table(header, rows, label=title), key="settings")


def whole_page(
    kind: str,
    name: Cell,
    sections: Sequence[Section],
    plots: Sequence[Any] = (),
    *,
    redacted: bool = False,
    title: str = "",
) -> str:
    """Return a whole page, with style, script and data inside.

    Parameters
    ----------
    kind : str
        What it is, as `words` lists it.
    name : Cell
        Heading.
    sections : sequence of Section
        What it contains.
    plots : sequence, optional
        Data of the plots in the sections.
    redacted : bool, default False
        Say that positions and names are left out.
    title : str, optional
        Title of the window; the heading if not given.
    """
    own = files("factorgraph_dvl.report")
    style = (own / UPLOT / "uPlot.min.css").read_text(encoding="utf-8")
    style += (own / "html" / "report.css").read_text(encoding="utf-8")
    scripts = [(own / UPLOT / "uPlot.iife.min.js").read_text(encoding="utf-8")]
    scripts.append((own / "html" / "report.js").read_text(encoding="utf-8"))
    licence = (own / UPLOT / "LICENSE").read_text(encoding="utf-8")
    # A script ends at the first `</`, wherever it stands.
    data = msgspec.json.encode({"plots": list(plots)}).decode().replace("</", "<\\/")
    keys = "Plots: drag to zoom, double-click to reset. Keyboard: arrows move, + and − zoom, 0 resets."  # noqa: E501
    hidden = "Positions, names of trials and names of files are left out."
    head = element(
        "header",
        element(
            "div",
            paragraph(both(kind)),
            element("div", element("button", "中文 / English", id_="language", type="button")),
            class_="bar",
        ),
        element("h1", name),
        *([paragraph(both(hidden))] if redacted else []),
        _contents(sections),
        *([element("p", both(keys), class_="keys")] if plots else []),
        element(
            "noscript",
            paragraph(
                both("Scripts are off, so there are no plots. Their tables contain the numbers.")
            ),
        ),
    )
    body = [
        head,
        element("main", *(s.html() for s in sections)),
        element("footer", "factorgraph-dvl. Plots: uPlot 1.6.32, MIT License."),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en" data-lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        f"{html(element('title', title or f'{kind}: {name}'))}\n<style>\n{style}</style>\n"
        "</head>\n"
        f"<body>\n{''.join(map(html, body))}\n"
        f'<script type="application/json" id="data">{data}</script>\n'
        f"<!--\nuPlot\n{licence}-->\n"
        + "".join(f"<script>{text}</script>\n" for text in scripts)
        + "</body>\n</html>\n"
    )


def _contents(sections: Sequence[Section]) -> Html:
    """Return links to the sections, by their headings."""
    links = [element("li", element("a", both(s.title), href=f"#{s.key}")) for s in sections]
    return element("nav", element("ul", *links), **labels("Contents"))
