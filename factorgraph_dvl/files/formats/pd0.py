"""Teledyne PD0, as ADCPs, DVLs, VmDas and WinRiver write it.

Sources: Teledyne, Pathfinder DVL Guide (April 2018), PD0 Output Data Format; RiverPro and
RioPro ADCP Guide (October 2017), NMEA PD0 Message Format.

A velocity here is one of the bottom or of the water relative to the instrument, as in the file;
that of the vehicle is its opposite. Velocities along beams are positive towards the
transducer, which is the velocity of the transducer along the outward beam.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.files.formats.clocks import posix
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
from factorgraph_dvl.files.formats.pd0_navigation import VMDAS, embedded_sentences, vmdas_fixes
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array

BEAM, INSTRUMENT, SHIP, EARTH = range(4)
_SYNC = b"\x7f\x7f"
# At least a header with one data type, at most what 16 bits can count.
_SHORTEST, _LONGEST = 8, 65535
# Ensembles at a time: profiles of 255 cells then take 17 MB.
_MOST = 2048

PING = np.dtype(
    [
        ("at", "i8"),
        ("number", "i8"),
        ("time", "f8"),
        ("coordinates", "u1"),
        ("tilts_used", "?"),
        ("three_beams_used", "?"),
        ("up", "?"),
        ("convex", "?"),
        ("beam_angle", "f8"),
        ("heading_alignment", "f8"),
        ("heading_bias", "f8"),
        ("sensor_source", "u1"),
        ("pings", "i8"),
        ("ping_interval", "f8"),
        ("cells", "i8"),
        ("cell_size", "f8"),
        ("first_cell", "f8"),
        ("sound_speed", "f8"),
        ("depth", "f8"),
        ("heading", "f8"),
        ("pitch", "f8"),
        ("roll", "f8"),
        ("salinity", "f8"),
        ("temperature", "f8"),
        ("bottom_velocity", "f8", (4,)),
        ("bottom_range", "f8", (4,)),
        ("bottom_correlation", "f8", (4,)),
        ("bottom_amplitude", "f8", (4,)),
        ("bottom_good", "f8", (4,)),
    ]
)


def _layout(size: int, **fields: tuple[int, str]) -> np.dtype[np.void]:
    return np.dtype(
        {
            "names": list(fields),
            "offsets": [offset for offset, _ in fields.values()],
            "formats": [form for _, form in fields.values()],
            "itemsize": size,
        }
    )


_FIXED = _layout(
    59,
    configuration=(4, "<u2"),
    cells=(9, "u1"),
    pings=(10, "<u2"),
    cell_size=(12, "<u2"),
    interval=(22, "3u1"),
    transform=(25, "u1"),
    alignment=(26, "<i2"),
    bias=(28, "<i2"),
    source=(30, "u1"),
    first_cell=(32, "<u2"),
    angle=(58, "u1"),
)
_VARIABLE = _layout(
    65,
    number=(2, "<u2"),
    clock=(4, "7u1"),
    number_high=(11, "u1"),
    sound_speed=(14, "<u2"),
    depth=(16, "<u2"),
    heading=(18, "<u2"),
    pitch=(20, "<i2"),
    roll=(22, "<i2"),
    salinity=(24, "<u2"),
    temperature=(26, "<i2"),
    century=(57, "u1"),
    clock_2000=(58, "7u1"),
)
_BOTTOM = _layout(
    81,
    range=(16, "4<u2"),
    velocity=(24, "4<i2"),
    correlation=(32, "4u1"),
    amplitude=(36, "4u1"),
    good=(40, "4u1"),
    range_high=(77, "4u1"),
)
# A velocity that is missing, as TRDI defines it.
_BAD = -32768


@dataclass(frozen=True)
class Block:
    """Consecutive ensembles.

    Parameters
    ----------
    pings : Records
        (N,) of `PING`: `at`, position in the file; `time` at which the ensemble began, by the
        instrument, seconds since 1970; `pings`, how many are averaged in it, and
        `ping_interval`, s from one to the next, 0 for as fast as possible; angles in rad, roll
        positive starboard down, pitch positive bow up, if beam 3 is forward;
        `heading_alignment` and `heading_bias`, EA and EB; `up`, looking up;
        `bottom_...` by beam (or axis, for velocities in other than beam coordinates), ranges
        vertical, m; nan where not measured.
    water : Array
        (N, C, 4) velocities of the water, m/s, nan where there are none.
    vmdas : Records
        (M,) of `VMDAS`, each with `at` of its ensemble.
    nmea : dict of str to Records
        Sentences that WinRiver stored, as `read_nmea` returns them, in the order of the file.
        `received`: on the clock of `time`, where the file has it.
    """

    pings: Records
    water: Array
    vmdas: Records
    nmea: dict[str, Records]


def read_pd0(source: Source, losses: Losses | None = None) -> Iterator[Block]:
    """Read ensembles whose checksum is right and that have both leaders.

    Parameters
    ----------
    source : Source
        The file.
    losses : Losses, optional
        Takes counts of what was left out.

    Yields
    ------
    Block
    """
    losses = Losses() if losses is None else losses
    for frames in count_outside(source, _frames(source), losses, _FRAME, 2):
        for first in range(0, len(frames), _MOST):
            part = frames[first : first + _MOST]
            begin = int(part[0, 0])
            data = as_bytes(source, begin, int(part[-1, 1]))
            block = _block(data, part - begin, begin)
            losses.add("ensemble without leaders", begin, len(part) - len(block.pings))
            if len(block.pings):
                yield block


def covered(sample: bytes) -> int:
    """Return the number of bytes of a sample that lie in ensembles whose checksum is right."""
    return sum(int(np.sum(frames[:, 1] - frames[:, 0] + 2)) for frames in _frames(sample))


def _frames(source: Source) -> Iterator[Index]:
    return summed_frames(source, _SYNC, _length, _SHORTEST, _LONGEST)


def _length(data: Bytes, at: Index) -> Index:
    length = u16(data, at + 2)
    types = data[at + 5].astype(np.int64)
    return np.where((types > 0) & (length >= 6 + 2 * types), length, 0)


_FRAME = summed("ensemble", _SYNC, _length, _SHORTEST)


class _Types:
    """Where each data type stands in each of K ensembles."""

    def __init__(self, data: Bytes, frames: Index) -> None:
        self.data = data
        start, stop = frames[:, 0], frames[:, 1]
        count = data[start + 5].astype(np.int64)
        column = np.arange(int(count.max()))
        listed = column < count[:, None]
        offset = np.where(listed, u16(data, start[:, None] + 6 + 2 * column * listed), 0)
        self.begin = start[:, None] + offset
        # Each type ends where the next one in the ensemble starts, in whatever order.
        good = listed & (offset >= 6 + 2 * count[:, None]) & (self.begin + 2 <= stop[:, None])
        order = np.argsort(np.where(good, self.begin, np.iinfo(np.int64).max), axis=1)
        ordered = np.take_along_axis(np.where(good, self.begin, stop[:, None]), order, axis=1)
        following = np.concatenate([ordered[:, 1:], stop[:, None]], axis=1)
        self.end = np.empty_like(self.begin)
        np.put_along_axis(self.end, order, following, axis=1)
        self.identity = np.where(good, u16(data, np.where(good, self.begin, start[:, None])), -1)

    def first(self, identity: int, shortest: int) -> tuple[Index, Index, NDArray[np.bool_]]:
        """Return begin, end and presence (K,) of a data type."""
        fits = (self.identity == identity) & (self.end - self.begin >= shortest)
        column = np.argmax(fits, axis=1)
        row = np.arange(len(fits))
        return self.begin[row, column], self.end[row, column], fits.any(axis=1)

    def decode(
        self, identity: int, shortest: int, layout: np.dtype[np.void]
    ) -> tuple[Records, NDArray[np.bool_]]:
        """Return one record for each ensemble, zero beyond its end, and presence (K,)."""
        begin, end, present = self.first(identity, shortest)
        return gather(self.data, begin, np.where(present, end, begin), layout), present


def gather(data: Bytes, begin: Index, end: Index, layout: np.dtype[np.void]) -> Records:
    """Return records (K,) that start at `begin`, with zeros for what lies behind `end`."""
    at = begin[:, None] + np.arange(layout.itemsize)
    inside = at < end[:, None]
    raw = np.where(inside, data[np.where(inside, at, 0)], np.uint8(0))
    return np.ascontiguousarray(raw).view(layout)[:, 0]


def _block(data: Bytes, frames: Index, begin: int) -> Block:
    types = _Types(data, frames)
    _, _, has_fixed = types.first(0x0000, 42)
    _, _, has_variable = types.first(0x0080, 28)
    whole = has_fixed & has_variable
    frames = frames[whole]
    if not len(frames):
        return Block(np.empty(0, PING), np.empty((0, 0, 4)), np.empty(0, VMDAS), {})
    types = _Types(data, frames)
    pings = np.zeros(len(frames), PING)
    pings["at"] = frames[:, 0] + begin
    _leaders(pings, types)
    _bottom(pings, types)
    fixes = vmdas_fixes(data, frames, *types.first(0x2000, 78))
    fixes["at"] += begin
    nmea = embedded_sentences(data, types.identity, types.begin, types.end, pings, begin)
    return Block(pings, _water(pings, types), fixes, nmea)


def _leaders(pings: Records, types: _Types) -> None:
    fixed, _ = types.decode(0x0000, 42, _FIXED)
    configuration = fixed["configuration"]
    pings["coordinates"] = (fixed["transform"] >> 3) & 3
    pings["tilts_used"] = (fixed["transform"] & 4) > 0
    pings["three_beams_used"] = (fixed["transform"] & 2) > 0
    pings["up"] = (configuration & 0x80) > 0
    pings["convex"] = (configuration & 0x08) > 0
    nominal = np.array([15.0, 20.0, 30.0, np.nan])[(configuration >> 8) & 3]
    stated = fixed["angle"].astype(float)
    # Instruments that state the angle do so in degrees; others have other things there.
    is_stated = (stated >= 5.0) & (stated <= 45.0)
    pings["beam_angle"] = np.where(np.isnan(nominal) & is_stated, stated, nominal) * DEG
    pings["heading_alignment"] = fixed["alignment"] * 0.01 * DEG
    pings["heading_bias"] = fixed["bias"] * 0.01 * DEG
    pings["sensor_source"] = fixed["source"]
    pings["pings"], pings["cells"] = fixed["pings"], fixed["cells"]
    pings["ping_interval"] = fixed["interval"] @ np.array([60.0, 1.0, 0.01])
    pings["cell_size"], pings["first_cell"] = fixed["cell_size"] * 0.01, fixed["first_cell"] * 0.01

    variable, _ = types.decode(0x0080, 28, _VARIABLE)
    pings["number"] = variable["number"] + variable["number_high"].astype(np.int64) * 65536
    has_century = (variable["century"] == 19) | (variable["century"] == 20)
    clock = np.where(has_century[:, None], variable["clock_2000"], variable["clock"]).astype(int)
    year = clock[:, 0] + np.where(has_century, variable["century"].astype(int) * 100, 0)
    second = clock[:, 5] + clock[:, 6] * 0.01
    pings["time"] = posix(year, clock[:, 1], clock[:, 2], clock[:, 3], clock[:, 4], second)
    pings["sound_speed"] = variable["sound_speed"]
    pings["depth"] = variable["depth"] * 0.1
    for name in ("heading", "pitch", "roll"):
        pings[name] = variable[name] * 0.01 * DEG
    pings["salinity"] = variable["salinity"]
    pings["temperature"] = variable["temperature"] * 0.01


def _bottom(pings: Records, types: _Types) -> None:
    bottom, present = types.decode(0x0600, 44, _BOTTOM)
    absent = ~present[:, None]
    velocity = bottom["velocity"]
    far = bottom["range"] + bottom["range_high"] * 65536.0
    pings["bottom_velocity"] = np.where(absent | (velocity == _BAD), np.nan, velocity * 1e-3)
    pings["bottom_range"] = np.where(absent | (far == 0.0), np.nan, far * 0.01)
    for name in ("correlation", "amplitude", "good"):
        pings[f"bottom_{name}"] = np.where(absent, np.nan, bottom[name])


def _water(pings: Records, types: _Types) -> Array:
    begin, end, present = types.first(0x0100, 2)
    cells = np.where(present, np.minimum(pings["cells"], (end - begin - 2) // 8), 0)
    most = int(cells.max())
    if not most:
        return np.empty((len(pings), 0, 4))
    layout = np.dtype([("velocity", "<i2", (most, 4))])
    values = gather(types.data, begin + 2, begin + 2 + cells * 8, layout)["velocity"]
    inside = np.arange(most) < cells[:, None]
    return np.where(inside[:, :, None] & (values != _BAD), values * 1e-3, np.nan)
