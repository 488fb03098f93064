"""The command `observability`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from factorgraph_dvl.cli.console import (
    ProgressLine,
    drawing,
    print_table,
    print_written,
    stdout,
    warn,
)
from factorgraph_dvl.cli.options import (
    Anyway,
    FigureKind,
    Figures,
    Force,
    NoFigures,
    Quiet,
    claim_output,
)
from factorgraph_dvl.cli.verdict import end_with

if TYPE_CHECKING:
    from factorgraph_dvl.analysis.information.observability import Observability
    from factorgraph_dvl.quality.verdict import Verdict
    from factorgraph_dvl.solution import Solution


def observability(
    source: Annotated[
        Path,
        typer.Argument(metavar="TRIAL|SOLUTION", help="Trial folder, or solution folder."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
    segments: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Segments, a YAML file; by default found from the motion."
        ),
    ] = None,
    force: Force = False,
    no_figures: NoFigures = False,
    figures: Figures = FigureKind.PNG,
    anyway: Anyway = False,
    quiet: Quiet = False,
) -> None:
    """Show which parameters the data determine, and which motion contributes to them.

    Examples:
      factorgraph-dvl observability data/seed-a-phase-90 --out observability
    """
    from factorgraph_dvl.errors import as_text
    from factorgraph_dvl.files.folders import new_folder
    from factorgraph_dvl.files.segments_file import read_segments
    from factorgraph_dvl.files.trial_folder import inputs_of
    from factorgraph_dvl.report.files.observability import OWNED

    claim_output(out, force=force, owned=OWNED, inputs=(*inputs_of(source), segments))
    given = () if segments is None else read_segments(segments)
    with ProgressLine(quiet=quiet) as progress:
        solution, view = _view(source, given, anyway, progress)
        progress("write", 0, None)
        with new_folder(out, force=force, owned=OWNED) as folder:
            kind = None if no_figures else figures.value
            write_observability(view, folder, as_text(source), solution.verdict, figures=kind)
    print_observability(view)
    print_written(out)
    end_with(solution.verdict)


def _view(
    source: Path,
    given: tuple[tuple[float, float, str], ...],
    anyway: bool,
    progress: ProgressLine,
) -> tuple[Solution, Observability]:
    """Return a solution, that of a trial or that in a folder, and its observability."""
    from factorgraph_dvl.analysis.information.observability import observability as look
    from factorgraph_dvl.files.calibration_file import CALIBRATION_FILE
    from factorgraph_dvl.files.folders import SETTINGS_FILE
    from factorgraph_dvl.files.solution_folder import load_solution
    from factorgraph_dvl.files.trial_folder import load_trial

    if os.path.lexists(source / CALIBRATION_FILE) and not (source / SETTINGS_FILE).exists():
        solution = load_solution(source)
        return solution, look(solution, given=given)
    trial = load_trial(source, anyway=anyway)
    # The solver is slow to import: do so after the checks of the input.
    from factorgraph_dvl.solvers.information_along_trial import solve_with_history

    solution, history = solve_with_history(trial, anyway=anyway, progress=progress)
    return solution, look(solution, trial=trial, history=history, given=given)


def write_observability(
    view: Observability, folder: Path, source: str, verdict: Verdict, *, figures: str | None
) -> None:
    """Write JSON, tables and, in a format, figures to a folder."""
    from factorgraph_dvl.files.tables import write_table
    from factorgraph_dvl.report.files.observability import history_columns, to_csv, to_json

    (folder / "observability.csv").write_text(to_csv(view), encoding="utf-8")
    if view.history is not None:
        write_table(folder / "history.csv", history_columns(view.history))
    if figures is not None:
        _draw(view, folder, verdict, figures)
    (folder / "observability.json").write_bytes(to_json(view, source))


def _draw(view: Observability, folder: Path, verdict: Verdict, kind: str) -> None:
    from factorgraph_dvl.report.figures.observability import write_observability_figures

    with drawing():
        write_observability_figures(view, folder, verdict, kind=kind)


def print_observability(view: Observability) -> None:
    """Print segments, marginals and weak directions."""
    from factorgraph_dvl.report.observability_tables import (
        direction_lines,
        marginal_table,
        segment_table,
    )

    console = stdout()
    if view.segments:
        print_table(segment_table(view), "strongest", "weakest", "rms rate deg/s", "up to its end")
    if view.point_set is not None:
        console.print(f"Singular values: {view.point_set.scaling}.", markup=False, soft_wrap=True)
    if view.marginals is not None:
        print_table(marginal_table(view), "information from", "observable", "before the trial")
        for line in direction_lines(view.marginals):
            console.print(line, markup=False, highlight=False, soft_wrap=True)
    for warning in view.warnings:
        warn(warning)
    for text in view.missing:
        warn(f"omitted: {text}")
