"""Closed form: rotation by singular value decomposition, with one scale (Li 2015).

The rotation that best takes one point set to the other is Wahba's problem; the scale
follows by projection. Time-independent, without lever arm, bias or recursion: the trial's
own lever arm is taken off in advance.

Umeyama, IEEE Trans. PAMI 13(4), 1991.
"""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.baselines.outcome import Outcome, prior_of
from factorgraph_dvl.baselines.point_sets import Points
from factorgraph_dvl.baselines.residual_covariance import by_residuals, point_weights
from factorgraph_dvl.geometry.rotations import best_rotation
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.parameters import Parameter


def wahba(points: Points, misalignment: Parameter, scale: Parameter, lever_arm: Array) -> Outcome:
    """Calibrate in closed form; the covariance comes from the residuals.

    The closed form knows no prior. Only the covariance does: along what the velocities
    leave open, as the angle about their common direction, it keeps the prior's.

    Parameters
    ----------
    points : Points
        The two point sets.
    misalignment, scale : Parameter
        Misalignment and scale with their priors.
    lever_arm : ndarray, shape (3,)
        Lever arm of the DVL, m, taken as known.
    """
    v, weight = points.at_dvl(lever_arm), point_weights(points)
    power = float(weight @ np.sum(v**2, axis=1))
    if power == 0.0:
        return Outcome(prior_of((misalignment, scale)), 1)
    moments = (points.v_d * weight[:, None]).T @ v
    dRb = best_rotation(moments)
    k = float(np.sum(dRb * moments)) / power
    values = (dRb, np.array([k - 1.0]))
    return Outcome(by_residuals(points, (misalignment, scale), values, lever_arm), 1)
