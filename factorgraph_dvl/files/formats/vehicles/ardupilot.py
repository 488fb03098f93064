"""ArduPilot logs (`.BIN`), through pymavlink.

Source: ArduPilot, Onboard Message Log Messages. Bodies are forward, right, down. Times are
microseconds since the start, which GPS messages relate to UTC.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats.clocks import gps_to_utc
from factorgraph_dvl.files.formats.format import Batch, Format, empty, left_out, positive
from factorgraph_dvl.files.formats.framing import BLOCK, Source, map_file
from factorgraph_dvl.files.formats.losses import UNKNOWN_TYPE, Losses
from factorgraph_dvl.files.formats.vehicles.library import (
    FIRST_WEEK,
    Row,
    column,
    columns,
    gga_quality,
    given_up,
    load,
    locate,
    movements,
    quiet,
    silently,
    started,
    unreadable,
)
from factorgraph_dvl.geometry.units import DEG, MICROSECOND

_SYNC = b"\xa3\x95"
# The message that defines others: its type, length, and the sizes of columns by their letter.
_FMT, _FMT_LENGTH = 128, 89
_SIZES = {"a": 64, "b": 1, "B": 1, "g": 2, "h": 2, "H": 2, "i": 4, "I": 4, "f": 4, "d": 8}
_SIZES |= {
    "n": 4,
    "N": 16,
    "Z": 64,
    "c": 2,
    "C": 2,
    "e": 4,
    "E": 4,
    "L": 4,
    "M": 1,
    "q": 8,
    "Q": 8,
}
# Parameter by which the autopilot turns movements before it logs them.
_ORIENT = "VISO_ORIENT"
_TURNED = (
    "VISO_ORIENT was {:g}: the movements are turned by it already, and the misalignment is what "
    "is left"
)


def share(path: Path, sample: bytes) -> float:
    """Return whether a sample starts as a log does, with the definition of definitions."""
    return float(
        not path.is_dir() and sample.startswith(_SYNC + bytes([_FMT])) and b"FMT\0" in sample[:16]
    )


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read the messages IMU, GPS with GPA, ATT and VISO, and the parameter VISO_ORIENT.

    Parameters, result and errors are those of `Format.read`.
    """
    library = load("pymavlink.DFReader", "ardupilot")
    source = map_file(path)
    spans = _whole(source)
    damaged = len(source) - sum(stop - start for start, stop in spans)
    with TemporaryDirectory() as folder:
        readable = path
        if damaged and spans:
            # The library ends at the first bytes that are no message.
            readable = Path(folder) / "whole.bin"
            with readable.open("wb") as file:
                file.writelines(source[start:stop] for start, stop in spans)
        try:
            if not spans:
                raise ValueError("no message with a definition")
            with quiet():
                log = library.DFReader_binary(str(readable), zero_time_base=True)
        except Exception as error:  # Of any type: the library does not foresee all damage.
            raise unreadable(path, error, "a binary log of ArduPilot") from None
        try:
            note = f"{path.name}: {damaged} bytes are in no message" if damaged else ""
            yield from _batches(path, log, note)
            yield left_out(_passed_over(log))
        finally:
            log.close()


def _passed_over(log: Any) -> Losses:
    """Count the messages of types that are not read here, by the index of the library."""
    losses = Losses()
    for number, count in enumerate(log.counts):
        name = log.id_to_name.get(number, str(number))
        if name in _HELPERS:
            losses.use(name, int(count))
        elif name not in _CONVERTERS:
            losses.skip(name, UNKNOWN_TYPE, int(count))
    return losses


def _whole(source: Source) -> list[tuple[int, int]]:
    """Return starts and stops of stretches of messages whose definition came before."""
    lengths = {_FMT: _FMT_LENGTH}
    spans: list[tuple[int, int]] = []
    at = start = 0
    size = len(source)
    while 0 <= at < size:
        head = source[at : at + 3]
        length = lengths.get(head[2], 0) if head[:2] == _SYNC and len(head) == 3 else 0
        is_whole = 0 < length <= size - at
        if is_whole and head[2] == _FMT:
            defined, length_of = _definition(source[at : at + _FMT_LENGTH])
            # A second definition must be that of the first.
            is_whole = length_of > 0 and lengths.setdefault(defined, length_of) == length_of
        if is_whole:
            at += length
            continue
        if at > start:
            spans.append((start, at))
        # A message behind damage counts if another one, or the end, follows it.
        at = source.find(_SYNC, at + 1)
        while 0 <= at < size - 2:
            stop = at + lengths.get(source[at + 2], size)
            if source[stop : stop + 2] == _SYNC or stop == size:
                break
            at = source.find(_SYNC, at + 1)
        start = at if 0 <= at < size - 2 else size
        at = start
    if at > start:
        spans.append((start, at))
    return spans


