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
        In order.
    values : ndarray, shape (M, d)
        Values; nan where there are none.
    """
    if time.size == 0:
        return Envelope(time, values, values)
    interval = float(time[-1] - time[0]) / _INTERVALS
    if time.size <= 2 * _INTERVALS:
        first = np.arange(time.size)
        longest = _GAP_INTERVALS * max(interval, float(np.median(np.diff(time, append=time[-1]))))
    else:
        edges = np.searchsorted(time, time[0] + interval * np.arange(_INTERVALS))
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
