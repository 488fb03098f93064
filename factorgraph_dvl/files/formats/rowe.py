"""Rowe Technology ensembles (`.ens`): bottom track and the NMEA sentences stored with it.

Source: no document of the maker could be read; the layout is that of the maker's own public
reader (rowetechinc/rti_python). Velocities are those over ground as the instrument sends them.
Instrument axes are forward, port, up at a roll of 0. So those of an instrument that looks down, at
a roll of 180°, are forward, starboard, down: in a recording of a boat, they become the Earth
velocities beside them, to the last digit. What looks up is turned over here, to the same axes. Its
times of the first and the last ping are since the first ensemble. In a recording of a boat,
the first ping of bottom track is 0.20 to 0.22 s behind the stamp of each ensemble, so stamps are
those of its start.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.clocks import posix
from factorgraph_dvl.files.formats.format import Batch, Format, left_out
from factorgraph_dvl.files.formats.framing import BLOCK, Records, Source, map_file
from factorgraph_dvl.files.formats.losses import UNKNOWN_TYPE, Frame, Losses, count_stretch
from factorgraph_dvl.files.formats.nmea import KINDS, read_nmea, sentence_batches
from factorgraph_dvl.files.formats.velocities import (
    INSTRUMENT,
    VELOCITY,
    attitude,
    averaged,
    empty,
    pings,
    share_of_records,
    without,
)
from factorgraph_dvl.geometry.rotations import wrapped
from factorgraph_dvl.geometry.units import DEG

# What an ensemble begins with, its largest size, bytes, and the value of a lost beam: by
# the manual, the size chosen.
_SYNC = b"\x80" * 16
_LARGEST = 1 << 20
# Bytes before the data: sync, and number and length with their inverses.
_HEADER = 32
_BAD = 88.888
# Floats before the first array of bottom track.
_HEAD = 14
# Forward, port, up to forward, starboard, down.
_OVER = np.array([1.0, -1.0, -1.0])
# Longest time between two pings of an ensemble, s.
_LONGEST_INTERVAL = 60.0
_SIZES = {10: 4, 20: 4, 50: 1}


# Data sets with the time, bottom track and sentences; a name is at most so long.
_READ, _LONGEST_NAME = ("E000008", "E000010", "E000011"), 16
_ERROR = (
    "the error velocity was scaled so that its spread is that of horizontal velocities: it is a "
    "quarter of the sum of two beams less that of the others"
)
_SHIFT = (
    "several pings in an ensemble: stamps of velocities were shifted by half of the time from the "
    "first to the last one"
)


def read_rowe(
    source: Source, block: int = BLOCK, losses: Losses | None = None
) -> Iterator[tuple[Records, dict[str, Records]]]:
    """Read ensembles whose checksum is right.

    Parameters
    ----------
    source : Source
        The file.
    block : int
        Number of ensembles at a time.
    losses : Losses, optional
        Takes counts of what was left out.

    Yields
    ------
    (N,) of `VELOCITY`, those with bottom track, in instrument axes with beams beside; and
    the sentences, as `read_nmea` returns them, `received` at the time of their ensemble.
    Axes are forward, starboard, down, and roll is near 0 when the instrument looks down.
    """
    pings: list[Records] = []
    nmea: dict[str, list[Records]] = {name: [] for name in KINDS}
    losses = Losses() if losses is None else losses
    for at, payload in _ensembles(source, losses):
        sets = dict(_data_sets(payload))
        for name in sets:
            if name not in _READ:
                losses.skip(f"data set {name[:_LONGEST_NAME]}", UNKNOWN_TYPE)
        time = _time(sets.get("E000008", b""))
        ping = _bottom_track(sets.get("E000010", b""))
        if ping is not None:
            ping["at"], ping["time"] = at, time
            pings.append(ping)
        else:
            losses.skip("ensemble without bottom track of three beams", UNKNOWN_TYPE)
        for part in read_nmea(sets.get("E000011", b""), losses=losses):
            for name, records in part.items():
                records["at"] += at
                records["received"] = time
                nmea[name].append(records)
        if len(pings) >= block:
            yield _stack(pings, nmea)
            pings, nmea = [], {name: [] for name in KINDS}
    yield _stack(pings, nmea)


def _stack(
    pings: list[Records], nmea: dict[str, list[Records]]
) -> tuple[Records, dict[str, Records]]:
    joined = {
        name: np.concatenate(parts) if parts else np.empty(0, KINDS[name])
        for name, parts in nmea.items()
    }
    return _with_error(np.concatenate(pings)) if pings else np.empty(0, VELOCITY), joined


def _with_error(found: Records) -> Records:
    """Scale error velocities so that their σ is that of horizontal velocities.

    With b = ± sin θ X + cos θ Z + e along one pair of beams and - e along the other, σ(e) is half
    that of a beam, and that of X and Y is √2 / (2 sin θ) of it. sin θ is the ratio of both.
    """
    beams, (x, y) = found["beam_velocity"], found["velocity"][:, :2].T
    across = np.hypot(beams[:, 0] - beams[:, 1], beams[:, 2] - beams[:, 3])
    use = np.isfinite(across) & np.isfinite(found["error"])
    speed = np.hypot(x, y)[use]
    sine = (across[use] @ speed) / (2.0 * (speed @ speed)) if speed.any() else np.nan
    found["error"] *= np.sqrt(2.0) / sine if 0.0 < sine < 1.0 else np.nan
    return found


def _ensembles(source: Source, losses: Losses) -> Iterator[tuple[int, bytes]]:
    at, free, size = 0, 0, len(source)
    while (at := source.find(_SYNC, at)) >= 0:
        stop = at + _size(source, at)
        if at < stop <= size:
            payload = source[at + _HEADER : stop - 4]
            (stated,) = struct.unpack("<I", source[stop - 4 : stop])
            if binascii.crc_hqx(payload, 0) == stated:
                count_stretch(source, free, at, losses, _FRAME)
                yield at, payload
                at = free = stop
                continue
        at += 1
    count_stretch(source, free, size, losses, _FRAME)


def _size(source: Source, at: int) -> int:
    """Return the number of bytes of an ensemble, 0 if there is no header at its position."""
    header = source[at + len(_SYNC) : at + _HEADER]
    if len(header) < _HEADER - len(_SYNC):
        return 0
    number, inverse, length, inverse_length = struct.unpack("<4I", header)
    is_header = number ^ inverse == length ^ inverse_length == 0xFFFFFFFF
    return _HEADER + length + 4 if is_header and length <= _LARGEST else 0


_FRAME = Frame("ensemble", _SYNC, _size)


def _data_sets(payload: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of each data set of an ensemble."""
    at = 0
    while at + 20 <= len(payload):
        kind, elements, multiplier, _, name_length = struct.unpack_from("<5I", payload, at)
        start = at + 20 + name_length
        stop = start + elements * multiplier * _SIZES.get(kind, 4)
        if name_length > 64 or stop > len(payload):
            return
        yield payload[at + 20 : start].rstrip(b"\0").decode("latin-1"), payload[start:stop]
        at = stop


