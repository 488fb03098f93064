"""The calibration at one moment, in the parametrisation in which it is reported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.keys import BIAS_SIZE
from factorgraph_dvl.graph.priors import local_coordinates, prior_mean, prior_root
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solution import Estimate
from factorgraph_dvl.solvers.reported import estimates_of, in_order, in_unit


@dataclass(frozen=True)
class CalibrationEstimate:
    """The calibration at one moment.

    Parameters
    ----------
    estimates : tuple of Estimate
        Estimates as in a solution.
    covariance : ndarray, shape (P, P)
        Joint covariance of all their components, in reported units.
    """

    estimates: tuple[Estimate, ...]
    covariance: Array


def calibration_of(
    parameters: Sequence[Parameter],
    values: Mapping[str, Array],
    biases: tuple[tuple[Parameter, Array], tuple[Parameter, Array]],
    P: Array,
    undetermined: Array,
) -> CalibrationEstimate:
    """Return the calibration as reported.

    Parameters
    ----------
    parameters : sequence of Parameter
        All parameters, those that are not estimated included.
    values : mapping of str to ndarray
        Their values, SI; rotations as matrices.
    biases : tuple of (tuple of (Parameter, ndarray), tuple of (Parameter, ndarray))
        Parameter and value of the gyro bias, and of the accelerometer bias.
    P : ndarray, shape (6 + n, 6 + n)
        Joint covariance of accelerometer bias, gyro bias and the estimated parameters, in GTSAM's
        tangent space, SI.
    undetermined : ndarray, shape (n, h)
        Directions that are not observable, as `undetermined_directions` returns them: the prior is
        reported there.

    Returns
    -------
    CalibrationEstimate
        Estimates and joint covariance in reported units.
    """
    free = [p for p in parameters if p.estimated]
    (gyro, gyro_bias), (accel, accel_bias) = biases
    if undetermined.size:
        values, P = _at_prior(free, values, P, undetermined)
    rows = in_order(
        [
            in_unit(gyro, gyro_bias),
            in_unit(accel, accel_bias),
            *(in_unit(p, values[p.name]) for p in parameters),
        ],
        lambda r: r.parameter,
    )
    start = {accel.name: 0, gyro.name: 3}
    at = BIAS_SIZE
    for p in free:
        start[p.name] = at
        at += p.mean.size
    estimated = [r for r in rows if r.parameter.estimated]
    total = sum(r.value.size for r in estimated)
    T = np.zeros((total, P.shape[0]))
    at = 0
    for r in estimated:
        n, column = r.value.size, start[r.parameter.name]
        T[at : at + n, column : column + n] = r.derivative
        at += n
    return CalibrationEstimate(*estimates_of([(r.parameter, r.value) for r in rows], T @ P @ T.T))


def _at_prior(
    free: Sequence[Parameter], values: Mapping[str, Array], P: Array, fixed: Array
) -> tuple[dict[str, Array], Array]:
    """Return values and covariance with some directions fixed at the prior's mean.

    Along them the covariance is the prior's. Fixing a direction must not make the biases better
    known, so theirs stays as it is.
    """
    root = prior_root(free)
    A = np.zeros((fixed.shape[1], P.shape[0]))
    A[:, BIAS_SIZE:] = fixed.T @ np.linalg.inv(root)
    off = np.concatenate([local_coordinates(p, values[p.name], prior_mean(p)) for p in free])
    gain = np.linalg.solve(A @ P @ A.T, A @ P).T
    step = -gain @ (A[:, BIAS_SIZE:] @ off)
    given = P - gain @ A @ P
    given[BIAS_SIZE:, BIAS_SIZE:] += root @ fixed @ fixed.T @ root.T
    given[:BIAS_SIZE, :BIAS_SIZE] = P[:BIAS_SIZE, :BIAS_SIZE]
    out = dict(values)
    at = BIAS_SIZE
    for p in free:
        part = step[at : at + p.mean.size]
        at += p.mean.size
        out[p.name] = out[p.name] @ exp_so3(part) if p.rotation else out[p.name] + part
    return out, given
