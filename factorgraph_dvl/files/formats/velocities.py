"""What readers of velocity logs share: their record, and pings in common terms."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factorgraph_dvl.files.formats.format import Batch, Clock, left_out, positive
from factorgraph_dvl.files.formats.format import empty as empty_records
from factorgraph_dvl.files.formats.framing import Records, Source, map_file
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array

BEAM, INSTRUMENT, SHIP, EARTH = range(4)
# One ping. `time`: seconds since 1970, nan if the format has none; `second`: of the day or
# of the instrument's own count; `velocity`: of the instrument over the bottom, m/s, in `axes`,
# Earth being east, north, up; `error`: error velocity; `beam_velocity`: as sent; `range`: m, along
# or below each beam, as the instrument defines it; `altitude` m; `merit`: the instrument's
# own standard deviation, m/s; `delay` and `window` as in `format`; angles in rad as sent. What is
# absent is nan.
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
        *((name, "f8") for name in ("delay", "window")),
    ]
)


def empty(count: int, axes: int = INSTRUMENT) -> Records:
    """Return records (count,) that contain nothing yet."""
    out = np.zeros(count, VELOCITY)
    for name in VELOCITY.names or ():
        if name not in ("at", "axes"):
            out[name] = np.nan
    out["axes"] = axes
    return out


def records(rows: Sequence[Mapping[str, object]], axes: int = INSTRUMENT) -> Records:
    """Return records of rows that name what they contain."""
    out = empty(len(rows), axes)
    for index, row in enumerate(rows):
        for name, value in row.items():
            out[name][index] = value
    return out


def without(values: NDArray[np.float64], sentinel: float) -> NDArray[np.float64]:
    """Return values with nan in place of a sentinel."""
    return np.where(np.abs(values - sentinel) < 1e-6, np.nan, values)


def averaged(count: ArrayLike, interval: ArrayLike) -> tuple[Array, Array]:
    """Return the delay to the middle of several pings and the window of their mean, s.

    Single pings at intervals i spread as much about their mean as a window of i √(n² - 1).

    Parameters
    ----------
    count : array_like, shape (N,)
        Number of pings.
    interval : array_like, shape (N,), s
        Time between them.

    Returns
    -------
    delay : ndarray, shape (N,), s
        Delay from the first ping; nan where it is the only one.
    window : ndarray, shape (N,), s
        Length of the window; nan where there is one ping.
    """
    number, step = np.asarray(count, float), np.asarray(interval, float)
    several = (number > 1.0) & (step > 0.0)
    number = np.where(several, number, np.nan)
    return 0.5 * (number - 1.0) * step, np.sqrt(number**2 - 1.0) * step


def mean_of_known(values: Array) -> Array:
    """Return the means (N,) of rows over what is above 0, nan where nothing is."""
    known = values > 0.0
    number = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def share_of_records(
    reader: Callable[[Source], Iterator[Any]], size: float
) -> Callable[[Path, bytes], float]:
    """Return what gives the share of a sample in records of about this size, bytes."""

    def share(path: Path, sample: bytes) -> float:
        count = 0
        for block in reader(sample):
            parts = block if isinstance(block, tuple) else (block,)
            count += sum(len(part) for part in parts if isinstance(part, np.ndarray))
        return min(count * size / len(sample), 1.0) if sample else 0.0

    return share


def pings(found: Records, clock: Clock, axes: BodyAxes | Literal[""], stream: str) -> Batch:
    """Return pings in common terms, with the time that they have."""
    out = empty_records("dvl", len(found))
    for name in ("at", "axes", "velocity", "error", "range", "roll", "pitch", "heading"):
        out[name] = found[name]
    for name in ("sound_speed", "temperature", "delay", "window"):
        out[name] = found[name]
    out["beams"] = found["beam_velocity"]
    has_time = clock in ("utc", "own") and bool(np.isfinite(found["time"]).any())
    out["time"] = found["time"] if has_time else found["second"]
    out["received"] = out["time"]
    out["alignment"], out["tilts_used"] = 0.0, True
    out["std"] = positive(found["merit"])[:, None]
    return Batch("dvl", out, clock, stream, axes)


def attitude(found: Records, clock: Clock) -> Iterator[Batch]:
    """Yield the attitudes of pings in common terms, if they have headings.

    Instruments without such sensors send zeros.
    """
    there = np.any([found[name] != 0.0 for name in ("roll", "pitch", "heading")], axis=0)
    if not (np.isfinite(found["heading"]) & there).any():
        return
    out = empty_records("attitude", len(found))
    out["at"] = found["at"]
    for name in ("roll", "pitch", "heading"):
        out[name] = np.where(there, found[name], np.nan)
    time = found["time"] if np.isfinite(found["time"]).any() else found["second"]
    out["time"] = out["received"] = time
    yield Batch("attitude", out, clock, "leader")


def read_pings(
    reader: Callable[..., Iterator[Records]],
    clock: Clock,
    axes: BodyAxes | Literal[""],
    path: Path,
    mapping: Mapping[str, Any] | None = None,
) -> Iterator[Batch]:
    """Read a file of pings alone; the parameters and the result are those of `Format.read`."""
    losses = Losses()
    for found in reader(map_file(path), losses=losses):
        if len(found):
            yield pings(found, clock, axes, "")
            yield from attitude(found, clock)
    yield left_out(losses)
