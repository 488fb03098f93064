"""Delays that rise and fall back: the period of the sawtooth that a clock's scores follow.

A buffer that fills and is emptied makes stamps late by a sawtooth. With J the whitened derivatives
of the rows of a measurement by its clock and r their residuals, the measurement has the score
s = -Jᵀ r and the information w = Jᵀ J on its own delay. The highest lines of the spectrum of s are
near the period; folded by a period P, s and w show the sawtooth g with the highest

    (Σ s g)² / Σ w g²,    g = (t - start) / P mod 1, less its weighted mean.

What is left of s without it says how noise scatters: where the vehicle sways, a delay itself has
lines everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.sensors.clock import Clock
from factorgraph_dvl.solvers.shape import Shape

# Fewest periods in a trial, and fewest measurements in a period. Chosen: of less, a rate or a jump
# of the clock, or noise, looks the same.
_PERIODS, _MEASUREMENTS = 4, 4
# Span over what its measurements take at their interval, from which on a record is in pieces, or
# its clock jumps. Chosen: the spectrum takes memory for all of the span.
_SPARSE = 10.0
# Lines of the spectrum that are folded, of the highest and of those that stand out. Chosen: sway
# makes others of each.
_LINES = 3
# Starts that are tried, first to last. Chosen: at the end, a delay of 0.1 s is known to 0.1 ms.
_STARTS = (64, 1024, 1024)
# Periods that are tried around a line, and around the best of them.
_AROUND = 21
# Lines beside one, whose median is that of noise. Chosen: harmonics are few of them.
_BESIDE = 41


@dataclass(frozen=True)
class Sawtooth:
    """The sawtooth that explains most.

    Parameters
    ----------
    period, start : float, s
        Its period, and a stamp at which one begins.
    fall : float
        Fall of the squares of the residuals, nothing else following.
    tried : int
        Periods and starts that could have been it.
    scatter : float
        Median power of lines beside it, over that of white noise, of what it leaves; at least one.
    """

    period: float
    start: float
    fall: float
    tried: int
    scatter: float


def best_sawtooth(time: Array, score: Array, information: Array) -> Sawtooth | None:
    """Return the sawtooth that scores follow best; None of short records, and of those in pieces.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Stamps.
    score, information : ndarray, shape (M,)
        Score, 1/s, and information, 1/s², of each measurement on its own delay.
    """
    stamps = np.unique(time)
    if stamps.size < _PERIODS * _MEASUREMENTS or not information.any():
        return None
    since, span = time - stamps[0], float(np.ptp(stamps))
    interval = float(np.median(np.diff(stamps)))
    if span > _SPARSE * interval * stamps.size:
        return None
    places = np.round(since / interval).astype(np.intp)
    power = np.abs(np.fft.rfft(np.bincount(places, score))) ** 2
    # Line k has k periods in the trial.
    last = min(power.size, stamps.size // _MEASUREMENTS)
    if last <= _PERIODS:
        return None
    # Noise that persists has more of slow lines.
    standing_out = power[_PERIODS:last] / _noise(power[_PERIODS:last], information)
    highest = {
        k for each in (power[_PERIODS:last], standing_out) for k in np.argsort(each)[-_LINES:]
    }
    lines = np.array(sorted(highest)) + float(_PERIODS)
    found = []
    for level, starts in enumerate(_STARTS):
        around = (2.0 / _AROUND) ** level * np.linspace(-1.0, 1.0, _AROUND)
        tried = (lines[:, None] + around).ravel()
        found = [_folded(since * (k / span), score, information, starts) for k in tried]
        best = int(np.argmax([fall for fall, _ in found]))
        lines = tried[best : best + 1]
    fall, phase = found[best]
    line = float(lines[0])
    left = score - _explained(since * (line / span) - phase, score, information)
    power = np.abs(np.fft.rfft(np.bincount(places, left))) ** 2
    noise = _noise(power[_PERIODS:last], information)
    nearest = int(np.clip(round(line) - _PERIODS, 0, noise.size - 1))
    period, tried_in_all = span / line, int(last) * _STARTS[-1]
    start = float(stamps[0] + phase * period)
    return Sawtooth(period, start, fall, tried_in_all, float(noise[nearest]))


def _noise(power: Array, information: Array) -> Array:
    """Return the median power beside each line, over that of white noise; at least one."""
    beside = median_filter(power, _BESIDE, mode="nearest") / np.log(2.0)
    return np.maximum(beside / information.sum(), 1.0)


def _explained(turns: Array, score: Array, information: Array) -> Array:
    """Return what a sawtooth, and a mean delay beside it, are of the scores."""
    shape = np.mod(turns, 1.0)
    shape -= information @ shape / information.sum()
    size = score @ shape / max(information @ shape**2, 1e-12 * information.sum())
    return information * (size * shape + score.sum() / information.sum())


def _folded(turns: Array, score: Array, information: Array, starts: int) -> tuple[float, float]:
    """Return what the best start takes off the squares, and where it is in a period, 0 to 1."""
    bins = np.floor(np.mod(turns, 1.0) * starts).astype(np.intp) % starts
    s, w = (np.bincount(bins, each, starts) for each in (score, information))
    shape = (np.arange(starts) + 0.5) / starts - 0.5
    by_s, by_w, by_ww = (
        np.fft.irfft(np.fft.rfft(sums) * np.conj(np.fft.rfft(of)), starts)
        for sums, of in ((s, shape), (w, shape), (w, shape**2))
    )
    total = w.sum()
    # Less a mean, which the offset of the clock takes up.
    slope, known = by_s - by_w * (s.sum() / total), by_ww - by_w**2 / total
    fall = slope**2 / np.maximum(known, 1e-12 * total)
    best = int(np.argmax(fall))
    return float(fall[best]), best / starts


def sawtooths(problem: Problem, evaluation: Evaluation) -> dict[str, Shape]:
    """Return the period of each delay that is not estimated, by its name.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Problem, and where it is.
    """
    every = {p.name: p for p in problem.all_parameters}
    rows: dict[str, tuple[Clock, list[tuple[Array, Array, Array]]]] = {}
    for bound, motion, residual in zip(
        problem.bound, evaluation.motions, evaluation.residuals, strict=True
    ):
        clock = bound.observation.clock
        if not isinstance(clock, Clock) or not bound.weight.any():
            continue
        delay = every.get(clock.sawtooth.name)
        if delay is None or delay.estimated:
            continue
        offset = clock.offset.name
        lin = bound.linearized(
            motion, evaluation.parameters, [offset], problem.processes_of(bound)
        )
        by_delay = bound.weight * lin.d_parameters[offset][:, :, 0]
        own = bound.observation.time, -np.sum(by_delay * residual, 1), np.sum(by_delay**2, 1)
        rows.setdefault(clock.sawtooth.name, (clock, []))[1].append(own)
    out = dict[str, Shape]()
    for name, (clock, parts) in rows.items():
        found = best_sawtooth(*map(np.concatenate, zip(*parts, strict=True)))
        if found is not None:
            period = every[clock.period.name]
            mean = np.array([found.period, found.start])
            out[name] = Shape(replace(period, mean=mean), found.tried, found.scatter)
    return out
