"""Correlated noise: white and Gauss-Markov parts of residuals, from their spectrum."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from factorgraph_dvl.geometry.vectors import Array

# Lowest frequencies that are left out, the mean included. Chosen: the trajectory follows what is
# slower.
_SKIPPED = 3
# Standard deviation of the logarithm of an expected correlation time. Chosen: a factor of three.
_LOG_TIME = np.log(3.0)
# Times, s, from which one that nothing is known of is searched. Chosen: of filters in receivers,
# and of the sea.
_STARTS = (1.0, 10.0)
# Bounds of the search: logarithms of a variance over that of all, and of the longest time in s.
# Chosen: far outside of what residuals show, and no power of either overflows.
_VARIANCES = (-30.0, 10.0)
_LOG_LONGEST = 20.0
# Shortest time, in intervals: noise that persists for less is white. Measured: without a bound the
# search followed ridges along which white noise takes the place of such a process, and took 1854
# evaluations where 70 suffice.
_SHORTEST = 0.5
# Fall of -2 log likelihood from which on noise counts as correlated. Measured: below 10 on clean
# data, above 1500 where half of the variance is correlated.
_GAIN = 20.0
# Share of the trial that a correlation time may have where none is expected, and gain from which
# on it is that where a longer one fits best. Measured: less is drift or bias, and made σ of a
# scale three times too large.
_LONGEST = 0.2
_CERTAIN = 200.0
# Intervals that a gap counts at most. Chosen: longer ones, as of a clock that jumps, would fill
# the record with zeros.
_LONGEST_GAP = 1000
# Residuals from which on a spectrum is worth a fit. Chosen: some tens of frequencies.
_FEWEST = 100


@dataclass(frozen=True)
class Correlation:
    """A fit of white noise and a first-order Gauss-Markov process.

    Parameters
    ----------
    white, correlated : float
        Variances, in the squared unit of the residuals.
    time_s : float
        Correlation time, s.
    gain : float
        Fall of -2 log likelihood against white noise alone.
    """

    white: float
    correlated: float
    time_s: float
    gain: float

    def long_run_factor(self, interval_s: float) -> float:
        """Return the ratio of the long-run variance to that of a single measurement.

        Of a correlation time that is too short for nodes of its own: white noise of this variance
        leaves the same in a mean over a longer time.
        """
        persists = 2.0 * max(self.time_s, _SHORTEST * interval_s) / interval_s
        total = self.white + self.correlated
        return (self.white + self.correlated * persists) / total


def fit_correlation(
    time: Array, residuals: Array, *, expected_time_s: float | None = None
) -> Correlation | None:
    """Fit white and Gauss-Markov noise to residuals; None if they seem to be white.

    By the likelihood of their periodogram (Whittle, Estimation and information in stationary time
    series, Arkiv för Matematik 2, 1953), with the spectrum

        w + c (1 - phi²) / (1 - 2 phi cos(2 pi f dt) + phi²),    phi = exp(-dt / tau).

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Increasing; gaps are left out.
    residuals : ndarray, shape (M, d)
        Residuals of components whose noise is alike, scaled to one unit; nan where there is none.
    expected_time_s : float, optional
        Correlation time that is stated or usual, with a factor of three.
    """
    used = np.isfinite(residuals).all(axis=1)
    time, residuals = time[used], residuals[used]
    if time.size < _FEWEST:
        return None
    interval = float(np.median(np.diff(time)))
    power, omega = _periodogram(time, residuals, interval)
    size, cosine = residuals.shape[1], np.cos(omega)

    def cost(p: Array) -> tuple[float, Array]:
        spectrum, by_p = _spectrum(p, cosine, interval)
        out = float(size * np.log(spectrum).sum() + (power / spectrum).sum())
        gradient = by_p @ ((size - power / spectrum) / spectrum)
        if expected_time_s is not None:
            off = (p[2] - np.log(expected_time_s)) / _LOG_TIME
            out += 0.5 * off**2
            gradient[2] += off / _LOG_TIME
        return out, gradient

    level = float(power.mean()) / size
    log_level = float(np.log(level))
    within = (log_level + _VARIANCES[0], log_level + _VARIANCES[1])
    starts = _STARTS if expected_time_s is None else (expected_time_s,)
    fits = [
        minimize(
            cost,
            [np.log(0.6 * level), np.log(0.4 * level), np.log(start)],
            jac=True,
            method="L-BFGS-B",
            bounds=[within, within, (np.log(_SHORTEST * interval), _LOG_LONGEST)],
            options={"ftol": 1e-12},
        )
        for start in starts
    ]
    best = min(fits, key=lambda fit: fit.fun)
    white, correlated, tau = np.exp(best.x)
    alone = power.size * size * np.log(level) + float(power.sum()) / level
    gain = 2.0 * (alone - float(best.fun))
    found = Correlation(float(white), float(correlated), float(tau), gain)
    longest = _LONGEST * float(time[-1] - time[0])
    if found.gain < _GAIN:
        return None
    if expected_time_s is not None or found.time_s <= longest:
        return found
    if found.gain < _CERTAIN:
        return None
    # Of what is so slow only the rate of its random walk is seen, 2 c / tau.
    return replace(found, time_s=longest, correlated=found.correlated * longest / found.time_s)


def _periodogram(time: Array, residuals: Array, interval: float) -> tuple[Array, Array]:
    """Return power (F,) of unit white noise d, and angular frequencies (F,) per sample."""
    steps = np.minimum(np.round(np.diff(time) / interval), _LONGEST_GAP)
    place = np.concatenate([[0], np.cumsum(steps)]).astype(int)
    grid = np.zeros((place[-1] + 1, residuals.shape[1]))
    grid[place] = residuals - residuals.mean(axis=0)
    power = np.sum(np.abs(np.fft.rfft(grid, axis=0)) ** 2, axis=1) / time.size
    omega = np.asarray(2.0 * np.pi * np.fft.rfftfreq(grid.shape[0]), dtype=float)
    return power[_SKIPPED:], omega[_SKIPPED:]


def _spectrum(p: Array, cosine: Array, interval: float) -> tuple[Array, Array]:
    """Return the spectral density, (F,), of logarithms of variances and correlation time.

    And its derivatives by them, (3, F); `cosine` is that of the angular frequency.
    """
    white, correlated, time = np.exp(p)
    phi = np.exp(-interval / time)
    denominator = 1.0 - 2.0 * phi * cosine + phi**2
    process = correlated * (1.0 - phi**2) / denominator
    by_phi = -2.0 * (phi * correlated + process * (phi - cosine)) / denominator
    by_p = np.stack([np.full_like(process, white), process, by_phi * phi * interval / time])
    return white + process, by_p
