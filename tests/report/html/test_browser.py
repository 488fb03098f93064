"""The page in a real browser: Debian's chromium, driven by selenium, where both are installed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reports import build_result

from factorgraph_dvl.report.html.page import comparison_page, report_page

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
WebDriverWait = pytest.importorskip("selenium.webdriver.support.wait").WebDriverWait
CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="chromium and chromedriver are not installed"
)
PLOTS = 14


@pytest.fixture(scope="module")
def driver() -> Iterator[Any]:
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    found = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield found
    found.quit()


@pytest.fixture(scope="module")
def page(driver: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The page of a result, opened from its file."""
    file = tmp_path_factory.mktemp("page") / "report.html"
    # The plot of σ along the trial has a logarithmic axis.
    along = np.array([0.0, 300.0, 600.0]), ("misalignment_x_deg",), np.array([[9.0], [1], [0.1]])
    file.write_text(report_page(build_result(history=along)), encoding="utf-8")
    driver.get(file.as_uri())
    # On a busy machine scripts end a while after the page has been read.
    WebDriverWait(driver, 30).until(
        lambda d: d.execute_script("return document.documentElement.dataset.drawn")
    )
    return driver


def resized(driver: Any, width: int) -> None:
    metrics = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 600}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def test_every_plot_is_drawn_without_errors_or_requests(page: Any) -> None:
    assert page.execute_script("return document.documentElement.dataset.drawn") == str(PLOTS)
    # A canvas that is blank has no opaque pixel.
    drawn = page.execute_script(
        "return [...document.querySelectorAll('.canvas canvas')].map((c) => c.getContext('2d')"
        ".getImageData(0, 0, c.width, c.height).data.filter((v, i) => i % 4 === 3 && v).length)"
    )
    assert len(drawn) == PLOTS
    assert min(drawn) > 1000
    assert page.get_log("browser") == []
    events = [json.loads(entry["message"])["message"] for entry in page.get_log("performance")]
    sent = [
        e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"
    ]
    assert [url for url in sent if not url.startswith(("file://", "data:"))] == []
    assert len([url for url in sent if url.startswith("file://")]) == 1


def test_the_keyboard_shows_values_and_zooms(page: Any) -> None:
    canvas = page.find_element("id", "speed")
    canvas.send_keys("\ue014\ue014")  # arrow to the right, twice
    readout = page.execute_script(
        "return document.getElementById('speed').parentNode.querySelector('.readout').textContent"
    )
    assert "speed 2" in readout
    assert readout.endswith("m/s")


def test_it_fits_a_phone_in_both_languages(page: Any) -> None:
    resized(page, 360)
    shown = []
    for _ in range(2):
        width = page.execute_script("return document.documentElement.scrollWidth")
        assert width <= 360
        shown.append(page.find_element("css selector", "h2").text)
        assert page.find_element("id", "speed").get_attribute("aria-label")
        page.find_element("id", "language").click()
    assert set(shown) == {"Verdict", "结论"}
    resized(page, 1200)


@pytest.mark.parametrize("language", ["English", "Chinese"])
@pytest.mark.parametrize("several", [False, True])
def test_axe_finds_no_fault(driver: Any, tmp_path: Path, several: bool, language: str) -> None:
    axe = pytest.importorskip("axe_selenium_python", reason="axe-core is not installed")
    text = (
        comparison_page([build_result(), build_result(name="b")])
        if several
        else report_page(build_result())
    )
    file = tmp_path / "page.html"
    file.write_text(text, encoding="utf-8")
    driver.get(file.as_uri())
    if language == "Chinese":
        driver.find_element("id", "language").click()
    script = files(axe) / "node_modules" / "axe-core" / "axe.min.js"
    driver.execute_script(script.read_text(encoding="utf-8"))
    faults = driver.execute_async_script(
        "const done = arguments[0]; axe.run().then((r) => done("
        "r.violations.map((v) => v.id + ': ' + v.nodes.map((n) => n.html).join(' '))))"
    )
    assert faults == []
