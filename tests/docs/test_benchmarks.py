"""Benchmarks start safely, name what made a page, and their pages still hold."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from factorgraph_dvl.simulation import parse_scenario

ROOT = Path(__file__).resolve().parents[2]
# Modules that scripts share are none.
SHARED = ("common", "fault_rows", "kf_gins")
SCRIPTS = sorted(p.stem for p in (ROOT / "benchmarks").glob("*.py") if p.stem not in SHARED)
# Where a page of the repository is, of those with a sample that is made anew below.
SAMPLED = (
    "luo_2024",
    "liu_2020",
    "stars",
    "beams",
    "beacon_2021",
    "sea_trial",
    "papers",
    "rivals",
    "preintegration",
)

# Chosen: relative difference of a number to the printed one, beside one unit of its last digit,
# that the end of an iteration may make.
SAME = 0.02
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_folder_that_cannot_be_written_is_refused_before_any_work(
    name, benchmark, monkeypatch, tmp_path, capsys
):
    (tmp_path / "file").touch()
    monkeypatch.setattr(sys, "argv", [f"{name}.py", "--out", str(tmp_path / "file" / "deep")])
    with pytest.raises(SystemExit) as caught:
        benchmark(name).main()
    assert caught.value.code == 2
    assert "--out" in capsys.readouterr().err


def test_the_folder_is_made_and_by_default_no_page_is_replaced(benchmark, monkeypatch, tmp_path):
    common = benchmark("common")
    monkeypatch.setattr(common.sys, "argv", ["luo_2024.py"])
    args = common.parse(common.parser("", seeds=4), ["--out", str(tmp_path / "a" / "b")])
    assert (tmp_path / "a" / "b").is_dir()
    assert re.fullmatch(
        r"Written by `python benchmarks/luo_2024\.py --seeds 4` from "
        r"(commit [0-9a-f]{10} (\(clean tree\)|with changes)|an unknown commit); do not edit\.",
        args.origin,
    )
    assert common.parser("").parse_args([]).out == ROOT / "out" / "benchmarks"
    assert "/out*/" in (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()


def test_pages_of_the_documentation_name_the_commit_of_a_clean_tree():
    pages = [p.read_text(encoding="utf-8") for p in sorted((ROOT / "docs").glob("*.md"))]
    written = [
        line for page in pages for line in page.splitlines() if "Written by `python" in line
    ]
    assert len(written) >= 6
    validation = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")
    for line in written:
        assert line.split("`")[1] in validation
        assert re.search(r" from commit [0-9a-f]{10} \(clean tree\); do not edit\.", line), line


def test_the_scenario_of_a_campaign_has_its_name_and_mount(benchmark):
    built = benchmark("campaign").scenario("0007", 453.0, (0.0, 0.0, 0.1))
    assert built.name == "0007"
    mount = parse_scenario(benchmark("common").config("seed-a-phase-90")).dvl.misalignment_deg
    assert np.subtract(built.dvl.misalignment_deg, mount) == pytest.approx([0.0, 0.0, 0.1])


def test_a_changed_tree_is_named(benchmark, monkeypatch):
    common = benchmark("common")

    class Finished:
        def __init__(self, stdout):
            self.stdout = stdout

    def git(command, **_):
        return Finished(" M solvers/batch.py\n" if "status" in command else "0123456789\n")

    monkeypatch.setattr(common.subprocess, "run", git)
    assert common.commit() == "commit 0123456789 with changes"


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    # One seed of these takes minutes.
    [
        pytest.param(n, marks=pytest.mark.study) if n in ("beams", "sea_trial") else n
        for n in SAMPLED
    ],
)
def test_the_numbers_of_one_seed_are_those_of_the_page(name, benchmark):
    module = benchmark(name)
    page = (ROOT / "docs" / module.PAGE).read_text(encoding="utf-8")
    printed = page.splitlines()
    missing = [line for line in module.sample() if not any(agree(line, p) for p in printed)]
    assert not missing, f"docs/{module.PAGE} is out of date; run benchmarks/{name}.py --out docs"


def agree(line: str, printed: str) -> bool:
    """Whether two lines have the same text, and numbers that are the same for a reader."""
    if NUMBER.sub("#", line) != NUMBER.sub("#", printed):
        return False
    pairs = zip(NUMBER.findall(line), NUMBER.findall(printed), strict=True)
    return all(abs(float(a) - float(b)) <= allowed(b) for a, b in pairs)


def allowed(number: str) -> float:
    mantissa, _, exponent = number.partition("e")
    digit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    return max(SAME * abs(float(number)), 1.001 * digit)


def test_lines_agree_to_what_a_reader_sees():
    assert agree("| x | 1.2346e-05, 7 |", "| x | 1.2345e-05, 7 |")
    assert agree("| x | 10.05 |", "| x | 10.20 |")
    assert not agree("| x | 10.05 |", "| x | 10.30 |")
    assert not agree("| x | 10.05 |", "| y | 10.05 |")
    assert agree("| x | 0.0002 |", "| x | 0.0003 |")
    assert not agree("| x | 0.0001 |", "| x | 0.0003 |")
