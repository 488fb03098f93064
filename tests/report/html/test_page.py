from __future__ import annotations

import hashlib
import json
import re
from base64 import b64decode
from dataclasses import replace
from importlib import import_module
from importlib.resources import files
from pkgutil import iter_modules
from typing import Any

import numpy as np
import pytest
from reports import build_result

from factorgraph_dvl import sensors
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.quality.texts import catalogue, chinese_cause
from factorgraph_dvl.report.html.envelope import envelope
from factorgraph_dvl.report.html.page import UPLOT, comparison_page, report_page
from factorgraph_dvl.report.html.plots import Plot
from factorgraph_dvl.report.html.steps import steps_drawing
from factorgraph_dvl.sensors.parameters import ParameterSpec

# Of the files in the package `uplot` 1.6.32 as npm serves it, whose shasum is
# c800a63b432bad692d6d746f44f0882aa73a49ae.
UPLOT_SHA256 = {
    "uPlot.iife.min.js": "19c8d4c6ad88929a79f4ae49d6f7161566dfd0ba3d15cc495e974f787eb78f1f",
    "uPlot.min.css": "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04",
    "LICENSE": "8f989229699b4fe2f1a0432d0e9edc338a8a911e250e2d1b01ecd770a5f5b1bd",
}


@pytest.fixture(scope="module")
def page() -> str:
    return report_page(build_result())


def data_of(page: str) -> Any:
    (found,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page)
    return json.loads(found.replace("<\\/", "</"))


def test_uplot_is_that_of_the_registry() -> None:
    folder = files("factorgraph_dvl.report") / UPLOT
    found = {
        name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in UPLOT_SHA256
    }
    assert found == UPLOT_SHA256
    assert {item.name for item in folder.iterdir()} == set(UPLOT_SHA256)


def test_the_page_holds_all_it_needs(page: str) -> None:
    assert "uPlot (v1.6.32) */" in page
    assert "Permission is hereby granted, free of charge" in page
    assert "default-src 'none'" in page
    for tag in re.findall(r"<(?:script|link|img|iframe|a)\b[^>]*>", page):
        assert "src=" not in tag
        assert 'href="' not in tag or 'href="#' in tag


def test_the_verdict_comes_first_with_what_to_do(page: str) -> None:
    body = page[page.index("<main>") :]
    first = body[: body.index("</section>")]
    assert "doubtful" in first
    assert "0.2 s late" in first
    assert Code.CLOCK_OFFSET.why in first
    assert Code.CLOCK_OFFSET.action in first


def test_every_plot_has_a_description_and_a_table(page: str) -> None:
    plots = data_of(page)["plots"]
    assert len(plots) == 3 + 4 + 3 + 3
    for plot in plots:
        (canvas,) = re.findall(rf'<div [^>]*id="{plot["key"]}"[^>]*>', page)
        assert 'role="img"' in canvas
        assert re.search(r'aria-label="[^"]+"', canvas)
        figure = page[page.index(canvas) : page.index("</figure>", page.index(canvas))]
        assert figure.count("<tr>") == 1 + 11 + 2


def test_residuals_beyond_the_panel_are_counted_and_marked(page: str) -> None:
    (plot,) = (p for p in data_of(page)["plots"] if p["key"] == "residual-0-0")
    assert plot["limit"] == 6.0
    assert len(plot["series"][0]["outside"]) == 1
    assert page.count(": 1 beyond the panel, up to 20") == 3


def decode(series: dict[str, Any], key: str) -> Array:
    steps = np.frombuffer(b64decode(series[key]), "<i2").astype(float)
    steps[steps == -32768] = np.nan
    return np.asarray(series["offset"] + series["step"] * steps)


def test_envelopes_hold_every_value_to_a_65000th() -> None:
    result = build_result(3000.0)
    (plot,) = (p for p in data_of(report_page(result))["plots"] if p["key"] == "heading")
    series = plot["series"][0]
    heading = np.rad2deg(result.solution.trajectory.rph[:, 2])
    step = np.ptp(heading) / 60000
    assert np.nanmax(decode(series, "high")) == pytest.approx(heading.max(), abs=step)
    assert np.nanmin(decode(series, "low")) == pytest.approx(heading.min(), abs=step)


