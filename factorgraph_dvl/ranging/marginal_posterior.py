"""The posterior of a track along the direction that the data determine least.

While the current is hardly known, ranges to one beacon leave an arc around it. The covariance
at the most probable track is a straight, thin ellipse, which misses the ends of that arc. So the
first position is constrained to points of a grid along the arc, and the rest is fitted anew at
each: an integrated nested Laplace approximation (Rue, Martino and Chopin, J. Royal Statistical
Society B 71(2), 2009) in one direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.ranging.model import PlanarProblem
from factorgraph_dvl.ranging.smoother import Fit, cost_terms, covariance, fit

# Chosen: distance of grid points in standard deviations; sums over a normal density at this
# distance are exact to rounding.
_SPACING = 0.7
# Chosen: points to either side at most, out to 6.3 standard deviations.
_POINTS = 9
# Chosen: likelihood, e^-6 of the highest, at which the grid ends.
_NEGLIGIBLE = 6.0
# Chosen: standard deviation of the constraint, as a share of the distance between points.
_CONSTRAINT = 1e-3
# Chosen: height of the arc over its chord within one standard deviation, relative to the
# standard deviation across it, from which on it counts as curved.
_CURVED = 0.3


@dataclass(frozen=True)
class GridPoint:
    """A track at a point of the grid.

    Parameters
    ----------
    fit : Fit
        The most probable track through this point.
    parts : tuple of (ndarray, ndarray, ndarray)
        Its covariances, as `smoother.covariance` returns them.
    cost : float
        Of all data, without the constraint.
    """

    fit: Fit
    parts: tuple[Array, Array, Array]
    cost: float


def grid_points(problem: PlanarProblem, best: Fit) -> list[GridPoint]:
    """Return tracks along the arc of a fit to all data, the most probable first.

    Where the arc is straight, the fit itself with its whole covariance.
    """
    parts = covariance(problem, best)
    values, vectors = np.linalg.eigh(parts[0][0, :2, :2])
    along, sigma = vectors[:, 1], float(np.sqrt(values[1]))
    if not best.converged or not _is_curved(problem, best, parts[0][0, :2, :2]):
        return [GridPoint(best, parts, best.cost)]
    out = []
    for side in (0, 1, -1):
        near = best
        for i in range(1, _POINTS + 1) if side else (0,):
            place = best.p[0] + along * sigma * _SPACING * side * i
            constrained = _constrained(problem, place, along, _CONSTRAINT * _SPACING * sigma)
            moved = near.x + np.array([*(place - near.p[0]), 0.0, 0.0])
            near = fit(constrained, near.x if side == 0 else moved, near.theta)
            cost = float(cost_terms(problem, near).sum())
            if not near.converged or cost > best.cost + _NEGLIGIBLE:
                break
            out.append(GridPoint(near, covariance(constrained, near), cost))
    return sorted(out, key=lambda point: point.cost) or [GridPoint(best, parts, best.cost)]


def posterior_weights(grid: Sequence[GridPoint]) -> Array:
    """Return the normalised likelihoods of grid_points."""
    cost = np.array([point.cost for point in grid])
    likelihood = np.exp(cost.min() - cost)
    return np.asarray(likelihood / likelihood.sum())


def _is_curved(problem: PlanarProblem, best: Fit, cov: Array) -> bool:
    """Whether the arc around the nearest beacon leaves the ellipse of the first position."""
    values = np.linalg.eigvalsh(cov)
    flat = np.linalg.norm(problem.place[:, :2] - best.p[0], axis=1)
    return bool(values[1] / (2.0 * flat.min()) > _CURVED * np.sqrt(values[0]))


def _constrained(
    problem: PlanarProblem, place: Array, along: Array, sigma: float
) -> PlanarProblem:
    """Return the problem with the first position constrained at a place, in one direction."""
    prior = np.linalg.inv(problem.start_cov)
    constraint = np.outer(along, along) / sigma**2
    cov = np.asarray(np.linalg.inv(prior + constraint), dtype=float)
    return replace(
        problem, start_mean=cov @ (prior @ problem.start_mean + constraint @ place), start_cov=cov
    )
