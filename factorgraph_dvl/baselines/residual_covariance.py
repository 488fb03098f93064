"""Covariance of a fit that has none of its own: from the scatter of its residuals."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.baselines.outcome import Estimated
from factorgraph_dvl.baselines.point_sets import Points
from factorgraph_dvl.geometry.vectors import Array, skew
from factorgraph_dvl.sensors.parameters import Parameter


def point_weights(points: Points) -> Array:
    """Return the weight of each ping, (M,): one variance for its three axes."""
    of_reference = np.trace(points.v_b_covariance, axis1=1, axis2=2)
    return 1.0 / (np.mean(points.sigma_d**2, axis=1) + of_reference / 3.0)


def by_residuals(
    points: Points, parameters: tuple[Parameter, ...], values: tuple[Array, ...], lever_arm: Array
) -> Estimated:
    """Return values of a fit of v_d = (1 + k) R (v_b + omega x l), with their covariance.

    The information is that of the pings, scaled by the mean square of the residuals. Along what
    they leave open it keeps the prior's.

    Parameters
    ----------
    points : Points
        The two point sets.
    parameters : tuple of Parameter
        Misalignment, and of scale error and lever arm what was fitted.
    values : tuple of ndarray
        Found.
    lever_arm : ndarray, shape (3,), m
        Where it was not fitted.
    """
    found = Estimated(parameters, values, np.zeros((0, 0)))
    dRb = found.value("misalignment", np.eye(3))
    k = 1.0 + float(found.value("scale_error", np.zeros(1))[0])
    at_dvl = points.at_dvl(found.value("lever_arm", lever_arm))
    weight = point_weights(points)
    columns = {
        "misalignment": -k * dRb @ skew(at_dvl),
        "scale_error": (at_dvl @ dRb.T)[:, :, None],
        "lever_arm": k * dRb @ skew(points.omega_b),
    }
    H = np.concatenate([columns[p.stem] for p in parameters], axis=2)
    residual = k * at_dvl @ dRb.T - points.v_d
    freedom = max(3 * len(points) - H.shape[2], 1)
    unit = max(float(weight @ np.sum(residual**2, axis=1)) / freedom, 1e-12)
    information = np.einsum("mij,m,mik->jk", H, weight, H, optimize=True) / unit
    sigma = np.maximum(np.concatenate([p.sigma for p in parameters]), 1e-9)
    covariance = np.linalg.inv(information + np.diag(1.0 / sigma**2))
    return Estimated(parameters, values, covariance)
