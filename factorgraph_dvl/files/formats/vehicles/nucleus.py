"""Nortek Nucleus: packets decoded by nucleus-driver, found by their checksums here.

Units are those that the names in the maker's driver state: m/s, rad/s, degrees. Axes are forward,
right, down: the maker's program for a BlueROV passes velocities X, Y, Z on as movements in these
(`VISION_POSITION_DELTA`), and in a recording at rest the specific force has the signs that pitch
and roll of the AHRS give it. `timeVelBeam` is taken as the duration of a velocity estimate, which
the records of the maker's other DVLs name in the same place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.ad2cp import NUCLEUS, frames
from factorgraph_dvl.files.formats.format import Batch, Clock, Format, Kind, empty, left_out
from factorgraph_dvl.files.formats.framing import BLOCK, Records, map_file
from factorgraph_dvl.files.formats.losses import UNKNOWN_TYPE, Losses
from factorgraph_dvl.files.formats.vehicles.library import (
    column,
    columns,
    load,
    silently,
    started,
)
from factorgraph_dvl.files.formats.velocities import INSTRUMENT, mean_of_known
from factorgraph_dvl.geometry.units import DEG, MICROSECOND

IMU, AHRS, BOTTOM, WATER, INS = 0x82, 0xD2, 0xB4, 0xBE, 0xDC
# A calibration must not be compared with what was made of the same data.
_INS = "packets of the INS were left out: it navigates by the same IMU and DVL"
_NAMES = {
    0x20: "spectrum (packet 0x20)",
    0x87: "magnetometer (packet 0x87)",
    0x8B: "field calibration (packet 0x8B)",
    0x96: "fast pressure (packet 0x96)",
    0xA0: "text (packet 0xA0)",
    0xAA: "altimeter (packet 0xAA)",
    0xC0: "current profile (packet 0xC0)",
    0xC1: "current profile (packet 0xC1)",
    INS: "INS (packet 0xDC)",
}
_HEADER = 10
# Without an echo the driver passes on these.
_NO_VELOCITY, _NO_MERIT = -32.0, 10.0
_AXES = (
    "axes of the Nucleus taken as forward, right, down, as by the maker's program for a BlueROV; "
    "rotations that were set in the instrument (SETINST) are in them"
)
_SHIFT = "stamps of velocities were shifted by dtXYZ, from the stamp to their measurement"
Packet = dict[str, Any]


class _Silent:
    """Where the parser writes what it thinks of a packet."""

    def write_warning(self, message: object) -> None:
        """Drop a message."""

    write_exception = write_message = write_warning


def share(path: Path, sample: bytes) -> float:
    """Return the share of a sample that lies in packets of a Nucleus."""
    if not sample:
        return 0.0
    found = [_HEADER + stop - start for kind, _, start, stop in frames(sample) if kind == NUCLEUS]
    return sum(found) / len(sample)


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read IMU, AHRS, bottom track and water track packets.

    Parameters, result and errors are those of `Format.read`.
    """
    # The parser alone: the driver around it opens sockets.
    parser = load("nucleus_driver._parser", "nucleus").Parser(messages=_Silent())
    source = map_file(path)
    gathered: dict[int, list[Packet]] = {kind: [] for kind in _CONVERTERS}
    losses, notes = Losses(), []
    for family, kind, start, stop in frames(source, losses):
        if family == NUCLEUS and kind == INS and _INS not in notes:
            notes.append(_INS)
        if family != NUCLEUS or kind not in gathered:
            losses.skip(_NAMES.get(kind, f"packet 0x{kind:02X}"), UNKNOWN_TYPE)
            continue
        packet = _decoded(parser, bytearray(source[start - _HEADER : stop]))
        if packet is None:
            losses.add("packet too short for what it states", start - _HEADER)
            continue
        packet["at"] = start - _HEADER
        gathered[kind].append(packet)
        if len(gathered[kind]) >= BLOCK:
            yield from silently(_CONVERTERS[kind](gathered[kind]))
            gathered[kind] = []
    for kind, packets in gathered.items():
        if packets:
            yield from silently(_CONVERTERS[kind](packets))
    yield replace(left_out(losses), notes=tuple(notes))


