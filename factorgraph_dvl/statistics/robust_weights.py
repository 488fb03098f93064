"""Robust weights: outliers by truncated least squares, and windows of them."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from factorgraph_dvl.geometry.vectors import Array, BoolArray, spread
from factorgraph_dvl.sensors.gross_errors import gross_errors, steps

# Probability with which a good measurement passes the gate. Chosen: one in a thousand is lost.
_GATE = 0.999
# Square of a residual, in gates, up to which nothing is worth a search for outliers. Chosen: twice
# the gate is reached by chance once in 1e13 measurements.
_WORTH = 4.0
# Least scale of residuals, in stated standard deviations. Chosen: records without noise have none.
_LEAST_SCALE = 0.2
# Growth of the convexity parameter in a step. Chosen: some ten steps to the end.
_GROWTH = 3.0
# From which on weights are 0 or 1. Chosen: a band of 1 % about the gate is left.
_LARGEST_MU = 50.0
# Rejected measurements that make a window, s in which they lie, and the least share of all
# measurements in between. Chosen: locks that are wrong together reject nearly all.
_RUN = 5
_RUN_TIME = 10.0
_RUN_SHARE = 0.75


def robust_scale(residuals: Array, least: Array | float = _LEAST_SCALE) -> Array:
    """Return the standard deviation (d,) of white noise in residuals (M, d), nan where unused.

    From the median absolute deviation of first differences over sqrt(2): neither outliers nor
    what is slow, as errors of the model or correlated noise, count. It is `least` at least.
    """
    step = np.diff(residuals, axis=0) / np.sqrt(2.0)
    out = np.ones(residuals.shape[1])
    for i, column in enumerate(step.T):
        known = column[np.isfinite(column)]
        if known.size:
            out[i] = spread(known - np.median(known))
    return np.maximum(out, least)


class Truncation:
    """Graduated truncation of squared residuals, from nearly least squares to the gate.

    Yang, Antonante, Tzoumas and Carlone, Graduated non-convexity for robust spatial perception,
    IEEE Robotics and Automation Letters 5(2), 2020, eqs. 14 and remark 5.

    Parameters
    ----------
    residuals : ndarray, shape (M, d)
        Residuals at the start, in standard deviations; nan where a component is not used. Their
        scale is frozen there.
    apart : bool
        Whether components are outliers each for itself.
    unit : ndarray, shape (d,), or float, default 1
        Stated standard deviations in those of `residuals`. An error of less than about one is
        none that is gross, however little the rest scatters.
    """

    def __init__(self, residuals: Array, *, apart: bool, unit: Array | float = 1.0) -> None:
        self._scale = robust_scale(residuals, _LEAST_SCALE * unit)
        self._apart = apart
        used = np.isfinite(residuals)
        freedom = np.ones(used.shape) if apart else used.sum(axis=1, keepdims=True)
        self._gate = chdtri(np.maximum(freedom, 1), 1.0 - _GATE)
        largest = float(np.max(self.squares(residuals) / self._gate, initial=0.0))
        self.worth_it = largest > _WORTH
        self._mu = 1.0 / max(2.0 * largest - 1.0, 1e-9)

    @property
    def done(self) -> bool:
        """Whether weights are as good as 0 or 1."""
        return not self.worth_it or self._mu > _LARGEST_MU

    def squares(self, residuals: Array) -> Array:
        """Return squared residuals by what may be an outlier, (M, d) or (M, 1)."""
        squares = np.nan_to_num((residuals / self._scale) ** 2)
        return squares if self._apart else squares.sum(axis=1, keepdims=True)

    def weights(self, residuals: Array) -> Array:
        """Return the weights of squared residuals, (M, d) or (M, 1), and go one step on."""
        mu, ratio = self._mu, self.squares(residuals) / self._gate
        between = np.sqrt(mu * (mu + 1.0) / np.maximum(ratio, 1e-12)) - mu
        self._mu *= _GROWTH
        return np.clip(between, 0.0, 1.0)

    def outliers(self, residuals: Array) -> BoolArray:
        """Return what lies beyond the gate, (M, d) or (M, 1) bool.

        Where half of all residuals are larger than white noise makes them, the noise is
        correlated, and the gate goes by all of it.
        """
        level = np.nan_to_num(spread(residuals))
        relative = np.maximum(level / self._scale, 1.0)
        return np.asarray(self.squares(residuals / relative) > self._gate)


def misfit(
    residuals: Array, sigma: Array, rejected: BoolArray, unit: str, least: float | None
) -> float:
    """Return -2 log of the likelihood of measurements of which some are gross errors.

    The noise of the others is white and as large as their residuals.

    Parameters
    ----------
    residuals : ndarray, shape (M, d)
        Residuals in the standard deviations `sigma`; nan where a component is not used.
    sigma : ndarray, shape (M, d)
        Standard deviations in the unit of the measurement.
    rejected : ndarray of bool, shape (M, d) or (M, 1)
        The gross errors.
    unit : str
        Unit of the measurement.
    least : float, optional
        Least noise, in standard deviations; None where they are final as they are.
    """
    good = np.where(rejected, np.nan, residuals)
    scale = _level(good, least)
    wrong = gross_errors(residuals * sigma, sigma * scale, rejected, unit)
    return _noise(good, sigma, scale) + 2.0 * float(wrong.sum())


def persistent_misfit(residuals: Array, sigma: Array, least: float | None) -> float:
    """Return -2 log of the likelihood of measurements whose noise persists, none a gross error.

    What is white is the step from one to the next. Parameters as in `misfit`.
    """
    step, spread = steps(residuals * sigma, sigma)
    return _noise(step / spread, spread, _level(step / spread, least))


def _level(residuals: Array, least: float | None) -> Array:
    """Return the root mean square (d,) of residuals (M, d), `least` at least; ones if None."""
    if least is None:
        return np.ones(residuals.shape[1])
    count = np.isfinite(residuals).sum(axis=0)
    return np.maximum(np.sqrt(np.nansum(residuals**2, axis=0) / np.maximum(count, 1)), least)


def _noise(residuals: Array, sigma: Array, scale: Array) -> float:
    """Return -2 log of the likelihood of white noise `scale` (d,) times as large as `sigma`."""
    known = np.isfinite(residuals)
    cost = (residuals / scale) ** 2 + 2.0 * np.log(sigma * scale) + np.log(2.0 * np.pi)
    return float(np.sum(cost, where=known))


def windows(time: Array, rejected: BoolArray, used: BoolArray) -> BoolArray:
    """Return which measurements (M,) lie between rejected ones that are wrong together.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times, increasing.
    rejected, used : ndarray of bool, shape (M,)
        What was rejected, and what else there was with it.
    """
    inside = np.zeros(time.size, dtype=bool)
    at = np.flatnonzero(rejected)
    before = np.concatenate([[0], np.cumsum(used)])
    for first, last in zip(at[: -_RUN + 1], at[_RUN - 1 :], strict=False):
        count = before[last + 1] - before[first]
        if time[last] - time[first] <= _RUN_TIME and count * _RUN_SHARE <= _RUN:
            inside[first : last + 1] = True
    return inside & used
