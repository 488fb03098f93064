"""Computed trajectories in common terms: RTKLIB and SBET."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats.format import Batch, Format, empty, left_out
from factorgraph_dvl.files.formats.framing import Records, map_file
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.rtklib import is_geodetic, read_rtklib
from factorgraph_dvl.files.formats.sbet import north_east, read_sbet, read_smrmsg, true_heading

# Bytes of a record of RTKLIB. Chosen: about those of a line; they only share a file out.
_LINE_BYTES = 130.0
# Records of a trajectory are closer together than this, s.
_LONGEST_STEP = 10.0


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


def _share_of_steps(blocks: Iterator[Records], sample: bytes) -> float:
    """Return the share of a sample in records whose times run forward.

    Records without header or checksum are possible at other places too, of another length too; but
    their times run forward in the right place alone.
    """
    size = 0
    for block in blocks:
        step = np.diff(block["second"])
        size += int(np.sum((step > 0.0) & (step < _LONGEST_STEP))) * block.dtype.itemsize
    return size / len(sample) if sample else 0.0


def _share_sbet(path: Path, sample: bytes) -> float:
    return _share_of_steps(read_sbet(sample), sample)


def _share_smrmsg(path: Path, sample: bytes) -> float:
    return _share_of_steps(read_smrmsg(sample), sample)


def _read_smrmsg(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    losses = Losses()
    for block in read_smrmsg(map_file(path), losses):
        out = empty("ins_std", len(block))
        out["time"] = block["second"]
        names = {
            "std": ("std_e", "std_n", "std_d"),
            "velocity_std": ("vel_std_e", "vel_std_n", "vel_std_d"),
            "attitude_std": ("roll_std", "pitch_std", "heading_std"),
        }
        for name, columns in names.items():
            out[name] = np.stack([block[column] for column in columns], axis=1)
        yield Batch("ins_std", out, "week", "smrmsg")
    yield left_out(losses)


def _read_sbet(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    losses = Losses()
    for block in read_sbet(map_file(path), losses):
        out = empty("ins", len(block))
        for name in ("lat", "lon", "height", "roll", "pitch"):
            out[name] = block[name]
        out["time"], out["heading"] = block["second"], true_heading(block)
        north, east = north_east(block)
        out["velocity"] = np.stack([east, north, -block["vel_z"]], axis=1)
        yield Batch("ins", out, "week", "SBET", heading="true")
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
    Format(
        "sbet",
        "ins",
        "SBET",
        _share_sbet,
        _read_sbet,
        "files written after public record tables; its wander angle is not verified",
        (".sbet", ".out"),
    ),
    Format(
        "smrmsg",
        "ins",
        "smrmsg: standard deviations of an SBET file",
        _share_smrmsg,
        _read_smrmsg,
        "files written after public record tables",
        (".out", ".smrmsg"),
    ),
)
