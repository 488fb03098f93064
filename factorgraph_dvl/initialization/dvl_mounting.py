"""Misalignment, scale, lever arm and bias of a DVL, to start the solver from.

The pings obey v_d = M v_b + N omega + beta, linear in the unknown matrices. Their
misfit depends on the data only through the moments of (v_b, omega, 1) and v_d: once
these are summed up, a start costs nothing, so many can be tried. That matters because a
misalignment that is 180 degrees off is a local minimum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factorgraph_dvl.geometry.rotations import (
    best_rotation,
    exp_so3,
    inverse_right_jacobian,
    log_so3,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.sensors.dvl import (
    BIAS,
    LEVER_ARM,
    MISALIGNMENT,
    SCALE_ERROR,
    TIME_OFFSET,
    Dvl,
)
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Motion

# Error of the velocity that comes from IMU and GNSS, m/s. Chosen: a good receiver's, smoothed.
_VELOCITY_ERROR = 0.03
# Least scale of a DVL, and steps of a descent. Chosen: far off what instruments do and need.
_LEAST_SCALE = 0.2
_STEPS = 30
# Rotation, rad, from which on two minima are two. Chosen: less than half of what divides starts.
_APART = 20.0 * DEG
# Pings that are summed up at most. Chosen: far more than the unknowns ask for.
_MAX_PINGS = 4000
# Steps of the search for the time offset, and its reach, s. Chosen: a fraction of the period of
# a vessel's roll, then finer.
_OFFSET_STEP = 0.04
_OFFSET_FINE = 0.005
_OFFSET_REACH = 1.0


@dataclass(frozen=True)
class _Moments:
    """Weighted sums over pings of x xᵀ, x yᵀ, yᵀy with x = (v_b, omega, 1), y = v_d.

    `share` of the pings were summed up, those that the IMU covers.
    """

    xx: Array
    xy: Array
    yy: float
    share: float


@dataclass(frozen=True)
class _Mounting:
    dRb: Array
    scale: Array
    lever_arm: Array
    bias: Array


MotionAt = Callable[[Array], tuple[Motion, NDArray[np.bool_]]]


def initial_mountings(dvl: Dvl, motion_at: MotionAt) -> list[dict[str, Array]]:
    """Return values of the DVL's parameters to start from, rotations as matrices.

    The best first, then those of other local minima of the misfit.

    Parameters
    ----------
    dvl : Dvl
        Its record and its priors.
    motion_at : callable
        Returns the motion at times (M,), s, and at which of them it is known.
    """
    priors = {p.name: p for p in dvl.parameters()}
    values = {p.name: exp_so3(p.mean) if p.rotation else p.mean for p in priors.values()}
    pings = np.flatnonzero(dvl.locked)
    if pings.size == 0:
        return [values]
    pings = pings[:: max(pings.size // _MAX_PINGS, 1)]
    sigma = np.hypot(dvl.sigma()[pings], _VELOCITY_ERROR)

    def moments(offset: float) -> _Moments:
        motion, covered = motion_at(dvl.time[pings] - offset)
        v_b = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n)
        x = np.hstack([v_b, motion.omega_eb_b, np.ones((pings.size, 1))])
        weight = covered / (sigma**2).mean(axis=1)
        y = dvl.velocity[pings]
        xw = x * weight[:, None]
        share = float(np.mean(covered))
        return _Moments(xw.T @ x, xw.T @ y, float(weight @ (y**2).sum(axis=1)), share)

    offset_prior = priors[TIME_OFFSET]
    offset = float(offset_prior.mean[0])
    if offset_prior.estimated:
        reach = min(4.0 * float(offset_prior.sigma[0]), _OFFSET_REACH)
        for step in (_OFFSET_STEP, _OFFSET_FINE):
            count = int(np.ceil(reach / step))
            grid = offset + np.arange(-count, count + 1) * step
            prior_cost = 0.5 * ((grid - offset_prior.mean) / offset_prior.sigma) ** 2
            misfit = [_linear_misfit(moments(t)) for t in grid]
            offset = float(grid[np.argmin(misfit + prior_cost)])
            reach = 2.0 * step
        values[TIME_OFFSET] = np.array([offset])
    found = moments(offset)
    if found.share == 0.0:
        return [values]
    return [
        values
        | {
            MISALIGNMENT: each.dRb,
            SCALE_ERROR: each.scale - 1.0,
            LEVER_ARM: each.lever_arm,
            BIAS: each.bias,
        }
        for each in _minima(found, priors)
    ]


def _linear_misfit(moments: _Moments) -> float:
    """Return the misfit of v_d = M v_b + N omega + beta with the best free M, N, beta.

    As if all pings had been covered: an offset is no better for losing some.
    """
    if moments.share == 0.0:
        return np.inf
    theta = _least_squares(moments)
    return (moments.yy - float(np.sum(theta.T * moments.xy))) / moments.share


def _least_squares(moments: _Moments) -> Array:
    """Return [M N beta], (3, 7)."""
    ridge = np.diag(1e-9 * np.trace(moments.xx) * np.ones(7))
    return np.asarray(np.linalg.solve(moments.xx + ridge, moments.xy).T, dtype=float)


def _minima(moments: _Moments, priors: dict[str, Parameter]) -> list[_Mounting]:
    """Return the mountings that many starts lead to, the best first."""
    prior = _Mounting(
        exp_so3(priors[MISALIGNMENT].mean),
        1.0 + priors[SCALE_ERROR].mean,
        priors[LEVER_ARM].mean,
        priors[BIAS].mean,
    )
    starts = [prior, *_closed_form(moments, prior)]
    if priors[MISALIGNMENT].sigma.max() > 0.3:
        starts += [
            _Mounting(R, prior.scale, prior.lever_arm, prior.bias)
            for R in Rotation.create_group("O").as_matrix()
        ]
    out: list[_Mounting] = []
    for _, found in sorted((_descend(moments, s, priors) for s in starts), key=lambda r: r[0]):
        if all(np.linalg.norm(log_so3(found.dRb.T @ o.dRb)) > _APART for o in out):
            out.append(found)
    return out


def _closed_form(moments: _Moments, prior: _Mounting) -> list[_Mounting]:
    """Return the mounting from linear least squares of M and N, if M is a rotation's multiple.

    Wahba's solution alone would take the lever arm's share for a misalignment.
    """
    theta = _least_squares(moments)
    M, N = theta[:, :3], theta[:, 3:6]
    s = np.linalg.svd(M, compute_uv=False)
    if s[2] < _LEAST_SCALE or np.linalg.det(M) < 0:
        return []
    cross = -np.linalg.solve(M, N)
    lever_arm = 0.5 * np.array(
        [cross[2, 1] - cross[1, 2], cross[0, 2] - cross[2, 0], cross[1, 0] - cross[0, 1]]
    )
    scale = np.full_like(prior.scale, s.mean())
    return [_Mounting(best_rotation(M), scale, lever_arm, prior.bias)]


def _descend(
    moments: _Moments, start: _Mounting, priors: dict[str, Parameter]
) -> tuple[float, _Mounting]:
    """Return cost and mounting after Gauss-Newton on the moments, with the priors."""
    now, cost = start, _cost(moments, start, priors)
    damping = 0.0
    for _ in range(_STEPS):
        J = _derivative(now)
        theta = _theta(now)
        gradient = J.T @ (theta @ moments.xx - moments.xy.T).ravel()
        H = np.einsum("aip,ij,ajq->pq", J.reshape(3, 7, -1), moments.xx, J.reshape(3, 7, -1))
        prior_gradient, prior_information = _prior_terms(now, priors)
        H = H + prior_information
        H = H + damping * np.diag(np.diag(H))
        step = -np.linalg.solve(H, gradient + prior_gradient)
        n = now.scale.size
        new = _Mounting(
            now.dRb @ exp_so3(step[:3]),
            now.scale + step[3 : 3 + n],
            now.lever_arm + step[3 + n : 6 + n],
            now.bias + step[6 + n :],
        )
        new_cost = _cost(moments, new, priors)
        if new.scale.min() > _LEAST_SCALE and new_cost <= cost:
            done = cost - new_cost < 1e-3
            now, cost = new, new_cost
            damping = damping / 10.0 if damping > 1e-3 else 0.0
            if done:
                break
        else:
            damping = max(10.0 * damping, 1e-2)
            if damping > 1e6:
                break
    return cost, now


def _theta(m: _Mounting) -> Array:
    """Return [M N beta], (3, 7)."""
    M = m.scale[:, None] * m.dRb
    return np.hstack([M, -M @ skew(m.lever_arm), m.bias[:, None]])


def _derivative(m: _Mounting) -> Array:
    """Return d vec(theta), (21, 9 + n), with respect to rotation, scale, lever arm, bias."""
    columns = []
    eye = np.eye(3)
    scale = np.broadcast_to(m.scale, (3,))[:, None]
    M = scale * m.dRb
    cross = skew(m.lever_arm)
    zero = np.zeros((3, 1))
    for i in range(3):
        turned = M @ skew(eye[i])
        columns.append(np.hstack([turned, -turned @ cross, zero]))
    for i in range(m.scale.size):
        rows = np.ones((3, 1)) if m.scale.size == 1 else eye[:, i : i + 1]
        grown = rows * m.dRb
        columns.append(np.hstack([grown, -grown @ cross, zero]))
    for i in range(3):
        columns.append(np.hstack([0.0 * M, -M @ skew(eye[i]), zero]))
    for i in range(3):
        columns.append(np.hstack([0.0 * M, 0.0 * M, eye[:, i : i + 1]]))
    return np.stack([c.ravel() for c in columns], axis=1)


def _deviations(m: _Mounting, priors: dict[str, Parameter]) -> tuple[Array, Array]:
    """Return deviation from the prior and its standard deviation, stacked as the steps are."""
    mean = priors[MISALIGNMENT].mean
    deviation = np.concatenate(
        [
            inverse_right_jacobian(mean) @ log_so3(exp_so3(mean).T @ m.dRb),
            m.scale - 1.0 - priors[SCALE_ERROR].mean,
            m.lever_arm - priors[LEVER_ARM].mean,
            m.bias - priors[BIAS].mean,
        ]
    )
    names = (MISALIGNMENT, SCALE_ERROR, LEVER_ARM, BIAS)
    sigma = np.concatenate([priors[name].sigma for name in names])
    return deviation, np.maximum(sigma, 1e-6)


def _cost(moments: _Moments, m: _Mounting, priors: dict[str, Parameter]) -> float:
    theta = _theta(m)
    misfit = moments.yy - 2.0 * np.sum(theta.T * moments.xy) + np.sum((theta @ moments.xx) * theta)
    deviation, sigma = _deviations(m, priors)
    return float(0.5 * misfit + 0.5 * np.sum((deviation / sigma) ** 2))


def _prior_terms(m: _Mounting, priors: dict[str, Parameter]) -> tuple[Array, Array]:
    """Return gradient and information of the priors, to first order in the rotation."""
    deviation, sigma = _deviations(m, priors)
    return deviation / sigma**2, np.diag(1.0 / sigma**2)
