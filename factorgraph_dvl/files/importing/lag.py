"""The lag between two records of speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from factorgraph_dvl.files.formats.framing import Index
from factorgraph_dvl.geometry.vectors import Array

Series = tuple[Array, Array]

# Chosen: the widest difference of local time from UTC, one hour aside, and how far a clock that
# was set by hand is off, s.
_WIDEST_ZONE, _HAND = 13 * 3600.0, 60.0
# By law: zones are off by quarters of an hour, s.
_ZONE = 900.0
# Least overlap of two records that are compared, s and as a share of the shorter one. Chosen: less
# has no change of speed.
_OVERLAP, _SHARE = 60.0, 0.5
# A lag is clear if speeds at it correlate by this, and elsewhere by so much less. Chosen: by
# chance neither comes about.
_CLEAR, _MARGIN = 0.8, 0.1
# Step of the finer search, s. Chosen: finer than the interval of most receivers.
_FINE = 0.1
# Records beyond this are thinned out: three days at 1 Hz.
_LONGEST = 1 << 18


@dataclass(frozen=True)
class Lag:
    """Where two records correlate best.

    Parameters
    ----------
    lag : float, s
        Stamp of the first minus that of the second.
    peak, second : float
        Correlation there, and the next best that is no neighbour.
    """

    lag: float
    peak: float
    second: float

    @property
    def clear(self) -> bool:
        """Whether the data decide on it."""
        return self.peak > _CLEAR and self.peak - self.second > _MARGIN


def lag_between(first: Series, second: Series, *, zones: bool) -> Lag | None:
    """Return the lag at which two records of speed correlate best.

    Parameters
    ----------
    first, second : tuple of ndarray
        Stamps (N,), s, in order, and speeds (N,), m/s.
    zones : bool
        Whether both have dates: the lag is then near a multiple of a quarter of an hour.

    Returns
    -------
    Lag or None
        None if the records are too short.
    """
    step = max(
        1.0, (first[0][-1] - first[0][0]) / _LONGEST, (second[0][-1] - second[0][0]) / _LONGEST
    )
    a, b = _regular(first, step), _regular(second, step)
    shortest = min(len(a), len(b)) * step
    if shortest < _OVERLAP:
        return None
    correlation, shift = _correlations(a, b, max(_OVERLAP, _SHARE * shortest) / step)
    lag = first[0][0] - second[0][0] + shift * step
    if zones:
        off = np.abs((lag + _ZONE / 2.0) % _ZONE - _ZONE / 2.0)
        allowed = (np.abs(lag) <= _WIDEST_ZONE + _HAND) & (off <= _HAND)
        correlation = np.where(allowed, correlation, -1.0)
    best = int(np.argmax(correlation))
    if correlation[best] <= -1.0:
        return None
    # Neighbours correlate as well, as speeds change slowly: the peak ends where it falls by half.
    rest = correlation.copy()
    low = np.flatnonzero(correlation < correlation[best] / 2.0)
    left, right = low[low < best], low[low > best]
    rest[(left[-1] if len(left) else 0) : (right[0] if len(right) else len(rest))] = -1.0
    fine = lag[best] + np.arange(-1.5 * step, 1.5 * step + _FINE, _FINE)
    values = [_at(first, second, x) for x in fine]
    return Lag(float(fine[int(np.argmax(values))]), float(correlation[best]), float(rest.max()))


def _regular(series: Series, step: float) -> Array:
    """Return speeds at a regular step, nan in gaps."""
    time, speed = series
    grid = np.arange(time[0], time[-1], step)
    out = np.interp(grid, time, speed)
    place = np.clip(np.searchsorted(time, grid), 1, len(time) - 1)
    gap = time[place] - time[place - 1] > max(5.0, 2.0 * step)
    return np.where(gap, np.nan, out)


def _correlations(a: Array, b: Array, least: float) -> tuple[Array, Index]:
    """Return correlations of a(i + k) with b(i), -1 for short overlaps, and all shifts k."""
    size = scipy.fft.next_fast_len(len(a) + len(b))
    known_a, known_b = np.isfinite(a).astype(float), np.isfinite(b).astype(float)
    # Sums of squares lose no digits if values are near zero.
    a, b = np.nan_to_num(a - np.nanmean(a)), np.nan_to_num(b - np.nanmean(b))

    def product(x: Array, y: Array) -> Array:
        spectrum = scipy.fft.rfft(x, size) * np.conj(scipy.fft.rfft(y, size))
        return np.asarray(scipy.fft.irfft(spectrum, size))

    n = np.round(product(known_a, known_b))
    sum_a, sum_b = product(a, known_b), product(known_a, b)
    square_a, square_b = product(a * a, known_b), product(known_a, b * b)
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = product(a, b) - sum_a * sum_b / n
        spread = (square_a - sum_a**2 / n) * (square_b - sum_b**2 / n)
        value = cross / np.sqrt(spread)
    usable = (n >= least) & (spread > 1e-12 * n**2) & np.isfinite(value)
    shift = np.arange(size)
    shift = np.where(shift < len(a), shift, shift - size)
    order = np.argsort(shift, kind="stable")
    return np.where(usable, value, -1.0)[order], shift[order]


def _at(first: Series, second: Series, lag: float) -> float:
    time = first[0] - lag
    inside = (time >= second[0][0]) & (time <= second[0][-1])
    if inside.sum() < 3:
        return -1.0
    a, b = first[1][inside], np.interp(time[inside], *second)
    return float(np.corrcoef(a, b)[0, 1]) if np.ptp(a) > 0.0 and np.ptp(b) > 0.0 else -1.0
