"""The command line: parse, load, call, report, exit code."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from time import perf_counter, time
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

from factorgraph_dvl import __version__
from factorgraph_dvl.errors import FactorgraphDvlError

# GTSAM, SciPy, Matplotlib and Arrow take seconds to load: only in the commands that use
# them, so that --help answers at once.
if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from rich.table import Table

    from factorgraph_dvl.analysis.crosscheck import CrossCheck
    from factorgraph_dvl.kalman import History
    from factorgraph_dvl.solution import Solution
    from factorgraph_dvl.trial import Trial

_STARTED = time()
_NAME = "factorgraph-dvl"
# Tables that go to a file or a pipe are not cut to the 80 columns of no terminal.
_PIPE_WIDTH = 180

app = typer.Typer(
    name=_NAME,
    help="Calibrate a Doppler velocity log, jointly with the trajectory of its vehicle.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

TrialPath = Annotated[
    Path, typer.Argument(metavar="TRIAL", help="Trial folder, or the trial.yaml in it.")
]
SolutionPath = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Solution folder to write.")
]
Force = Annotated[bool, typer.Option("--force", help="Replace results that are there.")]
NoFigures = Annotated[bool, typer.Option("--no-figures", help="Draw no figures.")]
Rate = Annotated[
    float, typer.Option(metavar="HZ", min=1e-3, max=1e4, help="Rate of the trajectory.")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Show no progress.")]


class KalmanMethod(StrEnum):
    """How `kalman` holds the DVL against SINS/GNSS."""

    POINT_SET = "point-set"
    NINE_STATE = "nine-state"
    WAHBA = "wahba"
    LEAST_SQUARES = "least-squares"


class Side(StrEnum):
    """One of the two results of a cross-check."""

    A = "A"
    B = "B"


def main(argv: list[str] | None = None) -> NoReturn:
    """Run the command line and exit: 0 done, 1 could not deliver, 2 bad input or usage.

    Parameters
    ----------
    argv : arguments; by default those of the process.
    """
    args = sys.argv[1:] if argv is None else argv
    # All matrices are small: more threads only wait for one another.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    for stream in (sys.stdout, sys.stderr):
        # A terminal that knows no µ shall not fail a run.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    try:
        app(args=[arg for arg in args if arg != "--debug"], prog_name=_NAME)
    except FactorgraphDvlError as error:
        _fail(str(error), error.exit_code, args)
    except KeyboardInterrupt:
        _fail("interrupted", 130, args)
    except OSError as error:
        name = error.filename if error.filename is not None else "a file"
        _fail(f"{name}: {error.strerror or error}", 2, args)
    except Exception as error:
        hint = "" if "--debug" in args else ". Run with --debug to see where"
        _fail(f"internal error: {type(error).__name__}: {error}{hint}", 1, args)
    sys.exit(0)


def _fail(message: str, exit_code: int, args: list[str]) -> NoReturn:
    if "--debug" in args:
        _stderr().print_exception()
    _stderr().print(Text(f"error: {message}", "red"), soft_wrap=True)
    sys.exit(exit_code)


def _show_version(value: bool) -> None:
    if value:
        typer.echo(f"{_NAME} {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", callback=_show_version, is_eager=True
        ),
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error.")
    ] = False,
) -> None:
    pass


@app.command()
def simulate(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Scenario, a YAML file.")],
    out: Annotated[Path, typer.Option("--out", metavar="TRIAL", help="Trial folder to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Of all that is random.")] = 0,
    force: Force = False,
    parquet: Annotated[
        bool, typer.Option("--parquet", help="Write tables as Parquet instead of CSV.")
    ] = False,
) -> None:
    """Simulate a trial with known truth."""
    from factorgraph_dvl.io.folders import check_output
    from factorgraph_dvl.io.trial_folder import save_trial
    from factorgraph_dvl.simulation import simulate as run

    check_output(out, force=force)
    start = perf_counter()
    trial = run(config, seed=seed)
    save_trial(trial, out, force=force, parquet=parquet)
    _stdout().print(
        f"Wrote trial {trial.name} to {out} in {perf_counter() - start:.1f} s",
        markup=False,
        soft_wrap=True,
    )


@app.command()
def solve(
    trial_path: TrialPath,
    out: SolutionPath,
    force: Force = False,
    no_figures: NoFigures = False,
    rate: Rate = 10.0,
    quiet: Quiet = False,
) -> None:
    """Estimate calibration and trajectory from all data of a trial."""

    def run(trial: Trial, progress: _ProgressLine) -> tuple[Solution, None]:
        # The solver takes longest to load: after what is most often wrong.
        from factorgraph_dvl.solvers.batch import solve as run_batch

        return run_batch(trial, rate_hz=rate, progress=progress), None

    _solve_into(out, trial_path, run, force=force, figures=not no_figures, quiet=quiet)


@app.command()
def kalman(
    trial_path: TrialPath,
    out: SolutionPath,
    method: Annotated[
        KalmanMethod, typer.Option(help="How the DVL is held against SINS/GNSS.")
    ] = KalmanMethod.POINT_SET,
    force: Force = False,
    no_figures: NoFigures = False,
    rate: Rate = 10.0,
    quiet: Quiet = False,
) -> None:
    """Calibrate against a SINS/GNSS Kalman filter, to compare with `solve`."""

    def run(trial: Trial, progress: _ProgressLine) -> tuple[Solution, History | None]:
        from factorgraph_dvl.kalman import calibrate

        return calibrate(trial, method.value, rate_hz=rate, progress=progress)

    _solve_into(out, trial_path, run, force=force, figures=not no_figures, quiet=quiet)


def _solve_into(
    out: Path,
    trial_path: Path,
    run: Callable[[Trial, _ProgressLine], tuple[Solution, History | None]],
    *,
    force: bool,
    figures: bool,
    quiet: bool,
) -> None:
    """Load a trial, run a solver on it, write and show its solution."""
    from factorgraph_dvl.io.folders import check_output
    from factorgraph_dvl.io.solution_folder import FIGURES_FOLDER, save_solution, write_history
    from factorgraph_dvl.io.trial_folder import load_trial

    check_output(out, force=force)
    with _ProgressLine(quiet=quiet) as progress:
        trial = load_trial(trial_path)
        solution, history = run(trial, progress)
        progress("write", 0, None)

        def add(folder: Path) -> None:
            if history is not None:
                write_history(folder, history.time, history.names, history.values, history.std)
            if not figures:
                return
            from factorgraph_dvl.report.figures import write_figures

            try:
                write_figures(trial, solution, folder / FIGURES_FOLDER)
            except Exception as error:
                # A figure is not worth the solution.
                _warn(f"figures could not be drawn: {type(error).__name__}: {error}")

        save_solution(solution, out, force=force, extra=add)
    _print_solution(trial, solution)
    _print_written(out)
    if not solution.converged:
        _stderr().print(
            Text(f"error: not converged after {solution.iterations} iterations", "red"),
            soft_wrap=True,
        )
        raise typer.Exit(1)


@app.command()
def inspect(trial_path: TrialPath) -> None:
    """Show what a trial holds, and check its units and signs."""
    from factorgraph_dvl.analysis.survey import survey
    from factorgraph_dvl.io.trial_folder import load_trial
    from factorgraph_dvl.report.tables import finding_lines, motion_line, sensor_table

    trial = load_trial(trial_path)
    result = survey(trial)
    console = _stdout()
    _print_table(sensor_table(result))
    console.print(motion_line(result), markup=False, soft_wrap=True)
    for note in trial.notes:
        _warn(note)
    for line in finding_lines(result):
        console.print(line, soft_wrap=True)


@app.command("crosscheck")
def crosscheck_command(
    a: Annotated[
        Path,
        typer.Argument(metavar="A", help="Solution folder, or results from elsewhere: a file."),
    ],
    b: Annotated[Path, typer.Argument(metavar="B", help="Likewise.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
    reference: Annotated[
        Path | None,
        typer.Option(metavar="REF", help="Trial folder or table: the true trajectory."),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="True calibration, JSON or YAML; before the trial's."),
    ] = None,
    efficient: Annotated[
        Side | None,
        typer.Option(case_sensitive=False, help="Which result uses all data by a true model."),
    ] = None,
    force: Force = False,
    no_figures: NoFigures = False,
) -> None:
    """Hold two results of one trial against each other, and against the truth."""
    from factorgraph_dvl.analysis.crosscheck import crosscheck as compare
    from factorgraph_dvl.io.folders import check_output, new_folder
    from factorgraph_dvl.io.foreign import load_results, load_truth
    from factorgraph_dvl.io.tables import write_table
    from factorgraph_dvl.report.crosscheck_files import OWNED, difference_columns, to_csv, to_json

    check_output(out, force=force)
    result_a, result_b = load_results(a, b)
    true_motion, true_values = load_truth(reference, truth)
    check = compare(
        result_a,
        result_b,
        efficient=None if efficient is None else efficient.value,
        truth=true_values,
        reference=true_motion,
    )
    with new_folder(out, force=force, owned=OWNED) as folder:
        (folder / "crosscheck.csv").write_text(to_csv(check), encoding="utf-8")
        if check.motion is not None:
            write_table(folder / "differences.csv", difference_columns(check.motion))
        if not no_figures:
            _draw_crosscheck(check, folder)
        (folder / "crosscheck.json").write_bytes(to_json(check, {"A": str(a), "B": str(b)}))
    _print_crosscheck(check, a, b)
    _print_written(out)


class _ProgressLine:
    """Stage, iteration, cost and time: live on a terminal, else a line for each."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._start = perf_counter()
        self._console = _stderr()
        self._live = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
            disable=quiet or not self._console.is_terminal,
        )
        self._task = self._live.add_task("load")

    def __enter__(self) -> _ProgressLine:
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
        text = stage
        if iteration:
            text += f", iteration {iteration}"
            # That of the start values is huge, and says nothing.
            if cost is not None:
                text += f", cost {cost:.4g}"
        if self._console.is_terminal:
            self._live.update(self._task, description=text)
        elif not self._quiet:
            elapsed = perf_counter() - self._start
            self._console.print(f"{elapsed:7.1f} s  {text}", markup=False, soft_wrap=True)


