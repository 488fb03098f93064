"""Information that only the noise of the motion feigns.

A straight run does not show a rotation of the DVL about the velocity. Linearised at the
estimated motion it seems to: the estimate wavers by its error, and the Jacobian takes
that for changes of direction. Thousands of pings then add up to a standard deviation of
some degrees where nothing is known, and the estimate follows the noise (in regression:
errors in variables). The expected share of that error in the information is computed
here; where it is most of it, the direction is not observable, and the prior is held.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import eigh

from factorgraph_dvl.conventions import Array, rotate, skew
from factorgraph_dvl.graph import Problem
from factorgraph_dvl.preintegration import Attachment
from factorgraph_dvl.sensors.protocol import Motion, Observation
from factorgraph_dvl.solvers.covariance import Posterior
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum

# Share of the error of the motion in the information from which on it is not believed.
_FEIGNED = 0.5
# Information, in units of the prior's, that is not worth the question.
_LITTLE = 0.1
# Genuine information, in the same units, below which a direction is left to the prior once
# some are feigned.
_GENUINE = 0.5


def feigned_directions(problem: Problem, minimum: Minimum, covariances: Posterior) -> Array:
    """Return directions that are not observable, if the information on any is feigned.

    Parameters
    ----------
    problem, minimum, covariances : at the minimum.

    Returns
    -------
    (P, h) orthonormal, in the coordinates u of a step S u, S `Problem.prior_root`; h may be 0.
    """
    if not problem.parameters:
        return np.zeros((0, 0))
    root = problem.prior_root
    size = len(root)
    functionals = [{problem.key(p.name): np.eye(p.mean.size)} for p in problem.parameters]
    whiten = np.linalg.inv(root)
    P = whiten @ covariances.information.covariance_of(functionals) @ whiten.T
    data = np.linalg.inv(P) - np.eye(size)
    feigned = np.zeros((size, size))
    for observation, attachment, motion, weight in zip(
        problem.observations,
        problem.attachments,
        minimum.evaluation.motions,
        problem.weights,
        strict=True,
    ):
        names = [p.name for p in problem.parameters if p.name in observation.parameters]
        if names:
            part, columns = _feigned_by(
                problem, observation, attachment, motion, weight, minimum, covariances.nodes
            )
            feigned[np.ix_(columns, columns)] += part
    feigned = root.T @ feigned @ root
    data = 0.5 * (data + data.T)
    share = eigh(feigned, _positive(data) + _LITTLE * np.eye(size), eigvals_only=True)
    if share.max() < _FEIGNED:
        return np.zeros((size, 0))
    genuine, directions = np.linalg.eigh(data - feigned)
    return np.asarray(directions[:, genuine < _GENUINE])


def _positive(matrix: Array) -> Array:
    """Return a symmetric matrix without its negative eigenvalues."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def at_prior_along(
    problem: Problem, parameters: dict[str, Array], directions: Array
) -> dict[str, Array]:
    """Return parameters with the prior's value along directions (P, h)."""
    prior = problem.prior_values()
    root = problem.prior_root
    for _ in range(10):
        away = np.linalg.solve(root, problem.difference(parameters, prior))
        step = -directions @ (directions.T @ away)
        parameters = problem.moved(parameters, root @ step)
    return parameters


def _feigned_by(
    problem: Problem,
    observation: Observation,
    attachment: Attachment,
    motion: Motion,
    weight: Array,
    minimum: Minimum,
    nodes: Array,
) -> tuple[Array, np.ndarray]:
    """Return the expectation of the information that the motion's error adds, and its place."""
    wanted = [p.name for p in problem.parameters if p.name in observation.parameters]
    columns = np.concatenate(
        [np.arange(place.start, place.stop) for place in map(problem.columns.get, wanted) if place]
    )
    values = minimum.evaluation.parameters

    def jacobian(at: Motion) -> Array:
        found = observation.linearize(at, values, wanted).d_parameters
        return np.concatenate([found[name] for name in wanted], axis=2)

    base = jacobian(motion)
    v_b = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n)
    P = nodes[attachment.node]
    by_state = np.concatenate(
        [skew(v_b), np.zeros_like(motion.nRb), np.broadcast_to(np.eye(3), motion.nRb.shape)],
        axis=2,
    )
    covariance = by_state @ P @ by_state.transpose(0, 2, 1)
    root = np.linalg.cholesky(covariance + 1e-16 * np.eye(3))
    out = np.zeros((columns.size, columns.size))
    for k in range(3):
        axis = np.eye(3)[k]
        waver = rotate(motion.nRb, root[:, :, k])
        push = rotate(motion.nRb, attachment.force_sigma[:, None] * axis)
        for changed in (
            replace(motion, v_n=motion.v_n + waver),
            replace(motion, omega_eb_b=motion.omega_eb_b + motion.omega_sigma * axis),
            replace(motion, a_n=motion.a_n + push),
            replace(motion, alpha_b=motion.alpha_b + attachment.alpha_sigma[:, None] * axis),
        ):
            change = (jacobian(changed) - base) * weight[:, :, None]
            flat = change.reshape(-1, columns.size)
            out += flat.T @ flat
    return out, columns
