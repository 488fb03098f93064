"""Output of the commands: progress, tables, warnings."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import perf_counter, time
from typing import TYPE_CHECKING, Any

import msgspec
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from factorgraph_dvl.cli import events
from factorgraph_dvl.errors import printable

if TYPE_CHECKING:
    from types import TracebackType

    from rich.table import Table

    from factorgraph_dvl.sensors.finding import Finding
    from factorgraph_dvl.solution import Solution

_STARTED = time()
# Chosen: width of tables in a file or a pipe, columns; wide enough for every table.
_PIPE_WIDTH = 180


class _Console(Console):
    """A console that removes control characters, as from names of files."""

    def print(self, *objects: Any, **options: Any) -> None:
        if events.active() and not self.stderr:
            for x in objects:
                events.emit(events.Text(_lines(str(x))))
            return
        super().print(*(_lines(x) if isinstance(x, str) else x for x in objects), **options)


def _lines(text: str) -> str:
    return "\n".join(map(printable, text.split("\n")))


class ProgressLine:
    """Stage, iteration, cost and time: live on a terminal, otherwise a line for each."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._start = perf_counter()
        self._console = stderr()
        self._live = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
            disable=quiet or events.active() or not self._console.is_terminal,
        )
        self._task = self._live.add_task("load")

    def __enter__(self) -> ProgressLine:
        self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._live.stop()

    def __call__(self, stage: str, iteration: int = 0, cost: float | None = None) -> None:
        """Show the present stage."""
        if events.active():
            elapsed = perf_counter() - self._start
            if not self._quiet:
                events.emit(events.Progress(stage, round(elapsed, 3), iteration, cost))
            return
        text = stage
        if iteration:
            text += f", iteration {iteration}"
            # The cost of the start values is huge and uninformative.
            if cost is not None:
                text += f", cost {cost:.4g}"
        if self._console.is_terminal:
            self._live.update(self._task, description=text)
        elif not self._quiet:
            elapsed = perf_counter() - self._start
            self._console.print(f"{elapsed:7.1f} s  {text}", markup=False, soft_wrap=True)


class CountLine:
    """A bar of runs that have ended, with the time left: live on a terminal, otherwise lines."""

    def __init__(self, total: int, *, quiet: bool) -> None:
        self._quiet, self._total, self._done = quiet, total, 0
        self._start = perf_counter()
        self._console = stderr()
        self._live = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.description}", markup=False),
            console=self._console,
            transient=True,
            disable=quiet or events.active() or not self._console.is_terminal,
        )
        self._task = self._live.add_task("", total=total)

    def __enter__(self) -> CountLine:
        self._live.start()
        return self

    def __exit__(self, *ended: object) -> None:
        self._live.stop()

    def __call__(self, text: str) -> None:
        """Count one more, and say which."""
        self._done += 1
        if events.active():
            elapsed = perf_counter() - self._start
            if not self._quiet:
                events.emit(events.Progress(printable(text), round(elapsed, 3), self._done))
            return
        if self._console.is_terminal:
            self._live.update(self._task, advance=1, description=printable(text))
        elif not self._quiet:
            elapsed = perf_counter() - self._start
            line = f"{elapsed:7.1f} s  {self._done} of {self._total}: {text}"
            self._console.print(line, markup=False, soft_wrap=True)


def print_written(out: Path) -> None:
    """List the files that this run wrote to a folder."""
    # A folder that --force replaced may contain other files.
    new = (p for p in out.rglob("*") if p.is_file() and p.stat().st_mtime >= _STARTED - 1.0)
    written = sorted(path.relative_to(out) for path in new)
    if events.active():
        events.emit(events.Written(str(out), list(map(str, written))))
        _emit_results(out, written)
        return
    stdout().print(f"Wrote {', '.join(map(str, written))} to {out}", markup=False, soft_wrap=True)


def print_file(file: Path) -> None:
    """Print which file this run wrote."""
    if events.active():
        events.emit(events.Written(str(file.parent), [file.name]))
        return
    stdout().print(f"Wrote {file}", markup=False, soft_wrap=True)


def print_folder(out: Path) -> None:
    """Print where this run wrote its results, where the files are too many to list."""
    stdout().print(f"Wrote {out}", markup=False, soft_wrap=True)
    if events.active():
        _emit_results(out, sorted(path.relative_to(out) for path in out.glob("*.json")))


def _emit_results(out: Path, written: Iterable[Path]) -> None:
    """Emit the results that lie in a folder as JSON."""
    for name in written:
        if name.suffix == ".json" and name.parent == Path():
            content = msgspec.json.decode((out / name).read_bytes())
            events.emit(events.Result(str(name), content))


def print_table(table: Table) -> None:
    """Print a table uncut; a terminal wraps one that is too wide."""
    from factorgraph_dvl.report.terminal.tables import width_of

    if events.active():
        cells = [[_plain(cell) for cell in column.cells] for column in table.columns]
        rows = [list(row) for row in zip(*cells, strict=True)]
        header = [_plain(column.header) for column in table.columns]
        events.emit(events.Table(_plain(table.title or ""), header, rows))
        return
    console = stdout()
    console.width = max(console.width, width_of(table))
    console.print(table)


def _plain(cell: Any) -> str:
    return _lines(cell.plain if isinstance(cell, Text) else str(cell))


def print_error_budget(solution: Solution) -> None:
    """Print the largest causes of each standard deviation, if they are known."""
    from factorgraph_dvl.report.terminal.error_budget import error_budget_table

    if solution.error_budget:
        print_table(error_budget_table(solution, width=stdout().width))


def warn(message: str) -> None:
    """Print a warning."""
    if events.active():
        events.emit(events.Warned(printable(message)))
        return
    stderr().print(Text(f"warning: {printable(message)}", "yellow"), soft_wrap=True)


def found_event(finding: Finding) -> events.Found:
    """Return a finding as an event."""
    sensor, parameter, text = map(printable, (finding.sensor, finding.parameter, finding.text))
    code = finding.code
    return events.Found(str(code), finding.severity, sensor, parameter, text, code.action)


def say(finding: Finding) -> None:
    """Print a finding, and what to do about it if there is something."""
    if events.active():
        events.emit(found_event(finding))
        return
    from factorgraph_dvl.report.terminal.tables import STYLES

    line = printable(f"{finding.severity}: {finding}")
    stderr().print(Text(line, STYLES[finding.severity]), soft_wrap=True)
    action = finding.code.action
    if finding.severity != "note":
        stderr().print(f"  {action}", markup=False, highlight=False, soft_wrap=True)


@contextmanager
def drawing() -> Iterator[None]:
    """Turn whatever fails while figures are drawn into a warning: results are worth more."""
    try:
        yield
    except Exception as error:
        warn(f"figures could not be drawn: {type(error).__name__}: {error}")


def stdout() -> Console:
    """Return the console for results."""
    return _Console(width=None if sys.stdout.isatty() else _PIPE_WIDTH)


def stderr() -> Console:
    """Return the console for progress, warnings and errors."""
    # Keep the order where both streams go to one file.
    with suppress(OSError):
        sys.stdout.flush()
    return _Console(stderr=True)
