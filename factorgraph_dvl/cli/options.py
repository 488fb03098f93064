"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
Anyway = Annotated[bool, typer.Option("--anyway", help="Go on where records cannot be used.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Show no progress.")]
