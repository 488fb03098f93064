"""The command `import`: raw files of instruments into a trial."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_dvl.cli.console import ProgressLine, print_written, stdout, warn
from factorgraph_dvl.cli.options import Force, Quiet, claim_output


def import_(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Raw files of one trial.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="TRIAL", help="Trial folder to write.")],
    form: Annotated[
        str, typer.Option("--format", metavar="NAME", help="Format of all files, not recognised.")
    ] = "",
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Import raw files of instruments: velocity logs, GNSS, attitude, IMU."""
    from factorgraph_dvl.io.importing.raw_files import OWNED, import_files

    claim_output(out, force=force, owned=OWNED, inputs=files)
    with ProgressLine(quiet=quiet) as progress:
        decisions = import_files(files, out, form=form, force=force, progress=progress)
    for line in decisions.lines:
        stdout().print(line, markup=False, highlight=False, soft_wrap=True)
    for text in decisions.missing:
        warn(f"missing: {text}")
    print_written(out)
