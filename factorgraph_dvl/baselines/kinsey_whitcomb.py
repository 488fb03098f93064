"""Adaptive identification of a rotation (Kinsey and Whitcomb 2007).

With y = R u, R constant, the estimate turns towards what it predicts wrongly,

    dR/dt = [k (R u) x y]_x R,

and converges from almost any start where u turns in the body. Here u is the velocity of the body
at the DVL, by SINS/GNSS, and y that of the DVL. There is no scale, no lever arm, no noise and no
covariance in it. The gain k is free. Over a ping u and y are constant, and the equation is solved
exactly: the angle e between R u and y follows tan(e / 2) ~ exp(-k |u| |y| t). All pings are steps
of the same length t: a gap between two of them says no more than a ping.

J. C. Kinsey and L. L. Whitcomb, Adaptive identification on the group of rigid-body rotations and
its application to underwater vehicle navigation, IEEE Trans. Robotics 23(1), 124-136, 2007.
"""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.baselines.outcome import Outcome
from factorgraph_dvl.baselines.point_sets import Points
from factorgraph_dvl.baselines.residual_covariance import by_residuals
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.parameters import Parameter

# Chosen: share of the error across a mean velocity that a ping takes off; the publication leaves
# the gain free. The angle about the bow converges through what little velocity is across it: with
# a tenth of this gain 1 deg of 2 deg are left after 450 s, with ten times it nothing settles.
_PER_PING = 0.1


def kinsey_whitcomb(points: Points, misalignment: Parameter, lever_arm: Array) -> Outcome:
    """Identify the rotation between body and DVL, ping by ping.

    Parameters
    ----------
    points : Points
        The two point sets.
    misalignment : Parameter
        Misalignment with its prior: the mean is the start.
    lever_arm : ndarray, shape (3,), m
        Lever arm of the DVL, taken as known.
    """
    R, u = exp_so3(misalignment.mean), points.at_dvl(lever_arm)
    power = float(np.sum(u**2))
    gain = _PER_PING * len(points) / power if power > 0.0 else 0.0
    for u_k, y in zip(u, points.v_d, strict=True):
        R = exp_so3(_turn(R @ u_k, y, gain)) @ R
    return Outcome(by_residuals(points, (misalignment,), (R,), lever_arm), 1)


def _turn(a: Array, b: Array, gain: float) -> Array:
    """Return how far a vector turns towards another by da/dt = gain (a x b) x a, t = 1."""
    axis = np.cross(a, b)
    sine, product = float(np.linalg.norm(axis)), float(np.linalg.norm(a) * np.linalg.norm(b))
    if sine == 0.0:
        return axis
    both = product + float(a @ b)
    left = np.arctan2(np.exp(-gain * product) * sine, both)
    return 2.0 * (np.arctan2(sine, both) - left) / sine * axis
