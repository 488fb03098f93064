"""Variance between trials of each component, by restricted maximum likelihood."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtrc

from factorgraph_dvl.campaign.information import Information
from factorgraph_dvl.campaign.model import Effect, Fit, fit
from factorgraph_dvl.geometry.vectors import Array

# Chosen: largest variance between trials in units of that of one trial.
_LARGEST = 1e8


def fitted(information: Information, effects: Sequence[Effect] = ()) -> Fit:
    """Return the fit at the variances between trials that maximise the restricted likelihood.

    Its gradient by the variance of component k is (s² - W + W X A⁻¹ Xᵀ W)_kk / 2, summed over
    trials, with scores s (Patterson and Thompson 1971; Harville 1977).

    Parameters
    ----------
    information : Information
        Of N trials on n components.
    effects : sequence of Effect, optional
        To estimate with the common value.
    """
    return _maximise(information, effects, np.ones(information.prior_std.size, dtype=bool))


def probabilities(found: Fit) -> Array:
    """Return the probability of each variance between trials, if there were none, (n,).

    Twice the gain in likelihood is by half zero and by half chi-square (Self and Liang 1987).

    Parameters
    ----------
    found : Fit
        As of `fitted`.
    """
    out = np.ones(found.size)
    for k in np.flatnonzero(found.variance > 0.0):
        free = np.arange(found.size) != k
        without = _maximise(found.information, found.effects, free & (found.variance > 0.0))
        gain = max(2.0 * (found.likelihood - without.likelihood), 0.0)
        out[k] = 0.5 * chdtrc(1, gain)
    return out


def _maximise(information: Information, effects: Sequence[Effect], free: np.ndarray) -> Fit:
    zero = fit(information, np.zeros(free.size), effects)
    weight = np.einsum("ikk->k", zero.weight)
    informed = np.sum(np.einsum("ikk->ik", zero.weight) > 0.0, axis=0)
    # One trial more than the common value, at least, and no less for each effect.
    used = np.bincount([e.component for e in effects if np.isinf(e.variance)], minlength=free.size)
    free = free & (informed > used + 1)
    if not free.any():
        return zero
    unit = informed[free] / weight[free]
    best = [zero]

    def negative(x: Array) -> tuple[float, Array]:
        variance = np.zeros(free.size)
        variance[free] = x * unit
        found = fit(information, variance, effects)
        if found.likelihood > best[0].likelihood:
            best[0] = found
        own = np.einsum("ikk->ik", found.weight)
        gradient = 0.5 * np.sum(found.score**2 - own + found.leverage, axis=0)
        return -found.likelihood, -gradient[free] * unit

    # From the moments of the scores, one step of Fisher's scoring.
    own = np.einsum("ikk->ik", zero.weight)
    excess = np.sum(zero.score**2 - own + zero.leverage, axis=0)[free]
    start = np.maximum(excess / np.sum(own**2, axis=0)[free] / unit, 0.0)
    minimize(negative, start, jac=True, method="L-BFGS-B", bounds=[(0.0, _LARGEST)] * start.size)
    return best[0]
