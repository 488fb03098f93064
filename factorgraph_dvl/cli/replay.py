"""The command `replay`: a trial fed in the order of time."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from factorgraph_dvl.cli import events
from factorgraph_dvl.cli.console import (
    ProgressLine,
    drawing,
    print_table,
    print_written,
    stderr,
    stdout,
)
from factorgraph_dvl.cli.options import (
    Anyway,
    FigureKind,
    Figures,
    Force,
    NoFigures,
    Quiet,
    SolutionPath,
    TrialPath,
    claim_output,
)
from factorgraph_dvl.cli.report import write_report
from factorgraph_dvl.cli.verdict import end_with, print_findings, print_verdict
from factorgraph_dvl.errors import ConfigError

if TYPE_CHECKING:
    from factorgraph_dvl.analysis.convergence import Convergence
    from factorgraph_dvl.replay import ReplayRecord
    from factorgraph_dvl.solution import Solution
    from factorgraph_dvl.trial import Trial


class SmootherKind(StrEnum):
    """How far back states are corrected."""

    FIXED_LAG = "fixed-lag"
    ISAM2 = "isam2"


def replay(
    trial_path: TrialPath,
    out: SolutionPath,
    smoother: Annotated[
        SmootherKind,
        typer.Option(help="fixed-lag marginalises states after the lag; isam2 keeps all."),
    ] = SmootherKind.FIXED_LAG,
    lag: Annotated[
        float, typer.Option(metavar="S", min=1.0, max=1e4, help="Lag of the smoother, s.")
    ] = 30.0,
    rate: Annotated[
        float, typer.Option(metavar="HZ", min=0.1, max=50.0, help="Rate of states and updates.")
    ] = 5.0,
    live: Annotated[
        bool, typer.Option("--live", help="Show the current calibration while it runs.")
    ] = False,
    good_std: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Largest σ of a parameter that is good enough."),
    ] = None,
    good_error: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE", help="Largest error of a parameter that is good enough."
        ),
    ] = None,
    force: Force = False,
    no_figures: NoFigures = False,
    figures: Figures = FigureKind.PNG,
    anyway: Anyway = False,
    quiet: Quiet = False,
) -> None:
    """Feed a trial in the order of time, and show what was known when.

    Examples:
      factorgraph-dvl replay data/seed-a-phase-90 --out out --live
    """
    from factorgraph_dvl.analysis.convergence import check_limits, convergence
    from factorgraph_dvl.files.solution_folder import OWNED
    from factorgraph_dvl.files.trial_folder import inputs_of, load_trial

    std_asked = _limits("--good-std", good_std)
    error_asked = _limits("--good-error", good_error)
    claim_output(out, force=force, owned=OWNED, inputs=inputs_of(trial_path))
    live = live and stderr().is_terminal and not events.active()
    with ProgressLine(quiet=quiet or live) as progress:
        trial = load_trial(trial_path, anyway=anyway)
        check_limits(trial, (*std_asked, *error_asked))
        trial = replace(trial, limits={**trial.limits, **std_asked})
        # Two standard deviations hold 95 % of the errors.
        error_limits = {name: 2.0 * std for name, std in trial.limits.items()} | error_asked
        solution, record = _run(trial, smoother.value, lag, rate, anyway, progress, live=live)
        found = convergence(
            record.time,
            record.values,
            record.std,
            record.inconsistent,
            solution.estimates,
            trial.calibration_truth,
            trial.limits,
            error_limits,
        )
        progress("write", 0, None)
        _write(
            trial,
            solution,
            record,
            found,
            out,
            force=force,
            figures=None if no_figures else figures,
        )
    _print(trial, solution, record, found)
    print_written(out)
    end_with(solution.verdict)


def _limits(option: str, pairs: list[str] | None) -> dict[str, float]:
    """Return NAME=VALUE pairs as numbers by name."""
    out = {}
    for pair in pairs or []:
        name, _, text = pair.partition("=")
        try:
            value = float(text)
        except ValueError:
            value = -1.0
        if not value > 0.0:
            raise ConfigError(
                f"{option} is {pair!r}", expected="NAME=VALUE, such as misalignment_deg=0.05"
            )
        out[name] = value
    return out


def _run(
    trial: Trial,
    smoother: str,
    lag: float,
    rate: float,
    anyway: bool,
    progress: ProgressLine,
    *,
    live: bool,
) -> tuple[Solution, ReplayRecord]:
    """Run the replay; if live, show what is known and whether it is good enough as it goes."""
    from factorgraph_dvl.replay import KINDS, Update
    from factorgraph_dvl.replay import replay as run
    from factorgraph_dvl.replay.playback import VerdictAsItGoes

    kind = next(k for k in KINDS if k == smoother)
    began = perf_counter()
    shown = began
    first, last = (float(t) for t in trial.body_sensor.time[[0, -1]])
    verdict = VerdictAsItGoes(trial)

    def speed(update: Update) -> float:
        return (update.time - first) / max(perf_counter() - began, 1e-9)

    if live:
        from rich.live import Live

        from factorgraph_dvl.analysis.convergence import short_of_limits
        from factorgraph_dvl.report.terminal.live import live_view

        since: float | None = None
        waiting = Text(f"{trial.name}: collecting the first data")

        # The display costs more than an update.
        with Live(waiting, console=stderr(), refresh_per_second=8, transient=True) as view:

            def show(update: Update) -> None:
                nonlocal shown, since
                verdict.take(update)
                bad = short_of_limits(update.calibration.estimates, trial.limits)
                if bad or update.inconsistent:
                    since = None
                elif since is None:
                    since = update.time - first
                now = perf_counter()
                if now - shown > 0.1:
                    shown = now
                    view.update(
                        live_view(
                            trial.name,
                            update.time - first,
                            update.calibration.estimates,
                            update.state,
                            latency=update.latency,
                            speed=speed(update),
                            inconsistent=update.inconsistent,
                            short_of_limits=bad,
                            good_since=since,
                            verdict=verdict.at(update),
                        )
                    )
                for finding in update.findings:
                    view.console.print(
                        f"{update.time:.1f} s: {finding}", markup=False, soft_wrap=True
                    )

            return run(trial, smoother=kind, lag_s=lag, rate_hz=rate, anyway=anyway, watch=show)

    def print_update(update: Update) -> None:
        nonlocal shown
        verdict.take(update)
        now = perf_counter()
        if now - shown > 2.0:
            shown = now
            grade = verdict.at(update).grade
            at = f"{update.time - first:.0f} s"
            done = (update.time - first) / max(last - first, 1e-9)
            progress(f"at {at}, {speed(update):.0f} times real time, {grade}", done=done)

    return run(trial, smoother=kind, lag_s=lag, rate_hz=rate, anyway=anyway, watch=print_update)


def _write(
    trial: Trial,
    solution: Solution,
    record: ReplayRecord,
    found: Convergence,
    out: Path,
    *,
    force: bool,
    figures: FigureKind | None,
) -> None:
    from factorgraph_dvl.cli.solve import write_beams, write_instrument
    from factorgraph_dvl.files.run_file import run_of
    from factorgraph_dvl.files.solution_folder import (
        CONVERGENCE_FILE,
        FIGURES_FOLDER,
        save_solution,
        write_history,
        write_latency,
    )
    from factorgraph_dvl.report.files.convergence import to_csv

    def add(folder: Path) -> None:
        write_beams(trial, solution, folder)
        write_instrument(solution, folder)
        write_history(folder, record.time, record.names, record.std, record.values, record.latency)
        write_latency(folder, record.time, record.latency, record.solved)
        (folder / CONVERGENCE_FILE).write_text(to_csv(found), encoding="utf-8")
        series = (record.time, tuple(record.names), record.std)
        write_report(folder, str(out), solution, run_of(trial), series)
        if figures is None:
            return
        from factorgraph_dvl.report.figures.convergence import write_convergence_figures
        from factorgraph_dvl.report.figures.solution import write_figures

        with drawing():
            write_figures(trial, solution, folder / FIGURES_FOLDER, kind=figures.value)
            write_convergence_figures(
                record.time,
                record.values,
                record.std,
                record.latency,
                solution.estimates,
                trial.calibration_truth,
                found,
                folder / FIGURES_FOLDER,
                solution.verdict,
                name=solution.trial,
                kind=figures.value,
            )

    save_solution(solution, out, force=force, extra=add, smoothed=record.smoothed)


def _print(trial: Trial, solution: Solution, record: ReplayRecord, found: Convergence) -> None:
    import numpy as np

    from factorgraph_dvl.analysis.error_statistics import calibration_errors
    from factorgraph_dvl.report.tables import (
        calibration_table,
        convergence_table,
        good_enough_line,
        known_errors,
    )

    print_verdict(solution.verdict)
    console = stdout()
    truth = trial.calibration_truth
    errors = calibration_errors(solution, truth) if truth else None
    print_table(calibration_table(solution, known_errors(errors)))
    start = float(trial.body_sensor.time[0])
    print_table(convergence_table(found, start))
    plain = 1e3 * record.latency[~record.solved]
    if plain.size:
        median, tail = np.percentile(plain, [50.0, 99.0])
        console.print(
            f"{plain.size} updates: latency {median:.1f} ms (median), {tail:.1f} ms (99 %); "
            f"{int(record.solved.sum())} with a solution of all collected data, the longest "
            f"{record.latency.max():.1f} s; estimates are {record.delay:.2f} s behind the records",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
    console.print(good_enough_line(found, start), markup=False, highlight=False)
    print_findings(solution)
