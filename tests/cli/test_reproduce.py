"""The command `reproduce`: every item of a publication has a result and a verdict."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from markdown_tables import faults
from running import run  # noqa: F401

from factorgraph_dvl.reproduce import PAPERS
from factorgraph_dvl.reproduce.luo_2024_equations import scene_of
from factorgraph_dvl.reproduce.luo_2024_sea import _net_shares
from factorgraph_dvl.reproduce.page import label_of

# Numbered items of each publication: equations, tables, figures.
NUMBERED = {
    "luo-2024": (16, 7, 7),
    "liu-2020": (22, 0, 4),
    "nine-state": (0, 0, 0),
    "beams": (0, 0, 0),
    "chen-2021": (0, 1, 5),
}
VERDICTS = {"reproduced", "corrected", "not reproducible"}
# Verdicts that depend on how the print is read: their measurements name the readings.
READ = {
    # The Earth's turn in ω_ib makes the error diverge, but not in truth.
    ("luo-2024", "figure 1"): "corrected",
    # Rows of H less their mean: the change of H, by which the text argues.
    ("luo-2024", "table 3"): "corrected",
    # The printed filter and the one that settles, each by itself.
    ("luo-2024", "figure 4"): "not reproducible",
    ("luo-2024", "figure 4 (settled)"): "reproduced",
    # When the vessel turns, and the track that the errors before calibration imply.
    ("luo-2024", "figure 7"): "reproduced",
    ("luo-2024", "table 7 (before)"): "reproduced",
    # At heading 0, n and body have the same axes; the heading is not printed.
    ("liu-2020", "figure 2"): "reproduced",
    ("liu-2020", "figure 3"): "reproduced",
    ("liu-2020", "figure 4"): "reproduced",
    ("liu-2020", "eq. 16"): "corrected",
    # By eye stable, strictly not.
    ("liu-2020", "claim 1 (section 3.2)"): "corrected",
    # Attitude of SINS and velocity of GNSS fed apart.
    ("beams", "claim 6, step 4"): "corrected",
    ("beams", "step 5"): "reproduced",
    # From (0, 0) a vehicle must head away from the beacon.
    ("chen-2021", "claim 1 (abstract)"): "corrected",
}


def numbers(name: str, kind: str) -> set[int]:
    labels = [label_of(x) for e in PAPERS[name].entries for x in e.label.split(", ")]
    return {int(x.split()[1]) for x in labels if x.startswith(f"{kind} ")}


@pytest.mark.parametrize("name", sorted(PAPERS))
def test_every_numbered_item_has_an_entry(name):
    for kind, count in zip(("eq.", "table", "figure"), NUMBERED[name], strict=True):
        assert numbers(name, kind) == set(range(1, count + 1)), kind
    assert any(e.label.startswith("claim") for e in PAPERS[name].entries)


@pytest.mark.parametrize("name", sorted(PAPERS))
def test_modules_and_configurations_that_entries_name_are_there(name):
    root = Path(__file__).resolve().parents[2]
    for entry in PAPERS[name].entries:
        for where in re.findall(r"`([a-z_]+/[^`]+)`", entry.where):
            inside = "." if where.startswith(("configs/", "examples/")) else "factorgraph_dvl"
            pattern = where if "." in where else f"{where}*"
            assert list((root / inside).glob(pattern)), entry.where


@pytest.mark.parametrize("name", sorted(PAPERS))
def test_the_page_of_all_publications_has_every_item(name):
    page = Path(__file__).resolve().parents[2] / "docs" / "papers.md"
    lines = page.read_text(encoding="utf-8").splitlines()
    for entry in PAPERS[name].entries:
        found = [x for x in lines if x.startswith(f"| {entry.label} | {entry.says} | ")]
        assert found, f"{name}, {entry.label}: run benchmarks/papers.py --out docs"
        verdict = found[0].rpartition(" | ")[2].strip(" |")
        assert verdict in VERDICTS
        assert READ.get((name, entry.label), verdict) == verdict, entry.label


def test_one_table(run, tmp_path):  # noqa: F811
    result = run("reproduce", "luo-2024", "--table", "3", "--out", tmp_path / "out", "--quiet")
    assert result.code == 0, result.err
    # The paper argues by the change of H: with the rows less their mean, the best manoeuvre of
    # each state is the printed one, although 4 m/s have three singular values of 57.
    assert "2 of 6 states with rows as they are, 6 of 6 states with rows less" in result.out
    assert result.out.splitlines()[0].endswith(": corrected")
    page = (tmp_path / "out" / "luo-2024.md").read_text(encoding="utf-8")
    assert page.count("| steady | 0 | 0 | 0 | 0 | 0 | 0 | 0 |") == 2
    assert "three of 4 √N = 57" in page
    assert (tmp_path / "out" / "table-3.png").stat().st_size > 1000
    assert faults(page) == []
    again = run("reproduce", "luo-2024", "--table", "3", "--out", tmp_path / "out", "--quiet")
    assert again.code == 2
    assert "--force" in again.err


def test_one_figure(run, tmp_path):  # noqa: F811
    result = run("reproduce", "luo-2024", "--figure", "3", "--out", tmp_path / "out", "--quiet")
    assert result.code == 0, result.err
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"luo-2024.md", "figure-3.png"}


def test_the_track_has_the_net_displacement_that_table_7_implies():
    at_end, at_most = _net_shares()
    # Table 7, over the 28.9 % that α_z and δK of table 6 make of net displacement.
    assert at_end == pytest.approx(0.0795 / 0.289, rel=0.02)
    assert at_most == pytest.approx(0.1279 / 0.289, rel=0.02)
    heading = np.unwrap(scene_of("luo-2024-transit", 1.0).rph[:, 2])
    assert abs(np.degrees(heading[1390] - heading[1310])) == pytest.approx(180.0, abs=3.0)


def test_a_figure_that_is_not_there_is_refused(run, tmp_path):  # noqa: F811
    result = run("reproduce", "luo-2024", "--figure", "8", "--out", tmp_path / "out")
    assert result.code == 2
    assert "figure 1, table 2" in result.err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(PAPERS))
def test_every_item_has_a_verdict(name, run, tmp_path):  # noqa: F811
    result = run("reproduce", name, "--seeds", "1", "--out", tmp_path / "out", "--quiet")
    assert result.code == 0, result.err
    page = (tmp_path / "out" / f"{name}.md").read_text(encoding="utf-8")
    assert faults(page) == []
    for entry in PAPERS[name].entries:
        (line,) = [
            x for x in page.splitlines() if x.startswith(f"| {entry.label} | {entry.says} ")
        ]
        *_, measured, verdict = line.strip("| ").split(" | ")
        assert verdict in VERDICTS
        assert READ.get((name, entry.label), verdict) == verdict, entry.label
        assert re.search(r"\d|nothing to compute|not published", measured), line
    for image in re.findall(r"\]\((\S+\.png)\)", page):
        assert (tmp_path / "out" / image).stat().st_size > 1000
