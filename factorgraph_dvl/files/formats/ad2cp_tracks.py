"""Bottom track and water track of Nortek's DVLs in AD2CP records (0x1B, DF21; 0x1D, DF22).

Sources: four public readers of these records, of Woods Hole and of three universities, which agree
on what Nortek's DVL Integrators Guide says of them; Nortek, DVL Operations Manual (2017), 6.2: in
bottom track, velocities along beams are positive towards the transducer. No recording was
available to compare with.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.files.formats.clocks import posix
from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.geometry.vectors import Array

BOTTOM, WATER = 0x1B, 0x1D
_RECORD = np.dtype(
    [
        ("version", "u1"),
        ("offset", "u1"),
        ("serial", "<u4"),
        ("date", "6u1"),
        ("fraction", "<u2"),
        ("beams", "<u2"),
        ("error", "<u4"),
        ("status", "<u4"),
        *((name, "<f4") for name in ("sound_speed", "temperature", "pressure")),
        *((f"beam_{name}", "4<f4") for name in ("velocity", "range", "merit")),
        *((f"beam_{name}", "4<f4") for name in ("delay", "delay_to_output", "duration")),
        *((name, "4<f4") for name in ("velocity", "merit", "delay", "delay_to_output")),
        ("duration", "4<f4"),
    ]
)
# First of four bits in the status that say what is valid, of beams and of X, Y, Z1, Z2.
_BITS = {"beam_velocity": 0, "beam_range": 4, "velocity": 12}
# What stands for a velocity that was not measured, m/s, and for its standard deviation.
_NO_VELOCITY, _NO_MERIT = -32.0, 10.0
# Time from trigger to echo, s, that no range explains. Chosen: 7 km.
_LONGEST_DELAY = 10.0

TRACK = np.dtype(
    [
        ("at", "i8"),
        ("water", "?"),
        ("time", "f8"),
        ("velocity", "f8", (3,)),
        ("error", "f8"),
        ("merit", "f8", (3,)),
        ("delay", "f8"),
        *((f"beam_{name}", "f8", (4,)) for name in ("velocity", "range", "merit")),
        *((name, "f8") for name in ("sound_speed", "temperature", "pressure")),
    ]
)


def is_whole(record: bytes) -> bool:
    """Return whether a record has all fields."""
    return len(record) >= _RECORD.itemsize


def tracks(records: Sequence[tuple[int, int, bytes]]) -> Records:
    """Return what records hold that are whole.

    Parameters
    ----------
    records : sequence of (int, int, bytes)
        Position, kind (`BOTTOM` or `WATER`) and content.

    Returns
    -------
    Records
        (N,) of `TRACK`: `time` of the trigger, seconds since 1970; `delay` from it to the echo, s;
        `velocity` X, Y, Z, m/s, Z the mean of two, and `error` half their difference; `merit`, the
        instrument's own standard deviation, m/s; nan where not measured.
    """
    raw = np.frombuffer(
        b"".join(content[: _RECORD.itemsize] for _, _, content in records), _RECORD
    )
    out = np.zeros(len(raw), TRACK)
    out["at"] = [at for at, _, _ in records]
    out["water"] = [kind == WATER for _, kind, _ in records]
    # Years count from 1900 and months from 0, as in C.
    year, month, day, hour, minute, second = raw["date"].astype(np.int64).T
    out["time"] = posix(year + 1900, month + 1, day, hour, minute, second + raw["fraction"] * 1e-4)
    for name in ("sound_speed", "temperature", "pressure"):
        out[name] = _finite(raw[name])
    velocity, merit, delay = (_finite(raw[name]) for name in ("velocity", "merit", "delay"))
    velocity[~_valid(raw, "velocity") | (velocity <= _NO_VELOCITY)] = np.nan
    both = np.isfinite(velocity[:, 2:]).all(axis=1)
    vertical = np.where(np.isfinite(velocity[:, 2]), velocity[:, 2], velocity[:, 3])
    vertical[both] = velocity[both, 2:].mean(axis=1)
    out["velocity"] = np.column_stack([velocity[:, :2], vertical])
    out["error"] = (velocity[:, 2] - velocity[:, 3]) / 2.0
    merit[(merit <= 0.0) | (merit >= _NO_MERIT)] = np.nan
    out["merit"] = np.where(np.isfinite(out["velocity"]), merit[:, :3], np.nan)
    likely = (delay > 0.0) & (delay < _LONGEST_DELAY)
    number = likely[:, :3].sum(axis=1)
    total = np.where(likely, delay, 0.0)[:, :3].sum(axis=1)
    out["delay"] = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    for name in ("velocity", "range", "merit"):
        out[f"beam_{name}"] = _finite(raw[f"beam_{name}"])
    lost = ~_valid(raw, "beam_velocity") | (out["beam_velocity"] <= _NO_VELOCITY)
    out["beam_velocity"][lost] = np.nan
    out["beam_merit"][lost | (out["beam_merit"] >= _NO_MERIT)] = np.nan
    far = ~_valid(raw, "beam_range") | (out["beam_range"] <= 0.0)
    out["beam_range"][far] = np.nan
    return out


def _valid(raw: Records, name: str) -> NDArray[np.bool_]:
    return (raw["status"][:, None] >> (_BITS[name] + np.arange(4, dtype=np.uint32)) & 1) > 0


def _finite(values: Records) -> Array:
    out = values.astype(float)
    out[~np.isfinite(out)] = np.nan
    return out
