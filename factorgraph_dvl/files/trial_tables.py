"""Trials from tables in memory: NumPy arrays or DataFrames by column."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.files.tables import Tables
from factorgraph_dvl.files.trial_folder import assembled
from factorgraph_dvl.files.trial_yaml import settings_type
from factorgraph_dvl.sensors.catalogue import aid_types
from factorgraph_dvl.sensors.protocol import part_types
from factorgraph_dvl.settings.convert import convert
from factorgraph_dvl.trial import Trial

_SOURCE = "settings"


def trial_from_tables(
    tables: Tables, *, folder: Path | str = ".", anyway: bool = False, **settings: Any
) -> Trial:
    """Return a trial from tables in memory, with the columns and keys of a trial folder.

    Parameters
    ----------
    tables : mapping of str to mapping or DataFrame
        Columns by name, for each section such as `imu`, `gnss`, `dvl` and `reference`; columns and
        units are those of the files, and nan is missing.
    folder : path-like, default '.'
        Where a file that `dvl.calibration` names is looked for.
    anyway : bool, default False
        Take a calibration in `dvl.calibration` also if it is graded `do not use`.
    **settings
        Keys of trial.yaml, and its sections as mappings. A table whose section is not given has
        the defaults of that section.

    Raises
    ------
    ConfigError
        If a key is unknown, missing, of the wrong type or out of range, or a section has no table.
    DataError
        If a table does not contain what it should.

    Examples
    --------
    >>> import numpy as np
    >>> from factorgraph_dvl import trial_from_tables
    >>> t = np.arange(1, 501) / 100.0
    >>> imu = {"time_s": t, **{f"gyro_{axis}_rad_s": 0 * t for axis in "xyz"}}
    >>> imu |= {"accel_x_m_s2": 0 * t, "accel_y_m_s2": 0 * t, "accel_z_m_s2": 9.8 + 0 * t}
    >>> dvl = {"time_s": t[::20], **{f"vel_{axis}_m_s": 0 * t[::20] for axis in "xyz"}}
    >>> trial = trial_from_tables({"imu": imu, "dvl": dvl}, body_axes="RFU", imu={"grade": "mems"})
    >>> trial.imu.time.size, trial.dvl.time.size, trial.gnss
    (500, 25, None)
    """
    parts = {name for kind in aid_types() for name in part_types(kind)}
    sections = {name: dict(settings.pop(name, {})) for name in tables if name not in parts}
    for name, section in sections.items():
        section["file"] = f"table {name}"
    for name, value in settings.items():
        if isinstance(value, dict) and name not in ("initial", "limits"):
            raise ConfigError(
                f"section {name} has no table", where=_SOURCE, expected=f"a table {name}"
            )
    plain = _plain({"format": 1, **settings, **sections})
    found = convert(plain, settings_type(plain), "", _SOURCE)
    return assembled(found, tables, Path(folder), anyway=anyway)


def _plain(value: Any) -> Any:
    """Return settings as plain data, without NumPy's types."""
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value
