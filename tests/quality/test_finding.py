"""Findings: their codes, and the page that explains them."""

from __future__ import annotations

from pathlib import Path

import findings_page
import pytest

import factorgraph_dvl
from factorgraph_dvl.quality import finding
from factorgraph_dvl.quality.finding import UNUSABLE, Code, Finding

SOURCE = "".join(
    path.read_text(encoding="utf-8")
    for path in Path(factorgraph_dvl.__file__).parent.rglob("*.py")
    if path != Path(finding.__file__)
)


def test_the_page_of_findings_is_that_of_the_codes():
    assert findings_page.written() == findings_page.drawn(), "run python tests/findings_page.py"


def test_every_code_stands_once_on_the_page():
    for code in Code:
        assert findings_page.drawn().count(f"| `{code}`") == 1, code


@pytest.mark.parametrize("code", Code)
def test_every_code_is_reported_somewhere_and_explained_in_sentences(code):
    assert f"Code.{code.name}" in SOURCE
    assert code == code.name.lower()
    for text in (code.meaning, code.why, code.action):
        assert text[0].isupper() or text.startswith(("dvl", "time_s")), text
        assert text.endswith("."), text
        assert "|" not in text, text


def test_only_an_error_makes_a_record_unusable():
    for code in (Code.RADIANS, Code.DVL_UNIT):
        assert Finding(code, "", severity="error").unusable == (code in UNUSABLE)
        assert not Finding(code, "", severity="warning").unusable