def _decoded(parser: Any, frame: bytearray) -> Packet | None:
    try:
        header, data, packet = parser.get_packet(frame)
    except Exception:  # Of any type: the library does not foresee all damage.
        return None
    return packet if header and data and "flags.posixTime" in packet and len(packet) > 13 else None


def _timed(kind: Kind, packets: list[Packet]) -> tuple[Records, Clock]:
    time = column(packets, "timeStamp") + column(packets, "microSeconds") * MICROSECOND
    out = started(empty(kind, len(packets)), at=column(packets, "at"), time=time)
    return out, "utc" if column(packets, "flags.posixTime").all() else "own"


def _imu(packets: list[Packet]) -> Iterator[Batch]:
    out, clock = _timed("imu", packets)
    out["gyro"] = columns(packets, "gyro.x", "gyro.y", "gyro.z")
    out["accel"] = columns(packets, "accelerometer.x", "accelerometer.y", "accelerometer.z")
    valid = column(packets, "status.isValid") == 1.0
    yield Batch("imu", out, clock, "IMU", "FRD", notes=(_AXES,), valid=valid)


def _attitude(packets: list[Packet]) -> Iterator[Batch]:
    out, clock = _timed("attitude", packets)
    for name in ("roll", "pitch", "heading"):
        out[name] = column(packets, f"ahrsData.{name}") * DEG
    declination = column(packets, "declination")
    is_true = bool(np.all(np.isfinite(declination) & (declination != 0.0)))
    note = "headings of the AHRS rest on its compass" + (
        ", with a declination that was set" if is_true else "; no declination was set"
    )
    yield Batch(
        "attitude", out, clock, "AHRS", "FRD", "true" if is_true else "magnetic", (_AXES, note)
    )
    depth, _ = _timed("depth", packets)
    depth["depth"] = column(packets, "depth")
    yield Batch("depth", depth, clock, "AHRS")


def _track(kind: Kind, stream: str) -> Callable[[list[Packet]], Iterator[Batch]]:
    def convert(packets: list[Packet]) -> Iterator[Batch]:
        out, clock = _timed(kind, packets)
        velocity = columns(packets, *(f"velocity{axis}" for axis in "XYZ"))
        merit = columns(packets, *(f"fom{axis}" for axis in "XYZ"))
        status = columns(packets, *(f"status.{axis}VelocityValid" for axis in "xyz")) == 1.0
        measured = (velocity > _NO_VELOCITY) & (merit < _NO_MERIT)
        out["axes"], out["velocity"] = INSTRUMENT, np.where(measured, velocity, np.nan)
        out["std"] = np.where(measured & (merit > 0.0), merit, np.nan)
        distance = columns(packets, *(f"distanceBeam{i}" for i in (1, 2, 3)))
        known = columns(packets, *(f"status.beam{i}DistanceValid" for i in (1, 2, 3))) == 1.0
        out["range"][:, :3] = np.where(known & (distance > 0.0), distance, np.nan)
        out["sound_speed"] = column(packets, "soundSpeed")
        out["temperature"] = column(packets, "temperature")
        delay = column(packets, "dtXYZ")
        out["delay"] = np.where((delay > 0.0) & (delay < 1.0), delay, np.nan)
        duration = columns(packets, *(f"timeVelBeam{i}" for i in (1, 2, 3)))
        out["window"] = mean_of_known(np.where(duration < 1.0, duration, np.nan))
        note = "velocities along beams were left out: directions and signs are not documented"
        shifted = (_SHIFT,) if np.isfinite(out["delay"]).any() else ()
        notes = (_AXES, note, *shifted)
        yield Batch(kind, out, clock, stream, "FRD", notes=notes, valid=status.all(axis=1))

    return convert


_CONVERTERS: dict[int, Callable[[list[Packet]], Iterator[Batch]]] = {
    IMU: _imu,
    AHRS: _attitude,
    BOTTOM: _track("dvl", "bottom track"),
    WATER: _track("water", "water track"),
}

FORMAT = Format(
    name="nucleus",
    family="dvl",
    title="Nortek Nucleus",
    share=share,
    read=read,
    verified=(
        "a recording at rest (17,773 packets of the IMU), counts by type by "
        "the parser of nucleus-driver; velocities by their document only: it has no lock"
    ),
    endings=(".nucleus",),
    module="nucleus_driver",
    extra="nucleus",
)
