"""Covariance of a fit that has none of its own, and what other methods leave out of theirs."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.baselines.navigation import NavigationMotion
from factorgraph_dvl.baselines.outcome import Estimated
from factorgraph_dvl.baselines.point_sets import Points, derivatives, residuals
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
    weight = point_weights(points)
    H = derivatives(points, found, lever_arm)
    residual, _ = residuals(points, found, lever_arm)
    freedom = max(3 * len(points) - H.shape[2], 1)
    unit = max(float(weight @ np.sum(residual**2, axis=1)) / freedom, 1e-12)
    information = np.einsum("mij,m,mik->jk", H, weight, H, optimize=True) / unit
    sigma = np.maximum(np.concatenate([p.sigma for p in parameters]), 1e-9)
    covariance = np.linalg.inv(information + np.diag(1.0 / sigma**2))
    return Estimated(parameters, values, covariance)


def neglected_by(
    points: Points, motion: NavigationMotion, estimated: Estimated, lever_arm: Array
) -> Array:
    """Return by how much too small standard deviations may be, (n,), as factors.

    The methods take the error of the attitude to compare with as new at every ping. At the other
    end it lasts for the whole trial, e(t) = L(t) x with x of unit variance. With H the
    derivatives of the residuals, R their covariance, J those by e, and P the covariance of the
    method, the variance is then that of P (1 + b bᵀ P), with b = Σ Hᵀ R⁻¹ J L.

    Parameters
    ----------
    points : Points
        The two point sets.
    motion : NavigationMotion
        What the attitudes of body are, at the same pings.
    estimated : Estimated
        Found, with its covariance.
    lever_arm : ndarray, shape (3,), m
        Where it was not estimated.
    """
    dRb = estimated.value("misalignment", np.eye(3))
    scale = 1.0 + estimated.value("scale_error", np.zeros(1))
    H = derivatives(points, estimated, lever_arm)
    size, axes = np.linalg.eigh(motion.covariance[:, 6:9, 6:9])
    L = axes @ (np.sqrt(np.maximum(size, 0.0))[:, :, None] * axes.transpose(0, 2, 1))
    by_attitude = dRb @ motion.nRb.transpose(0, 2, 1) @ skew(motion.velocity)
    JL = scale[:, None] * (by_attitude @ L)
    R = points.covariance_d(dRb, estimated.value("lever_arm", lever_arm))
    b = np.einsum("mip,mij->pj", H, np.linalg.solve(R, JL))
    P = estimated.covariance
    variance = np.diagonal(P)
    more = np.sum((P @ b) ** 2, axis=1)
    return np.sqrt(1.0 + np.divide(more, variance, out=np.zeros_like(more), where=variance > 0.0))
