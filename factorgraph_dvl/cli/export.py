"""The command `export`: results in the formats of other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from factorgraph_dvl.cli.console import print_file
from factorgraph_dvl.cli.options import Force

if TYPE_CHECKING:
    from collections.abc import Callable

    from factorgraph_dvl.io.exporting.motion import ExportedMotion


class ExportFormat(StrEnum):
    """Formats of trajectories."""

    TUM = "tum"
    KML = "kml"
    GEOJSON = "geojson"
    NETCDF = "netcdf"
    PARQUET = "parquet"
    SBET = "sbet"
    NMEA = "nmea"
    MATLAB = "matlab"


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Solution folder.")],
    to: Annotated[
        ExportFormat, typer.Option("--to", metavar="FORMAT", help=", ".join(ExportFormat))
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE", help="File to write; by default DIR/trajectory.FORMAT."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Export the trajectory of a solution, with UTC and σ where the format has room for them.

    Examples:
      factorgraph-dvl export out --to tum

      factorgraph-dvl export out --to kml --out track.kml
    """
    from factorgraph_dvl.io.exporting.motion import exported_motion
    from factorgraph_dvl.io.output_file import check_new_file, write_file
    from factorgraph_dvl.io.run_file import read_run
    from factorgraph_dvl.io.solution_folder import EXPORT_STEM, load_solution

    file = out or folder / f"{EXPORT_STEM}.{to.value}"
    # What lies in the folder under these names was exported before.
    force = force or out is None
    if out is not None:
        check_new_file(file, force=force)
    solution = load_solution(folder)
    run = read_run(folder)
    motion = exported_motion(solution, run.epoch if run is not None else "")
    write = _writer(to)
    write_file(file, lambda path: write(motion, path), force=force)
    print_file(file)


def _writer(to: ExportFormat) -> Callable[[ExportedMotion, Path], None]:
    from factorgraph_dvl.io.exporting import arrays, geographic, navigation, tum

    return {
        ExportFormat.TUM: tum.write_tum,
        ExportFormat.KML: geographic.write_kml,
        ExportFormat.GEOJSON: geographic.write_geojson,
        ExportFormat.NETCDF: arrays.write_netcdf,
        ExportFormat.PARQUET: arrays.write_parquet,
        ExportFormat.SBET: navigation.write_sbet,
        ExportFormat.NMEA: navigation.write_nmea,
        ExportFormat.MATLAB: arrays.write_matlab,
    }[to]
