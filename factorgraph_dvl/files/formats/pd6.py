"""Teledyne PD6 and PD13, the text formats of DVLs.

Source: Teledyne, Pathfinder DVL Guide (April 2018), tables 50 and 51. Velocities are those
of the DVL, over the bottom. There is no checksum: a line counts if all its fields are
numbers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial

import numpy as np

from factorgraph_dvl.files.formats.clocks import posix
from factorgraph_dvl.files.formats.format import Format, positive
from factorgraph_dvl.files.formats.framing import BLOCK, Records, Source, lines, number
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.velocities import (
    EARTH,
    INSTRUMENT,
    SHIP,
    VELOCITY,
    empty,
    read_pings,
    share_of_records,
)
from factorgraph_dvl.geometry.units import DEG

# In the order of preference: what is nearest to the instrument.
_AXES = {b":BI": INSTRUMENT, b":BS": SHIP, b":BE": EARTH}
_FIELDS = {b":SA": 3, b":TS": 5, b":RA": 5, b":BI": 5, b":BS": 4, b":BE": 4, b":BD": 5}
_LINE = re.compile(rb"(:SA|:TS|:RA|:BI|:BS|:BE|:BD),([^:]*)")
_BAD = -32768.0


def read_pd6(
    source: Source, block: int = BLOCK, losses: Losses | None = None
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
            continue
        start, name, fields = match.start(), match[1], match[2].strip().split(b",")
        if len(fields) < _FIELDS[name]:
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
        elif ping is None:
            continue
        elif name in _AXES:
            if _AXES[name] < best:
                best = _velocity(ping, name, fields)
        else:
            _rest(ping, name, fields)
    if ping is not None:
        out.append(ping)
    yield np.concatenate(out) if out else np.empty(0, VELOCITY)


def _velocity(ping: Records, name: bytes, fields: list[bytes]) -> int:
    values = np.array([number(field) for field in fields[:4]])
    values = np.where(values == _BAD, np.nan, values * 1e-3)
    good = fields[_FIELDS[name] - 1].strip() == b"A" and bool(np.isfinite(values[:3]).all())
    ping["axes"] = _AXES[name]
    ping["velocity"] = values[:3] if good else np.nan
    ping["error"] = values[3] if good and name == b":BI" else np.nan
    return _AXES[name]


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


# Mean bytes of a record: what a count of records in a sample is worth.
_PD6_BYTES = 200.0

FORMATS = (
    Format(
        "pd6",
        "dvl",
        "Teledyne PD6, PD13",
        share_of_records(read_pd6, _PD6_BYTES),
        partial(read_pings, read_pd6, "own", "RFU"),
        "files written after the manufacturer's tables",
        (".pd6", ".pd13"),
        in_text=True,
    ),
)
