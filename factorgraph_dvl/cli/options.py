"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import ExitStack
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

# Output folders of the command that runs; `main` gives them up when it ends.
claims = ExitStack()


def claim_output(
    out: Path, *, force: bool, owned: Sequence[str], inputs: Iterable[Path | None]
) -> None:
    """Keep the output folder for this command until it ends; the parameters as of `claim`."""
    from factorgraph_dvl.io.folders import claim

    given = [path for path in inputs if path is not None]
    claims.enter_context(claim(out, force=force, owned=owned, inputs=given))
