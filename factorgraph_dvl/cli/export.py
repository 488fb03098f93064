"""The command `export`: results and trials in the formats of other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from factorgraph_dvl.cli.console import print_file, warn
from factorgraph_dvl.cli.options import Anyway, Force, Target

if TYPE_CHECKING:
    from collections.abc import Callable

    from factorgraph_dvl.files.exporting.trajectories import ExportedMotion


class ExportFormat(StrEnum):
    """Formats of trajectories and of trials."""

    TUM = "tum"
    KML = "kml"
    GEOJSON = "geojson"
    NETCDF = "netcdf"
    PARQUET = "parquet"
    SBET = "sbet"
    NMEA = "nmea"
    MATLAB = "matlab"
    CSV = "csv"
    MCAP = "mcap"
    PD0 = "pd0"
    URDF = "urdf"
    TF = "tf"
    ARDUPILOT = "ardupilot"
    WATER_LINKED = "water-linked"
    NUCLEUS = "nucleus"


_TRIALS = ("csv", "mcap", "pd0")
_SETTINGS = tuple(x.value for x in Target)
_TRAJECTORIES = tuple(x for x in ExportFormat if x.value not in (*_TRIALS, *_SETTINGS))


def export(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Solution folder or trial folder.")
    ],
    to: Annotated[
        ExportFormat, typer.Option("--to", metavar="FORMAT", help=", ".join(ExportFormat))
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="File to write; by default in DIR.",
        ),
    ] = None,
    force: Force = False,
    anyway: Anyway = False,
) -> None:
    """Export the trajectory or the calibration of a solution, or the records of a trial.

    Trajectories have UTC and σ where the format has room for them: tum, kml, geojson, netcdf,
    parquet, sbet, nmea, matlab. Trials: csv and parquet (folders), netcdf, mcap, pd0.
    Settings of vehicles and instruments: urdf, tf, ardupilot, water-linked, nucleus.

    Examples:
      factorgraph-dvl export out --to tum

      factorgraph-dvl export out --to kml --out track.kml

      factorgraph-dvl export out --to urdf

      factorgraph-dvl export trial --to pd0
    """
    from factorgraph_dvl.files.exporting.trial import export_trial
    from factorgraph_dvl.files.folders import SETTINGS_FILE

    if folder.name == SETTINGS_FILE or (folder / SETTINGS_FILE).is_file():
        written, notes = export_trial(folder, to.value, out, force=force)
        for note in notes:
            warn(note)
        print_file(written)
        return
    if to.value in _SETTINGS:
        _export_settings(folder, to.value, out, force=force, anyway=anyway)
        return
    _export_solution(folder, to, out, force=force)


def _export_settings(
    folder: Path, to: str, out: Path | None, *, force: bool, anyway: bool
) -> None:
    from factorgraph_dvl.analysis.vehicle_settings import TARGETS, settings_text
    from factorgraph_dvl.files.calibration_file import check_usable, load_calibration
    from factorgraph_dvl.files.folders import check_new_file, write_file

    found = load_calibration(folder)
    check_usable(found, found.body_axes, str(folder), anyway=anyway)
    file = out or folder / f"dvl-{to}.{TARGETS[to][1]}"
    # What lies in the folder under these names was exported before.
    force = force or out is None
    check_new_file(file, force=force)
    text = settings_text(found, to)
    write_file(file, lambda path: path.write_text(text, encoding="utf-8"), force=force)
    print_file(file)


def _export_solution(folder: Path, to: ExportFormat, out: Path | None, *, force: bool) -> None:
    from factorgraph_dvl.errors import ConfigError
    from factorgraph_dvl.files.exporting.trajectories import exported_motion
    from factorgraph_dvl.files.folders import check_new_file, write_file
    from factorgraph_dvl.files.run_file import read_run
    from factorgraph_dvl.files.solution_folder import EXPORT_STEM, load_solution

    if folder.exists() and to not in _TRAJECTORIES:
        raise ConfigError(
            f"`{to}` is not a format of trajectories",
            where="--to",
            expected=", ".join((*_TRAJECTORIES, *_SETTINGS)),
            hint=f"{folder} is not a trial folder; only trials have csv, mcap and pd0",
        )
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
    from factorgraph_dvl.files.exporting import geographic, navigation
    from factorgraph_dvl.files.exporting import trajectories as arrays
    from factorgraph_dvl.files.exporting import trajectories as tum

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
