"""Sentences of USBL systems: Kongsberg's `$PSIMSSB`, and `$PTSAG` of Exail's GAPS and Posidonia.

Sources: the sentences that Kongsberg's HPR 400 and HiPAP print (document 850-160045), with EIVA's
page on which of their forms are usual; the user guide of GAPS (MU-GAPS-AN-005), appendix on
protocols. `$PSIMSSB` has the time of day, the transponder, a status, and starboard, forward and
depth of it from the vessel, if they are Cartesian and head up: other forms are left out. `$PTSAG`
has date and time, latitude, longitude and depth of a transponder, or of the ship, as number 0.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.clocks import posix
from factorgraph_dvl.files.formats.format import (
    Batch,
    Clock,
    Format,
    Kind,
    empty,
    left_out,
    positive,
)
from factorgraph_dvl.files.formats.framing import BLOCK_OF_LINES, map_file, number
from factorgraph_dvl.files.formats.losses import NO_FIX, UNKNOWN_TYPE, Losses
from factorgraph_dvl.files.formats.sentences import NOT_USABLE, Sentence, sentences
from factorgraph_dvl.geometry.units import DEG

_ADDRESSES = b"PSIMSSB|PTSAG"
# A sentence besides its fields: `$`, address, comma, checksum, line end.
_FRAME = 13
_FIELDS = {b"PSIMSSB": 11, b"PTSAG": 13}
_SHIP = b"0"
_HEAD_UP = "$PSIMSSB: starboard, forward and depth of the transponder, head up"
_DEPTH = "$PTSAG: heights are depths below the surface, with the sign reversed"
# Stream, and what its records have in common.
_Key = tuple[Kind, str, Clock]


def share(path: Path, sample: bytes) -> float:
    """Return the share of a sample that is such sentences."""
    found = sum(len(b",".join(s.fields)) + _FRAME for s in sentences(sample, _ADDRESSES))
    return min(found / len(sample), 1.0) if sample else 0.0


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    losses = Losses()
    rows: dict[_Key, list[tuple[float, ...]]] = defaultdict(list)
    count = 0
    for sentence in sentences(map_file(path), _ADDRESSES):
        found = _row(sentence, losses)
        if found is None:
            continue
        key, row = found
        rows[key].append((sentence.at, sentence.received, *row))
        count += 1
        if count % BLOCK_OF_LINES == 0:
            yield from _batches(rows)
            rows.clear()
    yield from _batches(rows)
    yield left_out(losses)


def _row(sentence: Sentence, losses: Losses) -> tuple[_Key, tuple[float, ...]] | None:
    fields = sentence.fields
    if len(fields) < _FIELDS[sentence.address]:
        losses.add(NOT_USABLE, sentence.at)
        return None
    return _ssbl(fields, losses) if sentence.address == b"PSIMSSB" else _absolute(fields, losses)


def _ssbl(fields: list[bytes], losses: Losses) -> tuple[_Key, tuple[float, ...]] | None:
    """Return time of day, forward, starboard, down, and their accuracy."""
    name = fields[1].decode("latin-1")
    if fields[4] != b"C" or fields[5] != b"H":
        losses.skip("PSIMSSB that is not Cartesian and head up", UNKNOWN_TYPE)
        return None
    place = [number(fields[i]) for i in (8, 7, 9)]
    if fields[2] != b"A" or not np.isfinite(place).all():
        losses.skip("PSIMSSB", NO_FIX)
        return None
    row = (_of_day(fields[0]), *place, number(fields[10]))
    return ("acoustic", f"PSIMSSB {name}", "day"), row


def _absolute(fields: list[bytes], losses: Losses) -> tuple[_Key, tuple[float, ...]] | None:
    """Return UTC, latitude, longitude, depth."""
    date = [number(fields[i]) for i in (4, 3, 2)]
    lat, lon = _angle(fields[6], fields[7]), _angle(fields[8], fields[9])
    if not np.isfinite([*date, lat, lon]).all():
        losses.skip("PTSAG", NO_FIX)
        return None
    beacon = fields[5].lstrip(b"0") or _SHIP
    kind: Kind = "topside" if beacon == _SHIP else "transponder"
    time = float(posix(*(int(part) for part in date))[0]) + _of_day(fields[1])
    stream = f"PTSAG {beacon.decode('latin-1')}"
    # Without a depth, 9999 or a validity of 0.
    depth = number(fields[11]) if fields[12] != b"0" else np.nan
    return (kind, stream, "utc"), (time, lat, lon, depth)


def _of_day(field: bytes) -> float:
    """Return seconds of the day of hhmmss.ss."""
    clock = number(field)
    return float(clock // 1e4 * 3600.0 + clock % 1e4 // 100.0 * 60.0 + clock % 100.0)


def _angle(field: bytes, side: bytes) -> float:
    """Return the angle of dddmm.mmm, rad."""
    value = number(field)
    sign = -1.0 if side in (b"S", b"W") else 1.0
    return float(sign * (value // 100.0 + value % 100.0 / 60.0) * DEG)


def _batches(rows: Mapping[_Key, list[tuple[float, ...]]]) -> Iterator[Batch]:
    for (kind, stream, clock), found in rows.items():
        at, received, time, *values = np.array(found).T
        out = empty(kind, len(found))
        out["at"], out["received"], out["time"] = at, received, time
        if kind == "acoustic":
            out["place"], out["std"] = np.transpose(values[:3]), positive(values[3])
            yield Batch(kind, out, clock, stream, notes=(_HEAD_UP,))
            continue
        out["lat"], out["lon"] = values[:2]
        if kind == "transponder":
            out["altitude"] = -values[2]
        yield Batch(kind, out, clock, stream, notes=(_DEPTH,) if kind == "transponder" else ())


FORMAT = Format(
    name="usbl-sentences",
    family="gnss",
    title="USBL sentences: Kongsberg `$PSIMSSB`, Exail `$PTSAG`",
    share=share,
    read=read,
    verified="the examples of the documents; no recording was to be had",
    endings=(".txt", ".log", ".nmea"),
    in_text=True,
    addresses=_ADDRESSES,
)
