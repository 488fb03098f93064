"""The command `import`: raw files of instruments into a trial."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from factorgraph_dvl.cli.console import ProgressLine, print_table, print_written, stdout, warn
from factorgraph_dvl.cli.options import Force, Quiet, claim_output

if TYPE_CHECKING:
    from factorgraph_dvl.files.importing.account import Account
    from factorgraph_dvl.report.table import Table


def import_(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Raw files of one trial.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="TRIAL", help="Trial folder to write.")
    ] = None,
    form: Annotated[
        str,
        typer.Option(
            "--format", metavar="NAME", help="Format of all files; by default recognised."
        ),
    ] = "",
    mapping: Annotated[
        Path | None,
        typer.Option("--map", metavar="MAPPING.yaml", help="Mapping of the columns of tables."),
    ] = None,
    guess: Annotated[
        bool, typer.Option("--guess", help="Propose a mapping for tables, and write nothing.")
    ] = False,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Import raw files of instruments: velocity logs, GNSS, attitude, IMU.

    Examples:
      factorgraph-dvl import sensors.pd0 ship.nmea --out trial
    """
    from factorgraph_dvl.errors import ConfigError
    from factorgraph_dvl.files.formats.mapping import MappingSettings
    from factorgraph_dvl.files.importing.guess import guess_all
    from factorgraph_dvl.files.importing.raw_files import OWNED, import_files
    from factorgraph_dvl.settings.yaml_file import read_yaml

    if guess:
        stdout().print(guess_all(files), markup=False, highlight=False, soft_wrap=True, end="")
        return
    if out is None:
        raise ConfigError("is missing", where="--out", expected="the trial folder to write")
    settings = None if mapping is None else read_yaml(mapping, MappingSettings)
    claim_output(out, force=force, owned=OWNED, inputs=(*files, mapping))
    with ProgressLine(quiet=quiet) as progress:
        decisions = import_files(
            files, out, form=form, mapping=settings, force=force, progress=progress
        )
    for line in decisions.lines:
        stdout().print(line, markup=False, highlight=False, soft_wrap=True)
    for account in decisions.accounts:
        print_table(_table(account))
    for text in decisions.warnings:
        warn(text)
    for text in decisions.missing:
        warn(f"missing: {text}")
    print_written(out)


def _table(account: Account) -> Table:
    from factorgraph_dvl.report.table import Table

    table = Table(title=f"Records of {account.file}")
    table.column("type")
    table.column("read", numeric=True)
    table.column("skipped", numeric=True)
    table.column("reasons")
    for kind, read, skipped, reasons in account.rows():
        table.row(kind, str(read), str(skipped), reasons)
    return table
