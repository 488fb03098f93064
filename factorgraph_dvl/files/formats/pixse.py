"""Exail's `$PIXSE` sentences in common terms: a navigation solution, or attitude alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.clocks import nearest_day
from factorgraph_dvl.files.formats.format import Batch, Clock, Format, empty
from factorgraph_dvl.files.formats.framing import Records, map_file
from factorgraph_dvl.files.formats.nmea import KINDS, read_nmea, utc
from factorgraph_dvl.files.formats.sentences import sentences

# A sentence besides its fields: `$`, commas, checksum, line end.
_FRAME = 7
_PITCH = (
    "$PIXSE,ATITUD: pitch is bow down in Exail's sentences, and was reversed; not verified: "
    "compare it with another pitch"
)
_HEIGHT = (
    "$PIXSE,POSITI: its altitude was taken as height above the ellipsoid. If the system was set "
    "to the geoid, all heights are off by the separation; the calibration does not change"
)


def share(path: Path, sample: bytes) -> float:
    """Return the share of a sample that is sentences of this maker."""
    found = sum(len(b",".join(s.fields)) + 5 + _FRAME for s in sentences(sample, b"PIXSE"))
    return min(found / len(sample), 1.0) if sample else 0.0


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    for block in read_nmea(map_file(path)):
        block = {kind: part[part["checked"]] for kind, part in block.items()}
        if len(block["ATITUD"]):
            yield _batch(block)


def _batch(block: dict[str, Records]) -> Batch:
    bursts = block["ATITUD"]
    time = _of_burst(block, "TIME__")
    dated = _of_burst({**block, "TIME__": _dated(block)}, "TIME__")["second"]
    clock: Clock = "utc" if np.isfinite(dated).any() else "day"
    place, velocity = _of_burst(block, "POSITI"), _of_burst(block, "SPEED_")
    heading = _of_burst(block, "HDT")["heading"]
    is_solution = all(
        np.isfinite(part).any() for part in (place["lat"], velocity["vel_e"], heading)
    )
    out = empty("ins" if is_solution else "attitude", len(bursts))
    out["at"], out["received"] = bursts["at"], time["received"]
    out["time"] = dated if clock == "utc" else time["second"]
    out["roll"], out["pitch"], out["heading"] = bursts["roll"], -bursts["pitch"], heading
    hrp = _of_burst(block, "STDHRP")
    std = np.stack([hrp[f"std_{name}"] for name in ("roll", "pitch", "heading")], axis=1)
    if not is_solution:
        out["std"] = std
        return Batch("attitude", out, clock, "PIXSE", heading="true", notes=(_PITCH,))
    out["attitude_std"] = std
    out["lat"], out["lon"], out["height"] = place["lat"], place["lon"], place["altitude"]
    out["velocity"] = np.stack([velocity[f"vel_{axis}"] for axis in "enu"], axis=1)
    position = _of_burst(block, "STDPOS")
    names = ("std_lon", "std_lat", "std_height")
    out["std"] = np.stack([position[name] for name in names], axis=1)
    speed = _of_burst(block, "STDSPD")
    level = np.sqrt((speed["std_1"] ** 2 + speed["std_2"] ** 2) / 2.0)
    out["velocity_std"] = np.stack([level, level, speed["std_up"]], axis=1)
    return Batch("ins", out, clock, "PIXSE", heading="true", notes=(_PITCH, _HEIGHT))


def _dated(block: dict[str, Records]) -> Records:
    """Return the sentences of time with `second` since 1970."""
    out = block["TIME__"].copy()
    time = utc(block, "TIME__")
    near = nearest_day(out["second"], out["received"])
    out["second"] = np.where(np.isnan(time), near, time)
    return out


def _of_burst(block: dict[str, Records], kind: str) -> Records:
    """Return a sentence for each burst (N,), which begins with HDT and ATITUD; nan without."""
    part, starts = block[kind], block["ATITUD"]["at"]
    if kind == "HDT":
        burst = np.searchsorted(starts, part["at"])
    else:
        burst = np.searchsorted(starts, part["at"], "right") - 1
    out = np.zeros(len(starts), KINDS[kind])
    for name in KINDS[kind].names or ():
        if KINDS[kind][name].kind == "f":
            out[name] = np.nan
    good = (burst >= 0) & (burst < len(starts))
    out[burst[good]] = part[good]
    return out


FORMATS = (
    Format(
        "pixse",
        "ins",
        "Exail `$PIXSE`",
        share,
        read,
        "a published burst with its checksums; the sign of its pitch is not verified",
        in_text=True,
    ),
)
