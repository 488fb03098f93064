"""Records over time in few bytes: least and largest of each interval, as 16-bit numbers."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_dvl.geometry.vectors import Array

# Chosen: more intervals than pixels from left to right, so that two-fold zoom stays sharp.
_INTERVALS = 1200
# A record without a value for this many intervals has a gap. Chosen: one may be empty by chance.
_GAP_INTERVALS = 4.0
# A line that goes up and down more often than this is a block; as a band it has so many
# intervals. Chosen: a period takes three pixels of a plot, and an interval takes three too.
_MOST_SWINGS, _BAND_INTERVALS = 150.0, 300
_LARGEST = 32767
_MISSING = -32768


@dataclass(frozen=True)
class Envelope:
    """Least and largest values of a record in intervals of time.

    Parameters
    ----------
    time : ndarray, shape (K,), s
        First time of each interval; a row of nan values stands in a gap.
    low, high : ndarray, shape (K, d)
        Least and largest of each component; nan where there is none.
    """

    time: Array
    low: Array
    high: Array


def envelope(time: Array, values: Array) -> Envelope:
    """Return the envelope of a record; the record itself if it is short.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times in order.
    values : ndarray, shape (M, d)
        Values; nan where there are none.
    """
    if time.size == 0:
        return Envelope(time, values, values)
    intervals = _BAND_INTERVALS if is_dense(values) else _INTERVALS
    interval = float(time[-1] - time[0]) / intervals
    if time.size <= 2 * intervals:
        first = np.arange(time.size)
        longest = _GAP_INTERVALS * max(interval, float(np.median(np.diff(time, append=time[-1]))))
    else:
        edges = np.searchsorted(time, time[0] + interval * np.arange(intervals))
        first = np.unique(edges)
        longest = _GAP_INTERVALS * interval
    low = np.fmin.reduceat(values, first, axis=0)
    high = np.fmax.reduceat(values, first, axis=0)
    gaps = np.flatnonzero(np.diff(time[first]) > longest) + 1
    last = time[np.maximum(first[gaps] - 1, 0)] if gaps.size else np.empty(0)
    blank = np.full((1, values.shape[1]), np.nan)
    return Envelope(
        np.insert(time[first], gaps, last),
        np.insert(low, gaps, blank, axis=0),
        np.insert(high, gaps, blank, axis=0),
    )


def is_dense(values: Array) -> bool:
    """Return whether a line through a component of values (M, d) would be a solid block."""
    swings = np.nansum(np.abs(np.diff(values, axis=0)), axis=0)
    known = np.isfinite(values)
    span = np.where(known, values, -np.inf).max(axis=0) - np.where(known, values, np.inf).min(
        axis=0
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return bool(np.any(0.5 * swings / span > _MOST_SWINGS))


def packed_times(time: Array) -> dict[str, Any]:
    """Return times (K,) as 32-bit steps from the first."""
    start = float(time[0]) if time.size else 0.0
    step = max(float(time[-1]) - start, 1e-9) / (2**31 - 1) if time.size else 1.0
    steps = np.round((time - start) / step).astype("<i4")
    return {"start": start, "step": step, "data": b64encode(steps.tobytes()).decode()}


def packed(low: Array, high: Array) -> dict[str, Any]:
    """Return least and largest values (K,) as 16-bit numbers with an offset and a step."""
    finite = np.concatenate([low[np.isfinite(low)], high[np.isfinite(high)]])
    least, largest = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    middle, step = 0.5 * (least + largest), max(0.5 * (largest - least), 1e-300) / _LARGEST

    def text(values: Array) -> str:
        steps = np.where(np.isfinite(values), np.round((values - middle) / step), _MISSING)
        return b64encode(steps.astype("<i2").tobytes()).decode()

    out = {"offset": middle, "step": step, "low": text(low)}
    return out if np.array_equal(low, high, equal_nan=True) else out | {"high": text(high)}
