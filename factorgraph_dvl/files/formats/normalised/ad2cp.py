"""Nortek AD2CP in common terms: bottom track, attitude, and sentences that were sent to it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats import ad2cp
from factorgraph_dvl.files.formats.format import Batch, Format, Kind, empty, left_out
from factorgraph_dvl.files.formats.framing import Records, map_file
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.nmea import join, read_nmea
from factorgraph_dvl.files.formats.normalised.nmea import sentence_batches
from factorgraph_dvl.files.formats.velocities import BEAM, EARTH, INSTRUMENT

_BEAMS = (
    "velocities along beams are positive towards the transducer, which is its own velocity along "
    "the outward beam; directions of beams by the matrix GETXFBT of the file"
)
_NO_MATRIX = "velocities along beams, and no matrix in the file: left out"
_MAGNETIC = "headings of the instrument's own magnetic compass"
_TRACK = "velocities X, Y, Z of a DVL as they are: positive where it moves along its axes"
_SHIFT = "stamps of velocities were shifted by DT1, from the trigger to the echo"


def share(path: Path, sample: bytes) -> float:
    """Return the share of a sample that lies in records whose checksums are right."""
    return ad2cp.covered(sample) / len(sample) if sample else 0.0


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    matrix: np.ndarray[Any, np.dtype[np.float64]] | None = None
    losses = Losses()
    for block in ad2cp.read_ad2cp(map_file(path), losses=losses):
        for text in block.text:
            found = ad2cp.beam_matrix(text)
            matrix = matrix if found is None else found
        if len(block.bottom):
            yield from _batches(block.bottom, matrix)
        if len(block.tracks):
            yield from _tracks(block.tracks)
        sentences = "\r\n".join(block.text).encode("latin-1")
        nmea = join(read_nmea(sentences))
        stamps = np.concatenate([block.bottom["time"], block.tracks["time"]])
        stamps = stamps[np.isfinite(stamps)]
        yield from sentence_batches(nmea, float(np.median(stamps)) if len(stamps) else None)
    yield left_out(losses)


def _batches(
    bottom: Records, matrix: np.ndarray[Any, np.dtype[np.float64]] | None
) -> Iterator[Batch]:
    out = empty("dvl", len(bottom))
    for name in ("at", "number", "roll", "pitch", "heading", "sound_speed", "temperature"):
        out[name] = bottom[name]
    out["time"] = out["received"] = bottom["time"]
    out["range"], out["alignment"] = bottom["distance"], 0.0
    out["tilts_used"] = True
    out["axes"] = np.where(bottom["coordinates"] == ad2cp.ENU, EARTH, INSTRUMENT)
    in_beams = bottom["coordinates"] == ad2cp.BEAM
    out["velocity"] = np.where(in_beams[:, None], np.nan, bottom["velocity"][:, :3])
    notes: tuple[str, ...] = ()
    directions: tuple[tuple[float, ...], ...] = ()
    if in_beams.any():
        notes = (_NO_MATRIX,)
        if matrix is not None and matrix.shape == (4, 4):
            beams = bottom["velocity"][in_beams]
            out["beams"][in_beams], out["velocity"][in_beams] = beams, beams @ matrix[:3].T
            out["axes"][in_beams] = BEAM
            notes = (_BEAMS,)
            directions = tuple(map(tuple, np.linalg.pinv(matrix[:3]).tolist()))
    yield Batch("dvl", out, "own", "bottom", notes=notes, directions=directions)
    attitude = empty("attitude", len(bottom))
    for name in ("at", "time", "roll", "pitch", "heading"):
        attitude[name] = bottom[name]
    attitude["received"] = bottom["time"]
    yield Batch("attitude", attitude, "own", "leader", "", "magnetic", (_MAGNETIC,))


def _tracks(tracks: Records) -> Iterator[Batch]:
    kinds: tuple[tuple[Kind, str, bool], ...] = (
        ("dvl", "bottom", False),
        ("water", "water", True),
    )
    for kind, stream, is_water in kinds:
        part = tracks[tracks["water"] == is_water]
        if not len(part):
            continue
        out = empty(kind, len(part))
        for name in ("at", "time", "velocity", "error", "delay", "sound_speed", "temperature"):
            out[name] = part[name]
        out["received"], out["std"] = part["time"], part["merit"]
        out["beams"], out["range"] = part["beam_velocity"], part["beam_range"]
        out["axes"], out["alignment"] = INSTRUMENT, 0.0
        shifted = (_SHIFT,) if np.isfinite(out["delay"]).any() else ()
        yield Batch(kind, out, "own", stream, notes=(_TRACK, *shifted))


FORMATS = (
    Format(
        "ad2cp",
        "dvl",
        "Nortek AD2CP: bottom track (0x17), tracks of DVLs (0x1B, 0x1D), text",
        share,
        read,
        "mhkit on one recording; 0x1B and 0x1D: files written after public readers that agree",
        (".ad2cp",),
    ),
)
