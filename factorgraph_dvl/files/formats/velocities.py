"""The record that readers of velocity logs share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.files.formats.framing import Records

BEAM, INSTRUMENT, SHIP, EARTH = range(4)
# One ping. `time`: seconds since 1970, nan if the format has none; `second`: of the day or
# of the instrument's own count; `velocity`: of the instrument over the bottom, m/s, in `axes`,
# Earth being east, north, up; `error`: error velocity; `beam_velocity`: as sent; `range`: m, along
# or below each beam, as the instrument defines it; `altitude` m; `merit`: the instrument's
# own standard deviation, m/s; angles in rad as sent. What is absent is nan.
VELOCITY = np.dtype(
    [
        ("at", "i8"),
        ("time", "f8"),
        ("second", "f8"),
        ("axes", "u1"),
        ("velocity", "f8", (3,)),
        ("error", "f8"),
        ("beam_velocity", "f8", (4,)),
        ("range", "f8", (4,)),
        ("altitude", "f8"),
        ("merit", "f8"),
        *((name, "f8") for name in ("roll", "pitch", "heading")),
        *((name, "f8") for name in ("sound_speed", "temperature", "depth")),
    ]
)


def empty(count: int, axes: int = INSTRUMENT) -> Records:
    """Return records (count,) that hold nothing yet."""
    out = np.zeros(count, VELOCITY)
    for name in VELOCITY.names or ():
        if name not in ("at", "axes"):
            out[name] = np.nan
    out["axes"] = axes
    return out


def records(rows: Sequence[Mapping[str, object]], axes: int = INSTRUMENT) -> Records:
    """Return records of rows that name what they hold."""
    out = empty(len(rows), axes)
    for index, row in enumerate(rows):
        for name, value in row.items():
            out[name][index] = value
    return out


def without(values: NDArray[np.float64], sentinel: float) -> NDArray[np.float64]:
    """Return values with nan in place of a sentinel."""
    return np.where(np.abs(values - sentinel) < 1e-6, np.nan, values)
