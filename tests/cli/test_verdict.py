"""What is graded `do not use` is refused, wherever a result is used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders import build_solution, build_trial, edit, write_trial
from running import Run

from factorgraph_dvl.cli.verdict import print_conclusion
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.files.solution_folder import save_solution
from factorgraph_dvl.files.trial_folder import load_trial
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.verdict import verdict_of

REASON = "DVL velocity: residuals are 14 times as large as stated"
REFUSAL = f"graded `do not use`: {REASON}"


def condemned():
    """A complete calibration that the data contradict."""
    arm = Estimate(
        "lever_arm_m",
        ("lever_arm_x_m", "lever_arm_y_m", "lever_arm_z_m"),
        *(np.ones(3), np.full(3, 0.01), np.zeros(3), np.full(3, 10.0), np.ones(3, bool)),
    )
    solution = build_solution(body_axes="RFU")
    estimates = (*solution.estimates, arm)
    std = np.concatenate([e.std for e in estimates])
    sensor, _, text = REASON.partition(": ")
    return replace(
        solution,
        estimates=estimates,
        covariance=np.diag(std**2),
        findings=(Finding(Code.DOES_NOT_FIT, text, sensor=sensor),),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trial, and results that are not to be used."""
    root = tmp_path_factory.mktemp("verdict")
    write_trial(root, build_trial(seconds=20.0, calibration_truth={}))
    save_solution(condemned(), root / "bad")
    return root


def commands(root: Path, out: Path) -> dict[str, list[object]]:
    written = ["--out", out, "--no-figures"]
    reckon = ["deadreckon", root / "trial"]
    return {
        "crosscheck": ["crosscheck", root / "bad", root / "bad", *written],
        "deadreckon": [*reckon, root / "bad", *written, "--quiet", "--attitude", "reference"],
        "attitude": [
            *reckon,
            root / "values.json",
            *written,
            "--quiet",
            "--attitude",
            root / "bad",
        ],
        "export": ["export", root / "bad", "--to", "urdf", "--out", out],
    }


@pytest.mark.parametrize("name", ["crosscheck", "deadreckon", "attitude", "export"])
def test_a_result_that_is_not_to_be_used_is_refused(
    name: str, folder: Path, tmp_path: Path, run: Run
) -> None:
    (folder / "values.json").write_text('{"misalignment_deg": [1, 2, 3]}')
    command = commands(folder, tmp_path / "out")[name]
    refused = run(*command)
    assert refused.code == 2
    assert REFUSAL in refused.err
    assert "--anyway" in refused.err
    assert not (tmp_path / "out").exists()
    assert REFUSAL not in run(*command, "--anyway").err


@pytest.mark.parametrize("has_sum", [False, True])
def test_the_conclusion_leaves_room_on_a_screen(
    capsys: pytest.CaptureFixture[str], has_sum: bool
) -> None:
    reasons = [Finding(Code.DOES_NOT_FIT, f"reason {i}", severity="warning") for i in range(9)]
    if has_sum:
        reasons.append(Finding(Code.HEADING_ERROR, "the sum", parameter="misalignment_deg"))
    found = condemned()
    # A scale error of each axis makes the table longest.
    scales = tuple(f"scale_error_{axis}" for axis in "xyz")
    per_axis = [
        Estimate(
            e.name,
            scales,
            *(np.ones(3) * a for a in (e.value, e.std, e.prior_value, e.prior_std)),
            np.ones(3, bool),
        )
        if e.name == "scale_error"
        else e
        for e in found.estimates
    ]
    std = np.concatenate([e.std for e in per_axis])
    found = replace(
        found, findings=tuple(reasons), estimates=tuple(per_axis), covariance=np.diag(std**2)
    )
    print_conclusion(found, "Exail", Path("out/report.html"))
    lines = capsys.readouterr().out.splitlines()
    # Before it come at most what was rejected, an accuracy, and the files.
    assert len(lines) <= 30 - 3
    assert lines[0].startswith("Verdict: doubtful: reason 0")
    assert "Further reasons: 9" in lines[0]
    assert [line for line in lines if "reason" in line][1:] == [
        f"warning: reason {i}." for i in (1, 2)
    ]
    assert ("Mount and compass: the sum" in lines) == has_sum
    assert any("Delph XV3" in line for line in lines)
    assert lines[-1] == "Open out/report.html"


def test_what_to_do_about_further_reasons_is_said_once(capsys: pytest.CaptureFixture[str]) -> None:
    codes = (Code.DOES_NOT_FIT, Code.OUTLIERS, Code.OUTLIERS)
    reasons = [Finding(c, f"reason {i}", severity="warning") for i, c in enumerate(codes)]
    order = [f.code for f in verdict_of(reasons).reasons]
    print_conclusion(replace(condemned(), findings=tuple(reasons)), "", Path("out/report.html"))
    lines = [line for line in capsys.readouterr().out.splitlines() if "reason" in line]
    assert len(lines) == len(codes)
    for code in set(codes):
        assert sum(code.action in line for line in lines) == 1
    assert lines[1].endswith(order[1].action) == (order[1] != order[0])


def test_instrument_says_why_nothing_is_to_be_entered(folder: Path, run: Run) -> None:
    refused = run("instrument", folder / "bad")
    assert refused.code == 1
    first, reason, *_ = refused.out.splitlines()
    assert first == "# Verdict: do not use"
    assert reason.startswith(f"#   error: {REASON}.")
    assert all(line.startswith("#") for line in refused.out.splitlines())
    shown = run("instrument", folder / "bad", "--anyway")
    assert shown.code == 0
    assert shown.out.startswith(refused.out)
    assert "lever_arm_down_m: -1.000  # ± 0.010; positive: below; green" in shown.out


def test_a_prior_that_is_not_to_be_used_is_refused(folder: Path, tmp_path: Path) -> None:
    path = write_trial(tmp_path, build_trial(seconds=20.0))
    calibration = folder / "bad" / "calibration.json"
    edit(path / "trial.yaml", "dvl:\n", f"dvl:\n  calibration: {calibration}\n")
    with pytest.raises(DataError, match="graded `do not use`: DVL velocity"):
        load_trial(path)
    (note,) = load_trial(path, anyway=True).notes
    assert (note.code, note.severity) == (Code.UNUSABLE_PRIOR, "warning")
    assert REASON in note.text
