"""The site of the documentation builds without warnings and network; its links lead somewhere."""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import factorgraph_dvl
from factorgraph_dvl.quality.finding import Code

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(
    path
    for folder in (".", "docs", "data", "benchmarks", "examples/compass-plugin")
    for path in (ROOT / folder).glob("*.md")
)
COMMANDS = sorted(
    set(re.findall(r"(?:benchmarks|tests)/[\w/]+(?:\.\w+)?", (DOCS / "validation.md").read_text()))
)
# Of the files in the package `mathjax` 3.2.2 as npm serves it, whose shasum is
# c754d7b46a679d7f3fa03543d6b8bf124ddf9f6b.
MATHJAX_SHA256 = {
    "tex-svg-full.js": "a4354ff94fd868aea0cc6eaaa79a57fda0588646fc46ee3700a349ee0a11cbe6",
    "LICENSE": "cfc7749b96f63bd31c3c42b5c471bf756814053e847c10f3eb003417bc523d30",
}


def links(page: Path) -> list[tuple[Path, str]]:
    """Return the files that a page links, each with the heading in it."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    targets = re.findall(r"\]\((?!https?:|#)([^)\s]+)\)", text)
    return [
        ((page.parent / path).resolve(), heading)
        for path, _, heading in (target.partition("#") for target in targets)
    ]


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as code hosts and myst make them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.M)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page):
    lost = [
        f"{file}#{heading}"
        for file, heading in links(page)
        if not file.exists() or (heading and heading not in anchors(file))
    ]
    assert not lost


def test_every_page_is_reached_from_the_first_without_the_site():
    found, front = set(), [DOCS / "index.md"]
    while front:
        page = front.pop()
        if page not in found:
            found.add(page)
            front += [f for f, _ in links(page) if f.parent == DOCS and f.suffix == ".md"]
    assert {page.name for page in DOCS.glob("*.md")} == {page.name for page in found}


def test_the_reference_has_every_public_name():
    text = (DOCS / "api.md").read_text(encoding="utf-8")
    names = re.findall(r"^   (\w+)$", text, re.M)
    assert sorted(names) == sorted(factorgraph_dvl.__all__)


def test_troubleshooting_has_every_code():
    text = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(\w+)`", text))
    assert {code.value for code in Code} <= named


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_of_the_validation_are_there(command):
    assert (ROOT / command).exists()


def test_mathjax_is_that_of_the_registry():
    folder = DOCS / "_static" / "vendor" / "mathjax-3.2.2"
    found = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.iterdir()}
    assert found == MATHJAX_SHA256


@pytest.mark.slow
def test_the_site_builds_without_warnings_and_loads_nothing_from_elsewhere(tmp_path):
    for package in ("myst_parser", "pydata_sphinx_theme", "sphinx_gallery"):
        pytest.importorskip(package, reason="the extra `docs` is not installed")
    command = [sys.executable, "-m", "sphinx", "-E", "-W", "--keep-going", "-q"]
    built = subprocess.run(
        [*command, "-b", "html", DOCS, tmp_path], cwd=ROOT, capture_output=True, text=True
    )
    assert built.returncode == 0, built.stderr
    for page in DOCS.glob("*.md"):
        assert (tmp_path / f"{page.stem}.html").is_file()
    for name in factorgraph_dvl.__all__:
        assert (tmp_path / "_api" / f"factorgraph_dvl.{name}.html").is_file()
    for page in tmp_path.rglob("*.html"):
        loaded = re.findall(r"<(?:script|link|img|iframe)\b[^>]*", page.read_text("utf-8"))
        assert not [tag for tag in loaded if re.search(r'(?:src|href)="(?:https?:)?//', tag)], page
    browser = shutil.which("chromium")
    if browser is None:
        pytest.skip("chromium is not installed: equations are not looked at")
    switches = ["--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    for name in ("frames", "model", "kalman"):
        page = (tmp_path / f"{name}.html").as_uri()
        shown = subprocess.run(
            [browser, *switches, "--timeout=5000", "--dump-dom", page],
            capture_output=True,
            text=True,
        )
        assert shown.stdout.count("<mjx-container") > 3
        assert "mjx-merror" not in shown.stdout
        assert "Uncaught" not in shown.stderr
        assert "ERR_" not in shown.stderr
