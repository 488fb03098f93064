from __future__ import annotations

import os
import re
import subprocess
import sys
import webbrowser
from pathlib import Path
from typing import Any

import pytest
import yaml
from builders import build_history, build_solution, build_trial
from running import Run

from factorgraph_dvl.cli.commands import COMMANDS, command
from factorgraph_dvl.files.trial_folder import save_trial

ROOT = Path(__file__).parent.parent.parent


@pytest.mark.parametrize("name", COMMANDS)
def test_every_help_has_an_example(name: str, run: Run) -> None:
    shown = run(name, "--help").out
    assert f"factorgraph-dvl {name}" in shown.partition("Examples:")[2]


def test_every_command_that_draws_offers_other_formats() -> None:
    options = {
        name: {option for p in command(name).params for option in p.opts} for name in COMMANDS
    }
    drawing = {name for name, own in options.items() if "--no-figures" in own}
    assert drawing >= {"solve", "kalman", "replay", "observability", "plan", "crosscheck"}
    for name in (*drawing, "allan", "reproduce"):
        assert "--figures" in options[name], name


def test_the_demo_is_the_shipped_trial_and_opens_its_page(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    solution = build_solution()

    def solve(*_: Any, **__: Any) -> Any:
        return solution, build_history(solution)

    monkeypatch.setattr(
        "factorgraph_dvl.solvers.information_along_trial.solve_with_history", solve
    )
    monkeypatch.setattr(
        "factorgraph_dvl.report.figures.solution.write_figures", lambda *_, **__: []
    )
    monkeypatch.setattr(webbrowser, "open", opened.append)
    asked: list[Any] = []

    def simulate(config: Path, trial: Path, **options: Any) -> None:
        asked.append((config.name, config.read_text(), options["seed"]))
        save_trial(build_trial(), trial)

    monkeypatch.setattr("factorgraph_dvl.cli.simulate.simulate", simulate)
    result = run("demo", "--out", tmp_path / "demo")
    assert result.code == 0, result.err
    page = tmp_path / "demo" / "result" / "report.html"
    assert opened == [page.resolve().as_uri()]
    assert str(page.resolve()) in result.out
    ((name, scenario, seed),) = asked
    shipped = (ROOT / "data" / "README.md").read_text()
    assert f"simulate configs/{name} --out data/seed-a-phase-90 --seed {seed} " in shipped
    assert scenario == (ROOT / "configs" / name).read_text()


def test_the_shell_completes_commands() -> None:
    words = {"_FACTORGRAPH_DVL_COMPLETE": "complete_bash", "COMP_CWORD": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "factorgraph_dvl.cli"],
        env=os.environ | words | {"COMP_WORDS": "factorgraph-dvl cros"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["crosscheck"]


def test_the_citation_names_the_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = (ROOT / "pyproject.toml").read_text()
    (version,) = re.findall(r'^version = "(.*)"', project, re.MULTILINE)
    assert str(citation["version"]) == version
    assert citation["license"] in project
