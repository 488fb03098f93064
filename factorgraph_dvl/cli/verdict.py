"""The verdict on a result: its line, its reasons, the exit code."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer
from rich.text import Text

from factorgraph_dvl.cli import events
from factorgraph_dvl.cli.console import found_event, say, stderr, stdout
from factorgraph_dvl.cli.exit_codes import NO_RESULT
from factorgraph_dvl.errors import printable

if TYPE_CHECKING:
    from factorgraph_dvl.quality.verdict import Verdict
    from factorgraph_dvl.solution import Solution


def print_verdict(solution: Solution) -> None:
    """Print the verdict on one line, with its first reason and what to do about it."""
    from factorgraph_dvl.report.tables import verdict_line

    verdict = solution.verdict
    if events.active():
        events.emit(events.Judged(verdict.grade, list(map(found_event, verdict.reasons))))
        return

    stdout().print(verdict_line(verdict), soft_wrap=True)


def print_findings(solution: Solution) -> None:
    """Print the reasons of the verdict, then notes that tables do not show."""
    from factorgraph_dvl.quality.finding import Code

    for reason in solution.verdict.reasons:
        say(reason)
    for note in solution.findings:
        # A parameter that no limit is for is grey in the table, and nobody's trouble.
        aside = note.code == Code.NOT_OBSERVABLE and note.parameter not in solution.limits
        if note.severity == "note" and not aside:
            say(note)


def end_with(verdict: Verdict) -> None:
    """End the command with `NO_RESULT` if a result is not to be used."""
    if verdict.grade == "do not use":
        text = printable(f"error: not to be used: {verdict.reasons[0]}")
        if events.active():
            raise typer.Exit(NO_RESULT)
        stderr().print(Text(text, "red"), soft_wrap=True)
        raise typer.Exit(NO_RESULT)
