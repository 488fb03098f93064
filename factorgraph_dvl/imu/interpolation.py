"""Rate and force at any time, as smooth as the noise of the samples asks for.

The increments between samples use every sample as it is: their noise averages out in the
sum. A DVL with a lever arm sees the rate at one moment, and a time offset even its
derivative, and there the noise of one sample of a cheap gyro is larger than the motion.
Local cubics (Savitzky and Golay, Anal. Chem. 36 (1964)) over a window that is as wide as
the motion allows take it down.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import factorial

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from factorgraph_dvl.geometry.local_cubics import SHORT, filter_matrix, filtered, polynomial
from factorgraph_dvl.geometry.vectors import Array

# Half-widths that are tried, samples, the longest of them, s, and the order of the polynomials in
# them. Chosen: each is half as wide again as the one before; cubics follow a sway of 1 Hz for so
# long.
_HALF_WIDTHS = (2, 3, 5, 8, 12, 18, 25)
_LONGEST = 0.25
# The narrowest window.
_NARROW = 2 * _HALF_WIDTHS[0] + 1
# Measurements over which an error by sway adds up, while noise averages out, and samples of a
# block, half of which show a sway that goes on; turns begin in fewer. Measured: with 1, and gyros
# of 1.2 deg/sqrt(h), a sway of 2 Hz lost 0.08 % of its rate, and a lever arm of 1.4 m was 3 sigma
# too long.
_REPEATED = 30.0
_BLOCK = 500
# Samples that the window is chosen from. Chosen: minutes of motion, searched in milliseconds.
_ENOUGH = 60_000
# Noise of a derivative between single samples, in units of sample noise over interval.
_RAW_SLOPE = 2.0
# Samples that are smoothed at once, and others on both sides of them beside those of the window.
# Chosen: some ten megabytes; on a spline, what is so many samples off has a share below 1e-28.
_AT_ONCE = 50_000
_BESIDE = 50
# Differences between a narrow and the chosen window beyond which the motion has a step.
_STEP = 4.0


@dataclass(frozen=True)
class Smoothed:
    """A signal of three axes over one arc without gaps.

    Parameters
    ----------
    spline : BSpline or None
        Value over time, None where the samples are best left alone.
    misfit : BSpline or None
        What the window does not resolve, over time; None where nothing, or where not asked for.
    sigma, slope_sigma : float
        Standard deviation of value and derivative from the noise.
    window : int
        Number of samples that each value is made of, 0 where they are left alone.
    """

    spline: BSpline | None
    misfit: BSpline | None
    sigma: float
    slope_sigma: float
    window: int

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Return value, derivative and what is not resolved at times, (M, 3) each."""
        assert self.spline is not None
        value = np.asarray(self.spline(time))
        misfit = np.zeros_like(value) if self.misfit is None else np.abs(self.misfit(time))
        return value, np.asarray(self.spline(time, 1)), np.asarray(misfit)

    @cached_property
    def integral(self) -> BSpline | None:
        """Integral of the value over time, None where the samples are left alone."""
        return None if self.spline is None else self.spline.antiderivative()

    def on_knots_of(self, other: Smoothed) -> Smoothed:
        """Return this signal on the knots of another one at the same times, which are then one."""
        if self.spline is None or other.spline is None:
            return self
        knots = other.spline.t
        return replace(self, spline=BSpline.construct_fast(knots, self.spline.c, self.spline.k))


def unsmoothed(dt: float, sigma: float) -> Smoothed:
    """Return a signal that is not smoothed, with its noise."""
    return Smoothed(None, None, sigma, _RAW_SLOPE * sigma / dt, 0)


def best_window(values: Array, dt: float, sigma: float) -> int:
    """Return the window with the least error of noise and motion together, 0 for none.

    What a window takes of a sway that goes on is alike in many measurements, and counts as often.
    """
    few = values[:_ENOUGH]
    best, width = sigma**2, 0
    for half in _HALF_WIDTHS:
        window = 2 * half + 1
        if half * dt > _LONGEST or window >= few.shape[0]:
            break
        weights = polynomial(window)[0]
        kept = float(weights @ weights)
        moved = np.mean((filtered(few, window) - few) ** 2, axis=1)
        by_noise = sigma**2 * (1.0 - 2.0 * weights[half] + kept)
        by_motion = max(float(np.mean(moved)) - by_noise, 0.0)
        chance = 1.25 * by_noise * np.sqrt(2.0 * window / few.size)
        by_sway = max(float(np.median(block_means(moved, _BLOCK))) - by_noise - chance, 0.0)
        error = by_motion + (_REPEATED - 1.0) * by_sway + sigma**2 * kept
        if error < best:
            best, width = error, window
    return width


