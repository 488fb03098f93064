"""RTKLIB solutions (`.pos`).

Source: RTKLIB manual 2.4.2, appendix B.1 (positioning solution file).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats.clocks import GPS_EPOCH, gps_to_utc, posix
from factorgraph_dvl.files.formats.format import Batch, Format, empty, left_out
from factorgraph_dvl.files.formats.framing import (
    BLOCK_OF_LINES,
    Records,
    Source,
    lines,
    map_file,
    number,
)
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.geometry.units import DEG

# Angles rad, heights above the ellipsoid unless `is_geodetic` says otherwise.
SOLUTION = np.dtype(
    [("at", "i8"), ("time", "f8")]
    + [(name, "f8") for name in ("lat", "lon", "height", "quality", "satellites")]
    + [(name, "f8") for name in ("std_n", "std_e", "std_u", "age", "ratio")]
    + [(name, "f8") for name in ("vel_n", "vel_e", "vel_u")]
    + [(name, "f8") for name in ("vel_std_n", "vel_std_e", "vel_std_u")]
)
_COLUMNS = {
    "latitude": "lat",
    "longitude": "lon",
    "height": "height",
    "Q": "quality",
    "ns": "satellites",
    "sdn": "std_n",
    "sde": "std_e",
    "sdu": "std_u",
    "age": "age",
    "ratio": "ratio",
    "vn": "vel_n",
    "ve": "vel_e",
    "vu": "vel_u",
    "sdvn": "vel_std_n",
    "sdve": "vel_std_e",
    "sdvu": "vel_std_u",
}
_HEADER = re.compile(rb"^%\s*(GPST|UTC|JST)\s")
_UNREADABLE = "line without time and position"
# Japan's time is ahead of UTC by this.
_JST = 9 * 3600.0
_DATE = re.compile(rb"(\d{4})/(\d\d)/(\d\d)[ ,;\t]+(\d\d):(\d\d):(\d\d(?:\.\d+)?)[ ,;\t]+(.*)")
_WEEK = re.compile(rb"(\d{1,4})[ ,;\t]+(\d{1,6}(?:\.\d+)?)[ ,;\t]+(.*)")


def read_rtklib(
    source: Source, block: int = BLOCK_OF_LINES, losses: Losses | None = None
) -> Iterator[Records]:
    """Read a solution in latitude, longitude and height.

    Parameters
    ----------
    source : Source
        The file.
    block : int
        Number of solutions at a time.
    losses : Losses, optional
        Takes counts of what was left out.

    Yields
    ------
    Records
        (N,) of `SOLUTION`; `time` is UTC, seconds since 1970.

    Raises
    ------
    DataError
        If solutions begin without a header, or it has other coordinates.
    """
    losses = Losses() if losses is None else losses
    rows: list[tuple[float, ...]] = []
    system, names = b"", []
    for at, line in lines(source):
        if line.startswith(b"%"):
            if header := _HEADER.match(line):
                system, names = header[1], _columns(line)
            continue
        match = _DATE.match(line) or _WEEK.match(line)
        if match is None:
            if line.strip():
                losses.add(_UNREADABLE, at)
            continue
        if not names:
            raise DataError(
                "has solutions before a line that names its columns",
                where=f"byte {at}",
                expected="a line such as `%  GPST  latitude(deg) longitude(deg) height(m) Q ...`",
            )
        values = [number(field) for field in re.split(rb"[ ,;\t]+", match[match.lastindex or 1])]
        row = dict(zip(names, values, strict=False))
        time = _time(match, system)
        lat, lon = row.get("lat", np.nan), row.get("lon", np.nan)
        if np.isnan(time) or not (abs(lat) <= 90.0 and abs(lon) <= 360.0):
            losses.add(_UNREADABLE, at)
            continue
        row |= {"lat": lat * DEG, "lon": lon * DEG}
        rows.append((at, time, *(row.get(n, np.nan) for n in (SOLUTION.names or ())[2:])))
        if len(rows) == block:
            yield np.array(rows, SOLUTION)
            rows = []
    yield np.array(rows, SOLUTION)


def is_geodetic(source: Source) -> bool:
    """Return whether heights are above the geoid, as the header says."""
    return b"/geodetic" in source[: 1 << 16]


def _columns(line: bytes) -> list[str]:
    words = [word.partition("(") for word in line.decode("latin-1").split()[2:]]
    if ("latitude", "(", "deg)") not in words or ("longitude", "(", "deg)") not in words:
        raise DataError(
            "has no latitude and longitude in degrees",
            where=line[:60].decode("latin-1"),
            expected="a solution written with `out-solformat=llh` and `out-degform=deg`",
        )
    return [_COLUMNS.get(name, name) for name, _, _ in words]


def _time(match: re.Match[bytes], system: bytes) -> float:
    if match.lastindex == 3:
        return float(gps_to_utc(float(match[1]), float(match[2])))
    year, month, day, hour, minute = (int(match[i]) for i in range(1, 6))
    time = float(posix(year, month, day, hour, minute, float(match[6]))[0])
    if system == b"GPST":
        return float(gps_to_utc(0.0, time - GPS_EPOCH))
    return time - (_JST if system == b"JST" else 0.0)


# Bytes of a record of RTKLIB. Chosen: about those of a line; they only share a file out.
_LINE_BYTES = 130.0


def _share_rtklib(path: Path, sample: bytes) -> float:
    try:
        count = sum(len(block) for block in read_rtklib(sample))
    except DataError:
        return 0.0
    return min(count * _LINE_BYTES / len(sample), 1.0) if sample else 0.0


def _read_rtklib(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    source = map_file(path)
    vertical = "altitude" if is_geodetic(source) else "height"
    losses = Losses()
    for block in read_rtklib(source, losses=losses):
        out = empty("fix", len(block))
        for name in ("at", "time", "lat", "lon"):
            out[name] = block[name]
        out[vertical] = block["height"]
        for name, prefix in (("std", "std_"), ("velocity", "vel_"), ("velocity_std", "vel_std_")):
            out[name] = np.stack([block[prefix + axis] for axis in "enu"], axis=1)
        yield Batch("fix", out, "utc", "pos")
    yield left_out(losses)


FORMATS = (
    Format(
        "rtklib",
        "gnss",
        "RTKLIB `.pos`",
        _share_rtklib,
        _read_rtklib,
        "files written after the manual",
        (".pos",),
    ),
)
