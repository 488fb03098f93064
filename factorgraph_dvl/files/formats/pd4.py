"""Teledyne PD4 and PD5, the short binary formats of DVLs.

Source: Teledyne, Pathfinder DVL Guide (April 2018), Special Output Data Formats. In
these the DVL moves and the bottom stands still: velocities are those of the DVL. The sign of
beam velocities in beam coordinates is not verified.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from factorgraph_dvl.files.formats.format import Format
from factorgraph_dvl.files.formats.framing import (
    Bytes,
    Index,
    Records,
    Source,
    as_bytes,
    summed_frames,
    u16,
)
from factorgraph_dvl.files.formats.losses import Losses, count_outside, summed
from factorgraph_dvl.files.formats.velocities import (
    BEAM,
    empty,
    read_pings,
    share_of_records,
)
from factorgraph_dvl.geometry.units import DEG

_SYNC = b"\x7d"
# Bytes of the structures 0 and 1, the second byte of an ensemble, without the checksum.
_PD4, _PD5 = 45, 86
_LAYOUT = np.dtype(
    {
        "names": [
            *("structure", "configuration", "velocity", "range", "clock", "sound_speed"),
            *("temperature", "depth", "pitch", "roll", "heading"),
        ],
        "offsets": [1, 4, 5, 13, 35, 41, 43, 46, 48, 50, 52],
        "formats": [
            *("u1", "u1", "4<i2", "4<u2", "4u1", "<u2", "<i2", "<u2", "<i2", "<i2", "<u2"),
        ],
        "itemsize": _PD5,
    }
)


def read_pd4(source: Source, losses: Losses | None = None) -> Iterator[Records]:
    """Read PD4 and PD5 ensembles whose checksum is right.

    Parameters
    ----------
    source : Source
        The file; other bytes, such as commands, may stand between ensembles.
    losses : Losses, optional
        Takes counts of what was left out.

    Yields
    ------
    Records
        (N,) of `VELOCITY`; `second` of the day by the DVL's clock, as there is no date.
        Roll, pitch, heading and depth are in PD5 only.
    """
    losses = Losses() if losses is None else losses
    found = summed_frames(source, _SYNC, _length, _PD4, _PD5)
    for frames in count_outside(source, found, losses, _FRAME, 2):
        begin = int(frames[0, 0])
        data = as_bytes(source, begin, int(frames[-1, 1]))
        at = (frames[:, 0] - begin)[:, None] + np.arange(_PD5)
        raw = np.where(at < frames[:, 1:] - begin, data[np.minimum(at, len(data) - 1)], 0)
        yield _records(np.ascontiguousarray(raw, np.uint8).view(_LAYOUT)[:, 0], frames[:, 0])


def _length(data: Bytes, at: Index) -> Index:
    structure = data[at + 1]
    length = np.select([structure == 0, structure == 1], [_PD4, _PD5], 0)
    return np.where(u16(data, at + 2) == length, length, 0)


_FRAME = summed("ensemble", _SYNC, _length, _PD4)


def _records(raw: Records, at: Index) -> Records:
    out = empty(len(raw))
    out["at"] = at
    out["axes"] = raw["configuration"] >> 6
    velocity = np.where(raw["velocity"] == -32768, np.nan, raw["velocity"] * 1e-3)
    is_beam = (out["axes"] == BEAM)[:, None]
    out["beam_velocity"] = np.where(is_beam, velocity, np.nan)
    out["velocity"] = np.where(is_beam, np.nan, velocity[:, :3])
    # In Earth axes too the fourth is the error velocity.
    out["error"] = np.where(is_beam[:, 0], np.nan, velocity[:, 3])
    out["range"] = np.where(raw["range"] == 0, np.nan, raw["range"] * 0.01)
    hour, minute, second, hundredth = raw["clock"].astype(float).T
    exists = (hour < 24) & (minute < 60) & (second < 61) & (hundredth < 100)
    clock = hour * 3600.0 + minute * 60.0 + second + hundredth * 0.01
    out["second"] = np.where(exists, clock, np.nan)
    out["sound_speed"], out["temperature"] = raw["sound_speed"], raw["temperature"] * 0.01
    is_long = raw["structure"] == 1
    out["depth"] = np.where(is_long, raw["depth"] * 0.1, np.nan)
    for name in ("pitch", "roll", "heading"):
        out[name] = np.where(is_long, raw[name] * 0.01 * DEG, np.nan)
    return out


# Mean bytes of a record: what a count of records in a sample is worth.
_PD4_BYTES = 47.0

FORMATS = (
    Format(
        "pd4",
        "dvl",
        "Teledyne PD4, PD5",
        share_of_records(read_pd4, _PD4_BYTES),
        partial(read_pings, read_pd4, "day", "RFU"),
        "files written after the manufacturer's tables",
        (".pd4", ".pd5"),
    ),
)
