"""Directions of the parameters that the data do not determine, and their information besides.

A direction whose information is mostly spurious is not observable, and stays at the prior.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.clocks import linearized, parameters_of
from factorgraph_dvl.graph.priors import after_step
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.statistics.spurious_information import spurious_information
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Share of spurious information from which on a direction is not observable. Chosen: most of it.
SPURIOUS = 0.5
# Information, in units of the prior's, up to which no share is asked for. Chosen: 5 % of a
# standard deviation.
_LITTLE = 0.1
# Steps of other variables with a fixed direction are genuine from so many times the spurious
# information on. Chosen: three standard deviations.
_COUPLED = 10.0
# Genuine information, in units of the prior's, below which a direction is left to the prior
# once some are spurious. Chosen: it leaves 80 % of the prior's standard deviation.
_GENUINE = 0.5


@dataclass(frozen=True)
class DataInformation:
    """What the data say of the parameters, beside the prior's identity.

    All in the coordinates u of a step S u, S `Problem.prior_root`.

    Parameters
    ----------
    data : ndarray, shape (P, P)
        Information once all other variables are eliminated.
    by_node : ndarray, shape (K, P, P)
        Part of it that the error of the motion at each node is expected to add.
    """

    data: Array
    by_node: Array

    @cached_property
    def spurious(self) -> Array:
        """Part of the information that the error of the motion is expected to add, (P, P)."""
        return np.asarray(self.by_node.sum(axis=0))

    def undetermined_directions(self) -> Array:
        """Return the directions (P, h) that are not observable, if any is spurious."""
        return undetermined_directions(self.data, self.spurious)

    def coupled(self, directions: Array, full: Array) -> Array:
        """Return the projection (h, h) on the directions that other variables depend on.

        The step K of the others that goes with one prior's sigma of a direction is worth
        |K|² in their own information: what they take of that on the direction. Noise makes
        such steps too, as large as its spurious information.

        Parameters
        ----------
        directions : ndarray, shape (P, h)
            Orthonormal.
        full : ndarray
            `parameter_information`.
        """
        P = np.linalg.inv(self.data + np.eye(len(self.data)))
        own = np.eye(directions.shape[1])
        taken = directions.T @ full @ directions + own
        taken -= np.linalg.inv(directions.T @ P @ directions)
        L = np.linalg.cholesky(directions.T @ self.spurious @ directions + own)
        half = np.linalg.solve(L, taken)
        ratio, vectors = np.linalg.eigh(np.linalg.solve(L, half.T))
        spanned = np.linalg.qr(np.linalg.solve(L.T, vectors[:, ratio > _COUPLED]))[0]
        return np.asarray(spanned @ spanned.T)


def data_information(
    problem: Problem,
    evaluation: Evaluation,
    parameter_covariance: Array,
    state_covariances: Array,
    information: SquareRootInformation,
    *,
    at_truth: bool = False,
) -> DataInformation:
    """Return what the data say of the parameters.

    Parameters
    ----------
    problem : Problem
        What was minimised.
    evaluation : Evaluation
        Its minimum.
    parameter_covariance : ndarray, shape (P, P)
        Covariance in the coordinates u of a step S u, S `Problem.prior_root`.
    state_covariances : ndarray, shape (K, 9, 9)
        Covariances of the states where the parameters are exact, in GTSAM's tangent space.
    information : SquareRootInformation
        Square-root information on all variables.
    at_truth : bool, default False
        Whether the motion there is the true one, which adds nothing spurious: return what will be
        found once it is estimated.
    """
    size = len(problem.prior_root)
    if size == 0:
        return DataInformation(np.zeros((0, 0)), np.zeros((len(state_covariances), 0, 0)))
    data = np.linalg.inv(parameter_covariance) - np.eye(size)
    # What the variables take up takes time, and matters only where the bound without it is large.
    for known in (None, information):
        spurious = spurious_information(problem, evaluation, state_covariances, known)
        out = DataInformation(data + spurious.sum(axis=0) if at_truth else data, spurious)
        if not out.undetermined_directions().size:
            break
    return out


def parameter_information(problem: Problem, evaluation: Evaluation) -> Array:
    """Return the information (P, P) of the measurements on the parameters, all else exact.

    In the coordinates u of a step S u, S `Problem.prior_root`.
    """
    root = problem.prior_root
    out = np.zeros((len(root), len(root)))
    for observation, motion, weight in zip(
        problem.observations, evaluation.motions, problem.weights, strict=True
    ):
        wanted = [p.name for p in problem.parameters if p.name in parameters_of(observation)]
        if not wanted:
            continue
        found = linearized(
            observation, motion, evaluation.parameters, wanted, problem.clock_zero
        ).d_parameters
        J = np.concatenate([found[name] for name in wanted], axis=2) * weight[:, :, None]
        columns = np.concatenate([np.arange(len(root))[problem.columns[name]] for name in wanted])
        out[np.ix_(columns, columns)] += np.einsum("mdi,mdj->ij", J, J)
    return np.asarray(root.T @ out @ root)


def undetermined_directions(data: Array, spurious: Array) -> Array:
    """Return the directions (P, h) that are not observable, if any is spurious.

    Parameters
    ----------
    data : ndarray, shape (P, P)
        Information of the data, beside the prior's identity; what is spurious included.
    spurious : ndarray, shape (P, P)
        Part of the information that is spurious.
    """
    if not data.size or not largest_spurious_share(data, spurious) >= SPURIOUS:
        return np.zeros((data.shape[0], 0))
    genuine, directions = np.linalg.eigh(data - spurious)
    return np.asarray(directions[:, genuine < _GENUINE])


def largest_spurious_share(data: Array, spurious: Array) -> Array:
    """Return the largest share of spurious information in any direction, (...).

    Parameters
    ----------
    data, spurious : ndarray, shape (..., P, P)
        The same as for `undetermined_directions`.
    """
    data = 0.5 * (data + np.swapaxes(data, -1, -2))
    L = np.linalg.cholesky(_positive(data) + _LITTLE * np.eye(data.shape[-1]))
    half = np.linalg.solve(L, spurious)
    whitened = np.linalg.solve(L, np.swapaxes(half, -1, -2))
    return np.asarray(
        np.linalg.eigvalsh(0.5 * (whitened + np.swapaxes(whitened, -1, -2)))[..., -1]
    )


def _positive(matrix: Array) -> Array:
    """Return symmetric matrices without their negative eigenvalues."""
    values, vectors = np.linalg.eigh(matrix)
    kept = vectors * np.maximum(values, 0.0)[..., None, :]
    return np.asarray(kept @ np.swapaxes(vectors, -1, -2))


def at_prior_along(
    problem: Problem, parameters: dict[str, Array], directions: Array
) -> dict[str, Array]:
    """Return parameters with the prior's value along directions (P, h)."""
    prior = problem.prior_values()
    root = problem.prior_root
    for _ in range(10):
        offset = np.linalg.solve(root, problem.difference(parameters, prior))
        step = -directions @ (directions.T @ offset)
        parameters = after_step(problem.parameters, parameters, root @ step)
    return parameters
