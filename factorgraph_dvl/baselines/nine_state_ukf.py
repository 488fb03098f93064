"""Unscented Kalman filter of bias, per-axis scale error and misalignment of a DVL.

The nine states and the model of `nine_state`, v_d = (1 + a) Exp(theta) v_ref + beta, for angles
that are too large for a linear filter. Each ping sends the estimate and 18 sigma points, at
sqrt(3) standard deviations about it, through the model (Julier and Uhlmann, Proc. IEEE 92(3),
2004, with n + kappa = 3, alpha = 1, beta = 2). theta is what is left of the rotation so far.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph_dvl.baselines.outcome import Estimated, Outcome, history_rows, prior_of
from factorgraph_dvl.baselines.point_sets import Points
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.sensors.parameters import Parameter

# Squared distance of the sigma points, in standard deviations: that of a normal distribution's
# fourth moment. Measured at 30 deg: an error of 0.3 deg with it, of 4.4 deg with 9 (kappa = 0).
_SPREAD = 3.0
# Chosen: prior standard deviation of an angle up to which sigma points stay within 180 deg.
_WIDEST = 60.0 * DEG


def unscented(
    points: Points,
    parameters: tuple[Parameter, Parameter, Parameter],
    lever_arm: Array,
    findings: Sequence[Finding],
) -> Outcome:
    """Calibrate with the unscented filter, in one pass.

    Parameters
    ----------
    points : Points
        The two point sets.
    parameters : tuple of (Parameter, Parameter, Parameter)
        Misalignment, three scale errors and bias, with their priors.
    lever_arm : ndarray, shape (3,)
        Of the DVL, m, taken as known.
    findings : sequence of Finding
        What is already known.

    Raises
    ------
    ConfigError
        If the misalignment may be anything.
    """
    if parameters[0].sigma.max() > _WIDEST:
        raise ConfigError(
            "the unscented filter needs an approximate misalignment",
            where="trial.yaml dvl.misalignment_std_deg",
            expected=f"at most {_WIDEST / DEG:.0f}",
            hint="Use --method nine-state, which finds misalignments of any size",
        )
    prior = prior_of(parameters)
    D, x, P = prior.values[0], np.concatenate(prior.values[1:]), prior.covariance.copy()
    free = np.flatnonzero(P.diagonal() > 0.0)
    v = points.at_dvl(lever_arm)
    keep = set(history_rows(len(points)).tolist())
    history = []
    for k in range(len(points)):
        root = np.zeros((9, free.size))
        root[free] = np.sqrt(_SPREAD) * np.linalg.cholesky(P[np.ix_(free, free)])
        spread = np.concatenate([root.T, -root.T])
        turned = exp_so3(spread[:, :3]) @ v[k]
        z = (1.0 + x[:3] + spread[:, 3:6]) * (turned @ D.T) + x[3:] + spread[:, 6:]
        middle = (1.0 + x[:3]) * (D @ v[k]) + x[3:]
        mean = middle + (z - middle).sum(axis=0) / (2.0 * _SPREAD)
        # The middle has no weight in covariances (beta = 2), which so stay positive.
        off = z - mean
        R = D @ points.v_b_covariance[k] @ D.T + np.diag(points.sigma_d[k] ** 2)
        S = off.T @ off / (2.0 * _SPREAD) + R
        K = np.linalg.solve(S, off.T @ spread / (2.0 * _SPREAD)).T
        step = K @ (points.v_d[k] - mean)
        P = P - K @ S @ K.T
        P = 0.5 * (P + P.T)
        D, x = D @ exp_so3(step[:3]), x + step[3:]
        if k in keep:
            history.append((float(points.time[k]), Estimated(parameters, (D, x[:3], x[3:]), P)))
    final = Estimated(parameters, (D, x[:3], x[3:]), P)
    return Outcome(final, 1, tuple(history), tuple(findings))
