"""The command `crosscheck`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from factorgraph_dvl.cli.console import drawing, print_table, print_written, stdout, warn
from factorgraph_dvl.cli.options import (
    Anyway,
    FigureKind,
    Figures,
    Force,
    NoFigures,
    claim_output,
)

if TYPE_CHECKING:
    from factorgraph_dvl.analysis.comparison.crosscheck import CrossCheck


class Side(StrEnum):
    """One of the two results of a cross-check."""

    A = "A"
    B = "B"


def crosscheck(
    a: Annotated[
        Path,
        typer.Argument(metavar="A", help="Solution folder, or a file of external results."),
    ],
    b: Annotated[
        Path, typer.Argument(metavar="B", help="Solution folder, or a file of external results.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
    reference: Annotated[
        Path | None,
        typer.Option(metavar="REF", help="True trajectory: trial folder or table."),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="True calibration, JSON or YAML; replaces the truth of the trial."
        ),
    ] = None,
    efficient: Annotated[
        Side | None,
        typer.Option(case_sensitive=False, help="Result that uses all data with a correct model."),
    ] = None,
    force: Force = False,
    anyway: Anyway = False,
    no_figures: NoFigures = False,
    figures: Figures = FigureKind.PNG,
) -> None:
    """Compare two results of one trial with each other and with the truth.

    Examples:
      factorgraph-dvl crosscheck out out-kalman --out out/crosscheck
    """
    from factorgraph_dvl.analysis.comparison.crosscheck import crosscheck as compare
    from factorgraph_dvl.errors import as_text
    from factorgraph_dvl.files.calibration_file import check_verdict
    from factorgraph_dvl.files.external_results import load_results, load_truth
    from factorgraph_dvl.files.folders import new_folder
    from factorgraph_dvl.files.tables import write_table
    from factorgraph_dvl.files.trial_folder import inputs_of
    from factorgraph_dvl.report.files.crosscheck import OWNED, difference_columns, to_csv, to_json

    given = [path for path in (a, b, reference, truth) if path is not None]
    read = [path for source in given for path in inputs_of(source)]
    claim_output(out, force=force, owned=OWNED, inputs=read)
    result_a, result_b = load_results(a, b)
    for path, result in ((a, result_a), (b, result_b)):
        check_verdict(result, str(path), anyway=anyway)
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
            _draw_crosscheck(check, folder, figures.value)
        (folder / "crosscheck.json").write_bytes(
            to_json(check, {"A": as_text(a), "B": as_text(b)})
        )
    _print_crosscheck(check, a, b)
    print_written(out)


def _draw_crosscheck(check: CrossCheck, folder: Path, kind: str) -> None:
    from factorgraph_dvl.report.figures.crosscheck import write_crosscheck_figures

    with drawing():
        write_crosscheck_figures(check, folder, kind=kind)


def _print_crosscheck(check: CrossCheck, a: Path, b: Path) -> None:
    from factorgraph_dvl.report import crosscheck_tables as tables

    console = stdout()
    for side, path, solution in (("A", a, check.a), ("B", b, check.b)):
        solver = f" ({solution.solver})" if solution.solver else ""
        verdict = solution.verdict
        grade = "" if verdict.grade == "good" else f", {verdict}"
        console.print(f"{side}: {path}{solver}{grade}", markup=False, soft_wrap=True)
    if check.components:
        print_table(tables.component_table(check))
    if check.motion is not None:
        print_table(tables.motion_table(check.motion), "at s", "largest in σ", "which σ")
    for table in tables.truth_tables(check):
        print_table(table, "unit", "truth", "largest of A", "largest of B")
    for note in check.notes:
        warn(note)
    console.print(tables.paragraph(check), markup=False, highlight=False)
    if check.explanation:
        console.print("Possible reasons for the differences:", markup=False)
        for sentence in check.explanation:
            console.print(f"- {sentence}", markup=False, highlight=False)
    if check.components:
        console.print(tables.verdict_line(check.components), markup=False, highlight=False)
