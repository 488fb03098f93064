"""Trials in the formats of other programs, and as tables of the other kind."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.files.exporting.bag import write_mcap
from factorgraph_dvl.files.exporting.pd0 import write_pd0
from factorgraph_dvl.files.folders import write_file
from factorgraph_dvl.files.trial_folder import load_trial, locate, save_trial
from factorgraph_dvl.sensors.protocol import SensorRecord
from factorgraph_dvl.settings.yaml_file import read_text
from factorgraph_dvl.trial import Trial

# Times of a trial without an epoch are taken from here.
_NO_EPOCH = "2000-01-01T00:00:00Z"
# SI units of columns, by the ends of their names, the longest first.
_UNITS = (
    ("_rad_s", "rad s-1"),
    ("_m_s2", "m s-2"),
    ("_m_s", "m s-1"),
    ("_deg", "degree"),
    ("_m", "m"),
    ("_s", "s"),
)
FORMATS = ("csv", "parquet", "netcdf", "mcap", "pd0")


def export_trial(
    path: Path, to: str, out: Path | None = None, *, force: bool = False
) -> tuple[Path, tuple[str, ...]]:
    """Write a trial in another format.

    Parameters
    ----------
    path : path-like
        Trial folder.
    to : {'csv', 'parquet', 'netcdf', 'mcap', 'pd0'}
        The first two are trial folders.
    out : path-like, optional
        File or folder to write; by default beside the trial's tables, named after the format.
    force : bool, default False
        Replace what an earlier export wrote.

    Returns
    -------
    out : Path
        What was written.
    notes : tuple of str
        What the format has no room for, and what was assumed.

    Raises
    ------
    ConfigError
        If there is no such format, or a library that it needs is not installed.
    DataError
        If the trial cannot be read or contains nothing that the format takes, or if a file is in
        the way.
    """
    if to not in FORMATS:
        raise ConfigError(
            f"`{to}` is not a format of trials", where="--to", expected=", ".join(FORMATS)
        )
    trial = load_trial(path, anyway=True)
    folder, settings = locate(path)
    if to in ("csv", "parquet"):
        target = out or folder / f"trial-{to}"
        save_trial(trial, target, force=force, parquet=to == "parquet")
        return target, ()
    target = out or folder / f"trial.{to}"
    begin = datetime.fromisoformat(trial.epoch or _NO_EPOCH)
    begin = begin if begin.tzinfo is not None else begin.replace(tzinfo=UTC)
    notes: list[str] = []
    if not trial.epoch and to != "netcdf":
        notes.append(f"the trial has no epoch: time zero is written as {_NO_EPOCH}")
    write: Callable[[Path], Any] = {
        "netcdf": lambda file: _write_netcdf(trial, read_text(settings), file),
        "mcap": lambda file: notes.extend(write_mcap(trial, begin.timestamp(), file)),
        "pd0": lambda file: notes.extend(write_pd0(trial, begin.timestamp(), file)),
    }[to]
    write_file(target, write, force=force)
    return target, tuple(notes)


def _records(trial: Trial) -> tuple[SensorRecord, ...]:
    return (*(() if trial.imu is None else (trial.imu,)), *trial.aids)


def _write_netcdf(trial: Trial, settings: str, path: Path) -> None:
    """Write all tables as variables `section_column` over `section_row`, NetCDF 3."""
    from scipy.io import netcdf_file

    with netcdf_file(path, "w", version=2) as opened:
        # Attributes of the file and its variables are set by name.
        file: Any = opened
        file.title = _ascii(trial.name)
        file.epoch = trial.epoch
        file.trial_yaml = _ascii(settings)
        for record in _records(trial):
            columns = record.columns()
            row = f"{record.section}_row"
            file.createDimension(row, columns["time_s"].size)
            for name, values in columns.items():
                _add(file, f"{record.section}_{name}", name, row, values)


def _add(file: Any, variable: str, name: str, row: str, values: NDArray[Any]) -> None:
    if values.dtype.kind == "U":
        width = f"{variable}_width"
        text = np.char.encode(values, "utf-8")
        file.createDimension(width, max(text.dtype.itemsize, 1))
        cells = text.view("S1").reshape(len(text), -1)
        file.createVariable(variable, "c", (row, width))[:] = cells
        return
    out = file.createVariable(variable, "f8", (row,))
    out[:] = values
    unit = next((unit for end, unit in _UNITS if name.endswith(end)), "")
    if unit:
        out.units = unit


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode()
