"""Spurious information: observability that only noise of the SINS/GNSS velocity explains.

The point-set methods take v_b for the regressor as if it were exact. On a straight run its
noise rotates the velocity in the body from ping to ping, which seems to determine even the
angle about the velocity. The mean of this spurious information is known, and is subtracted here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.baselines.outcome import Estimated
from factorgraph_dvl.baselines.point_sets import Points, derivatives
from factorgraph_dvl.estimates import OBSERVABLE
from factorgraph_dvl.geometry.vectors import Array, skew

# Chosen: multiple of the mean that is subtracted; correlated errors add up to more than the mean.
_MARGIN = 5.0


def without_spurious_information(
    points: Points, estimated: Estimated, lever_arm: Array
) -> Estimated:
    """Return the estimate, with a wider covariance where its information is spurious.

    Unchanged where every observable component stays so without the spurious information.

    Parameters
    ----------
    points, estimated : Points or Estimated
        The pings and the calibration.
    lever_arm : ndarray
        Lever arm of the DVL where the calibration has none, m.
    """
    if len(points) == 0:
        return estimated
    dRb = estimated.value("misalignment", np.eye(3))
    scale = 1.0 + estimated.value("scale_error", np.zeros(1))
    arm = estimated.value("lever_arm", lever_arm)
    M = np.broadcast_to(scale, 3)[:, None] * dRb
    P = points.v_b_covariance
    S = points.omega_sigma[:, :, None] ** 2 * np.eye(3)
    weight = np.linalg.inv(points.covariance_d(dRb, arm))
    inner = M.T @ weight @ M

    noises: list[Array] = []
    for p in estimated.parameters:
        n = p.mean.size
        if p.stem == "misalignment":
            noises.append(_crossed(P, inner))
        elif p.stem == "scale_error":
            power = np.sum(weight * (dRb @ P @ dRb.T), axis=0)
            noises.append(power.sum().reshape(1, 1) if n == 1 else power)
        elif p.stem == "lever_arm":
            noises.append(_crossed(S, inner))
        else:
            noises.append(np.zeros((n, n)))
    H = derivatives(points, estimated, lever_arm)
    information = np.sum(H.transpose(0, 2, 1) @ weight @ H, axis=0)
    noise, at = np.zeros_like(information), 0
    for block in noises:
        noise[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return widened(estimated, information, noise)


def widened(estimated: Estimated, information: Array, noise: Array) -> Estimated:
    """Return the estimate with a wider covariance, where its information is spurious.

    Parameters
    ----------
    estimated : Estimated
        N components.
    information : ndarray, shape (n, n)
        Information of the data, with the spurious part.
    noise : ndarray, shape (n, n)
        Mean of the spurious part.
    """
    sigma = np.concatenate([p.sigma for p in estimated.parameters])
    seeming = _posterior(information, sigma)
    supported = _posterior(information - _MARGIN * noise, sigma)
    before = np.sqrt(np.diag(seeming)) <= OBSERVABLE * sigma
    after = np.sqrt(np.diag(supported)) <= OBSERVABLE * sigma
    if np.all(after[before]):
        return estimated
    values, vectors = np.linalg.eigh(supported - seeming)
    extra = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return replace(estimated, covariance=estimated.covariance + extra)


def _crossed(P: Array, weight: Array) -> Array:
    """Return the sum of the means of [e x]' W [e x], (3, 3), for errors e of covariance P."""
    cross = skew(np.eye(3))
    out = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            out += cross[i].T @ np.einsum("m,mij->ij", P[:, i, j], weight) @ cross[j]
    return out


def _posterior(information: Array, sigma: Array) -> Array:
    """Return the covariance from information, (P, P), and priors; no information below zero."""
    size, vectors = np.linalg.eigh(information * np.outer(sigma, sigma))
    scaled = (vectors / (np.maximum(size, 0.0) + 1.0)) @ vectors.T
    return scaled * np.outer(sigma, sigma)
