"""Output of the commands: progress, tables, warnings."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import msgspec
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from factorgraph_dvl.cli import events, interrupts
from factorgraph_dvl.errors import as_text, printable

if TYPE_CHECKING:
    from types import TracebackType

    from factorgraph_dvl.quality.finding import Finding
    from factorgraph_dvl.report.table import Table
    from factorgraph_dvl.solution import Solution

# Chosen: width of tables in a file or a pipe, columns; that of a page or a mail.
_PIPE_WIDTH = 80
# Share of a run that is done when each stage of the batch solver begins. Measured on the shipped
# trial, with figures; where the data contradict the model, `all sensors` takes far longer.
_STAGES = {
    "load": 0.0,
    "survey": 0.26,
    "increments": 0.31,
    "alignment": 0.33,
    "inertial and GNSS": 0.36,
    "mounting": 0.37,
    "all sensors": 0.38,
    "covariance": 0.44,
    "information along the trial": 0.47,
    "write": 0.48,
}
# Share of a stage that is left after an iteration. Chosen: a minimum takes about five.
_STEP = 0.7
# Share of a run from which on a time left is shown. Chosen: before, it jumps.
_LEAST_DONE = 0.1


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
    """One line of stage, iteration, cost, time and time left; none where nothing is drawn over."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._start = perf_counter()
        self._done = 0.0
        self._live = _live_line(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}", markup=False),
            quiet=quiet,
        )
        self._task = self._live.add_task("load", left="")

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

    def __call__(
        self,
        stage: str,
        iteration: int = 0,
        cost: float | None = None,
        *,
        done: float | None = None,
    ) -> None:
        """Show the present stage.

        Parameters
        ----------
        stage : str
            What begins, or goes on.
        iteration : int, optional
            Of the stage.
        cost : float, optional
            Of the iteration.
        done : float, optional
            Share of the run that is done; by default that of the stage, if it is a solver's.
        """
        interrupts.check()
        stage = printable(stage)
        elapsed = perf_counter() - self._start
        left = self._time_left(elapsed, share_done(stage, iteration) if done is None else done)
        if events.active():
            if not self._quiet:
                rounded = None if left is None else round(left, 1)
                events.emit(events.Progress(stage, round(elapsed, 3), iteration, cost, rounded))
            return
        text = stage
        if iteration:
            text += f", iteration {iteration}"
            # The cost of the start values is huge and uninformative.
            if cost is not None:
                text += f", cost {cost:.4g}"
        shown = "" if left is None else f"about {left:.0f} s left"
        self._live.update(self._task, description=text, left=shown)

    def _time_left(self, elapsed: float, done: float | None) -> float | None:
        """Return the time left, s, if enough is done to say; it is a guess at the best."""
        self._done = max(self._done, done or 0.0)
        if self._done < _LEAST_DONE:
            return None
        return elapsed * (1.0 / self._done - 1.0)


def share_done(stage: str, iteration: int) -> float | None:
    """Return the share of a run that is done at a stage of a solver; None if it has none."""
    if stage not in _STAGES:
        return None
    names = list(_STAGES)
    begin = _STAGES[stage]
    after = names.index(stage) + 1
    end = _STAGES[names[after]] if after < len(names) else 1.0
    # Nobody knows how many iterations are left: each takes a part of what is.
    return end - (end - begin) * _STEP**iteration


class CountLine:
    """A bar of runs that have ended, with the time left; none where nothing is drawn over."""

    def __init__(self, total: int, *, quiet: bool) -> None:
        self._quiet, self._done = quiet, 0
        self._start = perf_counter()
        self._live = _live_line(
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.description}", markup=False),
            quiet=quiet,
        )
        self._task = self._live.add_task("", total=total)

    def __enter__(self) -> CountLine:
        self._live.start()
        return self

    def __exit__(self, *ended: object) -> None:
        self._live.stop()

    def __call__(self, text: str) -> None:
        """Count one more, and say which."""
        interrupts.check()
        self._done += 1
        if events.active() and not self._quiet:
            elapsed = perf_counter() - self._start
            events.emit(events.Progress(printable(text), round(elapsed, 3), self._done))
        self._live.update(self._task, advance=1, description=printable(text))


