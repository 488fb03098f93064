"""Trajectories as arrays: NetCDF, MATLAB and Parquet."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np

from factorgraph_dvl.files.exporting.motion import ExportedMotion
from factorgraph_dvl.files.solution_folder import trajectory_columns
from factorgraph_dvl.files.tables import write_table
from factorgraph_dvl.geometry.vectors import Array


def _columns(motion: ExportedMotion) -> dict[str, Array]:
    """Return the columns of trajectory.csv, and UTC."""
    own = trajectory_columns(motion.trajectory)
    return {"time_s": own.pop("time_s"), "utc_s": motion.utc, **own}


def write_parquet(motion: ExportedMotion, path: Path) -> None:
    """Write the columns of trajectory.csv and `utc_s`, seconds since 1970, as Parquet."""
    table = path.with_suffix(".parquet")
    write_table(table, _columns(motion))
    table.replace(path)


def write_matlab(motion: ExportedMotion, path: Path) -> None:
    """Write the columns of trajectory.csv and `utc_s` as a MATLAB 5 file with a struct."""
    from scipy.io import savemat

    columns = {name: values[:, None] for name, values in _columns(motion).items()}
    columns |= {"trial": np.array([motion.name]), "verdict": np.array([motion.summary])}
    with path.open("wb") as file:
        savemat(cast("Any", file), {"trajectory": columns}, oned_as="column", do_compression=True)
    # SciPy writes the time of day into the 116 bytes of text at the start.
    with path.open("r+b") as file:
        file.write(b"MATLAB 5.0 MAT-file, written by factorgraph-dvl".ljust(116))


def write_netcdf(motion: ExportedMotion, path: Path) -> None:
    """Write the columns of trajectory.csv as variables over time, NetCDF 3, CF names of units."""
    from scipy.io import netcdf_file

    units = {"_s": "s", "_deg": "degree", "_m": "m", "_m_s": "m s-1"}
    with netcdf_file(path, "w", version=2) as opened:
        # Attributes of the file and its variables are set by name.
        file: Any = opened
        file.Conventions = "CF-1.8"
        file.title = motion.name.encode("ascii", "replace").decode()
        file.comment = motion.summary.encode("ascii", "replace").decode()
        file.createDimension("time", motion.trajectory.time.size)
        for name, values in _columns(motion).items():
            variable = file.createVariable(name, "f8", ("time",))
            variable[:] = values
            suffix = max((s for s in units if name.endswith(s)), key=len)
            variable.units = (
                "seconds since 1970-01-01T00:00:00Z" if name == "utc_s" else units[suffix]
            )
