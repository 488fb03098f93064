"""The commands `solve` and `kalman`: a trial becomes a solution."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from factorgraph_dvl.cli.console import (
    ProgressLine,
    drawing,
    print_error_budget,
    print_table,
    print_written,
    stdout,
    warn,
)
from factorgraph_dvl.cli.inspect import errors_in
from factorgraph_dvl.cli.options import (
    Anyway,
    Details,
    FigureKind,
    Figures,
    Force,
    NoFigures,
    Quiet,
    Rate,
    SolutionPath,
    TrialPath,
    claim_output,
)
from factorgraph_dvl.cli.report import write_report
from factorgraph_dvl.cli.verdict import end_with, print_conclusion, print_notes

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from factorgraph_dvl.analysis.comparison.halves import Halves
    from factorgraph_dvl.analysis.dead_reckoning.check import Check
    from factorgraph_dvl.baselines import History
    from factorgraph_dvl.baselines.calibration import Method
    from factorgraph_dvl.geometry.vectors import Array
    from factorgraph_dvl.solution import Solution
    from factorgraph_dvl.statistics.information_history import InformationHistory
    from factorgraph_dvl.trial import Trial

# Entries of σ along the trial. Chosen: a plot has no more pixels, and each costs as much as a
# step of the filter behind it.
_ENTRIES = 500


@dataclass(frozen=True)
class _Found:
    """What a run found.

    The solution, how a filter converged, the information along the trial, its halves, and what
    the calibration does to residuals and dead reckoning.
    """

    solution: Solution
    history: History | None = None
    along: InformationHistory | None = None
    halves: Halves | None = None
    check: Check | None = None


class KalmanMethod(StrEnum):
    """Method of `kalman`: for a DVL, for gyros with a star tracker, or for a planar trial."""

    POINT_SET = "point-set"
    LUO_2024 = "luo-2024"
    NINE_STATE = "nine-state"
    NINE_STATE_UKF = "nine-state-ukf"
    WAHBA = "wahba"
    LEAST_SQUARES = "least-squares"
    DIFFERENTIAL_EVOLUTION = "differential-evolution"
    KINSEY_WHITCOMB = "kinsey-whitcomb"
    THREE_POINTS = "three-points"
    JOYCE = "joyce"
    POLLARD_READ = "pollard-read"
    STAR = "star"
    LIU_2020 = "liu-2020"
    BEAMS = "beams"
    TWO_OBSERVATIONS = "4sv-2ob"
    THREE_OBSERVATIONS = "4sv-3ob"


def solve(
    trial_path: TrialPath,
    out: SolutionPath,
    force: Force = False,
    no_figures: NoFigures = False,
    figures: Figures = FigureKind.PNG,
    rate: Rate = 10.0,
    halves: Annotated[
        bool, typer.Option("--halves", help="Also solve each half of the trial, and compare them.")
    ] = False,
    anyway: Anyway = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Without effect: a run starts from the beginning.")
    ] = False,
    details: Details = False,
    quiet: Quiet = False,
) -> None:
    """Estimate calibration and trajectory from all data of a trial.

    Examples:
      factorgraph-dvl solve data/seed-a-phase-90 --out out
    """
    if resume:
        warn(
            "--resume has no effect any more: a run takes only seconds, and starts from the "
            "beginning; leave the option out"
        )

    def run(trial: Trial, progress: ProgressLine) -> _Found:
        from factorgraph_dvl.analysis.comparison.halves import halves_of
        from factorgraph_dvl.solvers.information_along_trial import solve_with_history

        parts = halves_of(trial) if halves else None
        solution, along = solve_with_history(
            trial, rate_hz=rate, entries=_ENTRIES, anyway=anyway, progress=progress
        )
        found = _Found(solution, along=along, check=_checked(trial, solution, along.halfway))
        return found if parts is None else _with_halves(trial, found, parts, progress)

    _solve_into(
        out,
        trial_path,
        run,
        force=force,
        figures=None if no_figures else figures,
        anyway=anyway,
        details=details,
        quiet=quiet,
    )


def kalman(
    trial_path: TrialPath,
    out: SolutionPath,
    method: Annotated[
        KalmanMethod | None,
        typer.Option(
            help="Method: for a DVL (default point-set), for gyros (star), or for a planar trial "
            "(default 4sv-3ob)."
        ),
    ] = None,
    linear: Annotated[
        bool, typer.Option("--linear", help="With nine-state: the linear filter, as published.")
    ] = False,
    force: Force = False,
    no_figures: NoFigures = False,
    figures: Figures = FigureKind.PNG,
    rate: Rate = 10.0,
    anyway: Anyway = False,
    details: Details = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate or navigate with a Kalman filter, for comparison with `solve`.

    Examples:
      factorgraph-dvl kalman data/seed-a-phase-90 --out out-kalman --method nine-state
    """
    if linear and method is not KalmanMethod.NINE_STATE:
        from factorgraph_dvl.errors import ConfigError

        raise ConfigError("--linear belongs to one method", expected="--method nine-state")

    def run(trial: Trial, progress: ProgressLine) -> _Found:
        from factorgraph_dvl.baselines import calibrate
        from factorgraph_dvl.plausibility.survey import explained

        name = "nine-state-linear" if linear else method and method.value
        errors = errors_in(trial, anyway=anyway)
        with explained(errors):
            solution, history = calibrate(
                trial, cast("Method | None", name), rate_hz=rate, progress=progress
            )
        return _Found(solution.with_findings(errors), history)

    _solve_into(
        out,
        trial_path,
        run,
        force=force,
        figures=None if no_figures else figures,
        anyway=anyway,
        details=details,
        quiet=quiet,
    )


