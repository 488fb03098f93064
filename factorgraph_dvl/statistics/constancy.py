"""Score tests of a change along a trial: are parameters the same all the time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Rows
from factorgraph_dvl.statistics.rows import product

# Intervals in which a trial is divided. Chosen: a change is found to half a percent of the trial.
INTERVALS = 200
# Parts whose scores must agree but for white noise, and degrees of freedom that show it. Chosen:
# parts last as long as noise is correlated, and a tenth of their number is chance.
_PARTS = 20
_LEAST_PARTS = 10
# Fall of the cost below which a change is none anyway. Chosen: 4 standard deviations.
_WORTH_IT = 16.0
# Least share of a parameter's information that either side of a change must have. Chosen: with
# less, a few measurements would decide.
_LEAST_SHARE = 0.05
# Share of the variance that must be left once all parameters follow what came before. Chosen: of
# less, rounding is most.
_LEAST_LEFT = 1e-6


@dataclass(frozen=True)
class Change:
    """The most probable change of a component along a trial.

    Parameters
    ----------
    chi2 : float
        Twice the fall of the cost if the component changed then, one degree of freedom; less
        where the scores of parts of the trial scatter more than white noise makes them.
    fall : float
        The same, whatever the scatter: that of a drift is the drift's own.
    time : float, s
        When.
    size, std : float
        Value after less value before, in the unit of the component, and its standard deviation,
        by the data alone.
    shift : ndarray, shape (P,)
        What all components would be before the change, if it is free, less what they are.
    """

    chi2: float
    fall: float
    time: float
    size: float
    std: float
    shift: Array

    @property
    def significance(self) -> float:
        """Size in standard deviations, as many as the scatter of the scores allows."""
        return float(np.sqrt(self.chi2))

    def within(self, sigma: float) -> Change:
        """Return it where a change has a prior: what goes beyond that pays for it.

        With V the information on the size, S²/(V + sigma⁻²) in place of S²/V.
        """
        share = sigma**2 / (sigma**2 + self.std**2) if np.isfinite(self.std) else 0.0
        return replace(self, chi2=share * self.chi2, fall=share * self.fall)


def changes(
    rows: Iterable[tuple[Rows, Array]],
    with_components: Mapping[int, Array],
    covariance: Array,
    span: tuple[float, float],
    gradient: Mapping[int, Array] | None = None,
) -> list[Change]:
    """Return the most probable change of each component of some parameters.

    With the rows' residuals r, their Jacobian J̃ once all else follows the components, and the
    covariance P of these, the score S and the information I of what was measured up to t make

        S(t) = -sum J̃ᵀ r,    V(t) = I(t) - I(t) P I(t),    chi² = S_i² / V_ii

    for a change of component i at t, all components being free: at the minimum the score of the
    whole trial, priors included, is zero (Andrews, Tests for parameter instability and structural
    change with unknown change point, Econometrica 61(4), 1993; Zeileis and Hornik, Generalized
    M-fluctuation tests for parameter instability, 2007). The most probable time has the largest.

    A change by d shifts all components by -P (I - I(t))_i d, I being that of all measurements.

    Where the objective has a gradient g that no row has, the score of the whole trial is g. It
    counts as the information does: S(t) - I(t) P g, the score where the rows alone have their
    minimum.

    Parameters
    ----------
    rows : iterable of tuple of (Rows, ndarray)
        Rows of the linearised graph, with the times (M,) of their items, s.
    with_components : dict of int to ndarray
        Covariance of every variable with the P components, (size, P) by key.
    covariance : ndarray, shape (P, P)
        Covariance of the components.
    span : tuple of (float, float)
        First and last time, s.
    gradient : mapping of int to ndarray, optional
        Gradient g by variables, (size,) by key.
    """
    edges = np.linspace(*span, INTERVALS + 1)[1:-1]
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    # Of steps in standard deviations, so that parameters of all sizes keep their digits.
    whole = np.linalg.inv(correlation)
    following = {key: (matrix / scale) @ whole for key, matrix in with_components.items()}
    score, information = by_interval(rows, following, edges)
    before = np.cumsum(score, axis=0)[:-1]
    known = np.cumsum(information, axis=0)[:-1]
    if gradient:
        along = sum(following[key].T @ own for key, own in gradient.items())
        before = before - known @ correlation @ along
    V = np.diagonal(known - known @ correlation @ known, axis1=1, axis2=2)
    total = information.sum(axis=0)
    own = np.diagonal(known, axis1=1, axis2=2)
    share = own / np.maximum(np.diag(total), np.finfo(float).tiny)
    allowed = (share > _LEAST_SHARE) & (share < 1.0 - _LEAST_SHARE) & (_LEAST_LEFT * own < V)
    chi2 = np.where(allowed, before**2 / np.where(allowed, V, 1.0), 0.0)
    best = np.argmax(chi2, axis=0)
    out = []
    for i, k in enumerate(best):
        std, change = np.inf, 0.0
        if allowed[k, i]:
            std = scale[i] / np.sqrt(V[k, i])
            # What came before asks for a value by its score, what comes after for the opposite.
            change = -np.sign(before[k, i]) * np.sqrt(chi2[k, i]) * std
        fall = float(chi2[k, i])
        scatter = _scatter(score, information, int(k) + 1, i) if fall > _WORTH_IT else 1.0
        shift = -scale * (correlation @ (total - known[k])[:, i]) * (change / scale[i])
        out.append(Change(fall / scatter, fall, float(edges[k]), float(change), float(std), shift))
    return out


def _scatter(score: Array, information: Array, change: int, i: int) -> float:
    """Return how much more scores of component i scatter than white noise makes them.

    Once all components change before the interval `change`. Noise that is correlated in a way that
    the model does not have makes the scores of parts of a trial scatter more.
    """
    edges = np.union1d(np.arange(0, INTERVALS, INTERVALS // _PARTS), [change]).astype(np.intp)
    scores, known = np.add.reduceat(score, edges), np.add.reduceat(information, edges)
    squares = freedom = 0.0
    for side in (edges < change, edges >= change):
        s, own = scores[side], known[side]
        total = own.sum(axis=0)
        step = np.linalg.lstsq(total, s.sum(axis=0), rcond=_LEAST_LEFT)[0]
        left, used = (s - own @ step)[:, i], own[:, i, i] > 0.0
        squares += float(np.sum(left[used] ** 2 / own[used, i, i]))
        freedom += max(int(used.sum()) - 1, 0)
    return max(1.0, squares / freedom) if freedom >= _LEAST_PARTS else 1.0


def by_interval(
    rows: Iterable[tuple[Rows, Array]], following: Mapping[int, Array], edges: Array
) -> tuple[Array, Array]:
    """Return scores (N, P) and information (N, P, P) of what was measured in each interval.

    Parameters
    ----------
    rows : iterable of tuple of (Rows, ndarray)
        Rows of the linearised graph, with the times (M,) of their items, s.
    following : dict of int to ndarray
        How every variable follows P components, (size, P) by key.
    edges : ndarray, shape (N - 1,), s
        Edges between the intervals.
    """
    size = next(iter(following.values())).shape[1]
    score = np.zeros((edges.size + 1, size))
    information = np.zeros((edges.size + 1, size, size))
    for each, time in rows:
        J = product(each, following)
        of_interval = np.searchsorted(edges, time)
        order = np.argsort(of_interval, kind="stable")
        present, first = np.unique(of_interval[order], return_index=True)
        parts = np.einsum("mdi,md->mi", J, each.vector)[order]
        score[present] -= np.add.reduceat(parts, first, axis=0)
        for k, at in zip(present, np.split(order, first[1:]), strict=True):
            block = J[at].reshape(-1, size)
            information[k] += block.T @ block
    return score, information
