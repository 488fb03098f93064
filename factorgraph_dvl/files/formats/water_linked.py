"""Water Linked DVLs: JSON lines, and `wrz`, `wru`, `wrp` of the serial protocol.

Source: Water Linked's published DVL protocol, 2.4 and json_v3, with its examples. Axes are
X forward, Y starboard, Z down of the DVL, turned by its own mounting offset; velocities are
those of the DVL over the bottom.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.format import Batch, Format, left_out, positive
from factorgraph_dvl.files.formats.framing import BLOCK, Records, Source, lines, map_file, number
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.velocities import (
    INSTRUMENT,
    pings,
    records,
    share_of_records,
)
from factorgraph_dvl.geometry.units import DEG

POSITION = np.dtype(
    [("at", "i8"), *((name, "f8") for name in ("time", "x", "y", "z", "std"))]
    + [(name, "f8") for name in ("roll", "pitch", "yaw")]
)
_SERIAL = re.compile(rb"w(r[zxup]),([ -)+-~]{1,400})\*([0-9a-f]{2})")
Row = dict[str, Any]


def read_water_linked(
    source: Source, block: int = BLOCK, losses: Losses | None = None
) -> Iterator[tuple[Records, Records]]:
    """Read velocity and position reports.

    Parameters
    ----------
    source : Source
        The file, of either protocol.
    block : int
        Number of reports at a time.
    losses : Losses, optional
        Takes counts of what was left out.

    Yields
    ------
    (N,) of `VELOCITY` and (M,) of `POSITION`, dead reckoning by the DVL itself, m and rad.
    `time`: of validity, nan in old versions, which have `second`, the sum of the times
    since the report before.
    """
    losses = Losses() if losses is None else losses
    velocities: list[Row] = []
    positions: list[tuple[float, ...]] = []
    elapsed = 0.0
    for at, line in lines(source):
        row: Row | None = None
        start = line.find(b"{")
        if start >= 0:
            message = _object(line[start:])
            if not message:
                losses.add("line of damaged JSON", at + start)
            if message.get("type") == "position_local":
                positions.append((at + start, *_json_position(message)))
            elif "vx" in message and "velocity_valid" in message:
                row = _json_velocity(message)
        elif match := _SERIAL.search(line):
            start = match.start()
            if crc8(line[start : match.end() - 3]) != int(match[3], 16):
                losses.add("report with a wrong checksum", at + start)
                continue
            fields = match[2].split(b",")
            if match[1] == b"rp" and len(fields) >= 9:
                positions.append((at + start, *_serial_position(fields)))
            elif match[1] == b"ru" and len(fields) >= 3 and velocities:
                _serial_beam(velocities[-1], fields)
            elif match[1] == b"rz" and len(fields) >= 11:
                row = _serial_velocity(fields)
            elif match[1] == b"rx" and len(fields) >= 8:
                row = _old_velocity(fields)
        if row is not None:
            step = row.pop("step")
            elapsed += step if 0.0 <= step < 3600.0 else 0.0
            if len(velocities) + len(positions) >= block:
                yield _blocks(velocities, positions)
                velocities, positions = [], []
            velocities.append({**row, "at": at + start, "second": elapsed})
    yield _blocks(velocities, positions)


def _crc8_of_byte(value: int) -> int:
    for _ in range(8):
        value = (value << 1 ^ (0x07 if value & 0x80 else 0)) & 0xFF
    return value


_TABLE = [_crc8_of_byte(byte) for byte in range(256)]


def crc8(data: bytes) -> int:
    """Return the checksum of the serial protocol: CRC-8, polynomial 7, from 0."""
    value = 0
    for byte in data:
        value = _TABLE[byte ^ value]
    return value


def _blocks(velocities: list[Row], positions: list[tuple[float, ...]]) -> tuple[Records, Records]:
    return records(velocities, INSTRUMENT), np.array(positions, POSITION)


def _object(text: bytes) -> Row:
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return message if isinstance(message, dict) else {}


def _value(message: Row, name: str) -> float:
    value = message.get(name)
    if not isinstance(value, int | float) or isinstance(value, bool):
        return math.nan
    # Times in microseconds are the largest; a wider integer has no float.
    return float(value) if abs(value) < 1e18 else math.nan


def _json_velocity(message: Row) -> Row:
    good = message["velocity_valid"] is True
    beams = np.full((2, 4), np.nan)
    transducers = message.get("transducers")
    for beam in transducers if isinstance(transducers, list) else []:
        index = beam.get("id") if isinstance(beam, dict) else None
        is_beam = type(index) is int and 0 <= index < 4
        if is_beam and beam.get("beam_valid", True) is True:
            beams[:, index] = _value(beam, "velocity"), _value(beam, "distance")
    velocity = np.array([_value(message, name) for name in ("vx", "vy", "vz")])
    altitude = _value(message, "altitude")
    return {
        "time": _value(message, "time_of_validity") * 1e-6,
        "step": _value(message, "time") * 1e-3,
        "velocity": velocity if good else np.full(3, np.nan),
        "beam_velocity": beams[0],
        "range": positive(beams[1]),
        "altitude": altitude if good and altitude > 0.0 else math.nan,
        "merit": _value(message, "fom"),
    }


def _json_position(message: Row) -> tuple[float, ...]:
    place = [_value(message, name) for name in ("ts", "x", "y", "z", "std")]
    return (*place, *(_value(message, name) * DEG for name in ("roll", "pitch", "yaw")))


def _serial_velocity(fields: list[bytes]) -> Row:
    good = fields[3] == b"y"
    velocity = np.array([number(field) for field in fields[:3]])
    altitude = number(fields[4])
    return {
        "time": number(fields[7]) * 1e-6,
        "step": number(fields[9]) * 1e-3,
        "velocity": velocity if good else np.full(3, np.nan),
        "beam_velocity": np.full(4, np.nan),
        "range": np.full(4, np.nan),
        "altitude": altitude if good and altitude > 0.0 else math.nan,
        "merit": number(fields[5]),
    }


def _serial_beam(row: Row, fields: list[bytes]) -> None:
    index, distance = number(fields[0]), number(fields[2])
    if index in (0.0, 1.0, 2.0, 3.0) and distance > 0.0:
        row["beam_velocity"][int(index)] = number(fields[1])
        row["range"][int(index)] = distance


def _old_velocity(fields: list[bytes]) -> Row:
    good = fields[6] == b"y"
    velocity = np.array([number(field) for field in fields[1:4]])
    return {
        "step": number(fields[0]) * 1e-3,
        "velocity": velocity if good else np.full(3, np.nan),
        "beam_velocity": np.full(4, np.nan),
        "range": np.full(4, np.nan),
        "altitude": number(fields[5]) if good else math.nan,
        "merit": number(fields[4]),
    }


def _serial_position(fields: list[bytes]) -> tuple[float, ...]:
    place = [number(field) for field in fields[:5]]
    return (*place, *(number(field) * DEG for field in fields[5:8]))


def _read_water_linked(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    losses = Losses()
    for velocities, _ in read_water_linked(map_file(path), losses=losses):
        if len(velocities):
            yield pings(velocities, "own", "FRD", "")
    yield left_out(losses)


# Mean bytes of a record: what a count of records in a sample is worth.
_WATER_LINKED_BYTES = 60.0

FORMATS = (
    Format(
        "water-linked",
        "dvl",
        "Water Linked JSON, `wrz`, `wru`, `wrp`",
        share_of_records(read_water_linked, _WATER_LINKED_BYTES),
        _read_water_linked,
        "the document's examples",
        (".json", ".jsonl"),
        in_text=True,
    ),
)
