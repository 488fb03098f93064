"""What `--json` prints."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import events_schema
import msgspec
import pytest
from builders import build_history, build_solution, write_trial
from calibrations import calibration
from running import Run

from factorgraph_dvl.cli.commands import COMMANDS
from factorgraph_dvl.cli.events import Event
from factorgraph_dvl.files.calibration_file import encode_calibration
from factorgraph_dvl.files.solution_folder import save_solution


def lines(out: str) -> list[Any]:
    """Return the events, each of which is of a type that the schema has."""
    for line in out.splitlines():
        msgspec.json.decode(line, type=Event)
    return [json.loads(line) for line in out.splitlines()]


def kinds(out: str) -> list[str]:
    return [event["event"] for event in lines(out)]


def test_the_published_schema_is_that_of_the_program() -> None:
    assert events_schema.FILE.read_bytes() == events_schema.content()
    page = (events_schema.FILE.parent / "events.md").read_text()
    for kind in get_args(Event):
        assert f"`{kind.__struct_config__.tag}`" in page


def test_inspect(tmp_path: Path, run: Run) -> None:
    result = run("inspect", write_trial(tmp_path), "--json")
    events = lines(result.out)
    (table,) = (e for e in events if e["event"] == "table")
    assert table["columns"][:2] == ["sensor", "rate Hz"]
    assert [row[0] for row in table["rows"]][:2] == ["IMU", "GNSS"]
    assert {e["code"] for e in events if e["event"] == "finding"}
    assert events[-1] == {"event": "end", "exit_code": result.code}


def test_a_result_comes_with_its_verdict_and_its_files(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    solution = build_solution()
    monkeypatch.setattr(
        "factorgraph_dvl.solvers.information_along_trial.solve_with_history",
        lambda *_, **__: (solution, build_history(solution)),
    )
    out = tmp_path / "out"
    result = run("--json", "solve", write_trial(tmp_path), "--out", out, "--no-figures")
    events = lines(result.out)
    (verdict,) = (e for e in events if e["event"] == "verdict")
    assert verdict["grade"] == solution.verdict.grade
    assert verdict["reasons"][0]["action"]
    found = {e["file"]: e["content"] for e in events if e["event"] == "result"}
    assert found["calibration.json"] == json.loads((out / "calibration.json").read_text())
    (written,) = (e for e in events if e["event"] == "written")
    assert "report.html" in written["files"]
    assert "progress" in kinds(result.out)
    assert result.err == ""


def test_an_error_is_an_event_and_keeps_its_exit_code(tmp_path: Path, run: Run) -> None:
    result = run("inspect", tmp_path / "none", "--json")
    failed, end = lines(result.out)
    assert result.code == 2
    assert failed["event"] == "error"
    assert "none" in failed["text"]
    assert (failed["kind"], failed["expected"]) == ("input", "a trial folder")
    assert end == {"event": "end", "exit_code": 2}


@pytest.mark.parametrize("name", COMMANDS)
def test_wrong_usage_is_an_error_of_its_kind(run: Run, name: str) -> None:
    result = run(name, "--json", "--no-such-option")
    failed, end = lines(result.out)
    assert failed["event"] == "error"
    assert failed["kind"] == "usage"
    assert "--no-such-option" in failed["text"]
    assert end == {"event": "end", "exit_code": 2}
    assert result.code == 2
    assert result.err == ""


@pytest.mark.parametrize("args", [(), ("no-such-command",), ("solve",)])
def test_a_command_line_that_lacks_something_is_wrong_usage(
    run: Run, args: tuple[str, ...]
) -> None:
    failed, end = lines(run(*args, "--json").out)
    assert (failed["kind"], end["exit_code"]) == ("usage", 2)
    assert failed["text"]


def test_a_simulated_trial_is_written(tmp_path: Path, run: Run) -> None:
    config = Path(__file__).parents[2] / "examples" / "short.yaml"
    out = tmp_path / "trial"
    written, *_, end = lines(run("simulate", config, "--out", out, "--json").out)
    assert written["event"] == "written"
    assert "trial.yaml" in written["files"]
    assert end["exit_code"] == 0


def test_help_and_version_are_texts(run: Run) -> None:
    for args in (("--version",), ("solve", "--help")):
        text, end = lines(run(*args, "--json").out)
        assert text["event"] == "text"
        assert text["text"]
        assert end["exit_code"] == 0


def test_the_terms_of_instruments_are_a_result(tmp_path: Path, run: Run) -> None:
    file = tmp_path / "calibration.json"
    file.write_bytes(encode_calibration(replace(calibration(), limits={})))
    found, end = lines(run("instrument", file, "--json").out)
    assert found["event"] == "result"
    assert found["content"]["enter_in_dvl"]["lever_arm_down_m"] == -3.0
    assert set(found["content"]["trdi"]) == {"EA", "EI", "EJ"}
    assert end["exit_code"] == 0


def test_the_next_command_prints_text_again(tmp_path: Path, run: Run) -> None:
    save_solution(build_solution(), tmp_path / "s")
    assert kinds(run("export", tmp_path / "s", "--to", "tum", "--json").out) == ["written", "end"]
    assert run("export", tmp_path / "s", "--to", "tum").out.startswith("Wrote ")
