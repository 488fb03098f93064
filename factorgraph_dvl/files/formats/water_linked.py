"""Water Linked DVLs: JSON, by lines or as an array, and the serial `wrz`, `wrs`, `wru`, `wrp`.

Source: Water Linked's published DVL protocol, serial 2.1 to 2.7 and json_v2 to json_v4.1, with its
examples. Axes are X forward, Y starboard, Z down of the DVL, turned by its own mounting offset;
velocities are those of the DVL over the bottom, or through the water where it tracks that.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.clocks import seconds_of
from factorgraph_dvl.files.formats.format import Batch, Format, left_out, positive
from factorgraph_dvl.files.formats.framing import (
    BLOCK,
    LONGEST_LINE,
    Records,
    Source,
    map_file,
    number,
)
from factorgraph_dvl.files.formats.losses import UNKNOWN_TYPE, Losses
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
_SERIAL = re.compile(rb"w(r[a-z?!])(?:,([ -)+-~]{1,400}))?\*([0-9a-f]{2})")
_UNUSABLE = "too few fields, or no report before it"
_BRACE, _ARRAY = re.compile(rb"[{}]"), re.compile(rb"\s*\[\s*\{")
# Bytes of a report, some times what one has, and how deep its objects are nested.
_LONGEST_REPORT, _DEEPEST = 1 << 14, 2
# Fields that a report has at least.
_FIELDS = {b"rz": 11, b"rs": 10, b"rx": 8, b"ru": 3, b"rp": 9}
_OFFSET = (
    "mounting_rotation_offset was {:g}° in the DVL: its velocities are turned by it already, and "
    "the misalignment is what is left"
)
# Stamps of computers, s: from 2001 to 2096.
_EARLIEST, _LATEST = 1e9, 4e9
Row = dict[str, Any]


def read_water_linked(
    source: Source, block: int = BLOCK, losses: Losses | None = None
) -> Iterator[tuple[Records, Records, Records, tuple[str, ...]]]:
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
    (N,) and (K,) of `VELOCITY`, over the bottom and through the water, (M,) of `POSITION`, dead
    reckoning by the DVL itself, m and rad, and what its configuration says. `time`: of validity.
    Old versions do not have it: then the stamp of a computer before the report, or nan, and
    `second`, the sum of the times since the report before.
    """
    losses = Losses() if losses is None else losses
    velocities: list[Row] = []
    positions: list[tuple[float, ...]] = []
    notes: tuple[str, ...] = ()
    elapsed = 0.0
    for at, line in _reports(source):
        row: Row | None = None
        start = line.find(b"{")
        if start >= 0:
            message = _object(line[start:])
            if not message:
                losses.add("line of damaged JSON", at + start)
            if message.get("type") == "position_local":
                positions.append((at + start, *_json_position(message)))
                losses.skip("position_local", UNKNOWN_TYPE)
            elif "vx" in message and "velocity_valid" in message:
                row = velocity_of(message)
            elif message:
                notes += _configuration(message.get("result"))
                losses.skip(str(message.get("type", "other JSON"))[:40], UNKNOWN_TYPE)
        elif match := _SERIAL.search(line):
            start = match.start()
            if crc8(line[start : match.end() - 3]) != int(match[3], 16):
                losses.add("report with a wrong checksum", at + start)
                continue
            name, fields = match[1], (match[2] or b"").split(b",")
            if name not in _FIELDS:
                if name == b"rc" and len(fields) >= 2:
                    notes += _configuration({_SETTING: number(fields[1])})
                losses.skip("w" + name.decode(), UNKNOWN_TYPE)
            elif len(fields) < _FIELDS[name] or (name == b"ru" and not velocities):
                losses.skip("w" + name.decode(), _UNUSABLE)
            elif name == b"rp":
                positions.append((at + start, *_serial_position(fields)))
                losses.skip("wrp", UNKNOWN_TYPE)
            elif name == b"ru":
                _serial_beam(velocities[-1], fields)
                losses.use("wru")
            else:
                row = _old_velocity(fields) if name == b"rx" else _serial_velocity(name, fields)
        if row is not None:
            if not math.isfinite(row.get("time", math.nan)):
                row["time"] = _received(line[:start])
            step = row.pop("step")
            elapsed += step if 0.0 <= step < 3600.0 else 0.0
            if len(velocities) + len(positions) >= block:
                yield *_blocks(velocities, positions), notes
                velocities, positions, notes = [], [], ()
            velocities.append({**row, "at": at + start, "second": elapsed})
    yield *_blocks(velocities, positions), notes


def _reports(source: Source) -> Iterator[tuple[int, bytes]]:
    """Yield lines, and objects that stand on several lines, as the maker's tools write them.

    Such an object begins with a brace that ends its line; a brace as far to the left begins the
    next one, whatever became of this one.
    """
    begin, depth, margin, gathered = 0, 0, 0, b""
    for at, line in _lines(source):
        if not depth and not line.rstrip().endswith(b"{"):
            yield at, line
            continue
        start, indent = 0, len(line) - len(line.lstrip())
        if depth and indent <= margin:
            if line.lstrip().startswith(b"{"):
                yield begin, gathered
                depth = 0
            elif not line.lstrip().startswith(b"}"):
                # Its own lines are no farther to the right: the margin says nothing.
                margin = -1
        for brace in _BRACE.finditer(line):
            if brace[0] == b"{":
                if not depth:
                    start, margin, gathered = brace.start(), indent, b""
                    begin = at + start
                depth += 1
            elif depth:
                depth -= 1
                if not depth:
                    yield begin, gathered + line[start : brace.end()]
        if depth:
            gathered += line[start:]
            if len(gathered) > _LONGEST_REPORT:
                yield begin, gathered
                depth = 0
    if depth:
        yield begin, gathered


