"""A trajectory with UTC, and as TUM, NetCDF, MATLAB or Parquet."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.files.solution_folder import trajectory_columns
from factorgraph_dvl.files.tables import write_table
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.solution import Solution

# Times of a trial that are seconds since 1970 already. Chosen: since 2001.
_UNIX_FROM = 1e9


@dataclass(frozen=True)
class ExportedMotion:
    """A trajectory and when it was.

    Parameters
    ----------
    name : str
        Name of the trial.
    trajectory : Trajectory
        Motion of the IMU.
    body_axes : BodyAxes
        Axes of the body.
    utc : ndarray, shape (M,), s
        Seconds since 1970-01-01T00:00:00 UTC; nan where it is not known.
    summary : str
        The verdict, for formats that have room for a remark.
    """

    name: str
    trajectory: Trajectory
    body_axes: BodyAxes
    utc: Array
    summary: str

    def known_utc(self, kind: str) -> Array:
        """Return UTC for a format that cannot do without.

        Raises
        ------
        DataError
            If it is not known.
        """
        if np.isnan(self.utc).any():
            raise DataError(
                f"{kind} needs UTC, and the trial has no epoch",
                expected="`epoch` in trial.yaml: the UTC of time_s = 0",
                hint="Add it and solve again, or export another format",
            )
        return self.utc


def exported_motion(solution: Solution, epoch: str) -> ExportedMotion:
    """Return what is exported of a solution.

    Parameters
    ----------
    solution : Solution
        Solution with a trajectory.
    epoch : str
        UTC of time zero, ISO 8601; empty if not known. Times after 2001 in seconds since 1970
        are UTC without it.
    """
    time = solution.trajectory.time
    if epoch:
        start = datetime.fromisoformat(epoch)
        start = start if start.tzinfo else start.replace(tzinfo=UTC)
        utc = start.timestamp() + time
    else:
        utc = time if time[0] > _UNIX_FROM else np.full(time.size, np.nan)
    verdict = solution.verdict
    summary = ": ".join([f"graded {verdict.grade}", *map(str, verdict.reasons[:1])])
    return ExportedMotion(solution.trial, solution.trajectory, solution.body_axes, utc, summary)


def iso_times(utc: Array) -> list[str]:
    """Return UTC (M,), s, as ISO 8601 to the millisecond."""
    milliseconds = np.round(utc * 1e3).astype("datetime64[ms]")
    return [f"{text}Z" for text in np.datetime_as_string(milliseconds).tolist()]


def write_tum(motion: ExportedMotion, path: Path) -> None:
    """Write `time x y z qx qy qz qw` lines.

    Positions are metres east, north, up of the first epoch, in one tangent frame; the quaternion
    takes body to that frame. Times are UTC, seconds since 1970, or those of the trial.
    """
    t = motion.trajectory
    known = np.isfinite(t.geodetic).all(axis=1) & np.isfinite(t.rph).all(axis=1)
    geodetic = t.geodetic[known]
    frame = LocalFrame(*geodetic[0])
    level = rotation_from_rph(t.rph[known], motion.body_axes)
    tangent = frame.level_from_tangent(geodetic[:, 0], geodetic[:, 1])
    nRb = np.swapaxes(tangent, 1, 2) @ level
    quaternion = Rotation.from_matrix(nRb).as_quat(canonical=True)
    time = np.where(np.isnan(motion.utc), t.time, motion.utc)[known]
    rows = np.column_stack([time, frame.position(*geodetic.T), quaternion])
    np.savetxt(path, rows, fmt=["%.6f", *["%.6f"] * 3, *["%.9f"] * 4])


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
