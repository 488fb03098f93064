"""Folders of planar trials: trial.yaml and the tables that it names."""

from __future__ import annotations

from pathlib import Path

import msgspec
from msgspec import UNSET

from factorgraph_dvl.errors import printable
from factorgraph_dvl.io.folders import new_folder
from factorgraph_dvl.io.initial_conditions import position_of, position_settings
from factorgraph_dvl.io.motion_table import motion_columns
from factorgraph_dvl.io.tables import write_table
from factorgraph_dvl.io.trial_folder import (
    OWNED,
    TRUTH_FILE,
    check_saved,
    locate,
    looks_planar,
    read_record,
    reference_of,
    write_settings,
)
from factorgraph_dvl.io.trial_yaml import PlanarInitialSettings, PlanarSettings, ReferenceSettings
from factorgraph_dvl.io.truth_file import read_truth, truth_json
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.sensors.depth import Depth
from factorgraph_dvl.sensors.speed_log import Heading, SpeedLog
from factorgraph_dvl.settings.yaml_file import parse_yaml, read_text
from factorgraph_dvl.trial import PlanarTrial


def is_planar(path: Path | str) -> bool:
    """Whether a trial folder holds a planar trial: heading and log instead of an imu.

    Raises
    ------
    ConfigError, DataError
        If there is no trial.yaml, or it is no YAML.
    """
    _, file = locate(Path(path))
    return looks_planar(read_text(file), file.name)


def load_planar_trial(path: Path | str) -> PlanarTrial:
    """Read the folder of a planar trial.

    Parameters
    ----------
    path : path-like
        Of the folder, or of the trial.yaml in it.

    Raises
    ------
    ConfigError, DataError
        As `load_trial`.
    """
    folder, file = locate(Path(path))
    settings = parse_yaml(read_text(file), PlanarSettings, source=file.name)
    initial = settings.initial
    return PlanarTrial(
        name=printable(settings.name or folder.resolve().name),
        heading=read_record(folder, Heading, settings.heading),
        log=read_record(folder, SpeedLog, settings.log),
        depth=read_record(folder, Depth, settings.depth),
        beacons=read_record(folder, Beacons, settings.beacons),
        body_axes=settings.body_axes,
        initial_position=None if initial is UNSET else position_of(initial),
        reference=reference_of(folder, settings),
        calibration_truth=read_truth(folder / TRUTH_FILE),
    )


def save_planar_trial(
    trial: PlanarTrial,
    path: Path | str,
    *,
    force: bool = False,
    parquet: bool = False,
    seed: int | None = None,
) -> None:
    """Write the folder of a planar trial, complete or not at all; as `save_trial`."""
    suffix = ".parquet" if parquet else ".csv"
    sections = {
        r.section: msgspec.structs.replace(r.settings, file=f"{r.section}{suffix}")
        for r in trial.records
    }
    position = trial.initial_position
    settings = PlanarSettings(
        format=1,
        name=trial.name,
        body_axes=trial.body_axes,
        **sections,  # type: ignore[arg-type]
        initial=(
            UNSET
            if position is None
            else PlanarInitialSettings(position=position_settings(position))
        ),
        reference=(
            UNSET if trial.reference is None else ReferenceSettings(file=f"reference{suffix}")
        ),
    )
    check_saved(Path(path))
    with new_folder(Path(path), force=force, owned=OWNED) as folder:
        for record in trial.records:
            write_table(folder / f"{record.section}{suffix}", record.columns())
        if trial.reference is not None:
            write_table(folder / f"reference{suffix}", motion_columns(trial.reference))
        if trial.calibration_truth:
            (folder / TRUTH_FILE).write_bytes(truth_json(trial.calibration_truth))
        write_settings(folder, settings, seed)