def _received(before: bytes) -> float:
    """Return the stamp that a computer wrote before a report, s since 1970, nan without one."""
    stamp = seconds_of(before.strip(b" \t,;[]()>"))
    return stamp if _EARLIEST < stamp < _LATEST else math.nan


def _lines(source: Source) -> Iterator[tuple[int, bytes]]:
    """Yield lines, and the objects of an array that stands on one line."""
    start, size = 0, len(source)
    while start < size:
        stop = source.find(b"\n", start)
        stop = size if stop < 0 else stop
        closed = source.find(b"}", start, stop)
        if closed >= 0 and _ARRAY.match(source[start : start + _LONGEST_REPORT]):
            yield from _objects(source, start, stop)
        elif stop - start <= LONGEST_LINE:
            yield start, source[start:stop].rstrip(b"\r")
        start = stop + 1


def _objects(source: Source, start: int, stop: int) -> Iterator[tuple[int, bytes]]:
    """Yield the objects between two positions, and what is left of damaged ones."""
    depth, first = 0, start
    for begin in range(start, stop, LONGEST_LINE):
        for brace in _BRACE.finditer(source[begin : min(begin + LONGEST_LINE, stop)]):
            place = begin + brace.start()
            is_open = brace[0] == b"{"
            if depth and ((is_open and depth >= _DEEPEST) or place - first >= _LONGEST_REPORT):
                yield first, source[first : min(place, first + _LONGEST_REPORT)]
                depth = 0
            if is_open:
                first = first if depth else place
                depth += 1
            elif depth:
                depth -= 1
                if not depth:
                    yield first, source[first : place + 1]
    if depth:
        yield first, source[first : min(stop, first + _LONGEST_REPORT)]


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


_SETTING = "mounting_rotation_offset"


def _configuration(settings: object) -> tuple[str, ...]:
    """Return what is said of the settings of the DVL, if they turn its velocities."""
    offset = _value(settings, _SETTING) if isinstance(settings, dict) else math.nan
    return (_OFFSET.format(offset),) if offset != 0.0 and math.isfinite(offset) else ()


def _blocks(
    velocities: list[Row], positions: list[tuple[float, ...]]
) -> tuple[Records, Records, Records]:
    return *by_track(velocities), np.array(positions, POSITION)


def by_track(rows: list[Row]) -> tuple[Records, Records]:
    """Return the velocities of rows over the bottom, and those through the water."""
    water = np.array([row.pop("water") for row in rows], bool)
    found = records(rows, INSTRUMENT)
    return found[~water], found[water]


def batches_of(bottom: Records, water: Records, *notes: str) -> Iterator[Batch]:
    """Yield velocities over the bottom and through the water in common terms."""
    if len(bottom):
        yield replace(pings(bottom, "own", "FRD", ""), notes=notes)
    if len(water):
        yield replace(pings(water, "own", "FRD", "water"), kind="water", notes=notes)


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


def velocity_of(message: Row) -> Row:
    """Return the velocity of a report of the JSON protocol, and the `step` since the last one."""
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
        "water": message.get("type") == "velocity_water"
        or message.get("tracking_mode") == "water",
    }


def _json_position(message: Row) -> tuple[float, ...]:
    place = [_value(message, name) for name in ("ts", "x", "y", "z", "std")]
    return (*place, *(_value(message, name) * DEG for name in ("roll", "pitch", "yaw")))


def _serial_velocity(name: bytes, fields: list[bytes]) -> Row:
    """Convert `wrz`, or `wrs`, whose velocity is through the water and which has no altitude."""
    if water := name == b"rs":
        fields = [*fields[:4], b"", *fields[4:]]
    good = fields[3] == b"y"
    velocity = np.array([number(field) for field in fields[:3]])
    altitude = number(fields[4])
    return {
        "water": water,
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
        "water": False,
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
    for bottom, water, _, notes in read_water_linked(map_file(path), losses=losses):
        yield from batches_of(bottom, water, *notes)
    yield left_out(losses)


# Mean bytes of a record: what a count of records in a sample is worth.
_WATER_LINKED_BYTES = 60.0

FORMATS = (
    Format(
        "water-linked",
        "dvl",
        "Water Linked JSON, `wrz`, `wrs`, `wru`, `wrp`",
        share_of_records(read_water_linked, _WATER_LINKED_BYTES),
        _read_water_linked,
        "JSON: a recording of an A50 without lock, counts by a search of its "
        "text; `wrz`, `wrs`, `wru`, `wrp` by their document only",
        (".json", ".jsonl"),
        in_text=True,
    ),
)
