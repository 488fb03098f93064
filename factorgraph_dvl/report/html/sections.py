"""The sections of the page of one result."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from factorgraph_dvl.analysis.error_statistics import true_value_of
from factorgraph_dvl.analysis.information.further_manoeuvres import further_manoeuvres
from factorgraph_dvl.analysis.information.manoeuvres import Segment, find_segments
from factorgraph_dvl.analysis.information.marginals import marginals
from factorgraph_dvl.analysis.instrument_terms import has_instrument_terms
from factorgraph_dvl.estimates import Cause
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.quality.notation import fixed, in_words
from factorgraph_dvl.quality.texts import chinese_cause, component_names
from factorgraph_dvl.quality.verdict import Verdict
from factorgraph_dvl.report.html.content import Result
from factorgraph_dvl.report.html.entries import entries_content
from factorgraph_dvl.report.html.markup import (
    Cell,
    Html,
    Section,
    both,
    component_cell,
    described,
    element,
    folded,
    items,
    joined,
    paragraph,
    said,
    section,
    table,
)
from factorgraph_dvl.report.html.plots import Plot
from factorgraph_dvl.report.html.steps import steps_drawing
from factorgraph_dvl.report.html.track import track_svg
from factorgraph_dvl.report.tables import FOR_EXPERTS, calibration_table, posterior_table
from factorgraph_dvl.solution import Solution

# Class of each verdict in the style sheet.
_CLASSES = {"good": "good", "doubtful": "doubtful", "do not use": "unusable"}
# Edge of the plots of residuals, and lines in them, in σ.
_PANEL, _BAND = 6.0, 3.0
# Causes with a colour of their own: Tol's muted scheme, which colour-blind readers distinguish.
_SHADES = ("#332288", "#88ccee", "#117733", "#ddcc77", "#cc6677", "#aa4499", "#44aa99", "#999933")
_REST = "#dddddd"
# Causes in words beside each bar. Chosen: they make up nearly all of it.
_NAMED = 2
# Chosen: more manoeuvres than this fill a screen and more.
_MOST_SEGMENTS = 200
_MANOEUVRES = {
    "straight": "straight ahead at constant speed",
    "speed": "half speed, then full speed",
    "turns": "turns to both sides at 3 deg/s",
    "pitching": "pitching by 10 deg, up and down",
}


def verdict_section(result: Result) -> Section:
    """Return what was found, how sure it is, what is wrong, and what to do."""
    solution = result.solution
    verdict = solution.verdict
    cells: list[Cell] = [verdict_box(verdict)]
    if has_instrument_terms(solution):
        cells += entries_content(result)
    elif main := [e for e in solution.estimates if e.name in solution.limits]:
        shown = calibration_table(replace(solution, estimates=tuple(main))).brief()
        cells.append(element("h3", both("What was found")))
        cells.append(described(shown, label="What was found"))
    if verdict.reasons:
        cells.append(element("h3", both("Problems, and what to do")))
        cells += [_reason(f) for f in verdict.reasons]
    notes = [f for f in solution.findings if f.severity == "note"]
    if notes:
        cells.append(folded("Notes", items([joined(_what(f), _code(f)) for f in notes])))
    return section("Verdict", *cells, key="verdict")


def verdict_box(verdict: Verdict) -> Html:
    """Return the grade of a verdict, with its first reason."""
    if verdict.reasons:
        first = _what(verdict.reasons[0])
    else:
        first = both("The checks found nothing wrong.")
    return element(
        "div",
        element("strong", both(verdict.grade)),
        paragraph(first),
        class_=f"verdict {_CLASSES[verdict.grade]}",
    )


def _what(finding: Finding) -> Html:
    """Return what was found."""
    return both(str(finding), finding.chinese)


def _reason(finding: Finding) -> Html:
    code = finding.code
    return element(
        "div",
        paragraph(element("b", _what(finding)), Html(" "), _code(finding)),
        paragraph(both(code.why, code.text("why", "zh"))),
        paragraph(
            element("b", both("What to do:")), " ", both(code.action, code.text("action", "zh"))
        ),
        class_="reason",
    )


def _code(finding: Finding) -> Html:
    return element("code", str(finding.code))


def calibration_section(result: Result) -> Section:
    """Return every component with its prior, its grade, and the truth where that is known."""
    solution = result.solution
    truth = result.run.get("truth", {})
    known = {
        name: (true, (value - true) / std if std > 0.0 else np.nan)
        for e in solution.estimates
        if (all_true := true_value_of(e, truth)) is not None
        for name, value, std, true in zip(
            e.component_names, e.value.tolist(), e.std.tolist(), all_true.tolist(), strict=True
        )
    }
    return section(
        "Calibration",
        paragraph(both(
            "Grades: green, σ is within its limit; orange, up to twice the limit; red, above "
            "that; grey, the data did not halve the σ known before the trial."
        )),
        *(
            [paragraph(both(FOR_EXPERTS))] if has_instrument_terms(solution) else []
        ),
        described(calibration_table(solution, known), label="Calibration"),
        *_noise(solution),
        key="calibration",
    )  # fmt: skip


def _noise(solution: Solution) -> Iterator[Html]:
    if solution.noise:
        yield element("h3", both("Noise against what is stated"))
        rows = [
            [both(in_words(n.name)), ", ".join(f"{f:.3g}" for f in np.atleast_1d(n.factor))]
            for n in solution.noise
        ]
        header = [both("measurement"), both("factor")]
        yield table(header, rows, label="Noise against what is stated", numeric=(1,))


def track_section(result: Result) -> Section:
    """Return the track on a plain grid."""
    trajectory = result.solution.trajectory
    cells: list[Cell] = [track_svg(trajectory)]
    cells.append(paragraph(both("Circle: start. Square: end. Dots: time since the start.")))
    if not result.redacted:
        lat, lon, height = trajectory.geodetic[0]
        cells.append(paragraph(
            both("start of the track"),
            f": {lat / DEG:.6f}°, {lon / DEG:.6f}°, {height:.2f} m",
        ))  # fmt: skip
    return section("Track", *cells, key="track")


def motion_plots(result: Result, segments: Sequence[Segment]) -> list[Plot]:
    """Return speed, heading, roll and pitch, and height over time."""
    t = result.solution.trajectory
    first = int(np.argmax(np.isfinite(t.geodetic).all(axis=1)))
    up = LocalFrame(*t.geodetic[first]).position(*t.geodetic.T)[:, 2:]
    speed = np.linalg.norm(t.velocity[:, :2], axis=1)[:, None]
    heading = np.unwrap(np.nan_to_num(t.rph[:, 2]))[:, None] / DEG
    plots = [
        Plot("speed", "Speed over ground", "m/s", ["speed"], t.time, speed, segments),
        Plot("heading", "Heading", "deg", ["heading"], t.time, heading, segments, cycle=360.0),
    ]
    if np.nanmax(np.abs(t.rph[:, :2]), initial=0.0) > 0.0:
        rp = t.rph[:, :2] / DEG
        plots.append(
            Plot("attitude", "Roll and pitch", "deg", ["roll", "pitch"], t.time, rp, segments)
        )
    plots.append(Plot("height", "Height above the start", "m", ["height"], t.time, up, segments))
    return plots


def deviation_plots(result: Result, segments: Sequence[Segment]) -> list[Plot]:
    """Return the standard deviations of the motion, and of the calibration as it converged."""
    t = result.solution.trajectory
    enu, rph = ["east", "north", "up"], ["roll", "pitch", "heading"]
    plots = [
        Plot("std-position", "σ of position", "m", enu, t.time, t.position_std, segments),
        Plot("std-velocity", "σ of velocity", "m/s", enu, t.time, t.velocity_std, segments),
        Plot("std-attitude", "σ of attitude", "deg", rph, t.time, t.rph_std / DEG, segments),
    ]
    plots = [p for p in plots if np.isfinite(p.values).any() and np.nanmax(p.values) > 0.0]
    if result.history is not None:
        time, names, std = result.history
        for e in result.solution.estimates:
            columns = [names.index(n) for n in e.component_names if n in names]
            if columns and np.isfinite(std[:, columns]).any():
                shown = [component_names(names[c])[0] for c in columns]
                unit = component_names(names[columns[0]])[2]
                plots.append(
                    Plot(f"std-{e.name}", "σ along the trial", unit, shown, time,
                         std[:, columns], segments, about=in_words(e.spec.stem),
                         log=True)
                )  # fmt: skip
    return plots


def budget_section(result: Result) -> Section | None:
    """Return what each cause adds to the standard deviations, as bars and as numbers."""
    solution = result.solution
    causes = solution.error_budget
    if not causes:
        return None
    std = np.concatenate([e.std for e in solution.estimates])
    shown = causes[: len(_SHADES)]
    legend = [
        element("li", element("span", class_="swatch", style=f"background:{colour}"), _cause(c))
        for c, colour in zip(shown, _SHADES, strict=False)
    ]
    if len(causes) > len(shown):
        swatch = element("span", class_="swatch", style=f"background:{_REST}")
        legend.append(element("li", swatch, both("all others")))
    rows, known = [], []
    for i, name in enumerate(solution.order):
        if std[i] <= 0.0:
            continue
        total = sum(float(c.adds[i]) ** 2 for c in causes) or 1.0
        shares = [float(c.adds[i]) ** 2 / total for c in causes]
        largest = sorted(range(len(causes)), key=lambda k: -shares[k])[:_NAMED]
        parts = [(causes[k].cause, f"{100.0 * shares[k]:.0f} %") for k in largest]
        named = "; ".join(f"{cause} {share}" for cause, share in parts)
        own = "；".join(f"{chinese_cause(cause)} {share}" for cause, share in parts)
        unit = component_names(name)[2]
        rows.append(
            [
                component_cell(name),
                f"{std[i]:.2g} {unit}",
                _bar(shares, named, own),
                both(named, own),
            ]
        )
        known.append(i)
    header = [both(x) for x in ("parameter", "σ now", "share of the variance", "largest causes")]
    return section(
        "Error budget",
        paragraph(both("Contribution of each cause to σ. The squares add up to σ².")),
        element("ul", *legend, class_="legend"),
        table(header, rows, label="Error budget", numeric=(1,)),
        folded(
            "All numbers",
            table(
                [both("cause"), *(_with_unit(solution.order[i]) for i in known)],
                [[_cause(c), *(f"{float(c.adds[i]):.2g}" for i in known)] for c in causes],
                label="All numbers",
                numeric=range(1, 1 + len(known)),
            ),
        ),
        key="budget",
    )


def _with_unit(component: str) -> Html:
    unit = component_names(component)[2]
    return joined(component_cell(component), unit, by=", ") if unit else component_cell(component)


def _cause(cause: Cause) -> Html:
    own = chinese_cause(cause.cause)
    if not cause.assumed:
        return both(cause.cause, own)
    return both(f"{cause.cause} ({cause.assumed})", f"{own}（{cause.assumed}）")


def _bar(shares: Sequence[float], text: str, own: str) -> Html:
    parts = [
        element("span", style=f"width:{100.0 * share:.2f}%;background:{colour}")
        for share, colour in zip(shares, _SHADES, strict=False)
    ]
    parts.append(element("span", style=f"flex:1;background:{_REST}"))
    return element(
        "div", *parts, class_="share", role="img", aria_label=text, data_en=text, data_zh=own
    )


def observability_section(result: Result, segments: Sequence[Segment]) -> Section:
    """Return posterior against prior, the weak directions, and manoeuvres that would help."""
    solution = result.solution
    cells: list[Cell] = []
    view = marginals(solution.estimates, solution.covariance, solution.limits)
    if view is not None:
        # Values and grades are in the table of the calibration.
        table_ = posterior_table(view).without("value ± σ", "grade")
        cells.append(described(table_, label="Observability"))
        if view.sentences:
            cells.append(element("h3", both("Directions that the data hardly determine")))
            cells.append(items(list(map(said, view.sentences))))
        else:
            cells.append(paragraph(both("The data determine every component.")))
    cells.append(element("h3", both("Which manoeuvre would help")))
    cells += _further(solution)
    if segments:
        cells.append(
            folded("Manoeuvres of this trial", _segment_table(solution, segments, result.start))
        )
    return section("Observability", *cells, key="observability")


def _further(solution: Solution) -> list[Cell]:
    short = [e for e in solution.estimates if np.any(e.std > solution.limits.get(e.name, np.inf))]
    if not short:
        return [paragraph(both("Every σ is within its limit: no further manoeuvre is needed."))]
    found = further_manoeuvres(solution)
    if not found:
        text = "No manoeuvre of the list lowers a σ that is above its limit: record longer."
        return [paragraph(both(text))]
    rows = [
        [
            both(_MANOEUVRES[m.name]) if i == 0 else "",
            f"{m.duration:.0f}" if i == 0 else "",
            component_cell(name),
            f"{before:.2g} {component_names(name)[2]}",
            f"{after:.2g}",
        ]
        for m in found
        for i, (name, before, after) in enumerate(zip(m.names, m.before, m.after, strict=True))
    ]
    header = ["manoeuvre", "duration, s", "helps", "σ now", "σ at best"]
    text = (
        "These are lower limits, because the motion is taken as known. The command plan predicts "
        "a whole trial."
    )
    label = "Which manoeuvre would help"
    return [
        table([both(h) for h in header], rows, label=label, numeric=(1, 3, 4)),
        paragraph(both(text)),
    ]


def _segment_table(solution: Solution, segments: Sequence[Segment], start: float) -> Html:
    t = solution.trajectory
    speed = np.linalg.norm(t.velocity, axis=1)
    heading = np.unwrap(np.nan_to_num(t.rph[:, 2])) / DEG
    rows = []
    for s in segments[:_MOST_SEGMENTS]:
        inside = np.flatnonzero((t.time >= s.start) & (t.time <= s.end))
        if inside.size:
            rows.append([
                both(s.label), f"{s.start - start:.0f}", f"{s.end - start:.0f}",
                f"{speed[inside].mean():.2f}",
                fixed(float(heading[inside[-1]] - heading[inside[0]]), 0),
            ])  # fmt: skip
    header = ["manoeuvre", "from, s", "to, s", "mean speed, m/s", "turn, deg"]
    label = "Manoeuvres of this trial"
    return table([both(h) for h in header], rows, label=label, numeric=(1, 2, 3, 4))


def residual_plots(result: Result) -> list[Plot]:
    """Return residual / σ over time of each component of each measurement."""
    plots = []
    for i, r in enumerate(result.solution.residuals):
        order = np.argsort(r.time, kind="stable")
        for c, name in enumerate(r.components):
            known = order[np.isfinite(r.residual[order, c]) & (r.sigma[order, c] > 0.0)]
            if known.size:
                normalised = (r.residual[known, c] / r.sigma[known, c])[:, None]
                key = f"residual-{i}-{c}"
                plots.append(
                    Plot(key, "residual / σ", "", [name], r.time[known], normalised,
                         limit=_PANEL, band=_BAND, about=r.label)
                )  # fmt: skip
    return plots


def residual_tables(result: Result) -> list[Cell]:
    """Return counts and sizes of residuals, and of what was rejected."""
    solution = result.solution
    rejected: dict[str, int] = {}
    for r in solution.rejected:
        rejected[r.label] = rejected.get(r.label, 0) + r.time.size
    rows = []
    for r in solution.residuals:
        lost = rejected.get(r.label, 0)
        share = 100.0 * lost / max(lost + r.time.size, 1)
        for c, name in enumerate(r.components):
            known = np.isfinite(r.residual[:, c]) & (r.sigma[:, c] > 0.0)
            if not known.any():
                continue
            x = r.residual[known, c] / r.sigma[known, c]
            rows.append([
                both(r.label), both(name), f"{x.size}", f"{lost}", f"{share:.2g}",
                fixed(float(x.mean()), 2), f"{float(np.sqrt(np.mean(x**2))):.2f}",
                f"{float(np.abs(x).max()):.1f}",
            ])  # fmt: skip
    if not rows:
        return [paragraph(both("No residuals were kept."))]
    header = ["measurement", "component", "used", "rejected", "rejected, %", "mean / σ",
              "RMS / σ", "largest / σ"]  # fmt: skip
    cells: list[Cell] = [
        table([both(h) for h in header], rows, label="Residuals", numeric=range(2, 8))
    ]
    if solution.rejected:
        own = [
            [both(r.label), both(r.reason), f"{r.time.size}", f"{r.time[0] - result.start:.1f}",
             f"{r.time[-1] - result.start:.1f}"]
            for r in solution.rejected if r.time.size
        ]  # fmt: skip
        header = ["measurement", "reason", "number", "from, s", "to, s"]
        cells.append(element("h3", both("Rejected measurements")))
        label = "Rejected measurements"
        cells.append(table([both(h) for h in header], own, label=label, numeric=(2, 3, 4)))
    return cells


def clock_section(result: Result) -> Section:
    """Return what the offsets of clocks mean, and what was found of clocks."""
    solution = result.solution
    estimated = any(
        e.spec.stem.endswith(("time_offset", "clock_rate")) for e in solution.estimates
    )
    about = [
        f
        for f in solution.findings
        if f.severity != "ok" and ("clock" in f.code or f.code in ("leap_seconds", "local_time"))
    ]
    text = (
        "Stamps of a sensor = time of the IMU + offset. A positive offset is a late stamp. The "
        "values are in the table of the calibration."
    )
    cells: list[Cell] = [paragraph(both(text if estimated else "No clock was estimated."))]
    if about:
        cells.append(items([joined(_what(f), _code(f)) for f in about]))
    return section("Clocks", *cells, key="clocks")


def halves_section(result: Result) -> Section | None:
    """Return the halves of the trial against each other, if they were solved."""
    columns = result.halves
    if not columns:
        return None
    names = list(columns)
    rows = [[str(cell) for cell in row] for row in zip(*columns.values(), strict=True)]
    shown = [[component_cell(row[0]), *row[1:]] for row in rows]
    header = [name.replace("_", " ") for name in names]
    numeric = range(1, len(names))
    return section(
        "Halves of the trial",
        table(header, shown, label="Halves of the trial", numeric=numeric),
        key="halves",
    )


def crosscheck_section(result: Result) -> Section | None:
    """Return a cross-check with another result, if there is one."""
    check = result.crosscheck
    if not check:
        return None
    rows = [
        [component_cell(c["name"]), _text(c["a"]), _text(c["b"]), _text(c["difference"]),
         _text(c["in_sigmas"]), str(c["verdict"])]
        for c in check.get("components", [])
    ]  # fmt: skip
    header: list[Cell] = [
        both("parameter"), _side(check, "a"), _side(check, "b"),
        both("difference"), both("difference / σ"), both("Verdict"),
    ]  # fmt: skip
    cells: list[Cell] = [table(header, rows, label="Cross-check", numeric=(1, 2, 3, 4))]
    explanation = check.get("explanation")
    if explanation:
        lines = [explanation] if isinstance(explanation, str) else list(map(str, explanation))
        cells.append(items(lines))
    return section("Cross-check", *cells, key="crosscheck")


def _side(check: Mapping[str, Any], side: str) -> str:
    return f"{side.upper()}: {check.get(side, {}).get('solver', '')}"


def _text(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "–" if value is None else str(value)
    return f"{value:.4g}"


def settings_section(result: Result) -> Section:
    """Return settings, records and versions that the result came from."""
    run = result.run
    if not run:
        text = "The folder has no settings, because an earlier version wrote it."
        return section("Settings", paragraph(both(text)), key="settings")
    start = result.start
    records = [
        [r["sensor"], f"{r['rows']}", f"{r['from_s'] - start:.1f}", f"{r['to_s'] - start:.1f}",
         f"{r['interval_s']:.4g}", f"{r['longest_interval_s']:.4g}"]
        for r in run["records"]
    ]  # fmt: skip
    header = ["sensor", "rows", "from, s", "to, s", "interval, s", "longest interval, s"]
    settings = [[s, key, value] for s, key, value in flat_settings(run["settings"])]
    versions = [[name, number] for name, number in run["versions"].items()]
    return section(
        "Settings",
        element("h3", both("Data")),
        table([both(h) for h in header], records, label="Data", numeric=range(1, 6)),
        folded(
            "Settings",
            table([both("section"), both("key"), both("value")], settings, label="Settings"),
        ),
        *_solver_steps(run.get("steps", ())),
        element("h3", both("Versions")),
        table([both("package"), both("version")], versions, label="Versions"),
        key="settings",
    )


def _solver_steps(steps: Sequence[Mapping[str, Any]]) -> Iterator[Html]:
    """Yield what the solver changed of its assumptions, step by step."""
    if not steps:
        return
    header = ["round", "what changed", "objective", "fall", "largest move, σ"]
    rows = [
        [f"{s['round']}", both(s["change"]), f"{s['objective']:.1f}", f"{s['fall']:.2f}",
         f"{s['largest_move_sigma']:.2f}"]
        for s in steps
    ]  # fmt: skip
    label = "Steps of the solver"
    text = (
        "The solver keeps a change of its assumptions only if it lowers the objective: "
        "-2 log of the restricted likelihood, up to a constant."
    )
    yield folded(
        label,
        paragraph(both(text)),
        *([steps_drawing([float(s["objective"]) for s in steps])] if len(steps) > 1 else []),
        table([both(h) for h in header], rows, label=label, numeric=(0, 2, 3, 4)),
    )


def flat_settings(settings: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield section, key and value of every setting."""
    for name, keys in settings.items():
        for key, value in keys.items():
            text = ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
            yield name, key, text


def segments_of(solution: Solution) -> tuple[Segment, ...]:
    """Return the manoeuvres of a trial."""
    if solution.trajectory.time.size < 2:
        return ()
    return find_segments(solution.trajectory)


def titled(
    plots: Sequence[Plot], start: float, title: str, key: str, *more: Cell
) -> Section | None:
    """Return a section of plots, or nothing where there are none."""
    if not plots and not more:
        return None
    return section(title, *more, *(p.html(start) for p in plots), key=key)
