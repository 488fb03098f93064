from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from builders import build_solution, edit, write_trial
from comparisons import moved

from factorgraph_dvl.analysis.comparison.crosscheck import crosscheck
from factorgraph_dvl.cli import main
from factorgraph_dvl.files.solution_folder import load_solution, save_solution

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "crosscheck"

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*args: str | Path) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as caught:
            main(["crosscheck", *map(str, args)])
        assert isinstance(caught.value.code, int)
        text = capsys.readouterr()
        return caught.value.code, " ".join(text.out.split()), text.err

    return call


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    a = build_solution()
    misalignment, scale_error = a.estimates
    b = replace(
        a,
        solver="kalman-point-set",
        estimates=(misalignment, replace(scale_error, value=scale_error.value + 1e-3)),
        trajectory=moved(a.trajectory, 0.2),
    )
    save_solution(a, tmp_path / "a")
    save_solution(b, tmp_path / "b")
    return tmp_path / "a", tmp_path / "b"


def reject(text: str) -> float:
    raise ValueError(f"{text} is not JSON")


# A division by zero or a nan on its way to a figure warns, and fails here.
@pytest.mark.filterwarnings("error")
def test_command(tmp_path: Path, run: Run, folders: tuple[Path, Path]) -> None:
    trial, out = write_trial(tmp_path), tmp_path / "out"
    code, text, err = run(*folders, "--reference", trial, "--efficient", "a", "--out", out)
    assert code == 0, err
    names = {p.name for p in out.iterdir()}
    files = {"crosscheck.json", "crosscheck.csv", "differences.csv"}
    assert names == files | {"parameters.png", "differences.png", "errors.png"}
    for shown in ("upper bound", "Hausman 1978", "2 agree, 1 differ"):
        assert shown in text
    assert "models the error of its inertial velocity as white noise" in text
    found = json.loads((out / "crosscheck.json").read_text(), parse_constant=reject)
    assert found["b"] == {
        "file": str(folders[1]),
        "trial": "by hand",
        "solver": "kalman-point-set",
        "converged": True,
    }
    verdicts = {c["name"]: c["verdict"] for c in found["components"]}
    assert verdicts["misalignment_x_deg"] == "agree"
    assert verdicts["misalignment_z_deg"] == "not comparable"
    assert verdicts["scale_error"] == "differ"
    assert found["efficient"] == "A"
    assert found["joint"]["verdict"] == "differ"
    assert found["trajectory"]["components"]["u_m"]["rms"] == pytest.approx(0.2)
    assert found["truth"]["a"]["calibration"]["error"][0] == pytest.approx(1.0 / 3.0)
    with (out / "crosscheck.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["verdict"] for row in rows] == list(verdicts.values())
    assert rows[0]["std_hausman"] == ""
    assert float(rows[3]["difference"]) == pytest.approx(-1e-3)
    with (out / "differences.csv").open() as file:
        header, first = list(csv.reader(file))[:2]
    assert header[:2] == ["time_s", "diff_e_m"]
    assert float(first[header.index("diff_u_m")]) == pytest.approx(-0.2)


def test_command_options_and_bad_input(
    tmp_path: Path, run: Run, folders: tuple[Path, Path]
) -> None:
    out = tmp_path / "out"
    assert run(*folders, "--out", out, "--no-figures")[0] == 0
    assert not list(out.glob("*.png"))
    (out / "mine.txt").write_text("kept")
    code, _, err = run(*folders, "--out", out)
    assert code == 2
    assert "is not empty" in err
    line = edit(folders[1] / "trajectory.csv", "lat_deg", "latitude")
    before = (out / "crosscheck.json").read_bytes()
    code, _, err = run(*folders, "--out", out, "--force")
    assert code == 2
    assert f"trajectory.csv line {line}: missing column lat_deg" in err
    assert (out / "crosscheck.json").read_bytes() == before
    edit(folders[1] / "trajectory.csv", "latitude", "lat_deg")
    assert run(*folders, "--out", out, "--force")[0] == 0
    assert (out / "mine.txt").exists()
    assert (out / "parameters.png").stat().st_size > 1000
    code, _, err = run(*folders, "--out", tmp_path / "new", "--efficient", "C")
    assert code == 2
    assert not (tmp_path / "new").exists()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["luo-2024.yaml", "survey.json", "survey-trajectory.csv"])
def test_examples(tmp_path: Path, run: Run, name: str) -> None:
    """Each file of the documentation against another result of that trial."""
    luo, survey = EXAMPLES / "luo-2024.yaml", EXAMPLES / "survey.json"
    other = survey if name == "luo-2024.yaml" else luo
    if name == "survey-trajectory.csv":
        other = survey
    shipped = EXAMPLES.parent.parent / "data" / "seed-a-phase-90"
    out = tmp_path / "out"
    code, text, err = run(EXAMPLES / name, other, "--reference", shipped, "--out", out)
    assert code == 0, err
    assert "Wrote" in text
    found = json.loads((out / "crosscheck.json").read_text(), parse_constant=reject)
    assert found["a"]["file"].endswith(name)
    assert found["truth"] is not None


def test_saved_solutions_agree_with_themselves(folders: tuple[Path, Path]) -> None:
    a = load_solution(folders[0])
    check = crosscheck(a, a, efficient="A")
    assert {c.verdict for c in check.components} == {"agree", "not comparable"}
    assert check.explanation == ()
    assert check.joint is not None
    assert check.joint.statistic == 0.0


def test_figures_come_in_other_formats_and_an_earlier_one_is_replaced(
    tmp_path: Path, run: Run, folders: tuple[Path, Path]
) -> None:
    out = tmp_path / "out"
    code, _, err = run(*folders, "--figures", "svg", "--out", out)
    assert code == 0, err
    text = (out / "parameters.svg").read_text(encoding="utf-8")
    assert text.startswith("<?xml")
    assert (out / "parameters.png").exists()
    assert run(*folders, "--no-figures", "--out", out, "--force")[0] == 0
    assert {p.suffix for p in out.iterdir()} == {".json", ".csv"}
