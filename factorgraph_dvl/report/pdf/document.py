"""The report of a result on three pages of A4: what to enter, how good it is, certificate."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_pdf import PdfPages

from factorgraph_dvl.analysis.instrument_terms import (
    has_instrument_terms,
    instrument_of,
    transceiver_of,
)
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import FRD_NAMES
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.quality.texts import Language, component_names
from factorgraph_dvl.report.certificate import statements
from factorgraph_dvl.report.check import check_rows, check_texts
from factorgraph_dvl.report.entries import (
    TITLE,
    USBL_DEFINITIONS,
    USBL_TITLE,
    conventions,
    entries_table,
    sum_with_compass,
    usbl_table,
)
from factorgraph_dvl.report.figures.drawing import VERDICT_COLOURS, envelope, log_axis, style
from factorgraph_dvl.report.figures.vessel import draw_vessel
from factorgraph_dvl.report.html.content import Result
from factorgraph_dvl.report.pdf.sheet import SMALL, TEXT, Sheet, fonts
from factorgraph_dvl.report.table import Component, Table, plain
from factorgraph_dvl.report.tables import FOR_EXPERTS, calibration_table
from factorgraph_dvl.report.vessel import LEGEND, VIEWS, places_of
from factorgraph_dvl.solution import Solution

# Reasons that are printed with what to do, and input files. Chosen: they fit on their pages.
_REASONS, _FILES = 4, 24
_COLOURS = ("#0072b2", "#b34700", "#00694b")


def write_pdf(result: Result, path: Path, language: Language = "en") -> None:
    """Write the report of a result as PDF.

    Parameters
    ----------
    result : Result
        What to show.
    path : Path
        File to write.
    language : {'en', 'zh'}, default 'en'
        Language of the report.

    Raises
    ------
    ConfigError
        If no font has the characters of the language.
    """
    footer = f"factorgraph-dvl · {result.trial}"
    # TrueType fonts: text can be searched and copied. Fonts with Chinese characters are none.
    kind = 42 if language == "en" else 3
    with rc_context({"pdf.fonttype": kind, "font.family": fonts(language)}):
        sheets = [Sheet(language, f"{footer} · {k}/3") for k in (1, 2, 3)]
        _first_page(sheets[0], result)
        _second_page(sheets[1], result)
        _third_page(sheets[2], result)
        # Without a date, equal results are equal files.
        with PdfPages(path, metadata={"CreationDate": None, "Title": footer}) as pages:
            for sheet in sheets:
                pages.savefig(sheet.figure)


def _first_page(sheet: Sheet, result: Result) -> None:
    """Verdict, what to enter, and the drawing of the vessel."""
    solution = result.solution
    verdict = solution.verdict
    colon = ": " if sheet.language == "en" else "："
    sheet.text(f"{sheet.said('Calibration report')}{colon}{result.trial}", 15.0, weight="bold")
    colour = VERDICT_COLOURS[verdict.grade]
    sheet.text(f"{sheet.said('Verdict')}{colon}{sheet.said(verdict.grade)}", 13.0, colour=colour,
               weight="bold")  # fmt: skip
    if not verdict.reasons:
        sheet.text(sheet.said("The checks found nothing wrong."))
    for reason in verdict.reasons[:_REASONS]:
        code = reason.code
        action = code.action if sheet.language == "en" else code.text("action", "zh")
        sheet.text(f"• {_said(reason, sheet.language)} {action}", SMALL)
    if len(verdict.reasons) > _REASONS:
        sheet.text(f"+ {len(verdict.reasons) - _REASONS}: report.html", SMALL)
    sheet.heading(TITLE)
    if verdict.grade == "do not use":
        sheet.text(sheet.said("Enter nothing: this result must not be used."))
    elif has_instrument_terms(solution):
        terms = instrument_of(solution)
        if (found := sum_with_compass(solution.findings)) is not None:
            sheet.text(f"{sheet.said('Mount and compass:')} {_said(found, sheet.language)}", SMALL)
        _table(sheet, entries_table(terms, result.maker))
        sheet.text(" ".join(map(sheet.said, conventions(terms, result.maker))), SMALL)
        if (transceiver := transceiver_of(solution)) is not None:
            sheet.heading(USBL_TITLE)
            _table(sheet, usbl_table(transceiver))
            sheet.text(" ".join(map(sheet.said, USBL_DEFINITIONS)), SMALL)
        places = places_of(terms, solution, result.run.get("settings", {}))
        sheet.space(0.25)
        drawings = sheet.axes(min(3.0, sheet.left - 0.9), 2, labels=0.55)
        for ax, (title, view) in zip(drawings, VIEWS.items(), strict=True):
            draw_vessel(ax, view, places, terms.attitude, sheet.said)
            ax.set_title(sheet.said(title), fontsize=TEXT, loc="left")
            for axis, seen in zip((ax.xaxis, ax.yaxis), view, strict=True):
                _name_axis(axis, seen, sheet)
        sheet.space(0.5)
        legend = (f"Reference point: {terms.origin}.", *LEGEND)
        sheet.text(" ".join(map(sheet.said, legend)), SMALL)
    else:
        _table(sheet, calibration_table(solution).brief())


def _name_axis(axis: Axis, seen: Array, sheet: Sheet) -> None:
    """Name an axis of a drawing, with the signs of the lever arm.

    Parameters
    ----------
    axis : Axis
        Axis of the drawing.
    seen : ndarray, shape (3,)
        What is seen along it, of forward, starboard, down.
    sheet : Sheet
        Page of the drawing.
    """
    along = int(np.argmax(np.abs(seen)))
    sign = float(seen[along])
    axis.set_label_text(f"{sheet.said(FRD_NAMES[along])}, m", fontsize=SMALL)
    axis.set_major_formatter(lambda at, _: f"{sign * at + 0.0:.3g}".replace("-", "−"))


def _second_page(sheet: Sheet, result: Result) -> None:
    """Before and after calibration, and the track."""
    sheet.heading("Before and after calibration")
    if not result.check:
        sheet.text(sheet.said("The trial has no DVL, or no positions to compare it with."))
    else:
        sheet.text(" ".join(map(sheet.said, check_texts(result.check))), SMALL)
        header = ("quantity", "before calibration", "after calibration")
        rows = [[" ".join(map(sheet.said, names)), before, after]
                for names, before, after in check_rows(result.check)]  # fmt: skip
        sheet.table(list(map(sheet.said, header)), rows, numeric=(1, 2))
        _check_plots(sheet, result)
    sheet.heading("Track")
    (ax,) = sheet.axes(max(sheet.left - 0.55, 1.5))
    _draw_track(ax, result.solution, sheet)


def _check_plots(sheet: Sheet, result: Result) -> None:
    columns = result.check_table
    time = columns["time_s"] - result.start
    label = sheet.said("time, s")
    sheet.space(0.25)
    for ax, when in zip(sheet.axes(1.35, 2), ("before", "after"), strict=True):
        for axis, colour in zip(FRD_NAMES, _COLOURS, strict=True):
            values = columns[f"residual_{axis}_{when}_m_s"]
            at, low, high = envelope(time, values)
            ax.fill_between(
                at, low, high, color=colour, alpha=0.35, lw=0.4, label=sheet.said(axis)
            )
        style(ax, label, f"{sheet.said('DVL residual')}, m/s")
        ax.set_title(sheet.said(f"{when} calibration"), fontsize=TEXT, loc="left")
        if when == "after":
            ax.legend(fontsize=SMALL, ncols=3, frameon=False, loc="lower right",
                      handlelength=0.8, columnspacing=0.8,
                      bbox_to_anchor=(1.0, 1.14), borderaxespad=0.0)  # fmt: skip
    sheet.space(0.65)
    if np.isfinite(columns.get("track_error_after_m", np.nan)).any():
        (ax,) = sheet.axes(1.35)
        curves = [columns[f"track_error_{when}_m"] for when in ("before", "after")]
        for values, when, colour in zip(curves, ("before", "after"), _COLOURS, strict=False):
            ax.plot(time, np.where(values > 0.0, values, np.nan), color=colour, lw=1.0,
                    label=sheet.said(f"{when} calibration"))  # fmt: skip
        positive = np.concatenate([v[v > 0.0] for v in curves])
        if positive.size:
            log_axis(ax, "y", float(positive.min()), float(positive.max()))
        style(ax, label, f"{sheet.said('position error')}, m")
        ax.set_title(sheet.said("Position error of dead reckoning"), fontsize=TEXT, loc="left")
        ax.legend(fontsize=SMALL, ncols=2, frameon=False, loc="lower right",
                      handlelength=0.8, columnspacing=0.8,
                  bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)  # fmt: skip
        sheet.space(0.55)


def _draw_track(ax: Axes, solution: Solution, sheet: Sheet) -> None:
    geodetic = solution.trajectory.geodetic
    known: Array = geodetic[np.isfinite(geodetic).all(axis=1)]
    east, north = LocalFrame(*known[0]).position(*known.T).T[:2]
    ax.plot(east, north, color=_COLOURS[0], lw=1.0)
    ax.plot(east[0], north[0], "o", color="black", mfc="white")
    ax.plot(east[-1], north[-1], "s", color="black", ms=5)
    ax.set_aspect("equal", adjustable="datalim")
    style(ax, sheet.said("east of start, m"), sheet.said("north of start, m"))


def _third_page(sheet: Sheet, result: Result) -> None:
    """All parameters, and the certificate with its line to sign."""
    sheet.heading("Certificate")
    sheet.table([], [[" ".join(map(sheet.said, names)), sheet.said(text)]
                     for names, text in statements(result)])  # fmt: skip
    if (files := result.run.get("files", ())) and not result.redacted:
        sheet.heading("Input files", TEXT + 1.0)
        rows = [[f["name"], f["sha256"]] for f in files[:_FILES]]
        sheet.table([sheet.said("file"), "SHA-256"], rows, size=SMALL)
        if len(files) > _FILES:
            sheet.text(f"+ {len(files) - _FILES}: run.json", SMALL)
    sheet.space(0.4)
    sheet.text(f"{sheet.said('Signature, name, date:')} {'_' * 60}")
    sheet.space(0.2)
    if result.solution.estimates:
        sheet.heading("Calibration", TEXT + 1.0)
        if has_instrument_terms(result.solution):
            sheet.text(sheet.said(FOR_EXPERTS), SMALL)
        table = calibration_table(result.solution)
        fits = int((sheet.left - 0.5) / 0.16)
        kept = Table(columns=table.columns, rows=table.rows[: max(fits, 1)])
        _table(sheet, kept, size=SMALL)
        if len(table.rows) > len(kept.rows):
            sheet.text(f"+ {len(table.rows) - len(kept.rows)}: calibration.json", SMALL)


def _table(sheet: Sheet, table: Table, size: float = TEXT) -> None:
    header = [sheet.said(c.header) for c in table.columns]
    numeric = [k for k, c in enumerate(table.columns) if c.numeric]
    sheet.table(header, [_cells(sheet, row) for row in table.rows], numeric=numeric, size=size)


def _cells(sheet: Sheet, row: Sequence[object]) -> list[str]:
    out = []
    for cell in row:
        if isinstance(cell, Component):
            own = component_names(cell.name)
            out.append(own[0] if sheet.language == "en" else own[1])
        else:
            out.append(sheet.said(plain(cell)))  # type: ignore[arg-type]
    return out


def _said(finding: Finding, language: Language) -> str:
    return str(finding) if language == "en" else finding.chinese
