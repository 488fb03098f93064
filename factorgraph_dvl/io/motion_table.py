"""Tables of motion: the columns that references and trajectories share."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorgraph_dvl.geometry.units import DEG, GEODETIC_SI
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.io.tables import read_table
from factorgraph_dvl.sensors.records import check_finite, check_possible, check_times, stack
from factorgraph_dvl.solution import Trajectory
from factorgraph_dvl.trial import Reference

COLUMNS = (
    "time_s",
    *("lat_deg", "lon_deg", "height_m"),
    *("vel_e_m_s", "vel_n_m_s", "vel_u_m_s"),
    *("roll_deg", "pitch_deg", "heading_deg"),
)


def read_reference(path: Path, source: str = "") -> Reference:
    """Read the columns of `reference` from a CSV or Parquet file.

    Parameters
    ----------
    path : path-like
        Of the file.
    source : str, optional
        Its name in messages.

    Raises
    ------
    DataError
        If a column is missing, or a value is not a number or out of range.
    """
    source = source or path.name
    columns = read_table(path, COLUMNS, source=source)
    check_times(columns["time_s"], source)
    check_finite(columns, source)
    check_possible(columns, source)
    return Reference(
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
