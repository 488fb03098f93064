"""Nortek AD2CP files: bottom track, orientation and the configuration they begin with.

Source: Nortek, Signature Integrator's Guide (2017), 6.1 (header, DF20 bottom track, DF3
records); AHRS fields as in the DF3 table. 0x1B and 0x1D are the records of DVLs. Records of other
kinds are passed over, whole.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.files.formats.clocks import posix
from factorgraph_dvl.files.formats.format import Batch, Format, Kind, empty, left_out
from factorgraph_dvl.files.formats.framing import BLOCK, Records, Source, map_file, number
from factorgraph_dvl.files.formats.losses import UNKNOWN_TYPE, Frame, Losses, count_stretch
from factorgraph_dvl.files.formats.nmea import join, read_nmea, sentence_batches
from factorgraph_dvl.files.formats.velocities import BEAM, EARTH, INSTRUMENT, mean_of_known
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array

IN_ENU, IN_XYZ, IN_BEAMS = range(3)
BOTTOM, BURST, AVERAGE, TEXT = 0x17, 0x15, 0x16, 0xA0
# Nucleus frames its packets alike, with kinds of its own.
NUCLEUS = 0x20
_SYNC = b"\xa5"
_SEED = 0xB58C
# Bytes of a header, 12 in its long form.
_HEADER = 10
# The largest records, of raw echo sounder samples, have some 100 kB.
_LARGEST = 1 << 24
_UNITS = {
    "sound_speed": 0.1,
    "temperature": 0.01,
    "pressure": 0.001,
    "heading": 0.01 * DEG,
    "pitch": 0.01 * DEG,
    "roll": 0.01 * DEG,
    "acceleration": 9.81 / 16384.0,
}
_FIELDS = ((1 << 5, "velocity", "<i4"), (1 << 8, "distance", "<i4"), (1 << 9, "merit", "<u2"))
_IMPOSSIBLE = "record of bottom track with an impossible layout"
# Above this a velocity is one of nothing: the widest velocity range is 30 m/s.
_FASTEST = 50.0

PING = np.dtype(
    [
        ("at", "i8"),
        ("time", "f8"),
        ("number", "i8"),
        ("beams", "u1"),
        ("coordinates", "u1"),
        *((name, "f8") for name in ("sound_speed", "temperature", "pressure")),
        *((name, "f8") for name in ("heading", "pitch", "roll")),
        ("acceleration", "f8", (3,)),
        ("velocity", "f8", (4,)),
        ("distance", "f8", (4,)),
        ("merit", "f8", (4,)),
        ("rotation", "f8", (3, 3)),
        ("quaternion", "f8", (4,)),
        ("rate", "f8", (3,)),
        ("status", "u4"),
        ("error", "u4"),
    ]
)
_HEAD = np.dtype(
    {
        "names": [
            *("offset", "flags", "date", "fraction", "sound_speed", "temperature", "pressure"),
            *("heading", "pitch", "roll", "layout", "acceleration", "scale"),
            *("error", "status", "number"),
        ],
        "offsets": [1, 2, 8, 14, 16, 18, 20, 24, 26, 28, 30, 46, 60, 66, 70, 74],
        "formats": [
            *("u1", "<u2", "6u1", "<u2", "<u2", "<i2", "<u4", "<u2", "<i2", "<i2", "<u2"),
            *("3<i2", "i1", "<u4", "<u4", "<u4"),
        ],
        "itemsize": 78,
    }
)


@dataclass(frozen=True)
class Ad2cp:
    """What a file contains, or a part of it.

    Parameters
    ----------
    bottom : Records
        (N,) of `PING`, bottom track: `time`, seconds since 1970; angles in rad as sent;
        `velocity` m/s by beam or axis, `distance` m, `merit` (figure of merit), nan where
        not measured; `rotation`, `quaternion` and `rate` (rad/s) of the AHRS, nan without.
    tracks : Records
        (M,) of `TRACK`, bottom and water track of DVLs.
    text : tuple of str
        String records, in order: configuration, and sentences that were sent to it.
    """

    bottom: Records
    tracks: Records
    text: tuple[str, ...]


def read_ad2cp(
    source: Source, block: int = BLOCK, losses: Losses | None = None
) -> Iterator[Ad2cp]:
    """Read records whose checksums are right.

    Parameters
    ----------
    source : Source
        The file.
    block : int
        Number of records at a time.
    losses : Losses, optional
        Takes counts of what was left out.

    Yields
    ------
    Ad2cp
    """
    losses = Losses() if losses is None else losses
    pings: list[tuple[int, bytes]] = []
    dvl: list[tuple[int, int, bytes]] = []
    text: list[str] = []
    for family, kind, start, stop in frames(source, losses):
        if family == NUCLEUS:
            losses.skip(f"packet 0x{kind:02X} of a Nucleus", UNKNOWN_TYPE)
            continue
        if kind == BOTTOM:
            pings.append((start, source[start:stop]))
        elif kind in (DVL_BOTTOM, DVL_WATER):
            record = source[start:stop]
            if is_whole(record):
                dvl.append((start, kind, record))
            else:
                losses.add(_IMPOSSIBLE, start)
        elif kind != TEXT:
            losses.skip(f"record 0x{kind:02X}", UNKNOWN_TYPE)
        else:
            losses.use("text")
            text.append(source[start + 1 : stop].rstrip(b"\0").decode("latin-1"))
        if len(pings) + len(dvl) + len(text) >= block:
            yield Ad2cp(_bottom_track(pings, losses), tracks(dvl), tuple(text))
            pings, dvl, text = [], [], []
    yield Ad2cp(_bottom_track(pings, losses), tracks(dvl), tuple(text))


def beam_matrix(text: str) -> np.ndarray[tuple[int, int], np.dtype[np.float64]] | None:
    """Return the matrix from bottom-track beams to X, Y, Z, Z2 of a configuration, or None."""
    line = re.search(r"GETXFBT,ROWS=(\d),COLS=(\d),([^\r\n]*)", text)
    if line is None:
        return None
    rows, columns = int(line[1]), int(line[2])
    values = dict(re.findall(r"(M\d\d)=([-+.\deE]+)", line[3]))
    out = np.array(
        [[number(values.get(f"M{i + 1}{j + 1}", "")) for j in range(columns)] for i in range(rows)]
    )
    return out if out.size and np.isfinite(out).all() else None


def frames(source: Source, losses: Losses | None = None) -> Iterator[tuple[int, int, int, int]]:
    """Find records of Nortek's instruments whose checksums are right.

    Parameters
    ----------
    source : Source
        The file.
    losses : Losses, optional
        Takes counts of what was left out.

    Yields
    ------
    Family, kind, and start and stop of what stands behind the header.
    """
    losses = Losses() if losses is None else losses
    at, free, size = 0, 0, len(source)
    while (at := source.find(_SYNC, at)) >= 0:
        header = _header(source, at)
        if header is not None:
            stop = at + header.size + header.length
            if stop <= size and checksum(source[at + header.size : stop]) == header.data_sum:
                count_stretch(source, free, at, losses, _FRAME)
                yield header.family, header.kind, at + header.size, stop
                at = free = stop
                continue
        at += 1
    count_stretch(source, free, size, losses, _FRAME)


class _Header(NamedTuple):
    size: int
    kind: int
    family: int
    length: int
    data_sum: int


def _header(source: Source, at: int) -> _Header | None:
    """Return the header at a position, None if there is none whose own checksum is right."""
    raw = source[at : at + 12]
    if raw[1:2] not in (b"\x0a", b"\x0c") or len(raw) < raw[1]:
        return None
    layout = struct.Struct("<BBBBIHH" if raw[1] == 12 else "<BBBBHHH")
    _, *fields, head_sum = layout.unpack_from(raw)
    header = _Header(*fields)
    is_right = checksum(raw[: header.size - 2]) == head_sum and header.length <= _LARGEST
    return header if is_right else None


def _size(source: Source, at: int) -> int:
    header = _header(source, at)
    return 0 if header is None else header.size + header.length


_FRAME = Frame("record", _SYNC, _size)


def checksum(data: bytes) -> int:
    """Return the checksum of bytes: their little-endian 16-bit words and a seed, summed.

    Parameters
    ----------
    data : bytes
        A last odd byte counts as the upper half of a word.
    """
    even = len(data) & ~1
    total = _SEED + int(np.frombuffer(data[:even], "<u2").sum(dtype=np.int64))
    return (total + (data[-1] << 8 if len(data) & 1 else 0)) & 0xFFFF


def covered(sample: bytes) -> int:
    """Return the number of bytes of a sample that lie in records of AD2CP."""
    found = frames(sample)
    return sum(stop - start + _HEADER for family, _, start, stop in found if family != NUCLEUS)


def _bottom_track(pings: list[tuple[int, bytes]], losses: Losses) -> Records:
    """Return the pings of DF20 records, in the order of the file."""
    alike: dict[bytes, list[tuple[int, bytes]]] = {}
    for at, record in pings:
        if len(record) >= _HEAD.itemsize:
            # What decides on the layout: offset of data, flags, number of beams, length.
            key = record[1:4] + bytes([record[31] >> 4]) + len(record).to_bytes(4, "little")
            alike.setdefault(key, []).append((at, record))
    parts = [_alike(group) for group in alike.values()]
    out = np.concatenate(parts) if parts else np.empty(0, PING)
    if pings:
        impossible = len(pings) - len(out)
        losses.add(_IMPOSSIBLE, pings[0][0], impossible)
    return out[np.argsort(out["at"], kind="stable")]


def _alike(pings: list[tuple[int, bytes]]) -> Records:
    """Return the pings of records of one layout; none if it is no possible one."""
    raw = np.frombuffer(b"".join(record for _, record in pings), np.uint8)
    raw = raw.reshape(len(pings), -1)
    head = np.ascontiguousarray(raw[:, : _HEAD.itemsize]).view(_HEAD)[:, 0]
    beams, flags, at = int(head["layout"][0]) >> 12, int(head["flags"][0]), int(head["offset"][0])
    fields = [(flag, name, form) for flag, name, form in _FIELDS if flags & flag]
    needed = at + beams * sum(int(form[2]) for _, _, form in fields)
    if not 1 <= beams <= 4 or needed > raw.shape[1]:
        return np.empty(0, PING)
    out = np.zeros(len(pings), PING)
    out["at"] = [start for start, _ in pings]
    out["beams"], out["coordinates"] = beams, (head["layout"] >> 10) & 3
    # Years count from 1900 and months from 0, as in C.
    year, month, day, hour, minute, second = head["date"].astype(np.int64).T
    seconds = second + head["fraction"] * 1e-4
    out["time"] = posix(year + 1900, month + 1, day, hour, minute, seconds)
    for name, unit in _UNITS.items():
        out[name] = head[name] * unit
    for name in ("error", "status", "number"):
        out[name] = head[name]
    for name in ("velocity", "distance", "merit", "rotation", "quaternion", "rate"):
        out[name] = np.nan
    for _, name, form in fields:
        size = beams * int(form[2])
        out[name][:, :beams] = np.ascontiguousarray(raw[:, at : at + size]).view(form)
        at += size
    out["velocity"] *= 10.0 ** head["scale"].astype(float)[:, None]
    out["distance"] *= 1e-3
    if flags & 1 << 10 and raw.shape[1] >= at + 64:
        ahrs = np.ascontiguousarray(raw[:, at : at + 64]).view("<f4").astype(float)
        ahrs[~np.isfinite(ahrs)] = np.nan
        out["rotation"] = ahrs[:, :9].reshape(-1, 3, 3)
        out["quaternion"], out["rate"] = ahrs[:, 9:13], ahrs[:, 13:] * DEG
    _mark_lost(out)
    return out


def _mark_lost(pings: Records) -> None:
    # Without an echo the figure of merit is at its limit, distances are negative or 0,
    # and velocities are beyond what the instrument can measure.
    lost = (pings["merit"] >= 65535.0) | (pings["distance"] <= 0.0)
    lost |= np.abs(pings["velocity"]) > _FASTEST
    pings["velocity"] = np.where(lost, np.nan, pings["velocity"])
    pings["distance"] = np.where(pings["distance"] <= 0.0, np.nan, pings["distance"])


DVL_BOTTOM, DVL_WATER = 0x1B, 0x1D
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
        ("window", "f8"),
        *((f"beam_{name}", "f8", (4,)) for name in ("velocity", "range", "merit")),
        *((name, "f8") for name in ("sound_speed", "temperature", "pressure")),
    ]
)


def is_whole(record: bytes) -> bool:
    """Return whether a record has all fields."""
    return len(record) >= _RECORD.itemsize


def tracks(records: Sequence[tuple[int, int, bytes]]) -> Records:
    """Return what records contain that are whole.

    Parameters
    ----------
    records : sequence of (int, int, bytes)
        Position, kind (`DVL_BOTTOM` or `DVL_WATER`) and content.

    Returns
    -------
    Records
        (N,) of `TRACK`: `time` of the trigger, seconds since 1970; `delay` from it to the echo and
        `window`, the duration of the estimate, s; `velocity` X, Y, Z, m/s, Z the mean of two, and
        `error` half their difference; `merit`, the instrument's own standard deviation, m/s; nan
        where not measured.
    """
    raw = np.frombuffer(
        b"".join(content[: _RECORD.itemsize] for _, _, content in records), _RECORD
    )
    out = np.zeros(len(raw), TRACK)
    out["at"] = [at for at, _, _ in records]
    out["water"] = [kind == DVL_WATER for _, kind, _ in records]
    # Years count from 1900 and months from 0, as in C.
    year, month, day, hour, minute, second = raw["date"].astype(np.int64).T
    out["time"] = posix(year + 1900, month + 1, day, hour, minute, second + raw["fraction"] * 1e-4)
    for name in ("sound_speed", "temperature", "pressure"):
        out[name] = _finite(raw[name])
    velocity, merit, delay, duration = (
        _finite(raw[name]) for name in ("velocity", "merit", "delay", "duration")
    )
    velocity[~_valid(raw, "velocity") | (velocity <= _NO_VELOCITY)] = np.nan
    both = np.isfinite(velocity[:, 2:]).all(axis=1)
    vertical = np.where(np.isfinite(velocity[:, 2]), velocity[:, 2], velocity[:, 3])
    vertical[both] = velocity[both, 2:].mean(axis=1)
    out["velocity"] = np.column_stack([velocity[:, :2], vertical])
    out["error"] = (velocity[:, 2] - velocity[:, 3]) / 2.0
    merit[(merit <= 0.0) | (merit >= _NO_MERIT)] = np.nan
    out["merit"] = np.where(np.isfinite(out["velocity"]), merit[:, :3], np.nan)
    for name, times in (("delay", delay), ("window", duration)):
        out[name] = mean_of_known(np.where(times < _LONGEST_DELAY, times, np.nan)[:, :3])
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


_BEAMS = (
    "velocities along beams are positive towards the transducer, which is its own velocity along "
    "the outward beam; directions of beams by the matrix GETXFBT of the file"
)
_NO_MATRIX = "velocities along beams, and no matrix in the file: left out"
_MAGNETIC = "headings of the instrument's own magnetic compass"
_TRACK = "velocities X, Y, Z of a DVL as they are: positive where it moves along its axes"
_SHIFT = "stamps of velocities were shifted by DT1, from the trigger to the echo"


def share(path: Path, sample: bytes) -> float:
    """Return the share of a sample that lies in records whose checksums are right."""
    return covered(sample) / len(sample) if sample else 0.0


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    matrix: np.ndarray[Any, np.dtype[np.float64]] | None = None
    losses = Losses()
    for block in read_ad2cp(map_file(path), losses=losses):
        for text in block.text:
            found = beam_matrix(text)
            matrix = matrix if found is None else found
        if len(block.bottom):
            yield from _batches(block.bottom, matrix)
        if len(block.tracks):
            yield from _tracks(block.tracks)
        sentences = "\r\n".join(block.text).encode("latin-1")
        nmea = join(read_nmea(sentences))
        stamps = np.concatenate([block.bottom["time"], block.tracks["time"]])
        stamps = stamps[np.isfinite(stamps)]
        near = float(np.median(stamps)) if len(stamps) else None
        yield from sentence_batches(nmea, near, losses)
    yield left_out(losses)


def _batches(
    bottom: Records, matrix: np.ndarray[Any, np.dtype[np.float64]] | None
) -> Iterator[Batch]:
    out = empty("dvl", len(bottom))
    for name in ("at", "number", "roll", "pitch", "heading", "sound_speed", "temperature"):
        out[name] = bottom[name]
    out["time"] = out["received"] = bottom["time"]
    out["range"], out["alignment"] = bottom["distance"], 0.0
    out["tilts_used"] = True
    out["axes"] = np.where(bottom["coordinates"] == IN_ENU, EARTH, INSTRUMENT)
    in_beams = bottom["coordinates"] == IN_BEAMS
    out["velocity"] = np.where(in_beams[:, None], np.nan, bottom["velocity"][:, :3])
    notes: tuple[str, ...] = ()
    directions: tuple[tuple[float, ...], ...] = ()
    if in_beams.any():
        notes = (_NO_MATRIX,)
        if matrix is not None and matrix.shape == (4, 4):
            beams = bottom["velocity"][in_beams]
            out["beams"][in_beams], out["velocity"][in_beams] = beams, beams @ matrix[:3].T
            out["axes"][in_beams] = BEAM
            notes = (_BEAMS,)
            directions = tuple(map(tuple, np.linalg.pinv(matrix[:3]).tolist()))
    yield Batch("dvl", out, "own", "bottom", notes=notes, directions=directions)
    attitude = empty("attitude", len(bottom))
    for name in ("at", "time", "roll", "pitch", "heading"):
        attitude[name] = bottom[name]
    attitude["received"] = bottom["time"]
    yield Batch("attitude", attitude, "own", "leader", "", "magnetic", (_MAGNETIC,))


def _tracks(tracks: Records) -> Iterator[Batch]:
    kinds: tuple[tuple[Kind, str, bool], ...] = (
        ("dvl", "bottom", False),
        ("water", "water", True),
    )
    for kind, stream, is_water in kinds:
        part = tracks[tracks["water"] == is_water]
        if not len(part):
            continue
        out = empty(kind, len(part))
        for name in ("at", "time", "velocity", "error", "delay", "window"):
            out[name] = part[name]
        for name in ("sound_speed", "temperature"):
            out[name] = part[name]
        out["received"], out["std"] = part["time"], part["merit"]
        out["beams"], out["range"] = part["beam_velocity"], part["beam_range"]
        out["axes"], out["alignment"] = INSTRUMENT, 0.0
        shifted = (_SHIFT,) if np.isfinite(out["delay"]).any() else ()
        yield Batch(kind, out, "own", stream, notes=(_TRACK, *shifted))


FORMATS = (
    Format(
        "ad2cp",
        "dvl",
        "Nortek AD2CP: bottom track (0x17), tracks of DVLs (0x1B, 0x1D), text",
        share,
        read,
        "one recording (VelEchoBT01), by mhkit, counts by type by a script; 0x1B and 0x1D by "
        "public readers that agree only",
        (".ad2cp",),
    ),
)
