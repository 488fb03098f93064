"""What trial.yaml states for the certificate is kept, and printed on the page."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import pytest
import yaml
from reports import build_result
from running import Run, run

from factorgraph_dvl import load_trial, save_trial
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.report.certificate import statements
from factorgraph_dvl.report.html.page import report_page

__all__ = ["run"]
SHORT = Path(__file__).parents[3] / "examples" / "short.yaml"
STATED = {
    "vessel": "RV <Example>",
    "date": "2026-05-04",
    "operator": "A. Surveyor",
    "dvl": {"maker": "Teledyne RDI", "model": "Pathfinder", "serial": 4711, "firmware": 67.19},
    "water": {"temperature_c": 11.5, "salinity_psu": 34, "sound_speed_m_s": 1493},
}


@pytest.fixture
def trial(tmp_path: Path, run: Run) -> Path:
    path = tmp_path / "trial"
    assert run("simulate", SHORT, "--out", path, "--seed", "1").code == 0
    with (path / "trial.yaml").open("a") as file:
        file.write(yaml.safe_dump({"certificate": STATED}))
    return path


def test_the_page_prints_the_certificate(trial: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out"
    result = run("solve", trial, "--out", out, "--no-figures")
    # The maker is known, so its own names are there too.
    assert "TRDI EA" in result.out
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "TRDI EA" in page[: page.index('id="certificate"')]
    certificate = page[page.index('<section id="certificate"') : page.index('id="settings"')]
    for text in (
        "RV &lt;Example&gt;",
        "2026-05-04",
        "Pathfinder",
        "4711",
        "67.19",
        "1493.0 m/s",
        "34.0 PSU",
    ):
        assert text in certificate
    assert "factorgraph-dvl 0." in certificate
    assert "因子图" in certificate
    for name in ("trial.yaml", "imu.csv", "gnss.csv", "dvl.csv"):
        digest = hashlib.sha256((trial / name).read_bytes()).hexdigest()
        assert re.search(rf">{name}</th><td><code>{digest}</code>", certificate)
    check = json.loads((out / "check.json").read_text())
    assert check["data"] in ("second half", "same data")
    assert max(check["residual_rms_m_s"]["after"]) < max(check["residual_rms_m_s"]["before"])
    assert 'id="check-title"' in page
    # For paper, too.
    assert run("report", out, "--pdf").code == 0
    assert (out / "report.pdf").read_bytes().startswith(b"%PDF")
    assert run("report", out, out, "--pdf").code == 2
    # The page can be made again.
    assert run("report", out).code == 0
    assert certificate in (out / "report.html").read_text(encoding="utf-8")


def test_a_date_that_is_not_stated_is_named() -> None:
    for stated, expected in (
        ({}, (("date",), "not stated")),
        ({"epoch": "2022"}, (("recorded from",), "2022")),
    ):
        assert next(iter(statements(build_result(run=stated)))) == expected


def test_a_certificate_survives_saving(trial: Path, tmp_path: Path) -> None:
    first = load_trial(trial)
    assert first.certificate["dvl"]["serial"] == 4711
    save_trial(first, tmp_path / "again")
    assert load_trial(tmp_path / "again").certificate == first.certificate


def test_an_unknown_statement_is_refused(trial: Path) -> None:
    with (trial / "trial.yaml").open("a") as file:
        file.write("  vessels: x\n")
    with pytest.raises(ConfigError, match=r"certificate\.vessels"):
        load_trial(trial)


def test_a_redacted_page_has_no_certificate() -> None:
    result = build_result()
    result = build_result(run={**result.run, "certificate": STATED})
    assert "A. Surveyor" in report_page(result)
    page = report_page(result, redacted=True)
    assert "A. Surveyor" not in page
    assert 'id="certificate"' not in page
