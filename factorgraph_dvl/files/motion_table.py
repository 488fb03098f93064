"""Tables of motion: the columns that references and trajectories share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.geometry.units import DEG, GEODETIC_SI
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.records import check_finite, check_possible, check_times, stack
from factorgraph_dvl.trial import Reference

COLUMNS = (
    "time_s",
    *("lat_deg", "lon_deg", "height_m"),
    *("vel_e_m_s", "vel_n_m_s", "vel_u_m_s"),
    *("roll_deg", "pitch_deg", "heading_deg"),
)
STD_COLUMNS = (
    *("std_e_m", "std_n_m", "std_u_m"),
    *("vel_std_e_m_s", "vel_std_n_m_s", "vel_std_u_m_s"),
    *("roll_std_deg", "pitch_std_deg", "heading_std_deg"),
)


def read_reference(path: Path, source: str = "") -> Reference:
    """Read the columns of `reference` from a CSV or Parquet file.

    Parameters
    ----------
    path : path-like
        Path of the file.
    source : str, optional
        Its name in messages.

    Raises
    ------
    DataError
        If a column is missing, or a value is not a number or out of range.
    """
    return reference_from(read_motion(path, source), source or path.name)


def reference_from(columns: Mapping[str, Array], source: str) -> Reference:
    """Return the reference that columns contain, in the units of files.

    Raises
    ------
    DataError
        If a value is not a number or out of range, or times do not increase.
    """
    check_times(columns["time_s"], source)
    check_possible(columns, source)
    check_finite(columns, source)
    return Reference(*_motion(columns))


def read_motion(
    path: Path,
    source: str = "",
    required: Sequence[str] = (),
    optional: Sequence[Sequence[str]] = (),
) -> dict[str, Array]:
    """Read the columns of `reference` and others, with times in order and values in range.

    Parameters
    ----------
    path : path-like
        Path of the file.
    source : str, optional
        Its name in messages.
    required, optional : sequence of str, sequence of sequence of str, optional
        Further columns, as of `read_table`.
    """
    source = source or path.name
    columns = read_table(path, (*COLUMNS, *required), optional, source=source)
    check_times(columns["time_s"], source)
    check_possible(columns, source)
    return columns


def as_trajectory(columns: Mapping[str, Array]) -> Trajectory:
    """Return the trajectory that columns contain, with covariances that are diagonal."""
    std = stack(columns, STD_COLUMNS) * np.repeat([1.0, 1.0, DEG], 3)
    covariances = np.zeros((len(std), 9, 3))
    covariances[:, np.arange(9), np.arange(9) % 3] = std**2
    return Trajectory(*_motion(columns), *np.split(covariances, 3, axis=1))


def _motion(columns: Mapping[str, Array]) -> tuple[Array, Array, Array, Array]:
    return (
        columns["time_s"],
        stack(columns, COLUMNS[1:4]) * GEODETIC_SI,
        stack(columns, COLUMNS[4:7]),
        stack(columns, COLUMNS[7:10]) * DEG,
    )


def motion_columns(motion: Reference | Trajectory) -> dict[str, Array]:
    """Return the columns of `reference`, in the units of files."""
    values = np.column_stack(
        [motion.time, motion.geodetic / GEODETIC_SI, motion.velocity, motion.rph / DEG]
    )
    return dict(zip(COLUMNS, values.T, strict=True))
