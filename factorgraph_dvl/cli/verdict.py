"""The verdict on a result: its line, its reasons, the exit code."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import typer
from rich.text import Text

from factorgraph_dvl.cli import events
from factorgraph_dvl.cli.console import found_event, print_table, say, stderr, stdout
from factorgraph_dvl.cli.exit_codes import NO_RESULT
from factorgraph_dvl.errors import printable

if TYPE_CHECKING:
    from pathlib import Path

    from factorgraph_dvl.quality.verdict import Verdict
    from factorgraph_dvl.report.table import Table
    from factorgraph_dvl.solution import Solution


def print_verdict(verdict: Verdict) -> None:
    """Print the verdict on one line, with its first reason and what to do about it."""
    from factorgraph_dvl.report.tables import verdict_line

    if events.active():
        events.emit(events.Judged(verdict.grade, list(map(found_event, verdict.reasons))))
        return

    stdout().print(verdict_line(verdict), soft_wrap=True)


# Reasons of a verdict that are printed at the end. Chosen: with the longest table, all that is
# printed fits on a screen of 30 lines.
_REASONS = 3


def print_conclusion(solution: Solution, maker: str, page: Path) -> None:
    """Print what matters, last: verdict, its reasons, the values to enter, the page.

    Parameters
    ----------
    solution : Solution
        What was found.
    maker : str
        Maker of the DVL, empty if not known.
    page : Path
        Page of the result.
    """
    from factorgraph_dvl.analysis.instrument_terms import (
        has_instrument_terms,
        instrument_of,
        transceiver_of,
    )
    from factorgraph_dvl.analysis.mount import mount_in_words
    from factorgraph_dvl.quality.notation import sentence
    from factorgraph_dvl.quality.texts import text_of
    from factorgraph_dvl.report.entries import (
        MOUNT,
        entries_table,
        sum_with_compass,
        usbl_table,
    )

    print_verdict(solution.verdict)
    is_usable = solution.verdict.grade != "do not use" and has_instrument_terms(solution)
    both = sum_with_compass(solution.findings) if is_usable else None
    if not events.active():
        said = {reason.code for reason in solution.verdict.reasons[:1]}
        for reason in solution.verdict.reasons[1:_REASONS]:
            action = "" if reason.code in said else f" {reason.code.action}"
            said.add(reason.code)
            line = f"{reason.severity}: {sentence(printable(str(reason)))}{action}"
            stdout().print(line, markup=False, soft_wrap=True)
        if both is not None:
            stdout().print(f"Mount and compass: {both}", markup=False, soft_wrap=True)
    if is_usable:
        terms = instrument_of(solution)
        table = entries_table(terms, maker)
        words = " ".join(map(text_of, mount_in_words(terms.axes)))
        print_entries(replace(table, caption=f"{MOUNT} {words} {table.caption}"))
        if (transceiver := transceiver_of(solution)) is not None:
            print_entries(usbl_table(transceiver))
    if not events.active():
        stdout().print(f"Open {page}", markup=False, soft_wrap=True)


def print_entries(table: Table) -> None:
    """Print the values to enter, then how they are defined, on one line however long it is."""
    print_table(replace(table, caption=""))
    if not events.active():
        stdout().print(table.caption, markup=False, highlight=False, soft_wrap=True)


def print_findings(solution: Solution) -> None:
    """Print the reasons of the verdict, then notes that tables do not show."""
    for reason in solution.verdict.reasons:
        say(reason)
    print_notes(solution)


def print_notes(solution: Solution) -> None:
    """Print notes that tables do not show."""
    from factorgraph_dvl.quality.finding import Code

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
