"""Spurious information: what only the noise of the motion adds.

A straight run does not show a rotation of the DVL about the velocity. Linearised at the
estimated motion it seems to: the estimate has errors, and the Jacobian takes them for
changes of direction. Thousands of pings then add up to a standard deviation of
some degrees where the data say nothing, and the estimate follows the noise (in regression:
errors in variables). The expected share of that error in the information is computed here.

States take up a part of it, as they do of any noise of measurements: almost all where a sensor is
more precise than the motion is known without it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.vectors import Array, IntArray, rotate, skew
from factorgraph_dvl.graph.clocks import linearized, parameters_of
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.imu.propagation import Attachment
from factorgraph_dvl.sensors.protocol import Motion, Observation, ObservationByRows, Values
from factorgraph_dvl.statistics.rows import with_own_covariance
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Measurements that are varied at once. Chosen: some ten megabytes.
_AT_ONCE = 20_000
# Measurements whose covariances and products are found at once. Chosen: some megabytes.
_CHUNK = 4096


def spurious_information(
    problem: Problem,
    evaluation: Evaluation,
    nodes: Array,
    information: SquareRootInformation | None = None,
) -> Array:
    """Return the spurious information by node.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Linearised there.
    nodes : ndarray, shape (K, 9, 9)
        Covariances of the states, in GTSAM's tangent space, where the parameters are exact: an
        error that all states share turns the Jacobians alike, and adds nothing.
    information : SquareRootInformation, optional
        Information on all variables: these take up a part of it. By default none, an upper
        bound.

    Returns
    -------
    ndarray, shape (K, P, P)
        Expected information of the measurements that depend on each node, in the coordinates u
        of a step S u, S `Problem.prior_root`.
    """
    root = problem.prior_root
    out = np.zeros((nodes.shape[0], len(root), len(root)))
    if problem.chain.interpolates:
        # The states are integrated out there, so that no estimate follows their errors.
        return out
    left = {} if information is None else left_of_noise(problem, evaluation, information)
    for observation, attachment, motion, weight in zip(
        problem.observations,
        evaluation.attached,
        evaluation.motions,
        problem.weights,
        strict=True,
    ):
        names = [p.name for p in problem.parameters if p.name in parameters_of(observation)]
        if not names:
            continue
        places = [problem.columns[name] for name in names]
        columns = np.concatenate([np.arange(p.start, p.stop) for p in places])
        for own, some in _parts(observation):
            node = attachment.node[own]
            part = spurious_by(
                some,
                rows_of(attachment.forward, own),
                rows_of(motion, own),
                weight[own],
                nodes,
                evaluation.parameters,
                names,
                problem.clock_zero,
                left[observation.label][own] if left else None,
            )
            np.add.at(out, (node[:, None, None], columns[:, None], columns), part)
    for a in range(0, len(out), _CHUNK):
        out[a : a + _CHUNK] = root.T @ out[a : a + _CHUNK] @ root
    return out


def left_of_noise(
    problem: Problem, evaluation: Evaluation, information: SquareRootInformation
) -> dict[str, Array]:
    """Return what the variables leave of noise of each measurement, (M, d, d) by observation.

    Of whitened noise e of a measurement, independent of others, eᵀ (I - J P Jᵀ) e is left.
    """
    found: dict[str, list[Array]] = {}
    for rows in problem.observation_rows(evaluation):
        (covariance,) = with_own_covariance([(rows.keys, rows.matrix)], information)
        followed = covariance @ rows.matrix.transpose(0, 2, 1)
        found.setdefault(rows.source, []).append(np.eye(followed.shape[1]) - followed)
    return {source: np.concatenate(parts) for source, parts in found.items()}


def _parts(observation: Observation) -> Iterator[tuple[slice | IntArray, Observation]]:
    """Yield measurements some at a time, where an observation can be taken apart."""
    count = observation.time.size
    if count <= _AT_ONCE or not isinstance(observation, ObservationByRows):
        yield slice(None), observation
        return
    for first in range(0, count, _AT_ONCE):
        index = np.arange(first, min(first + _AT_ONCE, count))
        yield index, observation.some(index)


def spurious_by(
    observation: Observation,
    attachment: Attachment,
    motion: Motion,
    weight: Array,
    P: Array,
    values: Values,
    wanted: Sequence[str],
    clock_zero: float,
    left: Array | None = None,
) -> Array:
    """Return the spurious information by measurement, (M, p, p), SI.

    Parameters
    ----------
    observation : Observation
        Observation of M measurements of d components.
    attachment, motion : Attachment or Motion
        Attachment or motion of them.
    weight : ndarray, shape (M, d)
        Inverse standard deviations.
    P : ndarray, shape (K, 9, 9)
        Covariances of the nodes to which they are attached, in GTSAM's tangent space.
    values : Values
        Values of all parameters.
    wanted : sequence of str
        Names of the parameters, of p columns, whose information is asked for.
    clock_zero : float
        Reference time of the clock offsets, s.
    left : ndarray, shape (M, d, d), optional
        What the variables leave of the noise of each, by whitened components; by default all.
    """

    def jacobian(at: Motion) -> Array:
        found = linearized(observation, at, values, wanted, clock_zero).d_parameters
        return np.concatenate([found[name] for name in wanted], axis=2)

    # No residual has derivatives by accelerations: they only move what a clock is late for.
    clock = observation.clock
    by_clock = clock is not None and any(name in wanted for name in clock.names)
    base = jacobian(motion)
    size = base.shape[2]
    parts = [slice(a, a + _CHUNK) for a in range(0, max(attachment.node.size, 1), _CHUNK)]
    root = np.concatenate(
        [_velocity_root(rows_of(motion, part), P[attachment.node[part]]) for part in parts]
    )
    out = np.zeros((attachment.node.size, size, size))
    for k in range(3):
        axis = np.eye(3)[k]
        velocity_error = rotate(motion.nRb, root[:, :, k])
        errors = [
            replace(motion, v_n=motion.v_n + velocity_error),
            replace(motion, omega_eb_b=motion.omega_eb_b + motion.omega_sigma * axis),
        ]
        if by_clock:
            acceleration_error = rotate(motion.nRb, attachment.force_sigma[:, None] * axis)
            alpha_error = attachment.alpha_sigma[:, None] * axis
            errors += [
                replace(motion, a_n=motion.a_n + acceleration_error),
                replace(motion, alpha_b=motion.alpha_b + alpha_error),
            ]
        for changed in errors:
            change = jacobian(changed)
            change -= base
            change *= weight[:, :, None]
            for part in parts:
                own = change[part]
                out[part] += own.transpose(0, 2, 1) @ (own if left is None else left[part] @ own)
    return out


def _velocity_root(motion: Motion, P: Array) -> Array:
    """Return roots (M, 3, 3) of the covariance of the velocity in body axes."""
    v_b = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n)
    by_state = np.concatenate(
        [skew(v_b), np.zeros_like(motion.nRb), np.broadcast_to(np.eye(3), motion.nRb.shape)],
        axis=2,
    )
    covariance = by_state @ P @ by_state.transpose(0, 2, 1)
    return np.linalg.cholesky(covariance + 1e-16 * np.eye(3))
