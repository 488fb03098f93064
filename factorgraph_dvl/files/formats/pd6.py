"""Teledyne PD6 and PD13, the text formats of DVLs.

Source: Teledyne, Pathfinder DVL Guide (April 2018), tables 50 and 51. Velocities are those
of the DVL, over the bottom or through a layer of water. There is no checksum: a line counts if
all its fields are numbers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgraph_dvl.files.formats.clocks import posix
from factorgraph_dvl.files.formats.format import Batch, Clock, Format, positive
from factorgraph_dvl.files.formats.framing import (
    BLOCK,
    Records,
    Source,
    lines,
    map_file,
    number,
)
from factorgraph_dvl.files.formats.losses import UNKNOWN_TYPE, Losses
from factorgraph_dvl.files.formats.velocities import (
    EARTH,
    INSTRUMENT,
    SHIP,
    VELOCITY,
    empty,
    pings,
    read_pings,
    share_of_records,
)
from factorgraph_dvl.geometry.units import DEG

# Lines of an ensemble, and of its velocities over the bottom (B) and through the water (W): by the
# last letter, in the order of preference, what is nearest to the instrument.
_AXES = {b"I": INSTRUMENT, b"S": SHIP, b"E": EARTH}
_FIELDS = {b":SA": 3, b":TS": 5, b":RA": 5}
_TRACK_FIELDS = {b"I": 5, b"S": 4, b"E": 4, b"D": 5}
Track = Literal["B", "W"]
_LINE = re.compile(rb"(:SA|:TS|:RA|:[BW][ISED]),([^:\"]*)")
_OTHER = re.compile(rb"(:[A-Z]{2}),")
_BAD = -32768.0


def read_pd6(
    source: Source, block: int = BLOCK, losses: Losses | None = None, track: Track = "B"
) -> Iterator[Records]:
    """Read ensembles, each from its attitude line to the next.

    Parameters
    ----------
    source : Source
        The file.
    block : int
        Number of ensembles at a time.
    losses : Losses, optional
        Takes counts of what was left out.
    track : {'B', 'W'}
        Over the bottom, or through the water.

    Yields
    ------
    Records
        (N,) of `VELOCITY`, in instrument axes where the file has them, else ship or Earth
        axes. Ranges are in PD13 only, `altitude` in both.
    """
    losses = Losses() if losses is None else losses
    out: list[Records] = []
    ping: Records | None = None
    best = EARTH
    for at, line in lines(source):
        # A prompt or a time may stand before the line.
        match = _LINE.search(line)
        if match is None:
            if other := _OTHER.search(line):
                losses.skip(other[1].decode(), UNKNOWN_TYPE)
            continue
        start, name, fields = match.start(), match[1], match[2].strip().split(b",")
        if name not in _FIELDS and name[1:2] != track.encode():
            continue
        if len(fields) < _FIELDS.get(name, _TRACK_FIELDS.get(name[2:], 0)):
            losses.add("line with too few fields", at)
            continue
        if name == b":SA":
            if ping is not None:
                out.append(ping)
            if len(out) == block:
                yield np.concatenate(out)
                out = []
            ping, best = empty(1, EARTH), EARTH + 1
            ping["at"] = at + start
            for angle, field in zip(("pitch", "roll", "heading"), fields, strict=False):
                ping[angle] = number(field) * DEG
            continue
        if ping is None:
            losses.skip(name.decode(), "before the first ensemble")
            continue
        losses.use(name.decode())
        if name not in _FIELDS and name[2:] in _AXES:
            if _AXES[name[2:]] < best:
                best = _velocity(ping, name[2:], fields)
        else:
            _rest(ping, name, fields)
    if ping is not None:
        out.append(ping)
    yield np.concatenate(out) if out else np.empty(0, VELOCITY)


def _velocity(ping: Records, axes: bytes, fields: list[bytes]) -> int:
    values = np.array([number(field) for field in fields[:4]])
    values = np.where(values == _BAD, np.nan, values * 1e-3)
    good = fields[_TRACK_FIELDS[axes] - 1].strip() == b"A" and bool(np.isfinite(values[:3]).all())
    ping["axes"] = _AXES[axes]
    ping["velocity"] = values[:3] if good else np.nan
    ping["error"] = values[3] if good and axes == b"I" else np.nan
    return _AXES[axes]


def _rest(ping: Records, name: bytes, fields: list[bytes]) -> None:
    if name == b":TS":
        stamp = fields[0].strip()
        if len(stamp) == 14 and stamp.isdigit():
            year, month, day, hour, minute, second, hundredth = (
                int(stamp[i : i + 2]) for i in range(0, 14, 2)
            )
            seconds = second + hundredth * 0.01
            ping["time"] = posix(year, month, day, hour, minute, seconds)
        ping["temperature"], ping["depth"] = number(fields[2]), number(fields[3])
        ping["sound_speed"] = number(fields[4])
    elif name == b":RA":
        ranges = np.array([number(field) for field in fields[1:5]]) * 0.1
        ping["range"] = positive(ranges)
    else:
        altitude = number(fields[3])
        ping["altitude"] = altitude if altitude > 0.0 else np.nan


def _read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    source = map_file(path)
    yield from read_pings(read_pd6, "own", "RFU", path)
    if has_water(source):
        for found in read_pd6(source, track="W"):
            yield water_pings(found, "own")


def has_water(source: Source) -> bool:
    """Return whether there are velocities through the water."""
    return any(source.find(b":W" + axes + b",") >= 0 for axes in _AXES)


def water_pings(found: Records, clock: Clock) -> Batch:
    """Return pings through the water in common terms."""
    return replace(pings(found, clock, "RFU", "water mass"), kind="water")


# Mean bytes of a record: what a count of records in a sample is worth.
_PD6_BYTES = 200.0

FORMATS = (
    Format(
        "pd6",
        "dvl",
        "Teledyne PD6, PD13",
        share_of_records(read_pd6, _PD6_BYTES),
        _read,
        "by its document; lines of a DVL H1000, which keep to it, by a script",
        (".pd6", ".pd13"),
        in_text=True,
    ),
)