def _with_halves(
    trial: Trial, found: _Found, parts: tuple[Trial, Trial], progress: ProgressLine
) -> _Found:
    """Return a solution with the difference of the halves."""
    from factorgraph_dvl.analysis.comparison.halves import compare_halves
    from factorgraph_dvl.errors import FactorgraphDvlError
    from factorgraph_dvl.message import message
    from factorgraph_dvl.quality.finding import Code, Finding
    from factorgraph_dvl.solvers.batch import solve as run_batch

    try:
        first, second = (run_batch(part, anyway=True, progress=progress) for part in parts)
    except FactorgraphDvlError as error:
        text = message("halves_differ.unsolved", error=str(error))
        note = Finding(Code.HALVES_DIFFER, text, severity="note")
        return replace(found, solution=found.solution.with_findings((note,)))
    halves = compare_halves(trial, first, second)
    solution = found.solution.with_findings(halves.findings())
    return replace(found, solution=solution, halves=halves)


def _checked(trial: Trial, solution: Solution, halfway: Mapping[str, Array]) -> Check | None:
    """Return what the calibration does to the DVL's residuals and to dead reckoning.

    The calibration by the data of the first half is used with the data of the second. Where the
    trial gives none to be used, the data are those that the calibration is from.
    """
    from factorgraph_dvl.analysis.comparison.halves import halves_of
    from factorgraph_dvl.analysis.dead_reckoning.check import Data, check_calibration
    from factorgraph_dvl.errors import FactorgraphDvlError
    from factorgraph_dvl.estimates import values_of

    if trial.log is None or trial.position_sensor is None:
        return None
    candidates: list[tuple[Trial, Mapping[str, Array], Data]] = [
        (trial, values_of(solution.estimates), "same data")
    ]
    if halfway and solution.verdict.grade != "do not use":
        with suppress(FactorgraphDvlError):
            candidates.insert(0, (halves_of(trial)[1], halfway, "second half"))
    for part, values, data in candidates:
        with suppress(FactorgraphDvlError):
            return check_calibration(part, solution, values, data)
    return None


def _solve_into(
    out: Path,
    trial_path: Path,
    run: Callable[[Trial, ProgressLine], _Found],
    *,
    force: bool,
    figures: FigureKind | None,
    anyway: bool,
    details: bool,
    quiet: bool,
) -> None:
    """Load a trial, run a solver, write and show its solution."""
    from factorgraph_dvl.files.run_file import run_of
    from factorgraph_dvl.files.solution_folder import (
        CHECK_FILE,
        CHECK_TABLE,
        FIGURES_FOLDER,
        HALVES_FILE,
        OWNED,
        REPORT_FILE,
        save_solution,
        write_history,
    )
    from factorgraph_dvl.files.tables import write_table
    from factorgraph_dvl.files.trial_folder import files_of, inputs_of, load_trial
    from factorgraph_dvl.report.files.check import check_columns, check_json
    from factorgraph_dvl.report.html.content import maker_of

    claim_output(out, force=force, owned=OWNED, inputs=inputs_of(trial_path))
    with ProgressLine(quiet=quiet) as progress:
        trial = load_trial(trial_path, anyway=anyway)
        found = run(trial, progress)
        solution, history, along = found.solution, found.history, found.along
        progress("write", 0, None)

        def add(folder: Path) -> None:
            write_beams(trial, solution, folder)
            if history is not None:
                write_history(folder, history.time, history.names, history.std, history.values)
            if along is not None:
                write_history(folder, along.time, along.names, along.std)
            if found.halves is not None:
                write_table(folder / HALVES_FILE, found.halves.columns())
            if found.check is not None:
                (folder / CHECK_FILE).write_bytes(check_json(found.check))
                write_table(folder / CHECK_TABLE, check_columns(found.check))
            write_instrument(solution, folder)
            shown = history or along
            run = run_of(trial, solution.steps, files_of(trial_path))
            series = None if shown is None else (shown.time, shown.names, shown.std)
            write_report(folder, str(out), solution, run, series)
            if figures is not None:
                with drawing():
                    _draw(trial, solution, history, folder / FIGURES_FOLDER, figures.value)

        save_solution(solution, out, force=force, extra=add)
    _print_solution(trial, found, details=details)
    print_written(out)
    print_conclusion(solution, maker_of(trial.certificate), out / REPORT_FILE)
    end_with(solution.verdict)


