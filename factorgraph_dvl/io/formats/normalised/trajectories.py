"""Computed trajectories in common terms: RTKLIB and SBET."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.io.formats.format import Batch, Format, empty
from factorgraph_dvl.io.formats.framing import map_file
from factorgraph_dvl.io.formats.rtklib import is_geodetic, read_rtklib
from factorgraph_dvl.io.formats.sbet import SBET, north_east, read_sbet, true_heading

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
    for block in read_rtklib(source):
        out = empty("fix", len(block))
        for name in ("at", "time", "lat", "lon"):
            out[name] = block[name]
        out[vertical] = block["height"]
        for name, prefix in (("std", "std_"), ("velocity", "vel_"), ("velocity_std", "vel_std_")):
            out[name] = np.stack([block[prefix + axis] for axis in "enu"], axis=1)
        yield Batch("fix", out, "utc", "pos")


def _share_sbet(path: Path, sample: bytes) -> float:
    count = sum(len(block) for block in read_sbet(sample))
    return count * SBET.itemsize / len(sample) if sample else 0.0


def _read_sbet(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    for block in read_sbet(map_file(path)):
        out = empty("ins", len(block))
        for name in ("lat", "lon", "height", "roll", "pitch"):
            out[name] = block[name]
        out["time"], out["heading"] = block["second"], true_heading(block)
        north, east = north_east(block)
        out["velocity"] = np.stack([east, north, -block["vel_z"]], axis=1)
        yield Batch("ins", out, "week", "SBET", heading="true")


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
    Format(
        "sbet",
        "ins",
        "SBET",
        _share_sbet,
        _read_sbet,
        "files written after public record tables; its wander angle is not verified",
        (".sbet", ".out"),
    ),
)
