"""The posterior of a planar track along the direction that the data determine least.

While the current is hardly known, ranges to one beacon leave an arc around it. The covariance
at the most probable track is a straight, thin ellipse, which misses the ends of that arc. So the
first position is fixed at points of a grid along the arc, and the rest of the same problem is
minimised anew at each: an integrated nested Laplace approximation (Rue, Martino and Chopin, J.
Royal Statistical Society B 71(2), 2009) in one direction.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.solvers.levenberg_marquardt import minimise
from factorgraph_dvl.solvers.posterior import posterior

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


def points_along_arc(
    found: SolvedProblem, places: Array, report: Progress
) -> tuple[list[SolvedProblem], Array]:
    """Return tracks along the arc of a solved problem, the most probable first, and their costs.

    Where the arc is straight, the problem itself with its whole covariance.

    Parameters
    ----------
    found : SolvedProblem
        Solved problem of a planar chain.
    places : ndarray, shape (B, 2), m
        Places of the beacons, east and north.
    report : callable
        Called with stage, iteration and cost.
    """
    evaluation = found.minimum.evaluation
    P = found.covariances.nodes[0][:2, :2]
    first = evaluation.states.x[0, :2]
    if not found.minimum.converged or not _is_curved(P, np.linalg.norm(places - first, axis=1)):
        return [found], np.zeros(1)
    values, vectors = np.linalg.eigh(P)
    along, step = vectors[:, 1], float(np.sqrt(values[1])) * _SPACING
    out, costs = [], []
    for side in (0, 1, -1):
        near = evaluation
        for i in range(1, _POINTS + 1) if side else (0,):
            place = first + along * step * side * i
            held = _held(found.problem, place, along, _CONSTRAINT * step)
            x = near.states.x.copy()
            x[:, :2] += along * (along @ (place - x[0, :2]))
            at = held.values(replace(near.states, x=x), near.parameters)
            minimum = minimise(held, at, stage="along the arc", progress=report)
            near = minimum.evaluation
            cost = near.cost
            if not minimum.converged or cost > evaluation.cost + _NEGLIGIBLE:
                break
            out.append(replace(found, problem=held, minimum=minimum,
                               covariances=posterior(held, minimum), spurious=None))  # fmt: skip
            costs.append(cost)
    if len(out) < 2:
        return [found], np.zeros(1)
    order = np.argsort(costs)
    return [out[i] for i in order], np.array(costs)[order]


def _is_curved(P: Array, distances: Array) -> bool:
    """Whether the arc around the nearest beacon leaves the ellipse of the first position."""
    values = np.linalg.eigvalsh(P)
    return bool(values[1] / (2.0 * distances.min()) > _CURVED * np.sqrt(values[0]))


def _held(problem: Problem, place: Array, along: Array, sigma: float) -> Problem:
    """Return the problem with the first position fixed at a place, in one direction."""
    out = copy(problem)
    out.graph = gtsam.NonlinearFactorGraph(problem.graph)
    row = np.concatenate([along, np.zeros(2)])[None] / sigma
    factor = gtsam.JacobianFactor(
        keys.node(0), row, row[:, :2] @ place, gtsam.noiseModel.Unit.Create(1)
    )
    origin = gtsam.Values()
    origin.insert(keys.node(0), np.zeros(4))
    out.graph.push_back(gtsam.LinearContainerFactor(factor, origin))
    return out
