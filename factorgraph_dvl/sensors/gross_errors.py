"""Gross errors of measurements: how likely they are, one by one or persisting."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, BoolArray

# Share of gross errors among measurements, and the range that they lie in, by unit of the
# residual: what a rejected measurement costs hardly changes with either. Chosen: one in a hundred;
# any direction, a vessel's area of work, twice the speed that a DVL can measure.
_SHARE = 0.01
_RANGE = {"rad": 2.0 * np.pi, "m": 1e4, "m/s": 20.0}


def gross_errors(error: Array, sigma: Array, rejected: BoolArray, unit: str) -> Array:
    """Return -log of the likelihoods of gross errors, (M, d); zero where there is none.

    Where a row is one measurement, it is wrong or right as a whole, and that counts once.

    One that is none of the last one is uniform over the range of the sensor: the same whatever the
    noise of the others. One that persists counts once: the next is the same but for the noise of
    both, or another one, whichever is more likely.

    Parameters
    ----------
    error, sigma : ndarray, shape (M, d)
        Residuals and their standard deviations in the unit of the measurement; nan where a
        component is not used.
    rejected : ndarray of bool, shape (M, d) or (M, 1)
        The gross errors.
    unit : str
        Unit of the measurement.
    """
    wrong = np.isfinite(error) & rejected
    together = wrong.sum(axis=1, keepdims=True) if rejected.shape[1] == 1 else np.ones((1, 1))
    step, spread = steps(error, sigma)
    good, _ = steps(np.where(rejected, 0.0, 1.0) + 0.0 * error, sigma)
    persists = 0.5 * (step / spread) ** 2 + np.log(spread) + 0.5 * np.log(2.0 * np.pi)
    persists = np.where(good == 0.0, persists, np.inf)
    anew = np.log(_RANGE.get(unit, _RANGE["m"])) - np.log(_SHARE) / np.maximum(together, 1)
    return np.where(wrong, np.fmin(anew, persists), 0.0)


def steps(error: Array, sigma: Array) -> tuple[Array, Array]:
    """Return steps of errors (M, d) from the last known ones, and the noise of both; or nan."""
    known = np.isfinite(error)
    row = np.arange(len(error))[:, None]
    last = np.maximum.accumulate(np.where(known, row, -1), axis=0)
    last = np.vstack([np.full((1, error.shape[1]), -1), last[:-1]])
    both = known & (last >= 0)
    before = np.maximum(last, 0)
    step = error - np.take_along_axis(error, before, axis=0)
    spread = np.hypot(sigma, np.take_along_axis(sigma, before, axis=0))
    return np.where(both, step, np.nan), np.where(both, spread, np.nan)
