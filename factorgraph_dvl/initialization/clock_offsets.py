"""Offsets of the clocks of GNSS and DVL from that of the IMU, before anything is solved.

The IMU, carried through windows, says how velocity and attitude change; a clock is off by what
makes the other sensor's velocities fit these changes. A scan finds the offset, from which a fit
starts, without or with a rate or a jump.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.initialization.carried_windows import MARGIN_S
from factorgraph_dvl.initialization.clock_fit import (
    CERTAIN,
    ClockFit,
    Comparison,
    blocks,
    fit_clock,
    variances,
    window_misfits,
)

# Steps of the scan, s, and of a finer one around its minimum, with its reach. Chosen: turns last
# seconds; under sway at 2 Hz minima lie every 0.25 s, and are 0.05 s wide.
_STEP_S = 0.1
_FINE_STEP_S = 0.02
_FINE_REACH_S = 0.3
# Reach that is scanned first, s, and the misfit, in stated noise, from which on the rest is too.
# Chosen: most clocks are that good, and a scan costs as much as all else.
_NEAR_S = 1.0
_FITS = 2.5
# Misfit in stated noise, and share of the changes of velocity, up to which no other offset is
# looked for. Chosen: what a right clock leaves.
_NOISE = 1.2
_SHARE = 0.15
# Windows that are scanned, of each third of the record. Chosen: those with the largest changes
# of velocity show nearly all.
_SCANNED = 2
# Minima of the finer scan that are refined. Chosen: aliases of a sway on both sides.
_MINIMA = 5
# Log-likelihood per degree of freedom by which minima differ at least, or the nearest is taken.
# Chosen: sway repeats itself all but exactly.
_ALIKE = 0.2
# Variance of a window beside the usual one from which on it stands out, that another offset may
# have beside this one in any window, and must have in such a one at most; gain of its
# log-likelihood. Chosen: with a period of sway too many, motion differs where a turn begins or
# ends only.
_STANDS_OUT = 1.4
_NO_WORSE = 1.15
_BETTER_THERE = 0.8
_DOMINATES = 50.0
# Windows beside it in which other offsets are refined. Chosen: those with the largest changes of
# velocity show nearly all.
_BESIDE = 4
# Fewer blocks say nothing of the scatter between them, as on either side of a jump.
_LEAST_BLOCKS = 6
# Standard deviations of a step that fits a constant rate best, over those of the rate itself.
_STEP_OF_RATE = np.sqrt(0.75)
# Variance that a window may have beside the usual one for a rate or a jump to be believed. Chosen:
# turns leave ten times more than straight courses where a lever arm is not quite right.
_ALIKE_WINDOWS = 30.0
# Share of the squares that one that explains a misfit leaves at most.
_MOST = 0.25
# Drifts over the trial that are tried, and their step, s. Chosen: what stamps at an assumed rate
# make; under sway at 2 Hz thirds of a trial find aliases, and minima are 0.05 s wide.
_DRIFT_S = 1.2
_DRIFT_STEP_S = 0.06
# Times in two windows at which a jump is tried.
_BREAKS = 15
# Measurements that are compared at a time. Chosen: their columns stay in the cache.
_TOGETHER = 5000


@dataclass(frozen=True)
class ClockOffset:
    """How late a sensor's stamps are: offset + rate (t - middle), or another after a jump.

    Parameters
    ----------
    offset, sigma : float, s
        Offset and sigma at `middle`; before the jump if there is one.
    rate, rate_sigma : float
        Rate and its standard deviation, s/s; 0 where a rate is not certain.
    jump, jump_sigma : float, s
        0 where a jump is not certain.
    jump_time : float, s
        When; nan if never.
    middle : float, s
        Time at which the offset is valid.
    gain : float
        Log-likelihood that it gains against an offset `around`, its noise correlated as it is.
    unexplained : float
        Share of the changes of velocity that the IMU leaves, as a ratio of sums of squares.
    """

    offset: float
    sigma: float
    rate: float
    rate_sigma: float
    jump: float
    jump_sigma: float
    jump_time: float
    middle: float
    gain: float
    unexplained: float

    def late(self, time: Array) -> Array:
        """Return by how much stamps (M,) are late, s."""
        late = self.offset + self.rate * (time - self.middle)
        return late + np.where(time > self.jump_time, self.jump, 0.0)


def clock_offset(
    comparison: Comparison, around: float = 0.0, reach: float = MARGIN_S
) -> ClockOffset | None:
    """Return how late a sensor's stamps are.

    Parameters
    ----------
    comparison : Comparison
        Comparison of the sensor with the carried IMU.
    around : float
        Middle of the scan, s.
    reach : float
        Reach of the scan to both sides, s.

    Returns
    -------
    ClockOffset or None
        The clock, None where there are too few data.
    """
    if np.unique(blocks(comparison)).size < _LEAST_BLOCKS:
        return None
    time = comparison.time
    middle = float(np.mean(time[comparison.inside]))
    whole, first, last = _scan(comparison, around, reach)
    whole = _dominating(comparison, whole, around, reach)
    one = np.ones_like(time)
    constant = fit_clock(comparison, one[..., None], np.array([whole]))
    best, rate, jump, jump_time = constant, (0.0, 0.0), (0.0, 0.0), np.nan
    span = float(np.ptp(time[comparison.inside]))
    if _changes(comparison, constant) or abs(last - first) > _STEP_S:
        design = np.stack([one, time - middle], axis=-1)
        slope = 1.5 * (last - first) / span
        starts = [(constant.values[0], 0.0), (0.5 * (first + last), slope)]
        starts += [_drift(comparison, middle, (around, constant.values[0]))]
        drift = _first_of(comparison, design, starts)
        every = np.ones(len(time), dtype=bool)
        if drift.better_than(best, every) and _explains(comparison, drift, constant, every):
            best, rate = drift, (float(drift.values[1]), float(drift.sigma[1]))
        breaks = [
            _break(comparison, float(constant.values[0]), around, reach),
            _break_like(comparison, drift.values, middle),
        ]
        for at, before, after in breaks:
            design = np.stack([one, (time > at).astype(float)], axis=-1)
            found = fit_clock(comparison, design, np.array([before, after - before]))
            sides = [np.unique(blocks(comparison)[side]).size for side in (time > at, time <= at)]
            # In the window that it is in, the mean force over a jump makes a step of velocity.
            outside = ~_spans(comparison, at)
            enough = min(sides) >= _LEAST_BLOCKS and _explains(
                comparison, found, constant, outside
            )
            # A jump has as many parameters as a rate.
            better = found.better_than(constant, outside) and found.gain(best, outside) > 0.0
            if enough and better:
                best, rate = found, (0.0, 0.0)
                jump, jump_time = (float(found.values[1]), float(found.sigma[1])), at
    zero = comparison.residual(around)
    return ClockOffset(
        offset=float(best.values[0]),
        sigma=float(best.sigma[0]),
        rate=rate[0],
        rate_sigma=rate[1],
        jump=jump[0],
        jump_sigma=jump[1],
        jump_time=float(jump_time),
        middle=middle,
        gain=float(np.sum(window_misfits(comparison, zero) - best.misfits)) / best.inflation,
        unexplained=float(np.sum(best.residual**2)) / _signal(comparison),
    )


def _scan(comparison: Comparison, around: float, reach: float) -> tuple[float, float, float]:
    """Return the best offset of a scan, and those of the first and the last third."""
    some, parts = _strongest(comparison)
    freedom = max(float(some.count.sum()), 1.0)
    # A clock that is right needs no scan.
    near = fit_clock(some, np.ones_like(some.time)[..., None], np.array([around]))
    squares, offset = float(np.sum(near.residual**2)), float(near.values[0])
    right = squares < min(freedom * (_NOISE * some.noise) ** 2, _SHARE * _signal(some))
    if right and abs(offset - around) < _FINE_REACH_S:
        return offset, offset, offset
    for width in (min(_NEAR_S, reach), reach):
        grid = _grid(around, width, _STEP_S)
        misfits = _misfits_at(some, grid)
        coarse = float(grid[np.argmin(misfits.sum(axis=1))])
        fine = np.unique(
            [_grid(middle, _FINE_REACH_S, _FINE_STEP_S) for middle in (coarse, around)]
        )
        starts = _lowest(fine, _misfits_at(some, fine).sum(axis=1), freedom)
        found = _nearest_of(some, starts, around, freedom)
        best = float(found.values[0])
        fits = np.sum(found.residual**2) < freedom * (_FITS * some.noise) ** 2
        if width == reach or (fits and abs(best - around) < width - _STEP_S):
            break
    thirds = [float(grid[np.argmin(misfits[:, part].sum(axis=1))]) for part in parts]
    return best, thirds[0], thirds[-1]


def stands_out(comparison: Comparison, offset: float | Array) -> float:
    """Return the variance of the window that fits worst, beside that of the usual window."""
    variance = variances(comparison, comparison.residual(offset))
    return float(variance.max() / max(float(np.median(variance)), 1e-12))


def _dominating(comparison: Comparison, offset: float, around: float, reach: float) -> float:
    """Return the offset that fits each window as well as another, and one of them much better.

    Sway repeats itself, and steady turns as well. Where the motion changes, the difference shows.
    """
    at = variances(comparison, comparison.residual(offset))
    worst = int(np.argmax(at))
    if at[worst] < _STANDS_OUT * np.median(at):
        return offset
    there = comparison.only(np.array([worst]))
    grid = _grid(around, reach, _FINE_STEP_S)
    minima = grid[_minima(_misfits_at(there, grid).sum(axis=1), np.inf)]
    some = comparison.only(np.union1d(np.argsort(comparison.signal)[-_BESIDE:], [worst]))
    likely = np.argsort(_misfits_at(some, minima).sum(axis=1))
    best, most = offset, _DOMINATES
    for start in minima[likely[:_MINIMA]]:
        fit = fit_clock(some, np.ones_like(some.time)[..., None], np.array([start]))
        ratio = variances(comparison, comparison.residual(float(fit.values[0]))) / at
        gain = -0.5 * float(np.sum(comparison.count * np.log(ratio)))
        if gain > most and ratio.max() < _NO_WORSE and ratio[worst] < _BETTER_THERE:
            best, most = float(fit.values[0]), gain
    return best


def _lowest(grid: Array, misfit: Array, freedom: float) -> list[float]:
    """Return the lowest minima of a misfit on a grid, as far as they may be the lowest of all."""
    minima = _minima(misfit, freedom)
    return [float(at) for at in grid[minima[np.argsort(misfit[minima])[:_MINIMA]]]]


def _nearest_alike(grid: Array, misfit: Array, around: float, freedom: float) -> float:
    """Return, of the minima that are nearly the lowest, the one nearest to an offset."""
    minima = grid[_minima(misfit, _ALIKE * freedom)]
    return float(minima[np.argmin(np.abs(minima - around))])


def _minima(misfit: Array, margin: float) -> np.ndarray:
    """Return which points of a grid are minima, up to a margin above the lowest."""
    beyond = np.pad(misfit, 1, constant_values=np.inf)
    minimum = (misfit <= beyond[:-2]) & (misfit <= beyond[2:])
    return np.flatnonzero(minimum & (misfit <= misfit.min() + margin))


def least_misfit(
    comparison: Comparison, around: float, reach: float, step: float = _STEP_S
) -> tuple[float, float]:
    """Return what is left of the changes of velocity at the best offset, and minus its likelihood.

    The first is the ratio of sums of squares, 1 where the IMU explains nothing.
    """
    some, _ = _strongest(comparison)
    grid = _grid(around, reach, step)
    misfits = _misfits_at(some, grid).sum(axis=1)
    best = int(np.argmin(misfits))
    residual = some.residual(float(grid[best]))
    return float(np.sum(residual**2)) / _signal(some), float(misfits[best])


def noise_share(comparison: Comparison) -> float:
    """Return the share of the changes of velocity that stated noise makes."""
    return comparison.noise**2 * float(comparison.count.sum()) / _signal(comparison)


def _signal(comparison: Comparison) -> float:
    return max(float(comparison.signal.sum()), 1e-12)


def _grid(around: float, reach: float, step: float) -> Array:
    steps = int(np.ceil(reach / step))
    return np.asarray(around + step * np.arange(-steps, steps + 1), dtype=float)


def _strongest(comparison: Comparison) -> tuple[Comparison, list[slice]]:
    """Return the windows that show most, and which of them are in each third."""
    signal = comparison.signal
    thirds = [part for part in np.array_split(np.arange(signal.size), 3) if part.size]
    chosen = [np.sort(part[np.argsort(signal[part])[-_SCANNED:]]) for part in thirds]
    edges = np.cumsum([0, *(part.size for part in chosen)]).tolist()
    return comparison.only(np.concatenate(chosen)), list(map(slice, edges[:-1], edges[1:]))


def _misfits_at(comparison: Comparison, offsets: Array) -> Array:
    """Return minus the log-likelihood of each window (L, W) at offsets (L,) or (L, W, n)."""
    late = offsets.reshape(-1, 1, 1) if offsets.ndim == 1 else offsets
    shape = comparison.time.shape
    together = max(int(_TOGETHER / comparison.time.size), 1)
    parts = (late[k : k + together] for k in range(0, len(late), together))
    found = (
        window_misfits(comparison, comparison.residual(np.broadcast_to(part, (len(part), *shape))))
        for part in parts
    )
    return np.concatenate(list(found))


def _first_of(
    comparison: Comparison, design: Array, starts: Sequence[tuple[float, ...]]
) -> ClockFit:
    """Return the best of the fits from several starts."""
    fits = [fit_clock(comparison, design, np.array(start)) for start in starts]
    return max(fits, key=lambda fit: fit.likelihood)


def _nearest_of(
    comparison: Comparison, starts: Sequence[float], around: float, freedom: float
) -> ClockFit:
    """Return, of the fits that are nearly the best, the one nearest to what is stated."""
    one = np.ones_like(comparison.time)[..., None]
    fits = [fit_clock(comparison, one, np.array([start])) for start in starts]
    most = max(fit.likelihood for fit in fits)
    good = [fit for fit in fits if fit.likelihood >= most - _ALIKE * freedom]
    return min(good, key=lambda fit: abs(float(fit.values[0]) - around))


def _changes(comparison: Comparison, fit: ClockFit) -> bool:
    """Whether the offset may change along the trial by what is certain, by its scores.

    A change of z standard deviations scatters the scores of B blocks by 1 + z²/B more in variance.
    """
    order = np.argsort(comparison.time, axis=None)
    share = np.cumsum(fit.information.ravel()[order])
    share /= max(share[-1], 1e-12)
    process = np.cumsum(fit.score.ravel()[order])
    process -= share * process[-1]
    of_blocks = np.bincount(blocks(comparison).ravel(), fit.score.ravel())
    scale = float(np.sqrt(np.sum(of_blocks**2)))
    inner = (share > 0.1) & (share < 0.9)
    height = np.abs(process) / np.sqrt(np.maximum(share * (1.0 - share), 0.01)) * inner
    least = _STEP_OF_RATE * CERTAIN / np.sqrt(1.0 + CERTAIN**2 / np.count_nonzero(of_blocks))
    return bool(height.max() > least * max(scale, 1e-12))


def _drift(comparison: Comparison, middle: float, offsets: Sequence[float]) -> tuple[float, float]:
    """Return offset and rate that fit best, of some offsets in the middle and drifts on a grid."""
    some, _ = _strongest(comparison)
    span = float(np.ptp(comparison.time[comparison.inside]))
    tried = [
        (float(offset), drift / span)
        for offset in offsets
        for drift in _grid(0.0, _DRIFT_S, _DRIFT_STEP_S)
    ]
    late = np.array([offset + rate * (some.time - middle) for offset, rate in tried])
    return tried[int(np.argmin(_misfits_at(some, late).sum(axis=1)))]


def _spans(comparison: Comparison, at: float) -> np.ndarray:
    """Return which windows a time lies within, (W,) bool."""
    time = np.where(comparison.inside, comparison.time, np.nan)
    return np.asarray((np.nanmin(time, axis=1) <= at) & (at <= np.nanmax(time, axis=1)))


def _explains(
    comparison: Comparison, fit: ClockFit, without: ClockFit, windows: np.ndarray
) -> bool:
    """Whether a fit explains most of a misfit, or leaves about as much in each of some windows.

    If not, something else is wrong there.
    """
    if np.sum(fit.residual**2) < _MOST * np.sum(without.residual**2):
        return True
    variance = np.sum(fit.residual**2, axis=(1, 2)) / np.maximum(comparison.count, 1.0)
    usual = max(float(np.median(variance)), comparison.noise**2)
    return bool(np.all(variance[windows] < _ALIKE_WINDOWS * usual))


def _break(
    comparison: Comparison, constant: float, around: float, reach: float
) -> tuple[float, float, float]:
    """Return when an offset jumps, if it does, and its values before and after.

    They are `constant`, the best offset without a jump, where another one is hardly better: by
    a period of the sway, nearly the same motion is measured.
    """
    grid = np.unique([*_grid(around, reach, _STEP_S), constant])
    misfits = _misfits_at(comparison, grid)
    count = misfits.shape[1]
    sums = np.concatenate([np.zeros((grid.size, 1)), np.cumsum(misfits, axis=1)], axis=1)
    whole = sums[:, -1:] - sums
    k = 1 + int(np.argmin((sums.min(axis=0) + whole.min(axis=0))[1:count])) if count > 1 else 0
    before, after = (
        _nearest_alike(grid, misfit[:, k], constant, float(comparison.count[part].sum()))
        for misfit, part in ((sums, slice(k)), (whole, slice(k, None)))
    )
    sides = np.arange(count) < k, np.arange(count) > k
    before, after = (
        _dominating(comparison.only(side), offset, around, reach) if side.any() else offset
        for side, offset in zip(sides, (before, after), strict=True)
    )
    return _break_near(comparison, k, before, after), before, after


def _break_like(comparison: Comparison, drift: Array, middle: float) -> tuple[float, float, float]:
    """Return when an offset jumps, and its values before and after, as like a drift as possible.

    A jump J after a share p of the time has the mean offset and, by least squares, the rate

        before + (1 - p) J,    6 p (1 - p) J / span.
    """
    inside = comparison.time[comparison.inside]
    begin, span = float(inside.min()), float(np.ptp(inside))
    edges = comparison.time[1:, 0]
    share = (edges - begin) / span
    jump = drift[1] * span / (6.0 * share * (1.0 - share))
    before = drift[0] + drift[1] * (begin + 0.5 * span - middle) - (1.0 - share) * jump
    after = np.asarray(comparison.time > edges[:, None, None], dtype=float)
    late = before[:, None, None] + after * jump[:, None, None]
    k = int(np.argmin(_misfits_at(comparison, late).sum(axis=1)))
    sides = float(before[k]), float(before[k] + jump[k])
    return _break_near(comparison, k + 1, *sides), *sides


def _break_near(comparison: Comparison, k: int, before: float, after: float) -> float:
    """Return when an offset jumps, within the last window before and the first after, `k`."""
    time = comparison.time
    first, last = time[max(k - 1, 0)].min(), time[min(k, time.shape[0] - 1)].max()
    tried = np.linspace(first, last, _BREAKS)
    late = np.where(time > tried[:, None, None], after, before)
    return float(tried[np.argmin(_misfits_at(comparison, late).sum(axis=1))])
