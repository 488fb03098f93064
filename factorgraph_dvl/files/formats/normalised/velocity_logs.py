"""Velocity logs that speak of themselves alone, in common terms."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgraph_dvl.files.formats.dvl_sentences import read_cerulean, read_nortek
from factorgraph_dvl.files.formats.format import Batch, Clock, Format, empty, left_out, positive
from factorgraph_dvl.files.formats.framing import Records, Source, map_file
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.normalised.nmea import sentence_batches
from factorgraph_dvl.files.formats.pd4 import read_pd4
from factorgraph_dvl.files.formats.pd6 import read_pd6
from factorgraph_dvl.files.formats.rowe import read_rowe
from factorgraph_dvl.files.formats.water_linked import read_water_linked
from factorgraph_dvl.geometry.rotations import BodyAxes

_Axes = BodyAxes | Literal[""]
# Mean bytes of a record: what a count of records in a sample is worth there.
_PD4_BYTES, _PD6_BYTES, _SENTENCE_BYTES = 47.0, 200.0, 120.0
_WATER_LINKED_BYTES, _ROWE_BYTES = 60.0, 3000.0
_MEAN_INCREMENT = "velocities are means since the ping before: stamps are shifted to the middle"


def _share(count: Callable[[bytes], int], size: float) -> Callable[[Path, bytes], float]:
    def share(path: Path, sample: bytes) -> float:
        return min(count(sample) * size / len(sample), 1.0) if sample else 0.0

    return share


def _pings(records: Records, clock: Clock, axes: _Axes, stream: str) -> Batch:
    """Return pings of a reader, with the time that it has."""
    out = empty("dvl", len(records))
    for name in ("at", "axes", "velocity", "error", "range", "roll", "pitch", "heading"):
        out[name] = records[name]
    for name in ("sound_speed", "temperature"):
        out[name] = records[name]
    out["beams"] = records["beam_velocity"]
    has_time = clock in ("utc", "own") and bool(np.isfinite(records["time"]).any())
    out["time"] = records["time"] if has_time else records["second"]
    out["received"] = out["time"]
    out["alignment"], out["tilts_used"] = 0.0, True
    out["std"] = positive(records["merit"])[:, None]
    return Batch("dvl", out, clock, stream, axes)


def _read(
    reader: Callable[..., Iterator[Records]],
    clock: Clock,
    axes: _Axes,
    path: Path,
    mapping: Mapping[str, Any] | None = None,
) -> Iterator[Batch]:
    losses = Losses()
    for records in reader(map_file(path), losses=losses):
        if len(records):
            yield _pings(records, clock, axes, "")
            yield from _attitude(records, clock)
    yield left_out(losses)


def _attitude(records: Records, clock: Clock) -> Iterator[Batch]:
    if not np.isfinite(records["heading"]).any():
        return
    out = empty("attitude", len(records))
    for name in ("at", "roll", "pitch", "heading"):
        out[name] = records[name]
    time = records["time"] if np.isfinite(records["time"]).any() else records["second"]
    out["time"] = out["received"] = time
    yield Batch("attitude", out, clock, "leader")


def _read_water_linked(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    losses = Losses()
    for velocities, _ in read_water_linked(map_file(path), losses=losses):
        if len(velocities):
            yield _pings(velocities, "own", "FRD", "")
    yield left_out(losses)


def _read_cerulean(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    last = np.nan
    losses = Losses()
    for increments, extended in read_cerulean(map_file(path), losses=losses):
        if len(increments):
            batch = _pings(increments, "own", "", "DVPDL")
            stamps = np.concatenate([[last], increments["second"]])
            last = float(stamps[-1])
            steps = np.diff(stamps)
            delay = np.where((steps > 0.0) & (steps < 10.0), -steps / 2.0, 0.0)
            batch.records["delay"] = delay
            yield Batch("dvl", batch.records, "own", "DVPDL", notes=(_MEAN_INCREMENT,))
        if len(extended):
            yield _pings(extended, "own", "", "DVEXT")
            yield from _attitude(extended, "own")
    yield left_out(losses)


def _read_rowe(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    losses = Losses()
    for velocities, nmea in read_rowe(map_file(path), losses=losses):
        near = None
        if len(velocities):
            near = float(np.nanmedian(velocities["time"]))
            yield _pings(velocities, "own", "", "")
            yield from _attitude(velocities, "own")
        yield from sentence_batches(nmea, near)
    yield left_out(losses)


def _count(reader: Callable[[Source], Iterator[Any]]) -> Callable[[bytes], int]:
    def count(sample: bytes) -> int:
        total = 0
        for block in reader(sample):
            parts = block if isinstance(block, tuple) else (block,)
            total += sum(len(part) for part in parts if isinstance(part, np.ndarray))
        return total

    return count


FORMATS = (
    Format(
        "pd4",
        "dvl",
        "Teledyne PD4, PD5",
        _share(_count(read_pd4), _PD4_BYTES),
        partial(_read, read_pd4, "day", "RFU"),
        "files written after the manufacturer's tables",
        (".pd4", ".pd5"),
    ),
    Format(
        "pd6",
        "dvl",
        "Teledyne PD6, PD13",
        _share(_count(read_pd6), _PD6_BYTES),
        partial(_read, read_pd6, "own", "RFU"),
        "files written after the manufacturer's tables",
        (".pd6", ".pd13"),
        in_text=True,
    ),
    Format(
        "nortek",
        "dvl",
        "Nortek `$PNORBT0`, `1`, `6` to `9`",
        _share(_count(read_nortek), _SENTENCE_BYTES),
        partial(_read, read_nortek, "own", ""),
        "published sentences",
        in_text=True,
    ),
    Format(
        "water-linked",
        "dvl",
        "Water Linked JSON, `wrz`, `wru`, `wrp`",
        _share(_count(read_water_linked), _WATER_LINKED_BYTES),
        _read_water_linked,
        "the document's examples",
        (".json", ".jsonl"),
        in_text=True,
    ),
    Format(
        "cerulean",
        "dvl",
        "Cerulean `$DVPDL`, `$DVEXT`",
        _share(_count(read_cerulean), _SENTENCE_BYTES),
        _read_cerulean,
        "files written after the document",
        in_text=True,
    ),
    Format(
        "rowe",
        "dvl",
        "Rowe `.ens`",
        _share(_count(read_rowe), _ROWE_BYTES),
        _read_rowe,
        "not verified: no document and no recording was available",
        (".ens",),
    ),
)
