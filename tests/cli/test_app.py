from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import build_history, build_solution, build_trial, edit, write_trial
from running import Run
from truth import CONFIGS

import factorgraph_dvl.report.figures.solution
import factorgraph_dvl.solvers.information_along_trial
from factorgraph_dvl.cli.commands import COMMANDS, command
from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.files.solution_folder import load_solution
from factorgraph_dvl.files.trial_folder import load_trial
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import Scenario, load_scenario
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.statistics.information_history import InformationHistory
from factorgraph_dvl.trial import Trial


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A solver that answers what it is told, and notes what it was asked."""
    state: dict[str, Any] = {"solution": build_solution(), "raises": None}

    def solve(
        trial: Trial,
        *,
        rate_hz: float,
        entries: int,
        anyway: bool,
        progress: Callable[..., None],
    ) -> tuple[Solution, InformationHistory]:
        state["trial"], state["rate"] = trial, rate_hz
        progress("alignment", 0, None)
        progress("batch", 0, 9.87e12)
        progress("batch", 1, 12.51234)
        if state["raises"] is not None:
            raise state["raises"]
        return state["solution"], state.get("along") or build_history(state["solution"])

    def write_figures(trial: Trial, solution: Solution, folder: Path, *, kind: str) -> None:
        folder.mkdir()
        (folder / "track.png").write_text("png")

    module = factorgraph_dvl.solvers.information_along_trial
    monkeypatch.setattr(module, "solve_with_history", solve)
    monkeypatch.setattr(factorgraph_dvl.report.figures.solution, "write_figures", write_figures)
    return state


def test_solve_writes_a_solution_and_shows_it(
    tmp_path: Path, run: Run, stub: dict[str, Any]
) -> None:
    out = tmp_path / "deep" / "out"
    result = run("solve", write_trial(tmp_path), "--out", out)
    assert result.code == 0
    assert load_solution(out).estimate("scale_error").value == [0.00512345678901234]
    assert (out / "figures" / "track.png").exists()
    assert stub["rate"] == 10.0
    assert stub["trial"].name == "by hand"
    row = next(line for line in result.out.splitlines() if "scale_error" in line)
    for text in ("0.005123 ± 0.000033", "green", "0.005000", "+3.70"):
        assert text in row
    assert "3.3 ± 4.0" in result.out
    for name in ("calibration.json", "trajectory.csv", "track.png"):
        assert name in result.out
    reason = "misalignment_z_deg (±4) above the limit of 0.1 deg"
    verdict, last = result.out.splitlines()[-2:]
    assert verdict == f"Verdict: doubtful: {reason}. {Code.UNCERTAIN.action}"
    assert last == f"Open {out}/report.html"
    assert "note: misalignment_z_deg was not observable" in result.err
    # Nothing is drawn over in a pipe.
    assert "iteration" not in result.err
    assert " s  " not in result.err


def test_solve_shows_sigma_along_the_trial(tmp_path: Path, run: Run, stub: dict[str, Any]) -> None:
    names = stub["solution"].order[:3]
    roots = np.array([180.0, 3.0, 0.05])[:, None, None] * np.eye(3)
    stub["along"] = InformationHistory(np.array([0.0, 5.0, 10.0]), tuple(names), roots)
    out = tmp_path / "out"
    assert run("solve", write_trial(tmp_path), "--out", out, "--no-figures").code == 0
    header, *rows = (out / "history.csv").read_text().splitlines()
    assert header.split(",") == ["time_s", *(f"{name}_std" for name in names)]
    assert [float(row.split(",")[1]) for row in rows] == [180.0, 3.0, 0.05]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "misalignment: σ along the trial, deg" in page
    assert run("report", out).code == 0
    assert (out / "report.html").read_text(encoding="utf-8") == page


def test_solve_options(tmp_path: Path, run: Run, stub: dict[str, Any]) -> None:
    trial, out = write_trial(tmp_path), tmp_path / "out"
    result = run("solve", trial, "--out", out, "--no-figures", "--rate", "2.5", "--quiet")
    assert result.code == 0
    assert stub["rate"] == 2.5
    assert "iteration" not in result.err
    assert {p.name for p in out.iterdir()} == {
        *("calibration.json", "history.csv", "trajectory.csv", "report.html", "run.json")
    }
    assert run("solve", trial, "--out", out).code == 2
    assert run("solve", trial, "--out", out, "--force").code == 0


def test_a_solution_that_did_not_converge_is_written_and_exits_1(
    tmp_path: Path, run: Run, stub: dict[str, Any]
) -> None:
    stub["solution"] = build_solution(converged=False)
    out = tmp_path / "out"
    result = run("solve", write_trial(tmp_path), "--out", out)
    assert result.code == 1
    assert "\nVerdict: do not use: the solver did not converge in 5 iter" in result.out
    assert "error: not to be used: the solver did not converge in 5 iterations" in result.err
    assert not (out / "instrument.yaml").exists()
    assert json.loads((out / "calibration.json").read_text())["converged"] is False


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (SolveError("no minimum", hint="Try more"), 1, "error: no minimum. Try more"),
        (KeyboardInterrupt(), 130, ""),
        (PermissionError(13, "Permission denied", "imu.csv"), 2, "imu.csv: Permission denied"),
        (ZeroDivisionError("division"), 1, "internal error: ZeroDivisionError: division"),
    ],
)
def test_a_solver_that_fails_leaves_nothing(
    tmp_path: Path, run: Run, stub: dict[str, Any], error: BaseException, code: int, text: str
) -> None:
    stub["raises"] = error
    out = tmp_path / "out"
    result = run("solve", write_trial(tmp_path), "--out", out)
    assert result.code == code
    assert text in result.err
    assert "Traceback" not in result.err
    assert {p.name for p in tmp_path.iterdir()} == {"trial"}


def test_debug_shows_the_traceback(tmp_path: Path, run: Run, stub: dict[str, Any]) -> None:
    stub["raises"] = ZeroDivisionError("division")
    trial = write_trial(tmp_path)
    assert "--debug" in run("solve", trial, "--out", tmp_path / "out").err
    assert "Traceback" in run("solve", trial, "--out", tmp_path / "out", "--debug").err


def test_figures_that_fail_do_not_cost_the_solution(
    tmp_path: Path, run: Run, stub: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object, **options: object) -> None:
        raise ValueError("no axes")

    monkeypatch.setattr(factorgraph_dvl.report.figures.solution, "write_figures", fail)
    result = run("solve", write_trial(tmp_path), "--out", tmp_path / "out")
    assert result.code == 0
    assert "figures could not be drawn: ValueError: no axes" in result.err
    assert load_solution(tmp_path / "out").converged


def test_an_output_that_exists_is_refused_before_the_work(
    tmp_path: Path, run: Run, stub: dict[str, Any]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    result = run("solve", write_trial(tmp_path), "--out", out)
    assert result.code == 2
    assert "--force" in result.err
    assert "trial" not in stub
    assert [p.name for p in out.iterdir()] == ["mine.txt"]


BAD_INPUT = {
    "unknown key": ("trial.yaml", "misalignment_deg:", "misalinment_deg:", "misalinment_deg"),
    "out of range": ("trial.yaml", "velocity_std_m_s: 0.001", "velocity_std_m_s: -1", "line "),
    "wrong type": ("trial.yaml", "time_offset_s: 0.0", "time_offset_s: []", "gnss.time_offset_s"),
    "syntax": ("trial.yaml", "body_axes: RFU", "body_axes: {", "line "),
    "no table": ("trial.yaml", "file: dvl.csv", "file: nowhere.csv", "nowhere.csv"),
    "a cell": ("dvl.csv", "0.75,", "x,", "line 2: time_s is 'x'"),
    "no column": ("gnss.csv", "lat_deg", "latitude", "missing column lat_deg"),
    "truth": ("truth.json", "{", "", "truth.json"),
}


@pytest.mark.parametrize("command", ["solve", "inspect"])
@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_exits_2_and_says_where(
    tmp_path: Path, run: Run, stub: dict[str, Any], case: str, command: str
) -> None:
    name, old, new, expected = BAD_INPUT[case]
    trial = write_trial(tmp_path)
    edit(trial / name, old, new)
    args = ["--out", tmp_path / "out"] if command == "solve" else []
    result = run(command, trial, *args)
    assert result.code == 2
    assert f"error: {name}" in result.err or case == "no table"
    assert expected in result.err
    assert result.err.startswith("error: ")
    assert "Traceback" not in result.err
    assert {p.name for p in tmp_path.iterdir()} == {"trial"}


@pytest.mark.parametrize("command", ["solve", "inspect"])
def test_a_missing_trial_prints_its_error_only(
    tmp_path: Path, run: Run, stub: dict[str, Any], command: str
) -> None:
    args = ["--out", tmp_path / "out"] if command == "solve" else []
    result = run(command, tmp_path / "nowhere", *args)
    assert result.code == 2
    assert result.out == ""
    assert result.err.startswith("error: ")
    assert len(result.err.splitlines()) == 1


@pytest.mark.parametrize("width", [80, 60])
def test_a_terminal_too_narrow_cuts_no_number(
    tmp_path: Path,
    run: Run,
    stub: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    width: int,
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TERM", "xterm")
    trial = write_trial(tmp_path)
    out = run("solve", trial, "--out", tmp_path / "out").out
    assert "…" not in out
    # A long name continues on the next line.
    for text in ("misalignment_z,", "0.005123 ± 0.000033", "0.005000", "+3.70"):
        assert text in out
    assert "prior" not in out
    out = run("inspect", trial).out
    assert "…" not in out
    assert "missing %" in out


def test_the_table_comes_before_its_warnings_in_one_file(tmp_path: Path) -> None:
    trial = write_trial(tmp_path)
    # Beams at the times of the pings: one instrument in two records.
    times = [line.split(",")[0] for line in (trial / "dvl.csv").read_text().splitlines()[1:]]
    rows = ["time_s,beam1_m_s,beam2_m_s,beam3_m_s,beam4_m_s", *(f"{t},0,0,0,0" for t in times)]
    (trial / "dvl_beams.csv").write_text("\n".join(rows) + "\n")
    with (trial / "trial.yaml").open("a") as file:
        file.write("dvl_beams: {slant_azimuth_deg: [[30, 45], [30, 135], [30, 225], [30, 315]]}\n")
    done = subprocess.run(
        [sys.executable, "-m", "factorgraph_dvl.cli", "inspect", str(trial)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=60,
        check=False,
    )
    assert 0 < done.stdout.index("missing %") < done.stdout.index("warning: `dvl` and `dvl_beams`")


@pytest.mark.parametrize(
    "args",
    [
        ("solve",),
        ("solve", "TRIAL"),
        ("solve", "TRIAL", "--out", "OUT", "--rate", "0"),
        ("solve", "TRIAL", "--out", "OUT", "--rate", "nan"),
        ("solve", "TRIAL", "--out", "OUT", "--rate", "fast"),
        ("solve", "TRIAL", "--out", "OUT", "--what"),
        ("solve", "nowhere", "--out", "OUT"),
        ("inspect", "nowhere"),
        ("inspect",),
        ("simulate", "nowhere.yaml", "--out", "OUT"),
        ("simulate", "nowhere.yaml", "--out", "OUT", "--seed", "-1"),
        ("launch",),
    ],
)
def test_bad_usage_exits_2(
    tmp_path: Path, run: Run, stub: dict[str, Any], args: tuple[str, ...]
) -> None:
    places = {"TRIAL": str(write_trial(tmp_path)), "OUT": str(tmp_path / "out")}
    result = run(*(places.get(arg, arg) for arg in args))
    assert result.code == 2
    assert result.err
    assert "Traceback" not in result.err
    assert {p.name for p in tmp_path.iterdir()} == {"trial"}


def test_inspect_shows_records_and_findings(tmp_path: Path, run: Run) -> None:
    trial = build_trial(body_axes="FRD")
    result = run("inspect", write_trial(tmp_path, trial))
    assert result.code == 1
    for text in (
        "IMU",
        "GNSS",
        "DVL",
        "3000",
        "duration 59.98 s",
        "error: IMU: the mean specific",
    ):
        assert text in result.out


@pytest.mark.parametrize("flag", [(), ("--parquet",)])
def test_simulate_writes_a_trial(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch, flag: tuple[str, ...]
) -> None:
    import importlib

    module = importlib.import_module("factorgraph_dvl.simulation")
    seeds = []

    config = CONFIGS / "seed-a-phase-0.yaml"

    def simulate(scenario: Scenario, seed: int) -> Trial:
        assert scenario == load_scenario(config)
        seeds.append(seed)
        return build_trial()

    monkeypatch.setattr(module, "simulate", simulate)
    out = tmp_path / "out"
    args = ("simulate", config, "--out", out, *flag)
    result = run(*args, "--seed", "7")
    assert result.code == 0
    assert str(out) in result.out
    assert load_trial(out).name == "by hand"
    assert (out / ("imu.parquet" if flag else "imu.csv")).exists()
    assert run(*args).code == 2
    assert run(*args, "--force").code == 0
    assert seeds == [7, 0]


def test_version_and_help(run: Run) -> None:
    result = run("--version")
    assert result.code == 0
    assert result.out.startswith("factorgraph-dvl 0")
    result = run("--help")
    assert result.code == 0
    for name in ("simulate", "solve", "inspect"):
        assert name in result.out


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_of_commands_has_their_first_lines(name: str) -> None:
    listed = COMMANDS[name][1]
    assert (command(name).help or "").splitlines()[0] == listed


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from factorgraph_dvl.cli import main\n"
        "try:\n    main(['--help'])\n"
        "except SystemExit:\n    pass\n"
        "print([m for m in ('gtsam', 'scipy', 'numpy', 'matplotlib', 'pyarrow', 'msgspec', "
        "'rich.progress', 'factorgraph_dvl.cli.solve') "
        "if m in sys.modules], file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stderr.strip() == "[]"