def _live_line(*columns: ProgressColumn, quiet: bool) -> Progress:
    """Return a line that updates on a terminal, and that is nothing elsewhere."""
    console = stderr()
    return Progress(
        *columns,
        console=console,
        transient=True,
        disable=quiet or events.active() or not console.is_terminal,
    )


def print_written(out: Path) -> None:
    """List the files that this run wrote to a folder."""
    from factorgraph_dvl.files.folders import files_written

    written = files_written(out)
    if events.active():
        events.emit(events.Written(as_text(out), list(map(as_text, written))))
        _emit_results(out, written)
        return
    stdout().print(f"Wrote {', '.join(map(str, written))} to {out}", markup=False, soft_wrap=True)


def print_file(file: Path) -> None:
    """Print which file this run wrote."""
    if events.active():
        events.emit(events.Written(as_text(file.parent), [as_text(file.name)]))
        return
    stdout().print(f"Wrote {file}", markup=False, soft_wrap=True)


def print_folder(out: Path, *results: str) -> None:
    """Print where this run wrote files that are too many to list; as events, name its results."""
    if events.active():
        events.emit(events.Written(as_text(out), [*results]))
        _emit_results(out, map(Path, results))
        return
    stdout().print(f"Wrote {out}", markup=False, soft_wrap=True)


def _emit_results(out: Path, written: Iterable[Path]) -> None:
    """Emit the results that lie in a folder as JSON."""
    for name in written:
        if name.suffix == ".json" and name.parent == Path():
            content = msgspec.json.decode((out / name).read_bytes())
            events.emit(events.Result(str(name), content))


def print_table(table: Table, *leave_out: str) -> None:
    """Print a table uncut, and without some columns if there is no room for them.

    Parameters
    ----------
    table : Table
        What to print. Names that are too long continue on the next line.
    *leave_out : str
        Headers of columns that may be left out, the least important first.
    """
    from factorgraph_dvl.report.table import plain
    from factorgraph_dvl.report.terminal.tables import least_width_of, rendered

    if events.active():
        rows = [[_lines(plain(cell)) for cell in row] for row in table.rows]
        header = [_lines(column.header) for column in table.columns]
        events.emit(events.Table(_lines(table.title), header, rows))
        return
    console = stdout()
    shown = rendered(table, console.width, leave_out)
    console.width = max(console.width, least_width_of(shown))
    console.print(shown)


def print_error_budget(solution: Solution) -> None:
    """Print the largest causes of each standard deviation, if they are known."""
    from factorgraph_dvl.report.tables import error_budget_table

    if solution.error_budget:
        print_table(error_budget_table(solution))


def warn(message: str) -> None:
    """Print a warning."""
    if events.active():
        events.emit(events.Warned(printable(message)))
        return
    stderr().print(Text(f"warning: {printable(message)}", "yellow"), soft_wrap=True)


def found_event(finding: Finding) -> events.Found:
    """Return a finding as an event."""
    from factorgraph_dvl.message import encoded

    sensor, parameter, text = map(printable, (finding.sensor, finding.parameter, finding.text))
    code, own = finding.code, finding.message
    said = None
    if not isinstance(own, str):
        values = encoded(own.with_words(printable))["values"]
        said = events.Said(own.key, values)
    return events.Found(str(code), finding.severity, sensor, parameter, text, code.action, said)


def say(finding: Finding) -> None:
    """Print a finding, and what to do about it if there is something."""
    if events.active():
        events.emit(found_event(finding))
        return
    from factorgraph_dvl.report.tables import STYLES

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
    return _Console(emoji=False, width=None if sys.stdout.isatty() else _PIPE_WIDTH)


def stderr() -> Console:
    """Return the console for progress, warnings and errors."""
    # Keep the order where both streams go to one file.
    with suppress(OSError):
        sys.stdout.flush()
    return _Console(emoji=False, stderr=True)
