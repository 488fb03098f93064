"""Information that only the noise of the motion feigns.

A straight run does not show a rotation of the DVL about the velocity. Linearised at the
estimated motion it seems to: the estimate wavers by its error, and the Jacobian takes
that for changes of direction. Thousands of pings then add up to a standard deviation of
some degrees where nothing is known, and the estimate follows the noise (in regression:
errors in variables). The expected share of that error in the information is computed
here; where it is most of it, the direction is not observable, and the prior is held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import eigh

from factorgraph_dvl.conventions import Array, rotate, skew
from factorgraph_dvl.graph import Evaluation, Problem
from factorgraph_dvl.preintegration import Attachment
from factorgraph_dvl.sensors.protocol import Motion, Observation, Values
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
    (P, h) orthonormal, in units of the priors' standard deviations; h may be 0.
    """
    if not problem.parameters:
        return np.zeros((0, 0))
    functionals = [{problem.key(p.name): np.eye(p.mean.size)} for p in problem.parameters]
    P = covariances.information.covariance_of(functionals)
    feigned = feigned_information(problem, minimum.evaluation, covariances.nodes)
    return feigned_among(P, feigned, problem.prior_sigma)


def feigned_among(P: Array, feigned: Array, prior_sigma: Array) -> Array:
    """Return directions that are not observable, as `feigned_directions` does.

    Parameters
    ----------
    P : (P, P) covariance of the parameters, SI.
    feigned : (P, P) information that the motion's error adds, SI.
    prior_sigma : (P,) SI.
    """
    size = prior_sigma.size
    scaled = np.outer(prior_sigma, prior_sigma)
    data = np.linalg.inv(P / scaled) - np.eye(size)
    data = 0.5 * (data + data.T)
    feigned = feigned * scaled
    share = eigh(feigned, _positive(data) + _LITTLE * np.eye(size), eigvals_only=True)
    if share.max() < _FEIGNED:
        return np.zeros((size, 0))
    genuine, directions = np.linalg.eigh(data - feigned)
    return np.asarray(directions[:, genuine < _GENUINE])


def feigned_information(problem: Problem, evaluation: Evaluation, nodes: Array) -> Array:
    """Return the information, (P, P), SI, that the error of the motion is expected to add.

    Parameters
    ----------
    problem, evaluation : of what was minimised.
    nodes : (K, 9, 9) covariances of the states, in GTSAM's tangent space.
    """
    size = problem.prior_sigma.size
    feigned = np.zeros((size, size))
    for observation, attachment, motion, weight in zip(
        problem.observations,
        problem.attachments,
        evaluation.motions,
        problem.weights,
        strict=True,
    ):
        names = [p.name for p in problem.parameters if p.name in observation.parameters]
        if names:
            columns = np.concatenate([_range(problem.columns[name]) for name in names])
            feigned[np.ix_(columns, columns)] += feigned_by(
                observation,
                attachment,
                motion,
                weight,
                nodes[attachment.node],
                evaluation.parameters,
                names,
            )
    return feigned


def _range(place: slice) -> np.ndarray:
    return np.arange(place.start, place.stop)


def _positive(matrix: Array) -> Array:
    """Return a symmetric matrix without its negative eigenvalues."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def at_prior_along(
    problem: Problem, parameters: dict[str, Array], directions: Array
) -> dict[str, Array]:
    """Return parameters with the prior's value along directions (P, h)."""
    prior = problem.prior_values()
    scale = problem.prior_sigma
    for _ in range(10):
        away = problem.difference(parameters, prior) / scale
        step = -directions @ (directions.T @ away)
        parameters = problem.moved(parameters, scale * step)
    return parameters


def feigned_by(
    observation: Observation,
    attachment: Attachment,
    motion: Motion,
    weight: Array,
    P: Array,
    values: Values,
    wanted: Sequence[str],
) -> Array:
    """Return the expectation of the information that the motion's error adds, SI.

    Parameters
    ----------
    observation : of M measurements of d components.
    attachment, motion : of them.
    weight : (M, d) inverse standard deviations.
    P : (M, 9, 9) covariances of the nodes before them, in GTSAM's tangent space.
    values : of all parameters.
    wanted : names of the parameters whose information is asked for.
    """

    def jacobian(at: Motion) -> Array:
        found = observation.linearize(at, values, wanted).d_parameters
        return np.concatenate([found[name] for name in wanted], axis=2)

    base = jacobian(motion)
    size = base.shape[2]
    v_b = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n)
    by_state = np.concatenate(
        [skew(v_b), np.zeros_like(motion.nRb), np.broadcast_to(np.eye(3), motion.nRb.shape)],
        axis=2,
    )
    covariance = by_state @ P @ by_state.transpose(0, 2, 1)
    root = np.linalg.cholesky(covariance + 1e-16 * np.eye(3))
    out = np.zeros((size, size))
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
            flat = change.reshape(-1, size)
            out += flat.T @ flat
    return out
