from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import factorgraph_dvl.cli.console as console
from factorgraph_dvl.cli import events
from factorgraph_dvl.cli.console import CountLine, ProgressLine, print_folder, share_done


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> tuple[io.StringIO, dict[str, float]]:
    """What a terminal shows, and a clock that is set by hand."""
    text, clock = io.StringIO(), {"now": 0.0}
    monkeypatch.setattr(
        console, "stderr", lambda: Console(file=text, force_terminal=True, width=100)
    )
    monkeypatch.setattr(console, "perf_counter", lambda: clock["now"])
    return text, clock


def shown(progress: Any, text: io.StringIO) -> str:
    progress._live.refresh()
    return text.getvalue()


def test_a_terminal_shows_stage_cost_and_time_left(
    terminal: tuple[io.StringIO, dict[str, float]],
) -> None:
    text, clock = terminal
    with ProgressLine(quiet=False) as progress:
        progress("load")
        assert "left" not in shown(progress, text)
        clock["now"] = 8.0
        progress("all sensors", 0, 9.87e12)
        # 38 % are done after 8 s.
        assert "about 13 s left" in shown(progress, text)
        clock["now"] = 16.0
        progress("write", 0, 12.51234)
        progress("write", 1, 12.51234)
        assert "write, iteration 1, cost 12.51" in shown(progress, text)
        # The rest of the last stage, but for 30 % of it.
        assert "about 9 s left" in shown(progress, text)
        # A stage of another solver, or an earlier one, does not turn the time back.
        progress("other mountings")
        assert "other mountings" in shown(progress, text)
        progress("half", done=0.5)
        assert "about 9 s left" in shown(progress, text)


def test_a_campaign_shows_what_has_ended_and_the_time_left(
    terminal: tuple[io.StringIO, dict[str, float]],
) -> None:
    text, _ = terminal
    with CountLine(2, quiet=False) as progress:
        progress("monday")
        assert "1/2" in shown(progress, text)
        assert "monday" in shown(progress, text)


@pytest.mark.parametrize("quiet", [False, True])
def test_a_file_or_pipe_has_a_line_a_stage(quiet: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    text = io.StringIO()
    monkeypatch.setattr(console, "stderr", lambda: Console(file=text, force_terminal=False))
    with ProgressLine(quiet=quiet) as progress:
        progress("load")
        progress("all sensors", 1, 10.0)
        progress("all sensors", 2, 5.0)
        progress("write", done=0.5)
    with CountLine(2, quiet=quiet) as count:
        count("monday")
    lines = [line.split(": ")[1] for line in text.getvalue().splitlines()]
    assert lines == ([] if quiet else ["load", "all sensors", "write", "monday"])


def test_a_quiet_terminal_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    text = io.StringIO()
    monkeypatch.setattr(console, "stderr", lambda: Console(file=text, force_terminal=True))
    with ProgressLine(quiet=True) as progress:
        progress("load")
    with CountLine(2, quiet=True) as count:
        count("monday")
    assert text.getvalue() == ""


def test_the_share_that_is_done_only_grows() -> None:
    stages = ["load", "survey", "increments", "alignment", "inertial and GNSS", "mounting"]
    stages += ["all sensors", "covariance", "information along the trial", "write"]
    found = [share_done(stage, iteration) for stage in stages for iteration in (0, 1, 5, 50)]
    assert all(share is not None and 0.0 <= share < 1.0 for share in found)
    assert found == sorted(found, key=lambda share: share or 0.0)
    assert share_done("ranges", 0) is None


def test_results_in_a_folder_are_those_of_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "campaign.json").write_text("{}")
    (tmp_path / "mine.json").write_text("no JSON")
    events.switch(True)
    try:
        print_folder(tmp_path, "campaign.json")
    finally:
        events.switch(False)
    assert capsys.readouterr().out.count("campaign.json") == 2
