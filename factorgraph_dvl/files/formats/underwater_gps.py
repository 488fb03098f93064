"""Water Linked Underwater GPS: tables of what its API answers, a row for each call.

Source: the interface of the Underwater GPS, `position/acoustic/filtered`, `position/master` and
`position/global`, whose names the columns have, beside those of the sentences GGA and HDT that
the system at the surface was given. `timestamp` is that of the computer that asked, seconds since
1970. Places are in metres, x forward and y starboard of the system at the surface, z the depth:
Water Linked's page on reference frames, of the G2. In a recording with turns of 90°, the track of
the vehicle is the smoothest with these axes. The first version (Explorer Kit) has y forward.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.clocks import nearest_day
from factorgraph_dvl.files.formats.format import Batch, Format, empty, left_out, positive
from factorgraph_dvl.files.formats.framing import BLOCK_OF_LINES, Records, map_file, number
from factorgraph_dvl.files.formats.headed_table import find_header, rows
from factorgraph_dvl.files.formats.losses import REPEATED, UNKNOWN_TYPE, Losses
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array

_PLACE = ("x", "y", "z", "std")
_SURFACE = ("lat", "lon", "orientation")
_GGA = ("utc", "latitude", "longitude")
_ORIENTATION = ("roll", "pitch", "yaw", "state", "progress")
_TRUE = (b"true", b"1", b"1.0")
_TIME = "timestamp"
_AXES = (
    "acoustic places taken as forward, starboard, down of the system at the surface, as those of "
    "a G2; an Explorer Kit, whose y is forward, is not read"
)
_SURFACE_NOTE = (
    "positions with an orientation: those of the system at the surface, not of the vehicle"
)
_GLOBAL_NOTE = "positions without an orientation: those of the vehicle"
# Cells of a row by the names of the columns.
Row = dict[str, bytes]


def share(path: Path, sample: bytes) -> float:
    """Return whether the first lines of a sample name the columns of such a table."""
    return float(find_header(sample, *map(set, _CONVERTERS)) is not None)


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    source = map_file(path)
    header = find_header(source, *map(set, _CONVERTERS))
    if header is None:
        return
    convert = next(_CONVERTERS[key] for key in _CONVERTERS if set(key) <= set(header.names))
    losses = Losses()
    gathered: list[Row] = []
    places: list[int] = []
    kept = header.names.index(_TIME)
    last: list[bytes] = []
    for at, cells in rows(source, header, losses):
        content = cells[:kept] + cells[kept + 1 :]
        if convert is _acoustic and content == last:
            # The system is asked more often than it locates.
            losses.skip("row", REPEATED)
            continue
        last = content
        gathered.append(dict(zip(header.names, cells, strict=True)))
        places.append(at)
        if len(gathered) >= BLOCK_OF_LINES:
            yield from convert(gathered, np.array(places), losses)
            gathered, places = [], []
    if gathered:
        yield from convert(gathered, np.array(places), losses)
    yield left_out(losses)


def _column(found: list[Row], name: str) -> Array:
    return np.array([number(row.get(name, b"")) for row in found])


def _begun(out: Records, found: list[Row], at: Array) -> Records:
    out["at"] = at
    out["time"] = out["received"] = _column(found, _TIME)
    return out


def _acoustic(found: list[Row], at: Array, losses: Losses) -> Iterator[Batch]:
    out = _begun(empty("acoustic", len(found)), found, at)
    out["place"] = np.stack([_column(found, name) for name in "xyz"], axis=1)
    out["std"] = positive(_column(found, "std"))
    valid = np.array([row["position_valid"].lower() in _TRUE for row in found])
    yield Batch("acoustic", out, "own", "locator", notes=(_AXES,), valid=valid)


def _surface(found: list[Row], at: Array, losses: Losses) -> Iterator[Batch]:
    """Convert positions: that of the vehicle has no orientation, -1."""
    heading = _column(found, "orientation")
    is_vessel = (heading >= 0.0) & (heading <= 360.0)
    vessel = _begun(empty("topside", len(found)), found, at)
    vessel["heading"] = heading * DEG
    fix = _begun(empty("transponder", len(found)), found, at)
    for out in (vessel, fix):
        out["lat"], out["lon"] = _column(found, "lat") * DEG, _column(found, "lon") * DEG
        out["quality"] = _column(found, "fix_quality")
    if is_vessel.any():
        yield Batch("topside", vessel[is_vessel], "own", "position", notes=(_SURFACE_NOTE,))
    if not is_vessel.all():
        yield Batch("transponder", fix[~is_vessel], "own", "position", notes=(_GLOBAL_NOTE,))


def _gga(found: list[Row], at: Array, losses: Losses) -> Iterator[Batch]:
    out = _begun(empty("topside", len(found)), found, at)
    out["lat"], out["lon"] = _column(found, "latitude") * DEG, _column(found, "longitude") * DEG
    out["quality"] = _column(found, "fix_quality")
    clock = _column(found, "utc")
    hours, minutes, seconds = clock // 1e4, clock % 1e4 // 100.0, clock % 100.0
    day = np.where(
        (hours < 24) & (minutes < 60), hours * 3600.0 + minutes * 60.0 + seconds, np.nan
    )
    utc = nearest_day(day, out["received"])
    out["time"] = np.where(np.isfinite(utc), utc, np.nan)
    yield Batch("topside", out, "utc", "GGA")
    times = _begun(empty("clock", len(found)), found, at)
    times["time"] = out["time"]
    yield Batch("clock", times, "utc", "GGA")


def _heading(found: list[Row], at: Array, losses: Losses) -> Iterator[Batch]:
    out = _begun(empty("topside", len(found)), found, at)
    out["heading"] = _column(found, "heading") * DEG
    yield Batch("topside", out, "own", "HDT")


def _orientation(found: list[Row], at: Array, losses: Losses) -> Iterator[Batch]:
    losses.skip("orientation of the housing", UNKNOWN_TYPE, len(found))
    yield replace(left_out(Losses()), notes=(_HOUSING,))


_HOUSING = (
    "the orientation is that of the housing at the surface, with a compass of its own: not used"
)
_CONVERTERS: dict[tuple[str, ...], Callable[[list[Row], Array, Losses], Iterator[Batch]]] = {
    (_TIME, "position_valid", *_PLACE): _acoustic,
    (_TIME, *_SURFACE): _surface,
    (_TIME, *_GGA): _gga,
    (_TIME, *_ORIENTATION): _orientation,
    (_TIME, "heading"): _heading,
}

FORMAT = Format(
    name="underwater-gps",
    family="gnss",
    title="Water Linked Underwater GPS as tables of its API: `timestamp`, `position_valid`, `x`",
    share=share,
    read=read,
    verified=(
        "a recording of a G2 (24 minutes), counts by a script; axes by their document, and by how "
        "smooth the track is"
    ),
    endings=(".csv",),
)
