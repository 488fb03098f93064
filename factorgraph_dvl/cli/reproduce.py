"""The command `reproduce`: a publication's equations, tables, figures and claims, measured."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from factorgraph_dvl.cli.console import ProgressLine, print_written, stdout
from factorgraph_dvl.cli.options import FigureKind, Figures, Force, Quiet, claim_output


class PaperName(StrEnum):
    """The publications, by the names of their methods."""

    LUO_2024 = "luo-2024"
    LIU_2020 = "liu-2020"
    NINE_STATE = "nine-state"
    BEAMS = "beams"
    CHEN_2021 = "chen-2021"


def reproduce(
    paper: Annotated[PaperName, typer.Argument(metavar="PAPER", help=", ".join(PaperName))],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
    figure: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="This figure alone.")
    ] = None,
    table: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="This table alone.")
    ] = None,
    seeds: Annotated[
        int, typer.Option(metavar="N", min=1, max=1000, help="Number of simulated trials.")
    ] = 5,
    figures: Figures = FigureKind.PNG,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Measure what a publication states: each equation, table, figure and claim.

    Examples:
      factorgraph-dvl reproduce luo-2024 --out paper --table 3
    """
    from factorgraph_dvl.errors import ConfigError
    from factorgraph_dvl.files.folders import new_folder
    from factorgraph_dvl.report.figure_files import figure_files
    from factorgraph_dvl.reproduce import PAPERS
    from factorgraph_dvl.reproduce.page import selected, write_page

    found = PAPERS[paper.value]
    entries = selected(found, figure=figure, table=table)
    if not entries:
        labels = [e.label for e in found.entries if e.label.startswith(("figure", "table"))]
        raise ConfigError(
            f"{paper.value} has no such figure or table", expected=", ".join(labels) or "neither"
        )
    owned = (f"{paper.value}.md", *figure_files("figure-*", "table-*", "claim-*"))
    claim_output(out, force=force, owned=owned, inputs=())
    results = []
    with ProgressLine(quiet=quiet) as progress:
        for i, entry in enumerate(entries):
            progress(entry.label, done=i / len(entries))
            results.append((entry, entry.check(seeds)))
    with new_folder(out, force=force, owned=owned) as folder:
        write_page(found, results, seeds, folder, kind=figures.value)
    for entry, result in results:
        text = f"{entry.label}: {result.measured}: {result.verdict}"
        stdout().print(text, markup=False, soft_wrap=True)
    print_written(out)
