"""Third-party readers: loaded where they are used, silent, their failures as errors of ours."""

from __future__ import annotations

import importlib
import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.formats.format import Batch
from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.files.formats.velocities import INSTRUMENT
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array

# Kinds of fixes in autopilots (none, no fix, 2D, 3D, differential, RTK float, RTK fixed) to GGA's
# numbers.
_QUALITY = np.array([0.0, 0.0, 0.0, 1.0, 2.0, 5.0, 4.0])
# Before the first of 2012 no autopilot logged weeks of GPS.
FIRST_WEEK = 1669
# Longest interval of a movement, s: in microseconds it would be more.
_LONGEST_INTERVAL = 100.0
_MOVEMENTS = "{}: movements over intervals, taken as the mean velocity of a DVL in the body's axes"
# Values of one message by the names of its columns.
Row = dict[str, Any]


def load(module: str, extra: str) -> Any:
    """Import a third-party module.

    Parameters
    ----------
    module : str
        Its name.
    extra : str
        The extra of this package that installs it.

    Raises
    ------
    ConfigError
        If it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise ConfigError(
            f"{module.partition('.')[0]} is not installed",
            expected=f"the extra `{extra}`",
            hint=f"Install it by: pip install 'factorgraph-dvl[{extra}]'",
        ) from None


class _Nowhere(io.TextIOBase):
    def write(self, text: str) -> int:
        return len(text)


@contextmanager
def quiet() -> Iterator[None]:
    """Drop what a library prints; not around a `yield` that leaves this package."""
    with redirect_stdout(_Nowhere()), redirect_stderr(_Nowhere()):
        yield


def silently(batches: Iterator[Batch]) -> list[Batch]:
    """Return all batches; damaged numbers overflow quietly, their ranges are checked later."""
    with np.errstate(all="ignore"):
        return list(batches)


def column(rows: Sequence[Mapping[str, Any]], name: str) -> Array:
    """Return the values of a column by its name, nan where it is missing or no number."""
    values = (row.get(name) for row in rows)
    return np.array([float(v) if isinstance(v, int | float) else np.nan for v in values])


def columns(rows: Sequence[Mapping[str, Any]], *names: str) -> Array:
    """Return several columns side by side, (N, M)."""
    return np.stack([column(rows, name) for name in names], axis=1)


def started(out: Records, *, at: Any, time: Array, received: Array | None = None) -> Records:
    """Return records with their positions in the file and their times.

    Parameters
    ----------
    out : Records
        (N,) of any kind.
    at : array_like of int, shape (N,)
        Positions in the file.
    time : ndarray, shape (N,), s
        Times on the clock of the batch.
    received : ndarray, shape (N,), s, optional
        Times on the recording clock; `time` without.
    """
    out["at"], out["time"] = at, time
    out["received"] = time if received is None else received
    return out


def locate(out: Records, lat: Array, lon: Array, quality: Array) -> None:
    """Write latitudes and longitudes, deg (N,), into fixes; those of quality 0 have no place."""
    out["quality"] = quality
    for name, values in (("lat", lat), ("lon", lon)):
        out[name] = np.where(quality > 0.0, values * DEG, np.nan)


def movements(out: Records, delta: Array, interval: Array, stream: str) -> Batch:
    """Return pings of movements over intervals, as which vehicles under water log their DVL.

    Parameters
    ----------
    out : Records
        (N,) pings with their times, at the ends of the intervals.
    delta : ndarray, shape (N, 3), m
        Movements in forward, right, down.
    interval : ndarray, shape (N,), s
        Over which they were.
    stream : str
        Stream as in `Batch`.
    """
    good = (interval > 0.0) & (interval < _LONGEST_INTERVAL)
    interval = np.where(good, interval, np.nan)
    out["velocity"] = delta / interval[:, None]
    out["axes"], out["delay"] = INSTRUMENT, -0.5 * interval
    out["window"] = interval
    return Batch("dvl", out, "own", stream, "FRD", notes=(_MOVEMENTS.format(stream),))


def gga_quality(kind: Array) -> Array:
    """Return the quality as in GGA of fixes by their kind in logs of autopilots, 0 if unknown."""
    known = np.isin(kind, np.arange(len(_QUALITY)))
    return np.where(known, _QUALITY[np.where(known, kind, 0).astype(int)], 0.0)


def unreadable(path: Path, error: BaseException, expected: str, hint: str = "") -> DataError:
    """Return the error for a file that a library gives up on before its first message."""
    return DataError(
        f"cannot be read ({describe(error)})", where=path.name, expected=expected, hint=hint
    )


def describe(error: BaseException) -> str:
    """Return an exception of a library in one short line."""
    text = " ".join(str(error).split())[:200]
    return text.rstrip(".") or type(error).__name__


def given_up(path: Path, error: BaseException, count: int) -> str:
    """Return the note on a file that a library gives up on after `count` messages."""
    return f"{path.name} is damaged: read up to message {count} ({describe(error)})"