def test_a_gap_is_not_bridged() -> None:
    time = np.concatenate([np.arange(0.0, 100.0, 0.01), np.arange(500.0, 600.0, 0.01)])
    found = envelope(time, np.ones((time.size, 1)))
    (blank,) = np.flatnonzero(np.isnan(found.low[:, 0]))
    assert found.time[blank - 1] < 100.0 < found.time[blank + 1]
    assert found.time.size < 1300


@pytest.mark.parametrize("seconds", [4800.0, 14400.0])
def test_pages_stay_small_at_any_length(seconds: float) -> None:
    page = report_page(build_result(seconds))
    assert len(page.encode()) < 1.5e6


def test_a_redacted_page_has_no_places_and_no_names() -> None:
    result = build_result()
    full, redacted = report_page(result), report_page(result, redacted=True)
    for private in ("by hand", "gnss.csv", "dvl.csv", "34.123456", "34.37", "108.86"):
        assert private in full
        assert private not in redacted
    assert "0.2 s late" in redacted
    assert "velocity_std_m_s" in redacted


def test_text_of_files_is_escaped() -> None:
    result = build_result()
    solution = replace(result.solution, trial="<script>alert(1)</script>")
    assert "<script>alert" not in report_page(replace(result, solution=solution))


def test_every_phrase_is_there_in_chinese() -> None:
    pages = report_page(build_result()) + comparison_page([build_result(), build_result(name="b")])
    assert "标定报告" in pages
    for spec in ("安装误差角", "刻度系数误差"):
        assert spec in pages
    # A heading in one language only would have no translation.
    headings = re.findall(r"<h[23][^>]*>(.*?)</h[23]>", pages)
    names = ("by hand", "out", "b")
    assert all("zh-Hans" in h for h in headings if h not in names)
    assert all(catalogue("phrases").values())


def test_findings_and_causes_are_there_in_chinese() -> None:
    own = catalogue("findings")
    assert own.keys() == {str(code) for code in Code}
    for texts in own.values():
        assert texts.keys() == {"meaning", "why", "action"}
        assert all(len(both) == 2 and all(both) for both in texts.values())
    page = report_page(build_result())
    code = Code.CLOCK_OFFSET
    for english, chinese in (own[code]["why"], own[code]["action"]):
        assert f'<span lang="en">{english}</span>' in page
        assert f'<span lang="zh-Hans">{chinese}</span>' in page
    assert f"{own[code]['meaning'][1]}（GNSS: gnss.csv of by hand is 0.2 s late）" in page
    assert "陀螺噪声（0.1 deg/√h）" in page
    assert chinese_cause("noise of DVL velocity") == "DVL 速度噪声"
    assert chinese_cause("prior of lever_arm_m") == "杆臂的先验"
    assert chinese_cause("DVL noise") == "DVL noise"


def test_parameters_are_there_in_chinese() -> None:
    known = catalogue("parameters")
    specs = {
        spec.stem
        for module in iter_modules(sensors.__path__)
        for spec in vars(import_module(f"{sensors.__name__}.{module.name}")).values()
        if isinstance(spec, ParameterSpec)
    }
    assert len(specs) > 10
    assert specs <= known.keys()


def test_sigma_along_the_trial_is_drawn_on_a_logarithmic_axis() -> None:
    time = np.array([0.0, 300.0, 600.0])
    std = np.array([[180.0], [3.0], [0.05]])
    page = report_page(build_result(history=(time, ("misalignment_x_deg",), std)))
    (plot,) = (p for p in data_of(page)["plots"] if p["key"] == "std-misalignment_deg")
    assert plot["log"]
    assert plot["shade"]
    np.testing.assert_allclose(10.0 ** decode(plot["series"][0], "low"), std[:, 0], rtol=1e-3)
    assert "misalignment: σ along the trial, deg" in page
    assert "安装误差角：试验过程中的 σ, deg" in page


