"""The command `plan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from factorgraph_dvl.cli.console import (
    ProgressLine,
    print_error_budget,
    print_table,
    print_written,
    stdout,
)
from factorgraph_dvl.cli.inspect import errors_in
from factorgraph_dvl.cli.observability import print_observability, write_observability
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
    from collections.abc import Sequence

    from factorgraph_dvl.planning import Proposal, Requirement


def plan(
    source: Annotated[
        Path, typer.Argument(metavar="PLAN", help="Scenario with requirements, a YAML file.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
    force: Force = False,
    no_figures: NoFigures = False,
    figures: Figures = FigureKind.PNG,
    anyway: Anyway = False,
    quiet: Quiet = False,
) -> None:
    """Predict the σ of a planned trial, and propose manoeuvres if requirements are missed.

    Examples:
      factorgraph-dvl plan configs/plans/harbour.yaml --out plan
    """
    from factorgraph_dvl.analysis.information.observability import observability as look
    from factorgraph_dvl.errors import as_text
    from factorgraph_dvl.files.folders import new_folder
    from factorgraph_dvl.planning import predict, propose, requirements
    from factorgraph_dvl.report.files.plan import OWNED, to_json
    from factorgraph_dvl.simulation import load_scenario, simulate

    claim_output(out, force=force, owned=OWNED, inputs=(source,))
    planned = load_scenario(source)
    name = as_text(source)
    with ProgressLine(quiet=quiet) as progress:
        progress("prediction", 0, None)
        prediction = predict(planned)
        # A record without noise may well repeat one value.
        errors = errors_in(simulate(planned), anyway=anyway)
        solution = prediction.solution.with_findings(errors)
        required = requirements(planned.required, solution.estimates, name)
        view = look(solution, trial=prediction.trial, history=prediction.history, kind="plan")
        proposal = propose(prediction, required, progress=progress)
        progress("write", 0, None)
        with new_folder(out, force=force, owned=OWNED) as folder:
            kind = None if no_figures else figures.value
            write_observability(view, folder, name, solution.verdict, figures=kind)
            (folder / "plan.json").write_bytes(
                to_json(solution, prediction.duration, required, proposal, name)
            )
    print_observability(view)
    print_error_budget(solution)
    _print_requirements(required, proposal)
    print_written(out)
    end_with(solution.verdict)


def _print_requirements(required: Sequence[Requirement], proposal: Proposal | None) -> None:
    from factorgraph_dvl.report.files.plan import proposal_lines, requirement_table

    console = stdout()
    if required:
        print_table(requirement_table(required, proposal), "unit")
    if proposal is not None:
        for line in proposal_lines(proposal):
            console.print(line, markup=False, highlight=False, soft_wrap=True)
    elif required:
        console.print("All requirements are met.", markup=False)
