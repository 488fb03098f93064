"""The commands `solve` and `kalman`: a trial becomes a solution."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from factorgraph_dvl.cli.console import (
    ProgressLine,
    print_table,
    print_written,
    stderr,
    stdout,
    warn,
)
from factorgraph_dvl.cli.options import Force, NoFigures, Quiet, Rate, SolutionPath, TrialPath

if TYPE_CHECKING:
    from collections.abc import Callable

    from factorgraph_dvl.kalman import History
    from factorgraph_dvl.solution import Solution
    from factorgraph_dvl.trial import Trial


class KalmanMethod(StrEnum):
    """What `kalman` calibrates by which method: a DVL, or with `star` the gyros."""

    POINT_SET = "point-set"
    NINE_STATE = "nine-state"
    WAHBA = "wahba"
    LEAST_SQUARES = "least-squares"
    STAR = "star"
    BEAMS = "beams"


def solve(
    trial_path: TrialPath,
    out: SolutionPath,
    force: Force = False,
    no_figures: NoFigures = False,
    rate: Rate = 10.0,
    quiet: Quiet = False,
) -> None:
    """Estimate calibration and trajectory from all data of a trial."""

    def run(trial: Trial, progress: ProgressLine) -> tuple[Solution, None]:
        # The solver takes longest to load: after what is most often wrong.
        from factorgraph_dvl.solvers.batch import solve as run_batch

        return run_batch(trial, rate_hz=rate, progress=progress), None

    _solve_into(out, trial_path, run, force=force, figures=not no_figures, quiet=quiet)


def kalman(
    trial_path: TrialPath,
    out: SolutionPath,
    method: Annotated[
        KalmanMethod, typer.Option(help="How the DVL, or with star the gyros, are calibrated.")
    ] = KalmanMethod.POINT_SET,
    force: Force = False,
    no_figures: NoFigures = False,
    rate: Rate = 10.0,
    quiet: Quiet = False,
) -> None:
    """Calibrate by a Kalman filter, to compare with `solve`."""

    def run(trial: Trial, progress: ProgressLine) -> tuple[Solution, History | None]:
        from factorgraph_dvl.kalman import calibrate

        return calibrate(trial, method.value, rate_hz=rate, progress=progress)

    _solve_into(out, trial_path, run, force=force, figures=not no_figures, quiet=quiet)


def _solve_into(
    out: Path,
    trial_path: Path,
    run: Callable[[Trial, ProgressLine], tuple[Solution, History | None]],
    *,
    force: bool,
    figures: bool,
    quiet: bool,
) -> None:
    """Load a trial, run a solver on it, write and show its solution."""
    from factorgraph_dvl.io.folders import check_output
    from factorgraph_dvl.io.solution_folder import (
        FIGURES_FOLDER,
        save_solution,
        write_history,
    )
    from factorgraph_dvl.io.trial_folder import load_trial

    check_output(out, force=force)
    with ProgressLine(quiet=quiet) as progress:
        trial = load_trial(trial_path)
        solution, history = run(trial, progress)
        progress("write", 0, None)

        def add(folder: Path) -> None:
            write_beams(trial, solution, folder)
            if history is not None:
                write_history(folder, history.time, history.names, history.values, history.std)
            write_instrument(solution, folder)
            if not figures:
                return
            from factorgraph_dvl.report.figures import write_figures

            try:
                write_figures(trial, solution, folder / FIGURES_FOLDER)
            except Exception as error:
                # A figure is not worth the solution.
                warn(f"figures could not be drawn: {type(error).__name__}: {error}")

        save_solution(solution, out, force=force, extra=add)
    _print_solution(trial, solution)
    print_written(out)
    if not solution.converged:
        stderr().print(
            Text(f"error: not converged after {solution.iterations} iterations", "red"),
            soft_wrap=True,
        )
        raise typer.Exit(1)


def write_beams(trial: Trial, solution: Solution, folder: Path) -> None:
    """Write how the beams agree, if the trial has some and the solution calibrates them."""
    from factorgraph_dvl.analysis.beam_quality import beam_quality, calibrates, calibration_of
    from factorgraph_dvl.io.solution_folder import BEAMS_FILE
    from factorgraph_dvl.io.tables import write_table

    if trial.beams is not None and calibrates(solution, trial.beams):
        quality = beam_quality(trial.beams, calibration_of(trial.beams, solution))
        write_table(folder / BEAMS_FILE, quality.columns())


def write_instrument(solution: Solution, folder: Path) -> None:
    """Write the calibration as instruments take it, if there is one of a DVL."""
    from factorgraph_dvl.analysis.instrument import NEEDED, instrument_of
    from factorgraph_dvl.io.solution_folder import INSTRUMENT_FILE
    from factorgraph_dvl.report.instrument_text import instrument_text

    if solution.converged and set(NEEDED) <= {e.name for e in solution.estimates}:
        text = instrument_text(instrument_of(solution), solution.trial)
        (folder / INSTRUMENT_FILE).write_text(text, encoding="utf-8")


def _print_solution(trial: Trial, solution: Solution) -> None:
    from factorgraph_dvl.analysis.consistency import calibration_errors
    from factorgraph_dvl.report.tables import calibration_table

    truth = trial.calibration_truth
    errors = calibration_errors(solution, truth) if truth else None
    print_table(calibration_table(solution, errors, width=stdout().width))
    for warning in solution.warnings:
        warn(warning)
