"""Teledyne PD0, as ADCPs, DVLs, VmDas and WinRiver write it.

Sources: Teledyne, Pathfinder DVL Guide (April 2018), PD0 Output Data Format; RiverPro and
RioPro ADCP Guide (October 2017), NMEA PD0 Message Format.

A velocity here is one of the bottom or of the water relative to the instrument, as in the file;
that of the vehicle is its opposite. Velocities along beams are positive towards the
transducer, which is the velocity of the transducer along the outward beam.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.files.formats.clocks import posix
from factorgraph_dvl.files.formats.format import (
    Batch,
    Clock,
    Format,
    Kind,
    empty,
    left_out,
    type_name,
)
from factorgraph_dvl.files.formats.framing import (
    Bytes,
    Index,
    Records,
    Source,
    as_bytes,
    map_file,
    summed_frames,
    u16,
)
from factorgraph_dvl.files.formats.losses import NO_FIX, Losses, count_outside, summed
from factorgraph_dvl.files.formats.nmea import sentence_batches
from factorgraph_dvl.files.formats.pd0_navigation import VMDAS, embedded_sentences, vmdas_fixes
from factorgraph_dvl.files.formats.velocities import BEAM, averaged
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array

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


# Chosen: cells over which the water's velocity is averaged; the first is disturbed by the hull,
# and where shear is strong a mean over more of them is another water's. A ping counts if half
# of them have a velocity.
_CELLS = slice(1, 8)
_SIGN = (
    "PD0 stores the velocity of the bottom relative to the instrument: velocities in axes "
    "were reversed; velocities along beams are those of the transducers already"
)
_CLOCK = "pings of VmDas: UTC is the clock of the PC minus its stored difference from UTC"
_SHIFT = (
    "PD0 stamps an ensemble when it begins, and its pings are {interval:g} s apart: stamps of "
    "velocities were shifted by {delay:g} s, to the middle of the pings"
)
_HEIGHT = "VmDas stores fixes without heights"
# Bit of EZ, the sources of sensors: heading by the compass in the instrument.
_OWN_HEADING = 1 << 4


def share(path: Path, sample: bytes) -> float:
    """Return the share of a sample that lies in ensembles."""
    return covered(sample) / len(sample) if sample else 0.0


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    losses = Losses()
    for block in read_pd0(map_file(path), losses):
        yield from _batches(block, losses)
    yield left_out(losses)


def _batches(block: Block, losses: Losses) -> Iterator[Batch]:
    pings, vmdas = block.pings, block.vmdas
    times: Array = pings["time"]
    clock: Clock = "own"
    notes: tuple[str, ...] = ()
    if len(vmdas):
        times, clock, notes = _times_of_vmdas(pings, vmdas), "utc", (_CLOCK,)
    received = pings["time"]
    common = _common(pings, times)
    common["received"] = received
    if clock == "own":
        # Which of its ensembles' times VmDas stores is not documented.
        notes = _shift(common, pings)
    bottom = pings["bottom_velocity"]
    if np.isfinite(bottom).any():
        yield _pings("dvl", common, bottom, clock, notes)
    water = _mean_of_cells(block.water)
    if np.isfinite(water).any():
        yield _pings("water", common, water, clock, notes)
    attitude = empty("attitude", len(pings))
    for name in ("at", "roll", "pitch", "heading"):
        attitude[name] = pings[name]
    attitude["time"], attitude["received"] = times, received
    # With EB stated the heading is corrected already, and an external one is a gyro's.
    magnetic = (pings["sensor_source"] & _OWN_HEADING > 0) & (pings["heading_bias"] == 0.0)
    yield Batch(
        "attitude",
        attitude,
        clock,
        "leader",
        "RFU",
        "magnetic" if magnetic.any() else "unknown",
        _about_heading(pings),
    )
    if len(vmdas):
        yield from _fixes_of_vmdas(vmdas, losses)
    yield from sentence_batches(
        block.nmea, float(np.nanmedian(times)) if _any(times) else None, losses
    )


def _any(values: Array) -> bool:
    return bool(np.isfinite(values).any())


def _common(pings: Records, times: Array) -> Records:
    out = empty("dvl", len(pings))
    for name in ("at", "number", "roll", "pitch", "heading", "tilts_used", "up", "convex"):
        out[name] = pings[name]
    for name in ("beam_angle", "sound_speed", "temperature"):
        out[name] = pings[name]
    out["time"], out["axes"] = times, pings["coordinates"]
    out["alignment"] = pings["heading_alignment"]
    return out


def _shift(common: Records, pings: Records) -> tuple[str, ...]:
    """Set the delays from stamps to the middle of averages; return what is said about them."""
    common["delay"], common["window"] = averaged(pings["pings"], pings["ping_interval"])
    stated, first = np.unique(common["delay"], return_index=True)
    return tuple(
        _SHIFT.format(interval=pings["ping_interval"][place], delay=value)
        for value, place in zip(stated, first, strict=True)
        if value > 0.0
    )


def _pings(
    kind: Kind, common: Records, bottom: Array, clock: Clock, notes: tuple[str, ...]
) -> Batch:
    out = common.copy()
    in_beams = out["axes"] == BEAM
    out["beams"] = np.where(in_beams[:, None], bottom, np.nan)
    out["velocity"] = np.where(in_beams[:, None], np.nan, -bottom[:, :3])
    out["error"] = np.where(in_beams, np.nan, -bottom[:, 3])
    return Batch(
        kind, out, clock, "bottom" if kind == "dvl" else "cells", "RFU", notes=(_SIGN, *notes)
    )


def _mean_of_cells(water: Array) -> Array:
    """Return mean velocities (N, 4) over cells, nan where fewer than half of them have one."""
    cells = water[:, _CELLS]
    whole = np.asarray(np.isfinite(cells).all(axis=2), bool)
    count = whole.sum(axis=1)
    total = np.where(whole[:, :, None], cells, 0.0).sum(axis=1)
    enough = (count > 0) & (2 * count >= whole.shape[1])
    return np.where(enough[:, None], total / np.maximum(count, 1)[:, None], np.nan)


def _times_of_vmdas(pings: Records, vmdas: Records) -> Array:
    time = np.full(len(pings), np.nan)
    place = np.searchsorted(pings["at"], vmdas["at"])
    time[place] = vmdas["time"] - vmdas["pc_minus_utc"]
    return time


def _fixes_of_vmdas(vmdas: Records, losses: Losses) -> Iterator[Batch]:
    parts = []
    for which in ("first", "last"):
        out = empty("fix", len(vmdas))
        out["at"], out["time"] = vmdas["at"], vmdas[f"{which}_utc"]
        out["lat"], out["lon"] = vmdas[f"{which}_lat"], vmdas[f"{which}_lon"]
        parts.append(out)
    # Alternating, as they were measured.
    fixes = np.stack(parts, axis=1).reshape(-1)
    good = np.isfinite(fixes["lat"]) & np.isfinite(fixes["time"])
    losses.skip(type_name("fix", "VmDas"), NO_FIX, int((~good).sum()))
    yield Batch("fix", fixes[good], "utc", "VmDas", notes=(_HEIGHT,))


def _about_heading(pings: Records) -> tuple[str, ...]:
    bias = np.unique(pings["heading_bias"])
    if not bias.any():
        return ()
    stated = ", ".join(f"{value:.2f}" for value in np.rad2deg(bias))
    return (f"EB is {stated}°: headings in the file contain it already",)


FORMATS = (
    Format(
        "pd0",
        "dvl",
        "Teledyne PD0; `.ENX`, `.ENS`, `.ENR`, `.STA`, `.LTA` of VmDas; WinRiver",
        share,
        read,
        "three recordings (Nenana River, VmDas, WinRiver), by mhkit: velocities to 1e-5 m/s, "
        "pings with lock; counts by type by a script",
        (".pd0", ".enx", ".ens", ".enr", ".sta", ".lta", ".000"),
    ),
)
