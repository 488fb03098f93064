"""What is known at one moment, in the parametrisation in which it is reported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, rph_from_rotation, rph_jacobian
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.graph.priors import local_coordinates, prior_mean, prior_root
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solution import Estimate, Trajectory
from factorgraph_dvl.solvers.reported import estimates_of, in_order, in_unit

_STATE = 9
_BIAS = 6


@dataclass(frozen=True)
class CalibrationEstimate:
    """The calibration at one moment.

    Parameters
    ----------
    estimates : tuple of Estimate
        As in a solution.
    covariance : ndarray, shape (P, P)
        Joint covariance of all their components, in reported units.
    """

    estimates: tuple[Estimate, ...]
    covariance: Array


@dataclass(frozen=True)
class Innovations:
    """What was measured against what was predicted.

    Parameters
    ----------
    label, unit, components : str or tuple of str
        Of the kind.
    time : ndarray, shape (M,), s
    residual, sigma : ndarray, shape (M, d)
        Predicted - measured, and its standard deviation.
    used : ndarray, shape (M,)
        Bool.
    """

    label: str
    unit: str
    components: tuple[str, ...]
    time: Array
    residual: Array
    sigma: Array
    used: np.ndarray


@dataclass(frozen=True)
class Update:
    """What is known after one more segment.

    Parameters
    ----------
    time : float
        Of the newest state, s.
    latency : float
        Time that the update took, s.
    state : Trajectory
        The newest state, as a trajectory of one epoch.
    trajectory : Trajectory
        At the epochs of a batch solution since the update before.
    calibration : CalibrationEstimate
        With its joint covariance.
    smoothed : Trajectory or None
        Epochs that more data have made better, None if there are none this time.
    innovations : tuple of Innovations
        What was measured against what was predicted.
    messages : tuple of str
        For the user.
    solved : bool
        Whether the update includes a solution of all that was collected.
    doubted : tuple of str
        Kinds of measurements that disagree with the prediction, so that the standard deviations
        are not to be trusted.
    """

    time: float
    latency: float
    state: Trajectory
    trajectory: Trajectory
    calibration: CalibrationEstimate
    smoothed: Trajectory | None
    innovations: tuple[Innovations, ...]
    messages: tuple[str, ...]
    solved: bool
    doubted: tuple[str, ...]


def concatenated(parts: Sequence[Trajectory]) -> Trajectory:
    """Return trajectories one after another."""
    return Trajectory(
        *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Trajectory))
    )


def trajectory_of(
    time: Array, states: States, P: Array, frame: LocalFrame, body_axes: BodyAxes
) -> Trajectory:
    """Return states with their covariances (K, 9, 9), in GTSAM's tangent space, as reported."""
    lat, lon, height = frame.geodetic(states.p_n)
    lRn = frame.level_from_tangent(lat, lon)
    lRb = lRn @ states.nRb
    rph = rph_from_rotation(lRb, body_axes)

    def level(i: int) -> Array:
        return lRb @ P[:, i : i + 3, i : i + 3] @ lRb.transpose(0, 2, 1)

    to_rph = rph_jacobian(rph, body_axes)
    return Trajectory(
        time=time,
        geodetic=np.stack([lat, lon, height], axis=1),
        velocity=rotate(lRn, states.v_n),
        rph=rph,
        position_cov=level(3),
        velocity_cov=level(6),
        rph_cov=to_rph @ P[:, :3, :3] @ to_rph.transpose(0, 2, 1),
    )


def calibration_of(
    parameters: Sequence[Parameter],
    values: Mapping[str, Array],
    biases: tuple[tuple[Parameter, Array], tuple[Parameter, Array]],
    P: Array,
    held: Array,
) -> CalibrationEstimate:
    """Return the calibration as reported.

    Parameters
    ----------
    parameters : sequence of Parameter
        All, those that are not estimated included.
    values : mapping of str to ndarray
        Of them; rotations as matrices.
    biases : tuple of (tuple of (Parameter, ndarray), tuple of (Parameter, ndarray))
        Parameters and values of gyro and accelerometer.
    P : ndarray, shape (6 + n, 6 + n)
        Joint covariance of accelerometer bias, gyro bias and the parameters that are estimated, in
        GTSAM's tangent space, SI.
    held : ndarray, shape (n, h)
        Directions that are not observable, as `feigned_directions` returns them: the prior is
        reported there.
    """
    free = [p for p in parameters if p.estimated]
    (gyro, gyro_bias), (accel, accel_bias) = biases
    if held.size:
        values, P = _at_prior(free, values, P, held)
    rows = in_order(
        [
            in_unit(gyro, gyro_bias),
            in_unit(accel, accel_bias),
            *(in_unit(p, values[p.name]) for p in parameters),
        ],
        lambda r: r.parameter,
    )
    start = {accel.name: 0, gyro.name: 3}
    at = _BIAS
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
    free: Sequence[Parameter], values: Mapping[str, Array], P: Array, held: Array
) -> tuple[dict[str, Array], Array]:
    """Return values and covariance given that the prior holds along some directions.

    That a direction is held makes the biases no better known.
    """
    root = prior_root(free)
    A = np.zeros((held.shape[1], P.shape[0]))
    A[:, _BIAS:] = held.T @ np.linalg.inv(root)
    off = np.concatenate([local_coordinates(p, values[p.name], prior_mean(p)) for p in free])
    gain = np.linalg.solve(A @ P @ A.T, A @ P).T
    step = -gain @ (A[:, _BIAS:] @ off)
    given = P - gain @ A @ P
    given[_BIAS:, _BIAS:] += root @ held @ held.T @ root.T
    given[:_BIAS, :_BIAS] = P[:_BIAS, :_BIAS]
    out = dict(values)
    at = _BIAS
    for p in free:
        part = step[at : at + p.mean.size]
        at += p.mean.size
        out[p.name] = out[p.name] @ exp_so3(part) if p.rotation else out[p.name] + part
    return out, given
