"""The posterior of a track along the direction that it is known worst in.

While the current is hardly known, ranges to one beacon leave an arc around it: the covariance
at the most probable track is a straight, thin ellipse, and misses what lies round the bend. So
the track is held at places along its ridge, and the rest fitted anew at each: an integrated
nested Laplace approximation (Rue, Martino and Chopin, J. Royal Statistical Society B 71(2),
2009), here of one direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.ranging.model import PlanarProblem
from factorgraph_dvl.ranging.smoother import Fit, cost_terms, covariance, fit

# Places are so many standard deviations apart, and so many at most, to either side; beyond
# e^-6 of the highest likelihood there is nothing to see.
_APART = 0.7
_MOST = 9
_NEGLIGIBLE = 6.0
# A ridge is held this sharply, as a share of the distance between places.
_HELD = 1e-3
# Height of the arc over its chord within one standard deviation, relative to the standard
# deviation across it, above which it is not straight.
_BENT = 0.3


@dataclass(frozen=True)
class Station:
    """A track on the ridge.

    Parameters
    ----------
    fit : Fit
        The most probable one at this place.
    parts : tuple of (ndarray, ndarray, ndarray)
        Its covariances at this place, as of `smoother.covariance`.
    cost : float
        Of the whole data, without what holds it at its place.
    """

    fit: Fit
    parts: tuple[Array, Array, Array]
    cost: float


def stations(problem: PlanarProblem, best: Fit) -> list[Station]:
    """Return tracks along the ridge of a fit to all data, the most probable first.

    A fit whose ridge is straight stands alone, with its whole covariance.
    """
    parts = covariance(problem, best)
    values, vectors = np.linalg.eigh(parts[0][0, :2, :2])
    along, sigma = vectors[:, 1], float(np.sqrt(values[1]))
    if not best.converged or not _bent(problem, best, parts[0][0, :2, :2]):
        return [Station(best, parts, best.cost)]
    out = []
    for side in (0, 1, -1):
        near = best
        for i in range(1, _MOST + 1) if side else (0,):
            place = best.p[0] + along * sigma * _APART * side * i
            held = _held(problem, place, along, _HELD * _APART * sigma)
            moved = near.x + np.array([*(place - near.p[0]), 0.0, 0.0])
            near = fit(held, near.x if side == 0 else moved, near.theta)
            cost = float(cost_terms(problem, near).sum())
            if not near.converged or cost > best.cost + _NEGLIGIBLE:
                break
            out.append(Station(near, covariance(held, near), cost))
    return sorted(out, key=lambda station: station.cost) or [Station(best, parts, best.cost)]


def shares_of(ridge: Sequence[Station]) -> Array:
    """Return the normalised likelihoods of stations."""
    cost = np.array([station.cost for station in ridge])
    likelihood = np.exp(cost.min() - cost)
    return np.asarray(likelihood / likelihood.sum())


def _bent(problem: PlanarProblem, best: Fit, cov: Array) -> bool:
    """Whether the arc around the nearest beacon leaves the ellipse of the first position."""
    values = np.linalg.eigvalsh(cov)
    flat = np.linalg.norm(problem.place[:, :2] - best.p[0], axis=1)
    return bool(values[1] / (2.0 * flat.min()) > _BENT * np.sqrt(values[0]))


def _held(problem: PlanarProblem, place: Array, along: Array, sigma: float) -> PlanarProblem:
    """Return the problem with the first position held at a place, in one direction."""
    prior = np.linalg.inv(problem.start_cov)
    hold = np.outer(along, along) / sigma**2
    cov = np.asarray(np.linalg.inv(prior + hold), dtype=float)
    return replace(
        problem, start_mean=cov @ (prior @ problem.start_mean + hold @ place), start_cov=cov
    )
