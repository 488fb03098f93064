"""Covariances of states, biases and parameters at a minimum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.solvers.considered_errors import ConsideredError
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation


@dataclass(frozen=True)
class Posterior:
    """Covariances at a minimum.

    Directions of the parameters that the data do not determine are fixed at their prior, and
    motion and biases estimated as if they were exact there. What depends on them has a
    covariance P + K Kᵀ, with K the change with each direction, for one standard deviation of
    its prior (Schmidt's consider analysis; Bierman,
    Factorization Methods for Discrete Sequential Estimation, 1977, ch. VIII).

    Parameters
    ----------
    information : SquareRootInformation
        Information on all variables, the fixed directions taken as exact.
    nodes : ndarray, shape (K, 9, 9)
        Covariances of the states in their tangent space, K Kᵀ included. Where a state has several
        variables, without what is between these.
    given : ndarray, shape (K, 9, 9)
        Covariances of the states that are left where the parameters are exact.
    parameters : ndarray, shape (P, P)
        Covariance of the parameters, in the coordinates u of a step S u, S `Problem.prior_root`.
    with_parameters : dict of int to ndarray
        Covariance of states and biases with them, (size, P) by key.
    considered : dict of int to ndarray
        K of states and biases, (size, h) by key; empty where nothing is fixed.
    errors : tuple of ConsideredError, optional
        Other errors that are not estimated; their K Kᵀ is in `nodes`.
    """

    information: SquareRootInformation
    nodes: Array
    given: Array
    parameters: Array
    with_parameters: dict[int, Array]
    considered: dict[int, Array]
    errors: tuple[ConsideredError, ...] = ()


def posterior(problem: Problem, minimum: Minimum) -> Posterior:
    """Return the covariances at a minimum that was proven, fixed directions taken as exact."""
    information = minimum.information
    wanted = [problem.chain.state_keys(k) for k in range(problem.chain.node_time.size)]
    marginals = information.marginals([key for own in wanted for key in own])
    nodes = np.stack([block_diag(*(marginals[key] for key in own)) for own in wanted])
    if not problem.parameters:
        return Posterior(information, nodes, nodes, np.zeros((0, 0)), {}, {})
    whiten = np.asarray(np.linalg.inv(problem.prior_root), float)
    every = {problem.key(name): whiten[:, place] for name, place in problem.columns.items()}
    with_every = information.covariance_with([every])
    cross = of_states(problem.chain, with_every)
    P = information.covariance_of([every])
    given = nodes - cross @ np.linalg.solve(P, cross.transpose(0, 2, 1))
    others = {key: out for key, out in with_every.items() if key not in every}
    return Posterior(information, nodes, given, P, others, {})


def changes_with(found: Posterior, directions: Array, coupled: Array) -> dict[int, Array]:
    """Return the change K of states and biases with directions, (size, h) by key.

    Parameters
    ----------
    found : Posterior
        Covariances where the directions are not fixed yet.
    directions : ndarray, shape (P, h)
        Directions in the coordinates u of a step S u, S `Problem.prior_root`.
    coupled : ndarray, shape (h, h)
        Projection on those that others depend on.
    """
    P = directions.T @ found.parameters @ directions
    own = directions @ np.linalg.inv(P) @ coupled
    return {key: out @ own for key, out in found.with_parameters.items()}


def of_states(chain: Chain, by_key: Mapping[int, Array]) -> Array:
    """Return rows (K, n, m) of the states of all nodes from those of their variables."""
    every = range(chain.node_time.size)
    return np.stack([np.concatenate([by_key[key] for key in chain.state_keys(k)]) for k in every])


def considered(chain: Chain, found: Posterior, changes: dict[int, Array]) -> Posterior:
    """Return covariances where directions are fixed, with what depends on them."""
    change = of_states(chain, changes)
    return replace(
        found, nodes=found.nodes + change @ change.transpose(0, 2, 1), considered=changes
    )


def with_errors(chain: Chain, found: Posterior, errors: Sequence[ConsideredError]) -> Posterior:
    """Return covariances with what errors that are not estimated add."""
    nodes = found.nodes
    for error in errors:
        change = of_states(chain, error.changes)
        nodes = nodes + change @ change.transpose(0, 2, 1)
    return replace(found, nodes=nodes, errors=(*found.errors, *errors))
