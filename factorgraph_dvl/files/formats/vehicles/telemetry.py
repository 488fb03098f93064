"""Telemetry logs (`.tlog`) of ground stations: MAVLink messages, through pymavlink.

Source: MAVLink, packet serialisation, and the messages of `common.xml` and `ardupilotmega.xml`.
Before each message stands the time at the ground station, microseconds since 1970. Most messages
say how long their sender had been running: with the least delay in between, that is a better time.
Bodies are forward, right, down.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from factorgraph_dvl.files.formats.clocks import gps_to_utc
from factorgraph_dvl.files.formats.format import (
    Batch,
    Format,
    empty,
    left_out,
    positive,
    type_name,
)
from factorgraph_dvl.files.formats.framing import BLOCK, Source, map_file
from factorgraph_dvl.files.formats.losses import NO_TIME, REPEATED, UNKNOWN_TYPE, Losses
from factorgraph_dvl.files.formats.vehicles.library import (
    FIRST_WEEK,
    Row,
    column,
    columns,
    gga_quality,
    load,
    locate,
    movements,
    silently,
    started,
)
from factorgraph_dvl.geometry.units import DEG, MICROSECOND, STANDARD_GRAVITY

_LIBRARY = "pymavlink.dialects.v20.ardupilotmega"
# Of a stamp; of both versions of MAVLink: the first byte, bytes before the content, and where its
# length stands.
_STAMP = 8
_VERSION_1, _VERSION_2 = 0xFE, 0xFD
_HEADS = {_VERSION_1: 6, _VERSION_2: 10}
_CHECKSUM, _SIGNATURE = 2, 13
# The byte of each byte with its bits in reverse order: the checksum of MAVLink takes them so.
_REVERSED = bytes(int(f"{i:08b}"[::-1], 2) for i in range(256))
# Stamps of ground stations, s: from 2001 to 2096.
_EARLIEST, _LATEST = 1e9, 4e9
# Stamps of messages below this are since the start of the sender, s.
_SINCE_START = 1e8
# A clock that goes back by this much started anew, s.
_RESTART = 1.0
# Bits of `ignore_flags`: altitude, velocity over ground and vertical, and standard deviations.
_NO_ALTITUDE, _NO_SPEED, _NO_CLIMB, _NO_SPEED_STD, _NO_STD, _NO_VERTICAL_STD = (
    1,
    8,
    16,
    32,
    64,
    128,
)
_UNKNOWN_16 = 65535.0
# Of the air at sea level, and of a metre of water to 1 %, hPa.
_AIR, _METRE = 1013.25, 100.0
_GPS_INPUT, _GPS_RAW = "GPS_INPUT", "GPS_RAW_INT"
_REPEATED = "GPS_RAW_INT was left out: it repeats GPS_INPUT"
_ESTIMATE = (
    "GLOBAL_POSITION_INT: the filter of the autopilot, which may rest on the DVL; used if there "
    "are no other positions"
)
_DEPTH = "{}: depth from pressure, 1013.25 hPa at the surface and 100 hPa for a metre"
_ATTITUDE = (
    "ATTITUDE: the filter of the autopilot; whether its compass is true depends on its setup"
)
_IMU = "{}: taken as milli-g and mrad/s, as ArduPilot sends it"


class Frame(NamedTuple):
    """A message as it stands in the file.

    Parameters
    ----------
    at, stop : int
        Positions of its stamp, and behind its end.
    stamp : float, s
        Stamp at the ground station, since 1970.
    kind : int
        Number of its type.
    sender : tuple of int
        System and component.
    content : bytes
        Content without header and checksum.
    """

    at: int
    stop: int
    stamp: float
    kind: int
    sender: tuple[int, int]
    content: bytes


def share(path: Path, sample: bytes) -> float:
    """Return the share of a sample's first bytes that lies in messages with their stamps."""
    if path.is_dir() or not sample:
        return 0.0
    start = sample[: 1 << 14]
    return sum(f.stop - f.at for f in islice(_frames(start, {}, Losses()), BLOCK)) / len(start)


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read the messages in `_CONVERTERS`; others are passed over.

    Parameters, result and errors are those of `Format.read`.
    """
    library = load(_LIBRARY, "ardupilot")
    decoder = library.MAVLink(None)
    source = map_file(path)
    types = library.mavlink_map
    seeds = {kind: message.crc_extra for kind, message in types.items()}
    names = {kind: message.msgname for kind, message in types.items()}
    clocks, repeats = _clocks(source, seeds, names)
    gathered: dict[str, list[Row]] = {}
    losses, waiting = Losses(), 0
    for frame in _frames(source, seeds, losses):
        own = clocks.of(frame)
        name = names.get(frame.kind, f"message {frame.kind}")
        is_repeat = repeats and name == _GPS_RAW
        if name not in _CONVERTERS or is_repeat:
            losses.skip(name, REPEATED if is_repeat else UNKNOWN_TYPE)
            continue
        try:
            row: Row = decoder.decode(bytearray(source[frame.at + _STAMP : frame.stop])).to_dict()
        except Exception:  # Of any type: the library does not foresee all damage.
            losses.add("message that cannot be decoded", frame.at)
            continue
        row |= {"at": frame.at, "received": frame.stamp, "stamp": own}
        gathered.setdefault(f"{name} {frame.sender[0]}:{frame.sender[1]}", []).append(row)
        waiting += 1
        if waiting >= BLOCK:
            yield from _converted(gathered)
            gathered, waiting = {}, 0
    yield from _converted(gathered)
    notes = (_REPEATED,) if repeats and _GPS_RAW in losses.skipped else ()
    yield replace(left_out(losses), notes=notes)


def _converted(gathered: Mapping[str, list[Row]]) -> Iterator[Batch]:
    for stream, rows in gathered.items():
        yield from silently(_CONVERTERS[stream.partition(" ")[0]](stream, rows))


def _frames(source: Source, seeds: Mapping[int, int], losses: Losses) -> Iterator[Frame]:
    """Find messages; a type without a seed of the checksum counts if another message follows."""
    at, free, size = 0, 0, len(source)
    while at + _STAMP < size:
        frame = _frame_at(source, at)
        if frame is None:
            at = _next_start(source, at + 1)
            continue
        losses.add("byte outside records", free, at - free)
        seed = seeds.get(frame.kind)
        if seed is None or _is_whole(source, frame, seed):
            yield frame
        else:
            losses.add("message with a wrong checksum", at)
        at = free = frame.stop
    losses.add("byte outside records", free, size - free)


def _next_start(source: Source, at: int) -> int:
    """Return the next position at which a message may stand behind a stamp."""
    found = [source.find(bytes([first]), at + _STAMP) for first in _HEADS]
    return min((place for place in found if place >= 0), default=len(source) + _STAMP) - _STAMP


def _frame_at(source: Source, at: int) -> Frame | None:
    """Return the message whose stamp stands here, None without another one or the end behind."""
    head = source[at : at + _STAMP + 10]
    stop = at + _length(head)
    if stop == at or stop > len(source):
        return None
    if stop < len(source) and not _length(source[stop : stop + _STAMP + 10]):
        return None
    first = _HEADS[head[_STAMP]]
    message = head[_STAMP:]
    if message[0] == _VERSION_1:
        sender, kind = (message[3], message[4]), message[5]
    else:
        sender, kind = (message[5], message[6]), int.from_bytes(message[7:10], "little")
    begin = at + _STAMP + first
    content = bytes(source[begin : begin + message[1]])
    return Frame(at, stop, _stamp(head), kind, sender, content)


def _length(head: bytes) -> int:
    """Return the length of stamp and message, by their first bytes; 0 if these are none."""
    if len(head) < _STAMP + 6 or head[_STAMP] not in _HEADS:
        return 0
    if not _EARLIEST < _stamp(head) < _LATEST:
        return 0
    signed = head[_STAMP] == _VERSION_2 and head[_STAMP + 2] & 1
    length = _STAMP + _HEADS[head[_STAMP]] + head[_STAMP + 1] + _CHECKSUM
    return length + _SIGNATURE * signed


def _stamp(head: bytes) -> float:
    return int.from_bytes(head[:_STAMP], "big") * MICROSECOND


def _is_whole(source: Source, frame: Frame, seed: int) -> bool:
    """Return whether the checksum of a message is right."""
    first = frame.at + _STAMP
    stop = first + _HEADS[source[first]] + len(frame.content)
    # CRC-16/MCRF4XX is that of `binascii` with the bits of all bytes, and its own, reversed.
    summed = bytes(source[first + 1 : stop]) + bytes([seed])
    found = crc_hqx(summed.translate(_REVERSED), 0xFFFF).to_bytes(2, "big")
    return found.translate(_REVERSED) == source[stop : stop + _CHECKSUM]


class _Clocks:
    """Clocks of senders against that of the ground station, by the least delay of a message."""

    def __init__(self) -> None:
        self._last: dict[tuple[int, int], tuple[float, int]] = {}
        self.offsets: dict[tuple[int, int, int], float] = {}

    def key(self, frame: Frame) -> tuple[float, tuple[int, int, int]]:
        """Return the own stamp of a message, s, and which clock it is from: one of each start."""
        own = _own_stamp(frame)
        last, starts = self._last.get(frame.sender, (own, 0))
        if own < last - _RESTART:
            starts += 1
        self._last[frame.sender] = (own, starts)
        return own, (*frame.sender, starts)

    def add(self, frame: Frame) -> None:
        """Take a message into account."""
        own, key = self.key(frame)
        self.offsets[key] = min(self.offsets.get(key, np.inf), frame.stamp - own)

    def of(self, frame: Frame) -> float:
        """Return the own time of a message on the clock of the ground station, nan without."""
        if _LAYOUT.get(frame.kind) is None or not 0.0 < _own_stamp(frame) < _SINCE_START:
            return np.nan
        own, key = self.key(frame)
        return own + self.offsets[key]

    def again(self) -> _Clocks:
        """Start from the first message again."""
        self._last = {}
        return self


def _own_stamp(frame: Frame) -> float:
    """Return the stamp of a message, s, which its content begins with; 0 if it has none."""
    size, unit = _LAYOUT[frame.kind]
    # Zeros at the end of a content are not sent.
    return int.from_bytes(frame.content[:size], "little") * unit


def _clocks(
    source: Source, seeds: Mapping[int, int], names: Mapping[int, str]
) -> tuple[_Clocks, bool]:
    """Return the clocks of all senders, and whether GPS_RAW_INT repeats GPS_INPUT."""
    clocks, repeats = _Clocks(), False
    for frame in _frames(source, seeds, Losses()):
        repeats |= names.get(frame.kind) == _GPS_INPUT
        if frame.kind in _LAYOUT and 0.0 < _own_stamp(frame) < _SINCE_START:
            clocks.add(frame)
    return clocks.again(), repeats


def _time(rows: list[Row]) -> dict[str, Any]:
    own, received = column(rows, "stamp"), column(rows, "received")
    time = np.where(np.isfinite(own), own, received)
    return {"at": column(rows, "at"), "time": time, "received": time}


def _imu(stream: str, rows: list[Row]) -> Iterator[Batch]:
    out = started(empty("imu", len(rows)), **_time(rows))
    gyro, accel = columns(rows, "xgyro", "ygyro", "zgyro"), columns(rows, "xacc", "yacc", "zacc")
    # An IMU that is not there sends zeros; one that is there weighs itself.
    there = (accel != 0.0).any(axis=1)[:, None]
    out["gyro"] = np.where(there, gyro * 1e-3, np.nan)
    out["accel"] = np.where(there, accel * 1e-3 * STANDARD_GRAVITY, np.nan)
    note = _IMU.format(stream)
    yield Batch("imu", out, "own", stream, "FRD", notes=(note,))


def _attitude(stream: str, rows: list[Row]) -> Iterator[Batch]:
    out = started(empty("attitude", len(rows)), **_time(rows))
    for name, source in (("roll", "roll"), ("pitch", "pitch"), ("heading", "yaw")):
        out[name] = column(rows, source)
    out["heading"] %= 2.0 * np.pi
    yield Batch("attitude", out, "own", stream, "FRD", notes=(_ATTITUDE,))


def _receiver(stream: str, rows: list[Row]) -> Iterator[Batch]:
    """Convert `GPS_RAW_INT`."""
    out = started(empty("fix", len(rows)), **_time(rows))
    quality = gga_quality(column(rows, "fix_type"))
    locate(out, column(rows, "lat") * 1e-7, column(rows, "lon") * 1e-7, quality)
    out["altitude"] = column(rows, "alt") * 1e-3
    height = column(rows, "alt_ellipsoid")
    out["height"] = np.where(height != 0.0, height * 1e-3, np.nan)
    out["std"] = positive(columns(rows, "h_acc", "h_acc", "v_acc") * 1e-3)
    yield Batch("fix", out, "own", stream)
    course = started(empty("course", len(rows)), **_time(rows))
    speed, over_ground = column(rows, "vel"), column(rows, "cog")
    known = (speed < _UNKNOWN_16) & (over_ground < _UNKNOWN_16) & (quality > 0.0)
    course["speed"] = np.where(known, speed * 1e-2, np.nan)
    course["course"] = over_ground * 1e-2 * DEG
    yield Batch("course", course, "own", stream)


def _input(stream: str, rows: list[Row]) -> Iterator[Batch]:
    """Convert `GPS_INPUT`, as which acoustic positions reach an autopilot."""
    flags = column(rows, "ignore_flags").astype(int)

    def stated(values: Any, *bits: int) -> Any:
        ignored = np.stack([flags & bit > 0 for bit in bits], axis=-1)
        return np.where(ignored, np.nan, values)

    out = started(empty("fix", len(rows)), **_time(rows))
    quality = gga_quality(column(rows, "fix_type"))
    locate(out, column(rows, "lat") * 1e-7, column(rows, "lon") * 1e-7, quality)
    out["altitude"] = stated(columns(rows, "alt"), _NO_ALTITUDE)[:, 0]
    velocity = columns(rows, "ve", "vn", "vd") * (1.0, 1.0, -1.0)
    out["velocity"] = stated(velocity, _NO_SPEED, _NO_SPEED, _NO_CLIMB)
    speed_std = stated(columns(rows, "speed_accuracy"), _NO_SPEED_STD)
    out["velocity_std"] = positive(speed_std)
    stds = columns(rows, "horiz_accuracy", "horiz_accuracy", "vert_accuracy")
    out["std"] = positive(stated(stds, _NO_STD, _NO_STD, _NO_VERTICAL_STD))
    week = column(rows, "time_week")
    dated = week >= FIRST_WEEK
    own, utc = out[~dated], out[dated]
    utc["time"] = gps_to_utc(week[dated], column(rows, "time_week_ms")[dated] * 1e-3)
    yield Batch("fix", own, "own", stream)
    yield Batch("fix", utc, "utc", stream)


def _estimate(stream: str, rows: list[Row]) -> Iterator[Batch]:
    """Convert `GLOBAL_POSITION_INT`, which in the numbers of GGA is an estimate."""
    out = started(empty("fix", len(rows)), **_time(rows))
    lat, lon = column(rows, "lat") * 1e-7, column(rows, "lon") * 1e-7
    locate(out, lat, lon, np.where((lat != 0.0) | (lon != 0.0), 6.0, 0.0))
    out["altitude"] = column(rows, "alt") * 1e-3
    out["velocity"] = columns(rows, "vy", "vx", "vz") * (1e-2, 1e-2, -1e-2)
    yield Batch("fix", out, "own", stream, notes=(_ESTIMATE,))


def _odometry(stream: str, rows: list[Row]) -> Iterator[Batch]:
    """Convert `VISION_POSITION_DELTA`, as which a DVL reaches an autopilot."""
    out = started(empty("dvl", len(rows)), **_time(rows))
    deltas = np.full((len(rows), 3), np.nan)
    for index, row in enumerate(rows):
        deltas[index] = row["position_delta"]
    yield movements(out, deltas, column(rows, "time_delta_usec") * MICROSECOND, stream)


def _pressure(stream: str, rows: list[Row]) -> Iterator[Batch]:
    out = started(empty("depth", len(rows)), **_time(rows))
    out["depth"] = (positive(column(rows, "press_abs")) - _AIR) / _METRE
    yield Batch("depth", out, "own", stream, notes=(_DEPTH.format(stream),))


def _system_time(stream: str, rows: list[Row]) -> Iterator[Batch]:
    """Convert `SYSTEM_TIME` of a vehicle: that of a ground station is its own stamp again."""
    out = started(empty("clock", len(rows)), **_time(rows))
    utc = column(rows, "time_unix_usec") * MICROSECOND
    use = (column(rows, "time_boot_ms") > 0.0) & (utc > _SINCE_START)
    out["time"] = utc
    losses = Losses()
    losses.skip(type_name("clock", stream), NO_TIME, int((~use).sum()))
    yield replace(left_out(losses), records=out[use], clock="utc", stream=stream)


_CONVERTERS: dict[str, Callable[[str, list[Row]], Iterator[Batch]]] = {
    **dict.fromkeys(("RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3"), _imu),
    "ATTITUDE": _attitude,
    _GPS_RAW: _receiver,
    _GPS_INPUT: _input,
    "GLOBAL_POSITION_INT": _estimate,
    "VISION_POSITION_DELTA": _odometry,
    # SCALED_PRESSURE is that of the air inside.
    **dict.fromkeys(("SCALED_PRESSURE2", "SCALED_PRESSURE3"), _pressure),
    "SYSTEM_TIME": _system_time,
}
# Of the stamps that contents begin with: bytes, and unit in s, by the number of the type.
_LAYOUT = {
    **dict.fromkeys((27, 24, 232, 11011), (8, MICROSECOND)),
    **dict.fromkeys((26, 116, 129, 30, 33, 137, 143), (4, 1e-3)),
}

FORMAT = Format(
    name="tlog",
    family="vehicle",
    title="MAVLink telemetry log .tlog",
    share=share,
    read=read,
    verified=(
        "a recording of ArduSub with GPS_INPUT, counts by type by pymavlink; "
        "VISION_POSITION_DELTA by its document only"
    ),
    endings=(".tlog",),
    module="pymavlink",
    extra="ardupilot",
)
