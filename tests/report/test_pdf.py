"""The report on paper: three pages of A4, with nothing cut, and the numbers of the page."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from calibrations import calibration
from matplotlib.backends.backend_agg import FigureCanvasAgg
from reports import build_result

from factorgraph_dvl.analysis.instrument_terms import instrument_of
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.report.entries import entries_of
from factorgraph_dvl.report.figures.drawing import new_figure
from factorgraph_dvl.report.figures.vessel import draw_vessel
from factorgraph_dvl.report.html.content import Result, redact
from factorgraph_dvl.report.pdf import document, sheet
from factorgraph_dvl.report.pdf.document import write_pdf
from factorgraph_dvl.report.vessel import VIEWS, Place


def whole_result(reasons: int = 1) -> Result:
    """A result with all that a page may have, and many files."""
    found = calibration(alpha=np.array([1.0, 2.0, 30.0]))
    own = build_result()
    findings = [
        Finding(Code.CLOCK_OFFSET, f"gnss.csv of trial {k} is 0.2 s late, " * 8, "GNSS")
        for k in range(reasons)
    ]
    solution = replace(
        own.solution, estimates=found.estimates, covariance=found.covariance, body_axes="RFU",
        findings=tuple(findings),
    )  # fmt: skip
    run = dict(own.run) | {
        "files": [{"name": f"log-{k}.csv", "sha256": "a" * 64} for k in range(60)],
        "certificate": {"vessel": "RV Test", "dvl": {"maker": "TRDI", "serial": "42"}},
    }
    return replace(own, solution=solution, run=run)


@pytest.fixture
def sheets(monkeypatch):
    """Return what was written on each sheet."""
    made: list[sheet.Sheet] = []

    class Kept(sheet.Sheet):
        def __init__(self, *given: str) -> None:
            super().__init__(*given)
            made.append(self)

    monkeypatch.setattr(document, "Sheet", Kept)
    return made


def texts(page: sheet.Sheet) -> list[str]:
    return [t.get_text() for t in page.figure.texts]


@pytest.mark.slow
@pytest.mark.parametrize("reasons", [0, 1, 12])
def test_it_has_three_pages_of_a4_and_nothing_is_cut(tmp_path, sheets, reasons):
    file = tmp_path / "report.pdf"
    write_pdf(whole_result(reasons), file)
    content = file.read_bytes()
    assert content.startswith(b"%PDF")
    boxes = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", content)
    assert [(round(float(w)), round(float(h))) for w, h in boxes] == [(595, 842)] * 3
    for page in sheets:
        renderer = FigureCanvasAgg(page.figure).get_renderer()
        width, height = page.figure.bbox.size
        drawn = [t.get_window_extent(renderer) for t in page.figure.texts]
        drawn += [ax.get_tightbbox(renderer) for ax in page.figure.axes if ax.axison]
        for box in drawn:
            assert box.x0 >= 0.0
            assert box.x1 <= width
            assert box.y0 >= 0.0
            assert box.y1 <= height
        assert page.left > -0.01


def test_the_numbers_to_enter_are_those_of_the_page(tmp_path, sheets):
    result = whole_result()
    write_pdf(result, tmp_path / "report.pdf")
    first = " ".join(texts(sheets[0]))
    for entry in entries_of(instrument_of(result.solution)):
        assert entry.text in first
        assert entry.rule in first
    assert "0.1234" in " ".join(texts(sheets[1]))
    third = " ".join(texts(sheets[2]))
    assert "RV Test" in third
    assert "a" * 64 in third


def test_a_redacted_report_names_no_trial_no_file_and_no_vessel(tmp_path, sheets):
    write_pdf(redact(whole_result()), tmp_path / "report.pdf")
    written = " ".join(text for page in sheets for text in texts(page))
    for hidden in ("by hand", "log-1.csv", "RV Test", "2022-10-12", "gnss.csv"):
        assert hidden not in written


def test_nothing_is_to_be_entered_of_a_result_that_must_not_be_used(tmp_path, sheets):
    result = whole_result()
    finding = Finding(Code.CLOCK_OFFSET, "gnss.csv is late", "GNSS", severity="error")
    result = replace(result, solution=replace(result.solution, findings=(finding,)))
    assert result.solution.verdict.grade == "do not use"
    write_pdf(result, tmp_path / "report.pdf")
    first = " ".join(texts(sheets[0]))
    assert "Enter nothing" in first
    assert "lever arm forward" not in first


def test_equal_results_are_equal_files(tmp_path):
    for name in ("a.pdf", "b.pdf"):
        write_pdf(build_result(), tmp_path / name)
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()


def test_chinese_needs_a_font(tmp_path, monkeypatch):
    monkeypatch.setattr(sheet, "_CHINESE", ("No Such Font",))
    with pytest.raises(ConfigError, match="no font with Chinese"):
        write_pdf(build_result(), tmp_path / "report.pdf", "zh")


@pytest.mark.parametrize(("yaw", "starboard_of_bow"), [(0.0, 0.0), (45.0, 1.0), (-45.0, -1.0)])
def test_the_drawing_shows_places_to_scale_and_where_the_dvl_points(yaw, starboard_of_bow):
    """From above, ahead is up, and a DVL turned to starboard points to the right."""
    ax = new_figure(4.0, 4.0).add_subplot()
    cy, sy = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    axes = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    covariance = np.zeros((3, 3))
    places = [
        Place("IMU", np.zeros(3), covariance), Place("DVL", np.array([2.0, 1.0, 3.0]), covariance),
    ]  # fmt: skip
    draw_vessel(ax, VIEWS["From above"], places, axes)
    (points,) = [line for line in ax.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(np.stack(points.get_data(), axis=1), [[0.0, 0.0], [1.0, 2.0]])
    (forward,) = [t for t in ax.texts if t.get_text() == "forward"]
    right, up = np.array(forward.xy) - [1.0, 2.0]
    assert up > 0.0
    assert np.sign(round(right, 9)) == starboard_of_bow


def test_axes_of_the_drawing_have_the_signs_of_what_is_entered(tmp_path, sheets):
    write_pdf(whole_result(), tmp_path / "report.pdf")
    above, side = [ax for ax in sheets[0].figure.axes if ax.axison]
    assert [above.get_xlabel(), above.get_ylabel()] == ["starboard, m", "forward, m"]
    assert [side.get_xlabel(), side.get_ylabel()] == ["forward, m", "down, m"]
    # What is above the reference point has a negative place down.
    assert side.yaxis.get_major_formatter()(1.4, 0) == "−1.4"
    assert side.xaxis.get_major_formatter()(1.4, 0) == "1.4"
    assert any("do not enter them" in text.lower() for text in texts(sheets[2]))
