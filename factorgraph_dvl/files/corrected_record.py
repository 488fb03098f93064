"""A calibrated DVL as an instrument: its matrix, and the record that it would have made."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
from msgspec import UNSET

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.folders import new_folder
from factorgraph_dvl.files.tables import write_table
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.beam_geometry import as_dvl, error_rows, instrument_matrix
from factorgraph_dvl.sensors.dvl import (
    BIAS,
    LEVER_ARM,
    MISALIGNMENT,
    SCALE_ERROR,
    TIME_OFFSET,
    Dvl,
)
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
        Directions, scale error and lever arm in body, (N,), (3,) m: the calibration.
    path : path-like
        Path of the folder.
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
            expected="at least one ping with three beams that are not in one plane",
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


def corrected_dvl(dvl: Dvl, values: Mapping[str, Array]) -> Dvl:
    """Return the record that a DVL would have made without errors, aligned with the body.

    v = Rᵀ (v_d - β) / (1 + k), with R = C_b^d. The lever arm and the clock stay, as settings that
    are known.

    Parameters
    ----------
    dvl : Dvl
        The record.
    values : mapping of str to ndarray
        Calibration by reported name, in reported units; what is absent is that of the settings.
    """
    s = dvl.settings
    alpha = values.get(MISALIGNMENT, np.array(s.misalignment_deg))
    gain = 1.0 + np.broadcast_to(values.get(SCALE_ERROR, np.array(s.scale_error)), 3)
    matrix = _matrix(alpha, gain)
    velocity = (dvl.velocity - values.get(BIAS, np.zeros(3))) @ matrix.T
    std = np.sqrt(dvl.sigma() ** 2 @ (matrix**2).T)
    none = (0.0, 0.0, 0.0)
    lever_arm = values.get(LEVER_ARM, np.array(s.lever_arm_m))
    offset = values.get(TIME_OFFSET, np.array([s.time_offset_s]))
    settings = msgspec.structs.replace(
        s,
        file=RECORD_FILE,
        calibration=UNSET,
        misalignment_deg=none,
        misalignment_std_deg=none,
        scale_error=0.0,
        scale_error_std=0.0,
        lever_arm_m=tuple(np.asarray(lever_arm).tolist()),
        lever_arm_std_m=none,
        bias_std_m_s=none,
        time_offset_s=float(np.ravel(offset)[0]),
        time_offset_std_s=0.0,
    )
    return Dvl(settings, dvl.time, velocity, std, dvl.source, dvl.label)


def save_corrected_dvl(
    dvl: Dvl, values: Mapping[str, Array], path: Path, *, force: bool = False
) -> Dvl:
    """Write instrument.json and dvl.csv of a DVL, complete or not at all; return the record.

    Parameters
    ----------
    dvl : Dvl
        The record.
    values : mapping of str to ndarray
        Values as of `corrected_dvl`.
    path : path-like
        Path of the folder.
    force : bool, default False
        Replace what is there.

    Raises
    ------
    DataError
        If the folder exists, is not empty, and `force` is not set.
    """
    corrected = corrected_dvl(dvl, values)
    s = dvl.settings
    alpha = values.get(MISALIGNMENT, np.array(s.misalignment_deg))
    gain = 1.0 + np.broadcast_to(values.get(SCALE_ERROR, np.array(s.scale_error)), 3)
    content = {
        "format": 1,
        "dvl_to_body": _matrix(alpha, gain).tolist(),
        "bias_m_s": np.asarray(values.get(BIAS, np.zeros(3))).tolist(),
        "dvl": corrected.settings,
    }
    with new_folder(path, force=force, owned=OWNED) as folder:
        write_table(folder / RECORD_FILE, corrected.columns())
        text = msgspec.json.format(msgspec.json.encode(content), indent=2)
        (folder / INSTRUMENT_FILE).write_bytes(text + b"\n")
    return corrected


def _matrix(alpha: Array, gain: Array) -> Array:
    """Return the matrix (3, 3) from velocity in d, less its bias, to velocity in body."""
    return np.asarray(exp_so3(np.asarray(alpha) * DEG).T / gain)