def _print_solution(trial: Trial, solution: Solution) -> None:
    from factorgraph_dvl.analysis.consistency import calibration_errors
    from factorgraph_dvl.report.tables import calibration_table

    truth = trial.calibration_truth
    errors = calibration_errors(solution, truth) if truth else None
    _print_table(calibration_table(solution, errors, width=_stdout().width))
    for warning in solution.warnings:
        _warn(warning)


def _draw_crosscheck(check: CrossCheck, folder: Path) -> None:
    from factorgraph_dvl.report.crosscheck_figures import write_crosscheck_figures

    try:
        write_crosscheck_figures(check, folder)
    except Exception as error:
        _warn(f"figures could not be drawn: {type(error).__name__}: {error}")


def _print_crosscheck(check: CrossCheck, a: Path, b: Path) -> None:
    from factorgraph_dvl.report import crosscheck_tables as tables

    console = _stdout()
    for side, path, solution in (("A", a, check.a), ("B", b, check.b)):
        solver = f" ({solution.solver})" if solution.solver else ""
        console.print(f"{side}: {path}{solver}", markup=False, soft_wrap=True)
    if check.components:
        _print_table(tables.component_table(check, width=console.width))
    if check.motion is not None:
        _print_table(tables.motion_table(check.motion))
    for table in tables.truth_tables(check):
        _print_table(table)
    for note in check.notes:
        _warn(note)
    console.print(tables.paragraph(check), markup=False, highlight=False)
    if check.explanation:
        console.print("Where they differ:", markup=False)
        for sentence in check.explanation:
            console.print(f"- {sentence}", markup=False, highlight=False)
    if check.components:
        console.print(tables.verdict_line(check.components), markup=False, highlight=False)


def _print_written(out: Path) -> None:
    # A folder that was replaced by --force may hold files of others.
    new = (p for p in out.rglob("*") if p.is_file() and p.stat().st_mtime >= _STARTED - 1.0)
    written = sorted(path.relative_to(out) for path in new)
    _stdout().print(f"Wrote {', '.join(map(str, written))} to {out}", markup=False, soft_wrap=True)


def _print_table(table: Table) -> None:
    """Print a table whole: one wider than the terminal is wrapped by that, never cut."""
    from factorgraph_dvl.report.tables import width_of

    console = _stdout()
    console.width = max(console.width, width_of(table))
    console.print(table)


def _warn(message: str) -> None:
    _stderr().print(Text(f"warning: {message}", "yellow"), soft_wrap=True)


def _stdout() -> Console:
    return Console(width=None if sys.stdout.isatty() else _PIPE_WIDTH)


def _stderr() -> Console:
    # What was said first comes first, also where both streams end in one file.
    with suppress(OSError):
        sys.stdout.flush()
    return Console(stderr=True)


if __name__ == "__main__":
    main()