def test_results_side_by_side() -> None:
    a = build_result()
    (first, scale) = a.solution.estimates
    moved = replace(scale, value=scale.value + 3.0 * scale.std)
    settings = {**a.run["settings"], "dvl": {"file": "dvl.csv", "velocity_std_m_s": 0.02}}
    b = build_result(
        name="kalman",
        solution=replace(a.solution, estimates=(first, moved)),
        run={**a.run, "settings": settings},
    )
    page = comparison_page([a, b])
    values = page[page.index('id="values"') :]
    row = values[values.index("scale error") :]
    row = row[: row.index("</tr>")]
    assert ">3.00<" in row
    # Values are not broken over lines: two, and the difference.
    assert row.count('<td class="number">') == 3
    assert "dvl.velocity_std_m_s" in page
    assert "beacons.positions" not in page


def test_the_same_result_makes_the_same_bytes() -> None:
    assert report_page(build_result()) == report_page(build_result())


def drawn(plot: Any, which: str) -> Array:
    """Return the values of a series of a plot, nan where there is a gap."""
    series = plot["series"][0]
    steps = np.frombuffer(b64decode(series.get(which, series["low"])), dtype="<i2").astype(float)
    return np.where(steps == -32768, np.nan, series["offset"] + series["step"] * steps)


def test_every_axis_has_a_title_with_its_unit(page: str) -> None:
    for plot in data_of(page)["plots"]:
        assert plot["label"]
        assert plot["label_zh"]
        assert not plot["unit"] or plot["label"].endswith(f", {plot['unit']}")


@pytest.mark.parametrize(("middle", "least"), [(0.0, -180.0), (180.0, 0.0), (540.0, 0.0)])
def test_headings_are_in_one_turn_and_do_not_jump(middle: float, least: float) -> None:
    time = np.arange(0.0, 600.0, 0.1)
    swing = (middle + 5.0 * np.sin(time))[:, None]
    plot = Plot("heading", "Heading", "deg", ["heading"], time, swing, cycle=360.0).data(0.0)
    low, high = drawn(plot, "low"), drawn(plot, "high")
    assert np.isfinite(low).all()
    assert low.min() >= least
    assert high.max() < least + 360.0
    assert np.ptp(np.concatenate([low, high])) < 10.1


def test_a_circle_has_a_gap_where_its_heading_starts_anew() -> None:
    time = np.arange(0.0, 600.0, 0.1)
    turn = (0.9 * time + 10.0)[:, None]
    plot = Plot("heading", "Heading", "deg", ["heading"], time, turn, cycle=360.0).data(0.0)
    low = drawn(plot, "low")
    steps = np.abs(np.diff(low))
    assert np.isnan(low).any()
    assert np.nanmax(steps) < 2.0
    assert np.ptp(low[np.isfinite(low)]) > 350.0


def test_a_dense_signal_is_a_band_and_a_slow_one_a_line() -> None:
    time = np.arange(0.0, 500.0, 0.25)
    dense = envelope(time, np.sin(2.0 * np.pi * time)[:, None])
    assert dense.time.size <= 301
    assert np.all(dense.high - dense.low > 1.9)
    slow = envelope(time, np.sin(2.0 * np.pi * time / 100.0)[:, None])
    np.testing.assert_array_equal(slow.low, slow.high)


def test_the_steps_are_drawn_where_they_stand() -> None:
    text = steps_drawing([100.0, 10.0, 1.0, 0.0]).text
    height = [float(y) for y in re.findall(r'<circle cx="[\d.]+" cy="([\d.]+)"', text)]
    # Each factor of ten is as high, and the last is at the bottom.
    falls = np.diff(height)
    assert falls[0] == pytest.approx(falls[1], abs=1.0)
    assert height[-1] == max(height)
    assert steps_drawing([5.0]).text.count("<circle") == 1
