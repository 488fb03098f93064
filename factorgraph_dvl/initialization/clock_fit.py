"""The fit of a clock's parameters to velocities beside the carried IMU.

Gauss-Newton steps find the parameters. The scatter of short blocks and the spectrum of the
residuals give their standard deviations, whatever the noise is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from factorgraph_dvl.geometry.vectors import Array

# Half of the difference in time by which residuals are differentiated, s.
_DIFFERENCE_S = 0.02
_ITERATIONS = 6
# Halvings of a step that does not gain.
_HALVINGS = 3
# Largest step of Gauss-Newton, s. Chosen: a minimum's width under sway.
_LARGEST_STEP_S = 0.3
# Blocks of measurements whose errors are independent, s. Chosen: several times the correlation
# time of GNSS velocities.
_BLOCK_S = 10.0
# Periods in a window below which the trend of the window takes frequencies from its residuals, and
# twice this below which frequencies stand for them. Measured: noise of GNSS that is half
# correlated over 2 s has 1.8 times σ there, and clocks that are right were up to 7 σ off.
_TAKEN = 2
# A parameter is one where it is so many standard deviations, and windows fit better for it by
# this much of the log-likelihood. Chosen: chance gives neither in 10 000 trials.
CERTAIN = 6.0
_BETTER = 20.0
# Misfit below which nothing is gained, m/s. Chosen: finer than any receiver's or DVL's digits.
_LEAST_MISFIT = 1e-3


class Comparison(Protocol):
    """Velocities of a sensor against the carried IMU, in W windows of n."""

    @property
    def time(self) -> Array:
        """Times as in the record, (W, n), s."""

    @property
    def inside(self) -> np.ndarray:
        """Which of them are meant, (W, n) bool."""

    @property
    def count(self) -> Array:
        """Degrees of freedom of each window, (W,)."""

    @property
    def signal(self) -> Array:
        """Sum of squares of the changes of velocity in each window, (W,)."""

    @property
    def noise(self) -> float:
        """Stated standard deviation of a component, m/s."""

    def only(self, lines: np.ndarray) -> Self:
        """Return some of the windows."""

    def residual(self, offset: float | Array) -> Array:
        """Return what is left if the sensor is late by offsets (..., W, n), (..., W, n, 3)."""


@dataclass(frozen=True)
class ClockFit:
    """Clock parameters that fit W windows of n measurements best.

    Parameters
    ----------
    values, sigma : ndarray, shape (c,)
        Parameters, and their standard deviations.
    inflation : float
        Variance of the last parameter over what white noise would make it.
    misfits : ndarray, shape (W,)
        Misfits as of `window_misfits`.
    residual : ndarray, shape (W, n, 3), m/s
        What is left.
    score, information : ndarray, shape (W, n)
        Score and information of the offset at each measurement.
    """

    values: Array
    sigma: Array
    inflation: float
    misfits: Array
    residual: Array
    score: Array
    information: Array

    @property
    def likelihood(self) -> float:
        """Logarithm of the likelihood."""
        return -float(self.misfits.sum())

    def gain(self, other: ClockFit, windows: np.ndarray) -> float:
        """Return its gain in log-likelihood against another fit, in some windows."""
        return float(np.sum((other.misfits - self.misfits)[windows])) / self.inflation

    def better_than(self, other: ClockFit, windows: np.ndarray) -> bool:
        """Whether its last parameter is certain, and some windows fit better for it."""
        certain = abs(self.values[-1]) > CERTAIN * self.sigma[-1]
        return bool(certain and self.gain(other, windows) > _BETTER)


def fit_clock(comparison: Comparison, design: Array, start: Array) -> ClockFit:
    """Fit clock parameters by Gauss-Newton steps.

    Parameters
    ----------
    comparison : Comparison
        Comparison of W windows of n measurements.
    design : ndarray, shape (W, n, c)
        Design from clock parameters to offsets, s.
    start : ndarray, shape (c,)
        Parameters to start from.
    """
    values = start
    residual = comparison.residual(design @ values)
    misfit = window_misfits(comparison, residual)
    for _ in range(_ITERATIONS):
        later, sooner = (
            comparison.residual(design @ values + step) for step in (_DIFFERENCE_S, -_DIFFERENCE_S)
        )
        slope = (later - sooner) / (2.0 * _DIFFERENCE_S)
        squares = np.maximum(np.sum(residual**2, axis=(1, 2)), 1e-12)
        weight = (np.maximum(comparison.count, 1.0) / squares)[:, None]
        information = np.sum(slope**2, axis=2) * weight
        score = np.sum(slope * residual, axis=2) * weight
        normal = np.einsum("wn,wni,wnj->ij", information, design, design)
        normal += 1e-12 * np.diag(np.maximum(np.diag(normal), 1e-12))
        inverse = np.linalg.inv(normal)
        step = -inverse @ np.einsum("wn,wni->i", score, design)
        largest = float(np.max(np.abs(design @ step)))
        step *= min(1.0, _LARGEST_STEP_S / max(largest, 1e-12))
        for _ in range(_HALVINGS):
            tried = comparison.residual(design @ (values + step))
            new = window_misfits(comparison, tried)
            if new.sum() < misfit.sum():
                break
            step = 0.5 * step
        if new.sum() >= misfit.sum():
            break
        done = misfit.sum() - new.sum() < 0.01
        values, residual, misfit = values + step, tried, new
        if done:
            break
    root = np.sqrt(weight)[..., None]
    spreads = (
        _scatter(comparison, score, design),
        _score_covariance(comparison, residual * root, slope * root, design),
    )
    each = [np.diag(inverse @ spread @ inverse) for spread in spreads]
    variance = np.maximum.reduce([*each, np.diag(inverse)])
    return ClockFit(
        values=values,
        sigma=np.sqrt(variance),
        inflation=float(variance[-1] / inverse[-1, -1]),
        misfits=misfit,
        residual=residual,
        score=score,
        information=information,
    )


def _scatter(comparison: Comparison, score: Array, design: Array) -> Array:
    """Return the covariance (c, c) of the scores of clock parameters, by those of blocks."""
    number = blocks(comparison).ravel()
    of_blocks = np.stack(
        [np.bincount(number, (score * d).ravel()) for d in np.moveaxis(design, -1, 0)]
    )
    used = int(np.count_nonzero(np.bincount(number, comparison.inside.ravel())))
    return np.asarray(of_blocks @ of_blocks.T * (used / max(used - design.shape[-1], 1)))


def _score_covariance(
    comparison: Comparison, residual: Array, slope: Array, design: Array
) -> Array:
    """Return the covariance (c, c) of the scores of clock parameters, of stationary noise.

    The spectrum of all residuals says how correlated the noise is. A few blocks with large
    changes of velocity hardly say it by their scatter.

    Parameters
    ----------
    comparison : Comparison
        Comparison of W windows of n measurements.
    residual, slope : ndarray, shape (W, n, 3)
        Residual of unit noise, and its derivative by the offset.
    design : ndarray, shape (W, n, c)
        Design from clock parameters to offsets.
    """
    power = np.sum(np.abs(np.fft.fft(residual, axis=1)) ** 2, axis=(0, 2))
    power /= 3.0 * comparison.inside.sum()
    periods = np.minimum(np.arange(power.size), power.size - np.arange(power.size))
    taken, lowest = periods < _TAKEN, (periods >= _TAKEN) & (periods < 2 * _TAKEN)
    power[taken] = power[lowest].mean() if lowest.any() else 1.0
    by_parameters = np.fft.fft(slope[..., None] * design[:, :, None], axis=1)
    products = np.einsum("f,wfki,wfkj->ij", power, by_parameters.conj(), by_parameters)
    return np.asarray(products.real / power.size)


def blocks(comparison: Comparison) -> np.ndarray:
    """Return in which block each measurement is, (W, n), numbered from 0."""
    time = comparison.time
    return np.asarray(np.floor((time - time.min()) / _BLOCK_S), dtype=int)


def variances(comparison: Comparison, residual: Array) -> Array:
    """Return the mean square of each window, (..., W), and of digits, m²/s²."""
    squares = np.sum(residual**2, axis=(-2, -1))
    return np.asarray(squares / np.maximum(comparison.count, 1.0) + _LEAST_MISFIT**2)


def window_misfits(comparison: Comparison, residual: Array) -> Array:
    """Return minus the log-likelihood of each window, (..., W), its noise unknown."""
    freedom = np.maximum(comparison.count, 1.0)
    return np.asarray(0.5 * freedom * np.log(variances(comparison, residual)))