def _time(content: bytes) -> float:
    if len(content) < 52:
        return np.nan
    year, month, day, hour, minute, second, hundredth = struct.unpack_from("<7i", content, 24)
    return float(posix(year, month, day, hour, minute, second + hundredth * 0.01)[0])


def _bottom_track(content: bytes) -> Records | None:
    values = np.frombuffer(content[: len(content) & ~3], "<f4").astype(float)
    # A vertical beam has ensembles of its own.
    if len(values) < _HEAD or not 3.0 <= values[12] <= 4.0:
        return None
    beams = int(values[12])
    if len(values) < _HEAD + 10 * beams:
        return None
    values[~np.isfinite(values)] = np.nan
    # Range, SNR, amplitude, correlation, then velocity and count in beam, instrument and
    # Earth axes.
    arrays = values[_HEAD : _HEAD + 10 * beams].reshape(10, beams)
    ping = empty(1, INSTRUMENT)
    for name, index in (("heading", 2), ("pitch", 3)):
        ping[name] = values[index] * DEG
    roll = values[4] * DEG
    looks_down = np.cos(roll) < 0.0
    ping["roll"] = wrapped(roll - np.pi) if looks_down else roll
    ping["temperature"], ping["depth"], ping["sound_speed"] = values[5], values[9], values[10]
    first, last, number = values[0], values[1], values[13]
    interval = (last - first) / (number - 1.0) if number > 1.0 else np.nan
    if 0.0 < interval < _LONGEST_INTERVAL:
        ping["delay"], ping["window"] = averaged(number, interval)
    ping["range"][0, :beams] = np.where(arrays[0] > 0.0, arrays[0], np.nan)
    ping["beam_velocity"][0, :beams] = without(arrays[4], _BAD)
    velocity = without(arrays[6], _BAD)
    ping["velocity"] = velocity[:3] * (1.0 if looks_down else _OVER)
    ping["error"] = velocity[3] if beams == 4 else np.nan
    return ping


def _read_rowe(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    losses = Losses()
    for velocities, nmea in read_rowe(map_file(path), losses=losses):
        near = None
        if len(velocities):
            near = float(np.nanmedian(velocities["time"]))
            batch = pings(velocities, "own", "FRD", "")
            shifted = (_SHIFT,) if np.isfinite(velocities["delay"]).any() else ()
            yield replace(batch, notes=(_ERROR, *shifted))
            yield from (replace(b, axes="FRD") for b in attitude(velocities, "own"))
        yield from sentence_batches(nmea, near, losses)
    yield left_out(losses)


# Mean bytes of a record: what a count of records in a sample is worth.
_ROWE_BYTES = 3000.0

FORMATS = (
    Format(
        "rowe",
        "dvl",
        "Rowe `.ens`",
        share_of_records(read_rowe, _ROWE_BYTES),
        _read_rowe,
        "a recording of a boat (267 pings), counts by a search for its marks; axes by its own "
        "Earth velocities, speeds by its GNSS",
        (".ens",),
    ),
)
