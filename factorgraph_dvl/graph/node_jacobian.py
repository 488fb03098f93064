"""Derivatives of measurements by the nodes around them, through the motion in between."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.keys import BIAS_SIZE, STATE_SIZE
from factorgraph_dvl.imu.propagation import Transition, attitude_jacobian
from factorgraph_dvl.imu.two_way import TwoWayTransition
from factorgraph_dvl.sensors.protocol import Linearization


def two_way_jacobian(lin: Linearization, transition: TwoWayTransition, *, walking: bool) -> Array:
    """Return the derivative of residuals by the nodes before and after, (M, d, 24 or 30).

    Columns: state and bias as of `node_jacobian`, then the state at the node after and, of biases
    that walk, that one's too.
    """
    share = transition.at.share[:, None, None]
    before = (1.0 - share) * node_jacobian(lin, transition.forward)
    after = share * node_jacobian(lin, transition.backward)
    if walking:
        return np.concatenate([before, after], axis=2)
    before[:, :, STATE_SIZE:] += after[:, :, STATE_SIZE:]
    return np.concatenate([before, after[:, :, :STATE_SIZE]], axis=2)


def node_jacobian(lin: Linearization, transition: Transition) -> Array:
    """Return the derivative of residuals with respect to node and bias, (M, d, 15).

    Columns: attitude, position, velocity in GTSAM's tangent space of NavState, then
    accelerometer and gyro bias.

    Parameters
    ----------
    lin : Linearization
        Derivatives with respect to the motion at the M times.
    transition : Transition
        From the nodes to these times.
    """
    products: list[list[tuple[Array, Array]]] = [[] for _ in range(5)]
    theta, p, v, accel, gyro = products
    d_theta = attitude_jacobian(lin, transition)
    if d_theta is not None:
        theta.append((d_theta, transition.theta_theta))
        gyro.append((d_theta, transition.theta_gyro))
    if lin.d_p is not None:
        theta.append((lin.d_p, transition.p_theta))
        p.append((lin.d_p, transition.p_p))
        v.append((lin.d_p, transition.p_v))
        accel.append((lin.d_p, transition.p_accel))
        gyro.append((lin.d_p, transition.p_gyro))
    if lin.d_v is not None:
        theta.append((lin.d_v, transition.v_theta))
        v.append((lin.d_v, transition.v_v))
        accel.append((lin.d_v, transition.v_accel))
        gyro.append((lin.d_v, transition.v_gyro))
    out = np.zeros((*lin.residual.shape, STATE_SIZE + BIAS_SIZE))
    for i, of_block in enumerate(products):
        block = out[:, :, 3 * i : 3 * i + 3]
        # In place, the first product takes a third of the time.
        for left, right in of_block[:1]:
            np.matmul(left, right, out=block)
        for left, right in of_block[1:]:
            block += left @ right
    if lin.d_omega is not None:
        out[:, :, -3:] -= lin.d_omega
    return out
