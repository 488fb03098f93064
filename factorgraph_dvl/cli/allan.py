"""The command `allan`: noise figures of an IMU from a static record."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_dvl.cli.console import drawing, print_table, print_written, stdout
from factorgraph_dvl.cli.options import FigureKind, Figures, Force, claim_output

_FIGURE, _KEYS = "allan", "imu.yaml"


def allan(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Table of an IMU at rest, CSV or Parquet.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for plot and keys.")
    ] = None,
    figures: Figures = FigureKind.PNG,
    force: Force = False,
) -> None:
    """Find the noise of an IMU from a static record, by its Allan deviation.

    Examples:
      factorgraph-dvl allan static.csv --out allan
    """
    from factorgraph_dvl.analysis.static_noise import static_noise
    from factorgraph_dvl.files.folders import new_folder
    from factorgraph_dvl.files.tables import read_table
    from factorgraph_dvl.report.figure_files import figure_files
    from factorgraph_dvl.report.files.imu_noise import imu_yaml, noise_table
    from factorgraph_dvl.sensors.imu import COLUMNS, Imu, ImuSettings

    owned = (*figure_files(_FIGURE), _KEYS)
    if out is not None:
        claim_output(out, force=force, owned=owned, inputs=(file,))
    # The noise is what is asked for: that of the settings is not used.
    settings = ImuSettings(file=file.name, grade="mems")
    noise = static_noise(Imu.from_columns(settings, read_table(file, COLUMNS), file.name))
    keys = imu_yaml(noise)
    print_table(noise_table(noise))
    console = stdout()
    console.print("For trial.yaml:", markup=False)
    console.print(keys, markup=False, highlight=False, end="")
    if out is None:
        return
    with new_folder(out, force=force, owned=owned) as folder:
        (folder / _KEYS).write_text(keys, encoding="utf-8")
        with drawing():
            from factorgraph_dvl.report.figures.drawing import save_figures
            from factorgraph_dvl.report.figures.static_noise import allan_figure

            drawn = {_FIGURE: allan_figure(noise)}
            save_figures(drawn, folder, name=file.name, kind=figures.value)
    print_written(out)
