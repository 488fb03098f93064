"""Adaptive identification of a rotation (Kinsey and Whitcomb 2007).

With y = R u, R constant, the estimate turns towards what it predicts wrongly,

    dR/dt = [k (R u) x y]_x R,

and converges from almost any start where u turns in the body. Here u is the velocity of the body
at the DVL, by SINS/GNSS, and y that of the DVL. There is no scale, no lever arm, no noise and no
covariance in it. The gain k is free. All pings are steps of the same length: a gap between two of
them would else be one long step, which turns too far.

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
    for k in range(len(points)):
        R = exp_so3(gain * np.cross(R @ u[k], points.v_d[k])) @ R
    return Outcome(by_residuals(points, (misalignment,), (R,), lever_arm), 1)
