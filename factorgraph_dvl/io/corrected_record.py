"""Calibrated beams as an instrument: its matrix, and the record that it would have made."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.io.folders import new_folder
from factorgraph_dvl.io.tables import write_table
from factorgraph_dvl.sensors.beam_geometry import as_dvl, error_rows, instrument_matrix
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.dvl_beams import DvlBeams

INSTRUMENT_FILE = "instrument.json"
RECORD_FILE = "dvl.csv"
OWNED = (INSTRUMENT_FILE, RECORD_FILE)


def save_corrected(
    beams: DvlBeams,
    directions_b: Array,
    scale_error: Array,
    lever_arm: Array,
    path: Path,
    *,
    force: bool = False,
) -> Dvl:
    """Write instrument.json and dvl.csv, complete or not at all; return the record.

    Parameters
    ----------
    beams : DvlBeams
        The record.
    directions_b, scale_error, lever_arm : ndarray, shape (N, 3)
        In body, (N,), (3,) m: the calibration.
    path : path-like
        Of the folder.
    force : bool, default False
        Replace what is there.

    Raises
    ------
    DataError
        If the folder exists, is not empty, and `force` is not set; if no ping has a velocity.
    """
    dvl = as_dvl(beams, (directions_b, scale_error, lever_arm))
    if not dvl.locked.any():
        raise DataError(
            "no ping has a velocity",
            where=beams.source,
            expected="three beams, not in one plane, at one ping at least",
        )
    dRb = exp_so3(np.array(beams.settings.misalignment_deg) * DEG)
    directions_d = directions_b @ dRb.T
    gain = (1.0 + scale_error)[:, None] * directions_d
    content = {
        "format": 1,
        "directions_d": directions_d.tolist(),
        "directions_b": directions_b.tolist(),
        "scale_error": scale_error.tolist(),
        "beams_to_xyz": instrument_matrix(gain).tolist(),
        "error_velocity": error_rows(gain).tolist(),
        "dvl": msgspec.structs.replace(dvl.settings, file=RECORD_FILE),
    }
    with new_folder(path, force=force, owned=OWNED) as folder:
        write_table(folder / RECORD_FILE, dvl.columns())
        text = msgspec.json.format(msgspec.json.encode(content), indent=2)
        (folder / INSTRUMENT_FILE).write_bytes(text + b"\n")
    return dvl
