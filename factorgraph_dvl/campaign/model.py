"""Linear mixed model of many trials: a common value, effects, and variation between trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtrc

from factorgraph_dvl.campaign.information import Information
from factorgraph_dvl.geometry.vectors import Array


@dataclass(frozen=True)
class Effect:
    """What moves one component by a factor of its own in each trial.

    Parameters
    ----------
    component : int
        Component that it moves.
    profile : ndarray, shape (N,)
        Number of its sizes in each trial.
    variance : float, optional
        Variance of its size before the trials, in reported units; infinite by default.
    """

    component: int
    profile: Array
    variance: float = np.inf


@dataclass(frozen=True)
class Fit:
    """Common value and effects, given the variance between trials, in units of `scale`.

    Trial i has the value μ + Σ effects + b_i with b_i ~ N(0, T). With its information Λ and
    weighted value η the inverse covariance of its value is W = Λ (I + T Λ)⁻¹: without Λ⁻¹.

    Parameters
    ----------
    information : Information
        Information of the trials.
    effects : tuple of Effect
        Effects that are estimated.
    scale : ndarray, shape (n,)
        Scale of each component, in reported units.
    variance : ndarray, shape (n,)
        Variance between trials, T.
    weight : ndarray, shape (N, n, n)
        The inverse covariance of each trial, W.
    design : ndarray, shape (N, n, n + p)
        Derivative of the value of each trial by common value and effects.
    covariance : ndarray, shape (n + p, n + p)
        Covariance of common value and effects.
    estimate : ndarray, shape (n + p,)
        Common value, relative to the origin, and sizes of the effects.
    score : ndarray, shape (N, n)
        Residual of each trial times W.
    likelihood : float
        Logarithm of the restricted likelihood, up to a constant.
    statistic : float
        Sum of squared normalised residuals of the trials.
    freedom : float
        Its degrees of freedom: what the trials inform on less what they determine.
    """

    information: Information
    effects: tuple[Effect, ...]
    scale: Array
    variance: Array
    weight: Array = field(repr=False)
    design: Array = field(repr=False)
    covariance: Array = field(repr=False)
    estimate: Array = field(repr=False)
    score: Array = field(repr=False)
    likelihood: float
    statistic: float
    freedom: float

    @property
    def size(self) -> int:
        """Number of components."""
        return int(self.variance.size)

    @property
    def leverage(self) -> Array:
        """Variance that the estimate takes from each score, W X A⁻¹ Xᵀ W, diagonal, (N, n)."""
        spread = self.weight @ self.design
        return np.asarray(np.einsum("ikp,pq,ikq->ik", spread, self.covariance, spread))

    def value_in(self, trial: int) -> tuple[Array, Array]:
        """Return the expected value of a trial (n,) and its covariance, in reported units."""
        row = self.design[trial] * self.scale[:, None]
        value = self.information.origin + row @ self.estimate
        return value, row @ self.covariance @ row.T

    def effect(self, i: int) -> tuple[float, float]:
        """Return size and standard deviation of an effect, in reported units."""
        k, at = self.effects[i].component, self.size + i
        std = float(np.sqrt(self.covariance[at, at]))
        return float(self.scale[k] * self.estimate[at]), float(self.scale[k] * std)


def scale_of(information: Information) -> Array:
    """Return a scale of each component (n,): the σ of all trials and the prior together."""
    diagonal = np.einsum("ikk->k", information.matrix) + information.prior_std**-2
    return np.asarray(diagonal**-0.5)


def fit(information: Information, variance: Array, effects: Sequence[Effect] = ()) -> Fit:
    """Estimate common value and effects by generalised least squares.

    Parameters
    ----------
    information : Information
        Information of N trials on n components.
    variance : ndarray, shape (n,)
        Variance between trials, in units of `scale_of`.
    effects : sequence of Effect, optional
        Effects to estimate with the common value.
    """
    scale = scale_of(information)
    n, count = scale.size, information.square.size
    Lambda = information.matrix * np.outer(scale, scale)
    eta = information.weighted * scale
    shrink = np.linalg.inv(np.eye(n) + Lambda * variance)
    weight = shrink @ Lambda
    weight = 0.5 * (weight + weight.transpose(0, 2, 1))
    weighted = np.einsum("ikl,il->ik", shrink, eta)
    p = len(effects)
    design = np.zeros((count, n, n + p))
    design[:, range(n), range(n)] = 1.0
    prior = np.zeros(n + p)
    prior[:n] = (scale / information.prior_std) ** 2
    for j, e in enumerate(effects):
        design[:, e.component, n + j] = e.profile
        prior[n + j] = scale[e.component] ** 2 / e.variance
    offset = np.zeros(n + p)
    offset[:n] = (information.prior_mean - information.origin) / scale
    spread = weight @ design
    normal = np.einsum("ikp,ikq->pq", design, spread) + np.diag(prior)
    right = np.einsum("ikp,ik->p", design, weighted) + prior * offset
    # In units of its diagonal: effects of unlike sizes have unlike information.
    unit = np.sqrt(np.diag(normal))
    root = np.linalg.cholesky(normal / np.outer(unit, unit))
    inverse = np.linalg.inv(root) / unit
    covariance = inverse.T @ inverse
    estimate = covariance @ right
    score = weighted - np.einsum("ikp,p->ik", spread, estimate)
    # x W x = x Λ x - ηᵀ (I + T Λ)⁻¹ T η
    total = float(information.square.sum())
    total -= float(np.einsum("ik,k,ikl,il->", eta, variance, shrink, eta))
    total += float(prior @ offset**2)
    whole = max(total - float(estimate @ right), 0.0)
    off = estimate - offset
    determinant = float(np.linalg.slogdet(np.eye(n) + Lambda * variance)[1].sum())
    determinant += 2.0 * float(np.log(np.diag(root)).sum() + np.log(unit).sum())
    finite = prior[n:] > 0.0
    determinant -= float(np.log(prior[n:][finite]).sum())
    return Fit(
        information,
        tuple(effects),
        scale,
        np.asarray(variance, dtype=float),
        weight,
        design,
        covariance,
        estimate,
        score,
        -0.5 * (determinant + whole),
        max(whole - float(prior @ off**2), 0.0),
        float(information.rank.sum()) - n - p + float(prior @ np.diag(covariance)),
    )


# Chosen: largest variance between trials in units of that of one trial.
_LARGEST = 1e8


def fitted(information: Information, effects: Sequence[Effect] = ()) -> Fit:
    """Return the fit at the variances between trials that maximise the restricted likelihood.

    Its gradient by the variance of component k is (s² - W + W X A⁻¹ Xᵀ W)_kk / 2, summed over
    trials, with scores s (Patterson and Thompson 1971; Harville 1977).

    Parameters
    ----------
    information : Information
        Information of N trials on n components.
    effects : sequence of Effect, optional
        Effects to estimate with the common value.
    """
    return _maximise(information, effects, np.ones(information.prior_std.size, dtype=bool))


def probabilities(found: Fit) -> Array:
    """Return the probability of each variance between trials, if there were none, (n,).

    Twice the gain in likelihood is by half zero and by half chi-square (Self and Liang 1987).

    Parameters
    ----------
    found : Fit
        Fit as of `fitted`.
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