def _definition(message: bytes) -> tuple[int, int]:
    """Return type and length of the messages that a definition is for; length 0 if it is none."""
    columns = message[25:89].rstrip(b"\0")
    form = message[9:25].rstrip(b"\0").decode("latin-1")
    length = 3 + sum(_SIZES.get(letter, 1 << 16) for letter in form)
    is_one = length == message[4] and len(form) == len(columns.split(b",")) and columns.isascii()
    return message[3], length if is_one and message[5:9].rstrip(b"\0").isalnum() else 0


def _batches(path: Path, log: Any, note: str) -> Iterator[Batch]:
    gathered: dict[str, list[Row]] = {}
    accuracy: dict[str, Row] = {}
    notes: dict[str, None] = {}
    count = 0
    while True:
        try:
            with quiet():
                rows = [row for _ in range(BLOCK) if (row := _next(log)) is not None]
        except Exception as error:  # What was read until here is whole.
            rows, note = [], given_up(path, error, count)
        for row in rows:
            row["at"] = count
            count += 1
            name, instance = row["mavpackettype"], row.get("I", 0)
            if name == "GPA":
                accuracy[str(instance)] = row
                continue
            if name == "PARM":
                if row.get("Name") == _ORIENT and row.get("Value", 0.0) != 0.0:
                    notes[_TURNED.format(row["Value"])] = None
                continue
            if name == "GPS":
                row["accuracy"] = accuracy.get(str(instance), {})
            gathered.setdefault(f"{name}[{instance}]", []).append(row)
        for stream, part in gathered.items():
            if part:
                convert = _CONVERTERS[part[0]["mavpackettype"]]
                yield from silently(map(convert, [stream], [part]))
                gathered[stream] = []
        if len(rows) < BLOCK:
            break
    if not count:
        raise DataError(note or "has no messages", where=path.name, expected="a log of ArduPilot")
    yield replace(left_out(Losses()), notes=(*notes, *filter(None, [note])))


def _next(log: Any) -> Row | None:
    message = log.recv_match(type=[*_CONVERTERS, *_HELPERS], strict=True)
    return None if message is None else message.to_dict()


def _time(rows: list[Row]) -> dict[str, Any]:
    return {"at": column(rows, "at"), "time": column(rows, "TimeUS") * MICROSECOND}


def _imu(stream: str, rows: list[Row]) -> Batch:
    out = started(empty("imu", len(rows)), **_time(rows))
    out["gyro"] = columns(rows, "GyrX", "GyrY", "GyrZ")
    out["accel"] = columns(rows, "AccX", "AccY", "AccZ")
    return Batch("imu", out, "own", stream, "FRD")


def _attitude(stream: str, rows: list[Row]) -> Batch:
    out = started(empty("attitude", len(rows)), **_time(rows))
    rph = columns(rows, "Roll", "Pitch", "Yaw") * DEG
    out["roll"], out["pitch"], out["heading"] = rph.T
    note = "ATT: the filter of the autopilot; whether its compass is true depends on its setup"
    return Batch("attitude", out, "own", stream, "FRD", notes=(note,))


def _fix(stream: str, rows: list[Row]) -> Batch:
    out = started(empty("fix", len(rows)), **_time(rows))
    week = column(rows, "GWk")
    utc = gps_to_utc(week, column(rows, "GMS") * 1e-3)
    out["time"] = np.where(week >= FIRST_WEEK, utc, np.nan)
    locate(out, column(rows, "Lat"), column(rows, "Lng"), gga_quality(column(rows, "Status")))
    out["altitude"] = column(rows, "Alt")
    accuracy = [row["accuracy"] for row in rows]
    out["height"] = out["altitude"] + column(accuracy, "Und")
    speed, course = column(rows, "Spd"), column(rows, "GCrs") * DEG
    up = -column(rows, "VZ")
    out["velocity"] = np.stack([speed * np.sin(course), speed * np.cos(course), up], axis=1)
    out["std"] = positive(columns(accuracy, "HAcc", "HAcc", "VAcc"))
    out["velocity_std"] = positive(columns(accuracy, "SAcc", "SAcc", "SAcc"))
    return Batch("fix", out, "utc", stream)


def _odometry(stream: str, rows: list[Row]) -> Batch:
    """`VISO`, as which vehicles under water log their DVL: movements over intervals."""
    out = started(empty("dvl", len(rows)), **_time(rows))
    # ArduPilot takes seconds here and microseconds in the MAVLink message that it comes from.
    return movements(out, columns(rows, "PosDX", "PosDY", "PosDZ"), column(rows, "dt"), stream)


# Messages that are read for the sake of others.
_HELPERS = ("GPA", "PARM")
_CONVERTERS = {"IMU": _imu, "ATT": _attitude, "GPS": _fix, "VISO": _odometry}

FORMAT = Format(
    name="ardupilot",
    family="vehicle",
    title="ArduPilot .BIN",
    share=share,
    read=read,
    verified=(
        "`IMU`, `ATT`: a recording of ArduSub, counts by type by pymavlink; "
        "`GPS`, `VISO` by their document only"
    ),
    endings=(".bin",),
    module="pymavlink",
    extra="ardupilot",
    limit="pymavlink keeps 8 bytes for each message of the log in memory",
)
