"""Nortek AD2CP in common terms: bottom track, attitude, and sentences that were sent to it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.io.formats import ad2cp
from factorgraph_dvl.io.formats.format import Batch, Format, empty, left_out
from factorgraph_dvl.io.formats.framing import Records, map_file
from factorgraph_dvl.io.formats.losses import Losses
from factorgraph_dvl.io.formats.nmea import join, read_nmea
from factorgraph_dvl.io.formats.normalised.nmea import sentence_batches
from factorgraph_dvl.io.formats.velocities import EARTH, INSTRUMENT

_TO_XYZ = "velocities along beams → X, Y, Z by the matrix GETXFBT of the file"
_NO_MATRIX = "velocities along beams, and no matrix in the file: left out"
_MAGNETIC = "headings of the instrument's own magnetic compass"


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
        sentences = "\r\n".join(block.text).encode("latin-1")
        nmea = join(read_nmea(sentences))
        near = float(np.nanmedian(block.bottom["time"])) if len(block.bottom) else None
        yield from sentence_batches(nmea, near)
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
    in_beams = bottom["coordinates"] == ad2cp.BEAM
    out["axes"] = np.where(bottom["coordinates"] == ad2cp.ENU, EARTH, INSTRUMENT)
    out["velocity"] = np.where(in_beams[:, None], np.nan, bottom["velocity"][:, :3])
    notes: tuple[str, ...] = ()
    if in_beams.any():
        notes = (_NO_MATRIX,)
        if matrix is not None and matrix.shape[0] >= 3:
            beams = bottom["velocity"][in_beams][:, : matrix.shape[1]]
            out["velocity"][in_beams] = beams @ matrix[:3].T
            notes = (_TO_XYZ,)
    yield Batch("dvl", out, "own", "bottom", notes=notes)
    attitude = empty("attitude", len(bottom))
    for name in ("at", "time", "roll", "pitch", "heading"):
        attitude[name] = bottom[name]
    attitude["received"] = bottom["time"]
    yield Batch("attitude", attitude, "own", "leader", "", "magnetic", (_MAGNETIC,))


FORMATS = (
    Format(
        "ad2cp",
        "dvl",
        "Nortek AD2CP: bottom track (0x17), text",
        share,
        read,
        "mhkit on one recording",
        (".ad2cp",),
    ),
)
