"""Closed form: rotation by singular value decomposition, with one scale (Li 2015).

The rotation that best takes one point set to the other is Wahba's problem; the scale
follows by projection. Time-independent, without lever arm, bias or recursion: the trial's
own lever arm is taken off in advance.

Umeyama, IEEE Trans. PAMI 13(4), 1991.
"""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.baselines.outcome import Estimated, Outcome, prior_of
from factorgraph_dvl.baselines.point_sets import Points
from factorgraph_dvl.geometry.rotations import best_rotation
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
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
    parameters = (misalignment, scale)
    prior = prior_of(parameters)
    v = points.at_dvl(lever_arm)
    variance = (
        np.mean(points.sigma_d**2, axis=1)
        + np.trace(points.v_b_covariance, axis1=1, axis2=2) / 3.0
    )
    weight = 1.0 / variance
    power = float(weight @ np.sum(v**2, axis=1))
    if power == 0.0:
        return Outcome(prior, 1)
    moments = (points.v_d * weight[:, None]).T @ v
    dRb = best_rotation(moments)
    k = float(np.sum(dRb * moments)) / power
    residual = k * rotate(dRb[None], v) - points.v_d
    H = (
        np.concatenate([-k * dRb @ skew(v), rotate(dRb[None], v)[:, :, None]], axis=2)
        * np.sqrt(weight)[:, None, None]
    )
    dof = max(3 * len(points) - 4, 1)
    unit = max(float(weight @ np.sum(residual**2, axis=1)) / dof, 1e-12)
    information = np.einsum("mij,mik->jk", H, H) / unit
    sigma = np.maximum(np.concatenate([misalignment.sigma, scale.sigma]), 1e-9)
    covariance = np.linalg.inv(information + np.diag(1.0 / sigma**2))
    return Outcome(Estimated(parameters, (dRb, np.array([k - 1.0])), covariance), 1)