def block_means(values: Array, size: int) -> Array:
    """Return the means of blocks of so many values, (B,)."""
    blocks = max(values.size // size, 1)
    whole = values[: blocks * (values.size // blocks)]
    return np.asarray(whole.reshape(blocks, -1).mean(axis=1))


def smooth(
    time: Array,
    values: Array,
    dt: float,
    sigma: float,
    *,
    averaged: bool,
    window: int | None = None,
    with_misfit: bool = True,
) -> Smoothed:
    """Smooth a signal.

    Parameters
    ----------
    time : ndarray, shape (N,)
        Regular: those of the samples, or the middles of the intervals of means, s.
    values : ndarray, shape (N, 3)
        Samples.
    dt : float
        Interval of the samples, s.
    sigma : float
        Standard deviation of a sample.
    averaged : bool
        Whether samples are means over their intervals.
    window : int, optional
        Samples of which each value is made; None = `best_window`.
    with_misfit : bool, default True
        Whether to find what the window does not resolve.
    """
    width = best_window(values, dt, sigma) if window is None else window
    if width == 0 or width > values.shape[0]:
        return unsmoothed(dt, sigma)
    least = _STEP * sigma * white_gain(_NARROW)
    misfit: Array | None
    if values.shape[0] > SHORT:
        spline, misfit = _long_spline(time, values, width, least, averaged=averaged)
    else:
        to_spline, to_misfit = _short_matrices(values.shape[0], width, averaged)
        spline = _short_spline(time, to_spline @ values, 3)
        misfit = _from(least, to_misfit @ values) if with_misfit else None
    line = None
    if with_misfit and misfit is not None and misfit.any():
        line = _broken_line(time, misfit)
    return Smoothed(
        spline=spline,
        misfit=line,
        sigma=sigma * white_gain(width),
        slope_sigma=sigma * slope_gain(width) / dt,
        window=width,
    )


def _long_spline(
    time: Array, values: Array, width: int, least: float, *, averaged: bool
) -> tuple[BSpline, Array]:
    """Return the spline of a smoothed signal, and the size of its misfit from `least` on."""
    count = len(values)
    # Unlike those of `zeros_like`, these zeros take no memory until one is written.
    coefficients, misfit = np.empty(values.shape), np.zeros(values.shape)
    for first in range(0, count, _AT_ONCE):
        last = min(first + _AT_ONCE, count)
        begin, end = max(first - width - _BESIDE, 0), min(last + width + _BESIDE, count)
        own = slice(first - begin, last - begin)
        found, off = _found_and_misfit(values[begin:end], width, averaged)
        coefficients[first:last] = make_interp_spline(time[begin:end], found, k=3).c[own]
        off = _from(least, off[own])
        rows = np.flatnonzero(off.any(axis=1))
        misfit[first + rows] = off[rows]
    knots = np.concatenate([np.repeat(time[:1], 4), time[2:-2], np.repeat(time[-1:], 4)])
    return BSpline.construct_fast(knots, coefficients, 3), misfit


def _from(least: float, misfit: Array) -> Array:
    """Return the sizes of a misfit, those up to a least one as 0."""
    size = np.abs(misfit)
    size[size <= least] = 0.0
    return size


def _found_and_misfit(values: Array, width: int, averaged: bool) -> tuple[Array, Array]:
    """Return a smoothed signal (N, 3), and by how much a narrow window differs from it."""
    found = filtered(values, width)
    if averaged:
        # The mean over an interval exceeds the value at its middle by a'' dt² / 24.
        found -= filtered(values, width, deriv=2) / 24.0
    misfit = filtered(values, _NARROW)
    misfit -= found
    return found, misfit


@lru_cache(maxsize=64)
def _short_matrices(count: int, width: int, averaged: bool) -> tuple[Array, Array]:
    """Return what takes samples to the coefficients of their spline, and to the misfit."""
    found, misfit = _found_and_misfit(np.eye(count), width, averaged)
    return _spline_matrix(count, 3)[1] @ found, misfit


@lru_cache(maxsize=64)
def white_gain(width: int, deriv: int = 0) -> float:
    """Return the standard deviation that a window leaves of unit noise.

    In its middle value, or in a derivative there, at unit intervals.
    """
    return float(np.linalg.norm(polynomial(width)[deriv]) * factorial(deriv))


def smoothed_share(width: int, lengths: Array) -> tuple[Array, Array, Array]:
    """Return the share of the smoothed signal in means that have the noise of one of its values.

    The rest is the mean of the samples: alone, it has less noise from some length on.

    Parameters
    ----------
    width : int
        Window of the smoothing, samples.
    lengths : ndarray, shape (M,)
        Intervals of samples that each mean is over.

    Returns
    -------
    share, slope : ndarray, shape (M,)
        Share, and its derivative by the length.
    sigma : ndarray, shape (M,)
        Standard deviation of the mean where that of a sample is one.
    """
    length, share, slope = _shares(width)
    sigma = np.minimum(white_gain(width), np.maximum(lengths, 1.0) ** -0.5)
    return np.interp(lengths, length, share), np.interp(lengths, length, slope), sigma


@lru_cache(maxsize=64)
def _shares(width: int) -> tuple[Array, Array, Array]:
    """Return lengths of means, the share of the smoothed signal in each, and its slope.

    A mean over L of a signal with the covariance c(s) has the variance 2 / L² times the integral
    of (L - s) c(s), s from 0 to L. The window's weights are the covariance of samples and smoothed
    signal.
    """
    weights, half = polynomial(width)[0], width // 2
    lag = np.linspace(0.0, width, 16 * width + 1)[1:]
    kept = np.append(np.correlate(weights, weights, "full")[width - 1 :], 0.0)
    smooth, both = (_of_mean(lag, c) for c in (kept, np.append(weights[half:], 0.0)))
    raw, wanted = 1.0 / np.maximum(lag, 1.0), kept[0]
    # (1 - a)² raw + 2 a (1 - a) both + a² smooth = wanted, and the least a.
    square, line = raw - 2.0 * both + smooth, raw - both
    inside = np.maximum(line**2 - square * (raw - wanted), 0.0)
    share = np.clip((line - np.sqrt(inside)) / np.maximum(square, 1e-12), 0.0, 1.0)
    share[raw <= wanted] = 0.0
    return lag, share, np.gradient(share, lag)


def _of_mean(length: Array, covariance: Array) -> Array:
    """Return the variances of means over lengths, for a covariance at whole lags and 0 beyond."""
    c = np.interp(length, np.arange(float(covariance.size)), covariance, right=0.0)
    step = length[1] - length[0]

    def integral(values: Array, first: float) -> Array:
        before = np.concatenate([[first], values[:-1]])
        return np.cumsum(0.5 * step * (before + values))

    whole = length * integral(c, covariance[0]) - integral(length * c, 0.0)
    return np.asarray(2.0 * whole / length**2)


@lru_cache(maxsize=64)
def slope_gain(width: int) -> float:
    """Return that of the derivative of the spline, at unit intervals, between the samples.

    Smoothed values are correlated, and a window ends with a step: a wide one leaves twice the
    noise that the derivative of its own cubic would have.
    """
    count = 2 * width + 1
    knots, matrix = _spline_matrix(count, 3)
    spline = BSpline(knots, matrix @ filter_matrix(count, width), 3)
    return float(np.linalg.norm(spline(width + 0.25, 1)))


def _broken_line(time: Array, values: Array) -> BSpline:
    """Return lines between values (N, 3) at regular times, most of which are zero."""
    if time.size <= SHORT:
        return _short_spline(time, values, 1)
    # Lines that start and end at zero need no knots in between.
    beside = np.pad(values.any(axis=1), 1)
    kept = beside[:-2] | beside[1:-1] | beside[2:]
    kept[[0, -1]] = True
    return make_interp_spline(time[kept], values[kept], k=1)


def _short_spline(time: Array, coefficients: Array, degree: int) -> BSpline:
    """Return the spline over regular times; of degree 1 the values are the coefficients."""
    knots, _ = _spline_matrix(time.size, degree)
    step = (time[-1] - time[0]) / (time.size - 1)
    return BSpline.construct_fast(time[0] + step * knots, coefficients, degree)


@lru_cache(maxsize=64)
def _spline_matrix(count: int, degree: int) -> tuple[Array, Array]:
    spline = make_interp_spline(np.arange(float(count)), np.eye(count), k=degree)
    return spline.t, spline.c