def _draw(
    trial: Trial, solution: Solution, history: History | None, folder: Path, kind: str
) -> None:
    """Draw the figures of a solution."""
    from factorgraph_dvl.report.figures.solution import write_figures

    write_figures(trial, solution, folder, kind=kind)
    if history is not None:
        draw_history(trial, solution, history, folder, kind)


def draw_history(
    trial: Trial, solution: Solution, history: History, folder: Path, kind: str
) -> None:
    """Draw how a recursive filter converged."""
    from factorgraph_dvl.report.figures.convergence import convergence_figure
    from factorgraph_dvl.report.figures.drawing import save_figures

    estimates = [e for e in solution.estimates if set(e.component_names) <= set(history.names)]
    figure = convergence_figure(
        history.time, history.values, history.std, estimates, trial.calibration_truth, float("nan")
    )
    drawn = {"convergence": figure}
    save_figures(drawn, folder, solution.verdict, name=solution.trial, kind=kind)


def write_beams(trial: Trial, solution: Solution, folder: Path) -> None:
    """Write consistency and angles of the beams, if the solution calibrates beams."""
    from factorgraph_dvl.analysis.beam_angles import beam_angles
    from factorgraph_dvl.analysis.beam_quality import beam_quality, calibrates, calibration_of
    from factorgraph_dvl.files.solution_folder import BEAM_ANGLES_FILE, BEAMS_FILE
    from factorgraph_dvl.files.tables import write_table

    if trial.beams is not None and calibrates(solution, trial.beams):
        quality = beam_quality(trial.beams, calibration_of(trial.beams, solution))
        write_table(folder / BEAMS_FILE, quality.columns())
    if (angles := beam_angles(solution)) is not None:
        write_table(folder / BEAM_ANGLES_FILE, angles.columns())


def write_instrument(solution: Solution, folder: Path) -> None:
    """Write the calibration of a DVL in the terms of instruments, if it can be used."""
    from factorgraph_dvl.analysis.instrument_terms import has_instrument_terms
    from factorgraph_dvl.files.solution_folder import INSTRUMENT_FILE
    from factorgraph_dvl.report.files.instrument import instrument_text

    if solution.verdict.grade != "do not use" and has_instrument_terms(solution):
        (folder / INSTRUMENT_FILE).write_text(instrument_text(solution), encoding="utf-8")


def _print_solution(trial: Trial, found: _Found, *, details: bool) -> None:
    """Print what the conclusion does not show; all parameters and causes with `details`."""
    from factorgraph_dvl.analysis.error_statistics import calibration_errors, paper_accuracy
    from factorgraph_dvl.report.tables import (
        calibration_table,
        halves_table,
        hypothesis_table,
        known_errors,
        rejected_line,
    )

    solution = found.solution
    truth = trial.calibration_truth
    if solution.estimates:
        shown = solution if details else _main(solution)
        errors = calibration_errors(solution, truth) if truth else None
        if shown.estimates:
            print_table(calibration_table(shown, known_errors(errors)))
        if details:
            print_error_budget(solution)
        accuracy = paper_accuracy(solution.estimates, truth)
        if isfinite(accuracy):
            text = (
                "Accuracy, mean of 1 − |error / truth| of what the method estimates of "
                "misalignment, scale and lever arm: "
            )
            stdout().print(f"{text}{accuracy:.2f} %", markup=False, soft_wrap=True)
    if found.halves is not None:
        print_table(halves_table(found.halves), "unit", "second")
    if solution.hypotheses:
        print_table(hypothesis_table(solution))
    if solution.rejected:
        stdout().print(rejected_line(solution), markup=False, soft_wrap=True)
    print_notes(solution)


def _main(solution: Solution) -> Solution:
    """Return a solution with the parameters that are printed without being asked for.

    Those of a DVL are among the values to enter, unless it must not be used. Of another
    calibration, they are those that have a limit; all of them, if none has.
    """
    from factorgraph_dvl.analysis.instrument_terms import has_instrument_terms

    if has_instrument_terms(solution):
        return replace(solution, estimates=())
    limited = tuple(e for e in solution.estimates if e.name in solution.limits)
    return replace(solution, estimates=limited or solution.estimates)
