"""Derivatives of measurements by the nodes around them, through the motion in between."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, cross, skew
from factorgraph_dvl.imu.propagation import Transition, attitude_jacobian
from factorgraph_dvl.imu.two_way import TwoWayTransition, shares
from factorgraph_dvl.sensors.protocol import Linearization


def two_way_jacobian(lin: Linearization, transition: TwoWayTransition, *, walking: bool) -> Array:
    """Return the derivative of residuals by the nodes before and after, (M, d, 24 or 30).

    Columns: attitude, position, velocity in GTSAM's tangent space of NavState, then accelerometer
    and gyro bias, then the state at the node after and, of biases that walk, that one's too.
    """
    ahead, behind = shares(lin, transition)
    state, bias = by_node(ahead, transition.forward)
    state_after, bias_after = by_node(behind, transition.backward)
    if walking:
        return np.concatenate([*state, *bias, *state_after, *bias_after], axis=2)
    both = (one + other for one, other in zip(bias, bias_after, strict=True))
    return np.concatenate([*state, *both, *state_after], axis=2)


def by_node(lin: Linearization, transition: Transition) -> tuple[tuple[Array, ...], ...]:
    """Return the derivatives by attitude, position, velocity, and by both biases, (M, d, 3) each.

    Each row of those by the motion times the blocks of `Transition`, without the blocks: far fewer
    products. A row times [x x] is its cross product with x.
    """
    dR, dV, dP = transition.moved
    at, nothing = transition.at, np.zeros((*lin.residual.shape, 3))
    tau = at.tau[:, None, None]
    theta, p, v = nothing, nothing, nothing
    accel: Array | None = None
    gyro: Array | None = None
    by_p, by_v = lin.d_p, lin.d_v
    if by_v is not None:
        # The velocity over ground lacks that of the ground.
        by_ground = by_v @ -skew(transition.earth_rate_n)
        moved = by_ground if by_p is None else by_ground + by_p
        by_v, moved = by_v @ transition.turned, moved @ transition.turned
        theta = -cross(by_v, dV[:, None]) - cross(moved, dP[:, None])
        v = by_v + tau * moved
        accel, gyro = -by_v, 0.5 * by_v
    if by_p is not None:
        moved = by_p @ transition.turned
        p = by_p @ transition.p_p
        if by_v is None:
            theta, v = -cross(moved, dP[:, None]), tau * moved
        of_accel, of_gyro = (-0.5 * tau) * moved, (tau / 6.0) * moved
        accel = of_accel if accel is None else accel + of_accel
        gyro = of_gyro if gyro is None else gyro + of_gyro
    if gyro is not None:
        gyro = cross(gyro, at.dV[:, None])
    d_theta = attitude_jacobian(lin, transition)
    if d_theta is not None:
        turned = d_theta @ np.ascontiguousarray(dR.transpose(0, 2, 1))
        theta = theta + turned
        gyro = -turned if gyro is None else gyro - turned
    by_accel = nothing if accel is None else accel @ at.dA
    by_gyro = nothing if gyro is None else gyro @ at.dA
    return (theta, p, v), (by_accel, by_gyro if lin.d_omega is None else by_gyro - lin.d_omega)
