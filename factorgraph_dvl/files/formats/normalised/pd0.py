"""PD0 in common terms: pings over bottom and through water, fixes, courses, attitude."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats import pd0
from factorgraph_dvl.files.formats.format import Batch, Clock, Format, Kind, empty, left_out
from factorgraph_dvl.files.formats.framing import Records, map_file
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.normalised.nmea import sentence_batches
from factorgraph_dvl.files.formats.velocities import BEAM
from factorgraph_dvl.geometry.vectors import Array

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
    return pd0.covered(sample) / len(sample) if sample else 0.0


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    losses = Losses()
    for block in pd0.read_pd0(map_file(path), losses):
        yield from _batches(block)
    yield left_out(losses)


def _batches(block: pd0.Block) -> Iterator[Batch]:
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
        yield from _fixes_of_vmdas(vmdas)
    yield from sentence_batches(
        block.nmea, near=float(np.nanmedian(times)) if _any(times) else None
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
    delay = 0.5 * (pings["pings"] - 1) * pings["ping_interval"]
    common["delay"] = np.where(delay > 0.0, delay, np.nan)
    stated, first = np.unique(delay, return_index=True)
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


def _fixes_of_vmdas(vmdas: Records) -> Iterator[Batch]:
    parts = []
    for which in ("first", "last"):
        out = empty("fix", len(vmdas))
        out["at"], out["time"] = vmdas["at"], vmdas[f"{which}_utc"]
        out["lat"], out["lon"] = vmdas[f"{which}_lat"], vmdas[f"{which}_lon"]
        parts.append(out)
    # Alternating, as they were measured.
    fixes = np.stack(parts, axis=1).reshape(-1)
    good = np.isfinite(fixes["lat"]) & np.isfinite(fixes["time"])
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
        "mhkit on three recordings, velocities to 1e-5 m/s",
        (".pd0", ".enx", ".ens", ".enr", ".sta", ".lta", ".000"),
    ),
)
