"""Drift: components that walk at random over the dates of the trials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtrc

from factorgraph_dvl.campaign.information import Information
from factorgraph_dvl.campaign.model import Effect, Fit, fit
from factorgraph_dvl.geometry.vectors import Array

# Chosen: largest variance of a walk between two trials in units of that between trials.
_LARGEST = 1e4


@dataclass(frozen=True)
class Drift:
    """A component that walks at random.

    Parameters
    ----------
    component : int
        That drifts.
    variance : float
        Of its walk, squared reported units a day, or a trial where the dates are not known.
    probability : float
        Of as clear a drift if there were none.
    """

    component: int
    variance: float
    probability: float

    def effects(self, days: Array) -> list[Effect]:
        """Return the walk as the sum of its steps between trials at times (N,)."""
        trial = np.arange(days.size)
        return [
            Effect(self.component, np.where(trial > c, 1.0, 0.0), self.variance * dt)
            for c, dt in enumerate(np.diff(days))
            if dt > 0.0
        ]


def drift_of(
    information: Information, found: Fit, component: int, days: Array
) -> tuple[Drift, float] | None:
    """Return the drift of a component and the gain in likelihood over none.

    The walk is a sum of independent steps: with their scores g and information G, its restricted
    likelihood given the variances q is that of g ~ N(0, G + G Q G). The variance of the component
    between trials is estimated with it.

    Parameters
    ----------
    information : Information
        Of N trials, in order.
    found : Fit
        Without the drift.
    component : int
        That may drift.
    days : ndarray, shape (N,)
        Times of the trials.

    Returns
    -------
    tuple of (Drift, float) or None
        Drift and gain; None if no drift is more likely.
    """
    k = component
    interval = np.sqrt(np.maximum(np.diff(days), 0.0))
    unit = max(float(found.variance[k]), 1e-6)
    days_long = float(interval.max(initial=0.0)) ** 2
    if days_long <= 0.0:
        return None

    def negative(x: Array) -> float:
        variance = found.variance.copy()
        variance[k] = max(x[0], 0.0) * unit
        base = fit(information, variance, found.effects)
        score, matrix = _step_information(base, k)
        scaled = interval * np.sqrt(max(x[1], 0.0) * unit / days_long)
        normal = np.eye(score.size) + scaled[:, None] * matrix * scaled
        root = np.linalg.cholesky(normal)
        left = np.linalg.solve(root, scaled * score)
        return -base.likelihood + float(np.log(np.diag(root)).sum() - 0.5 * left @ left)

    best = min(
        (
            minimize(negative, start, method="L-BFGS-B", bounds=[(0.0, _LARGEST)] * 2)
            for start in ([0.1, 0.1], [0.5, 0.01])
        ),
        key=lambda result: float(result.fun),
    )
    gain = -found.likelihood - float(best.fun)
    variance = float(best.x[1]) * unit / days_long * float(found.scale[k]) ** 2
    if gain <= 0.0 or variance <= 0.0:
        return None
    return Drift(k, variance, 0.5 * float(chdtrc(1, 2.0 * gain))), gain


def _step_information(found: Fit, k: int) -> tuple[Array, Array]:
    """Return scores (N - 1,) and their covariance of a step of a component after each trial."""
    own = np.cumsum(found.weight[::-1, k, k])[-2::-1]
    cross = np.cumsum((found.weight @ found.design)[::-1, k], axis=0)[-2::-1]
    score = np.cumsum(found.score[::-1, k])[-2::-1]
    later = np.maximum.outer(np.arange(own.size), np.arange(own.size))
    return score, own[later] - cross @ found.covariance @ cross.T
