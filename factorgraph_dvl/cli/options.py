"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

TrialPath = Annotated[
    Path, typer.Argument(metavar="TRIAL", help="Trial folder, or the trial.yaml in it.")
]
SolutionPath = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Solution folder to write.")
]
Force = Annotated[bool, typer.Option("--force", help="Replace existing results.")]
NoFigures = Annotated[bool, typer.Option("--no-figures", help="Do not draw figures.")]


class Target(StrEnum):
    """Vehicles and instruments that a calibration can be written for."""

    URDF = "urdf"
    TF = "tf"
    ARDUPILOT = "ardupilot"
    WATER_LINKED = "water-linked"
    NUCLEUS = "nucleus"


class FigureKind(StrEnum):
    """Formats of figures."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"


Figures = Annotated[
    FigureKind, typer.Option("--figures", help="Draw figures in this format too, beside PNG.")
]
Rate = Annotated[
    float, typer.Option(metavar="HZ", min=1e-3, max=1e4, help="Rate of the trajectory.")
]
Anyway = Annotated[
    bool, typer.Option("--anyway", help="Use records and calibrations that would be refused.")
]
Details = Annotated[
    bool,
    typer.Option("--details", help="Also print all parameters and the error budget."),
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Do not show progress.")]

# Output folders of the running command; released when it ends.
claims = ExitStack()


def claim_output(
    out: Path, *, force: bool, owned: Sequence[str], inputs: Iterable[Path | None]
) -> None:
    """Reserve the output folder until the command ends.

    The parameters are those of `claim`.
    """
    from factorgraph_dvl.files.folders import claim

    given = [path for path in inputs if path is not None]
    claims.enter_context(claim(out, force=force, owned=owned, inputs=given))
