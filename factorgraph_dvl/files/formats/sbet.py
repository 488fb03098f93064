"""Smoothed trajectories: SBET files and the smrmsg files of their errors.

Source: the fields as several public readers agree on them (records of 17 and of 10
little-endian doubles, without header or checksum). What the wander angle does to heading and
velocities is not verified against a document.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.files.formats.format import Batch, Format, empty, left_out
from factorgraph_dvl.files.formats.framing import Bytes, Index, Records, Source, as_bytes, map_file
from factorgraph_dvl.files.formats.losses import Losses, count_outside
from factorgraph_dvl.geometry.units import DEG

# Time is GPS seconds of a week that the file does not name. Angles rad, heights above the
# ellipsoid; velocities along the axes of the wander frame, the third down.
SBET = np.dtype(
    [
        *((name, "<f8") for name in ("second", "lat", "lon", "height")),
        *((name, "<f8") for name in ("vel_x", "vel_y", "vel_z", "roll", "pitch", "heading")),
        *((name, "<f8") for name in ("wander", "accel_x", "accel_y", "accel_z")),
        *((name, "<f8") for name in ("rate_x", "rate_y", "rate_z")),
    ]
)
# Standard deviations, m, m/s and rad.
SMRMSG = np.dtype(
    [
        *((name, "<f8") for name in ("second", "std_n", "std_e", "std_d")),
        *((name, "<f8") for name in ("vel_std_n", "vel_std_e", "vel_std_d")),
        *((name, "<f8") for name in ("roll_std", "pitch_std", "heading_std")),
    ]
)
# Largest magnitudes. A week has 604800 s; some files count on past its end.
_SBET_LIMITS = np.array(
    [
        2e6,
        np.pi / 2,
        2 * np.pi,
        1e5,
        *[500.0] * 3,
        *[2 * np.pi + 0.01] * 4,
        *[500.0] * 3,
        *[50.0] * 3,
    ]
)
_SMRMSG_LIMITS = np.array([2e6, *[1e5] * 3, *[1e3] * 3, *[36000.0] * 3])
_TINY = 1e-30
_STEP = 1 << 20


def read_sbet(source: Source, losses: Losses | None = None) -> Iterator[Records]:
    """Read a trajectory.

    Parameters
    ----------
    source : Source
        The file.
    losses : Losses, optional
        Takes counts of what was left out.

    Yields
    ------
    Records
        (N,) of `SBET`. There is no checksum: a record counts if all its values are possible and
        so are those of a record beside it.
    """
    yield from _read(source, SBET, _SBET_LIMITS, losses)


def read_smrmsg(source: Source, losses: Losses | None = None) -> Iterator[Records]:
    """Read the standard deviations of a trajectory: (N,) of `SMRMSG`, as `read_sbet` does."""
    for part in _read(source, SMRMSG, _SMRMSG_LIMITS, losses):
        out = part.copy()
        for name in ("roll_std", "pitch_std", "heading_std"):
            out[name] *= DEG / 60.0
        yield out


def north_east(records: Records) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return velocities north and east (N,), m/s, of `SBET` records."""
    c, s = np.cos(records["wander"]), np.sin(records["wander"])
    x, y = records["vel_x"], records["vel_y"]
    return x * c + y * s, y * c - x * s


def true_heading(records: Records) -> NDArray[np.float64]:
    """Return true headings (N,), rad, of `SBET` records."""
    return np.asarray((records["heading"] - records["wander"]) % (2.0 * np.pi))


def _read(
    source: Source,
    layout: np.dtype[np.void],
    limits: NDArray[np.float64],
    losses: Losses | None,
) -> Iterator[Records]:
    found = _places(source, layout.itemsize, limits)
    for places in count_outside(source, found, Losses() if losses is None else losses):
        begin = int(places[0, 0])
        data = as_bytes(source, begin, int(places[-1, 1]))
        at = (places[:, :1] - begin) + np.arange(layout.itemsize)
        yield np.ascontiguousarray(data[at]).view(layout)[:, 0]


def _places(source: Source, size: int, limits: NDArray[np.float64]) -> Iterator[Index]:
    """Yield where records start and stop (K, 2)."""
    free = 0
    for begin in range(0, len(source), _STEP):
        # With the record before, which may be all that vouches for the first.
        lead = min(begin, size)
        data = as_bytes(source, begin - lead, begin + _STEP + 2 * size)
        possible = _possible(data, size, limits)
        # A lone possible record may be chance; two in a row are none.
        chained = np.zeros_like(possible)
        chained[:-size] |= possible[:-size] & possible[size:]
        chained[size:] |= possible[size:] & possible[:-size]
        chained |= possible & (len(source) < 2 * size)
        found = []
        for start in (np.flatnonzero(chained[lead : lead + _STEP]) + lead).tolist():
            if begin - lead + start >= free:
                free = begin - lead + start + size
                found.append((free - size, free))
        if found:
            yield np.array(found, np.int64)


def _possible(data: Bytes, size: int, limits: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return for each position (len(data),) whether a possible record starts there."""
    out = np.zeros(len(data), bool)
    for shift in range(min(8, len(data))):
        count = (len(data) - shift) // 8
        values = data[shift : shift + count * 8].view("<f8")
        fields = size // 8
        if count < fields:
            break
        good = np.ones(count - fields + 1, bool)
        with np.errstate(invalid="ignore"):
            magnitude = np.abs(values)
            is_number = (magnitude > _TINY) | (values == 0.0)
            for index, limit in enumerate(limits):
                part = slice(index, count - fields + 1 + index)
                good &= is_number[part] & (magnitude[part] <= limit)
            # Time runs forward from 0, and a position at 0, 0 is no position.
            good &= (values[: len(good)] >= 0.0) & (magnitude[1 : len(good) + 1] > 0.0)
        out[np.arange(len(good)) * 8 + shift] = good
    return out


# Records of a trajectory are closer together than this, s.
_LONGEST_STEP = 10.0


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
