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
# A descent ends where a step gains less cost than this, or not even a step so damped gains any.
# Chosen: the solver goes on from there.
_GAIN = 1e-3
_MOST_DAMPING = 1e6
# Rotations to start from, and the derivatives of one.
_CUBE = Rotation.create_group("O").as_matrix()
_GENERATORS = skew(np.eye(3))
# Rotation, rad, from which on two minima are two. Chosen: less than half of what divides starts.
_APART = 20.0 * DEG
# Pings that are summed up at most. Chosen: far more than the unknowns ask for.
_MAX_PINGS = 4000
# The same in the first search for the time offset. Chosen: enough to see which of its steps is
# the best.
_MAX_SCANNED = 800
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
class _Mountings:
    """S mountings: `dRb` (S, 3, 3), `scale` (S, n), `lever_arm` and `bias` (S, 3), m, m/s."""

    dRb: Array
    scale: Array
    lever_arm: Array
    bias: Array

    def __getitem__(self, rows: np.ndarray) -> _Mountings:
        """Return some of them."""
        return _Mountings(self.dRb[rows], self.scale[rows], self.lever_arm[rows], self.bias[rows])

    def moved(self, step: Array) -> _Mountings:
        """Return them after steps (S, 9 + n)."""
        n = self.scale.shape[1]
        return _Mountings(
            self.dRb @ exp_so3(step[:, :3]),
            self.scale + step[:, 3 : 3 + n],
            self.lever_arm + step[:, 3 + n : 6 + n],
            self.bias + step[:, 6 + n :],
        )


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
    variance = dvl.sigma() ** 2 + _VELOCITY_ERROR**2

    def moments(offset: float, pings: NDArray[np.intp] = pings) -> _Moments:
        motion, covered = motion_at(dvl.time[pings] - offset)
        v_b = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n)
        x = np.hstack([v_b, motion.omega_eb_b, np.ones((pings.size, 1))])
        weight = covered / variance[pings].mean(axis=1)
        y = dvl.velocity[pings]
        xw = x * weight[:, None]
        share = float(np.mean(covered))
        return _Moments(xw.T @ x, xw.T @ y, float(weight @ (y**2).sum(axis=1)), share)

    offset_prior = priors[TIME_OFFSET]
    offset = float(offset_prior.mean[0])
    if offset_prior.estimated:
        reach = min(4.0 * float(offset_prior.sigma[0]), _OFFSET_REACH)
        few = pings[:: max(pings.size // _MAX_SCANNED, 1)]
        for step, scanned in ((_OFFSET_STEP, few), (_OFFSET_FINE, pings)):
            count = int(np.ceil(reach / step))
            grid = offset + np.arange(-count, count + 1) * step
            prior_cost = 0.5 * ((grid - offset_prior.mean) / offset_prior.sigma) ** 2
            misfit = [_linear_misfit(moments(t, scanned)) for t in grid]
            offset = float(grid[np.argmin(misfit + prior_cost)])
            reach = 2.0 * step
        values[TIME_OFFSET] = np.array([offset])
    found = moments(offset)
    if found.share == 0.0:
        return [values]
    minima = _minima(found, priors)
    names = (MISALIGNMENT, SCALE_ERROR, LEVER_ARM, BIAS)
    each = zip(minima.dRb, minima.scale - 1.0, minima.lever_arm, minima.bias, strict=True)
    return [values | dict(zip(names, mounting, strict=True)) for mounting in each]


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


def _minima(moments: _Moments, priors: dict[str, Parameter]) -> _Mountings:
    """Return the mountings that many starts lead to, the best first."""
    dRb = [exp_so3(priors[MISALIGNMENT].mean)]
    scale, lever_arm = [1.0 + priors[SCALE_ERROR].mean], [priors[LEVER_ARM].mean]
    closed = _closed_form(moments)
    if closed is not None:
        dRb.append(closed[0])
        scale.append(np.full_like(scale[0], closed[1]))
        lever_arm.append(closed[2])
    if priors[MISALIGNMENT].sigma.max() > 0.3:
        dRb.extend(_CUBE)
        scale += [scale[0]] * len(_CUBE)
        lever_arm += [lever_arm[0]] * len(_CUBE)
    bias = [priors[BIAS].mean] * len(dRb)
    starts = _Mountings(*map(np.array, (dRb, scale, lever_arm, bias)))
    cost, found = _descend(moments, starts, priors)
    distinct: list[int] = []
    for i in np.argsort(cost, kind="stable").tolist():
        turns = log_so3(found.dRb[i].T @ found.dRb[distinct])
        if np.all(np.linalg.norm(turns, axis=1) > _APART):
            distinct.append(i)
    return found[np.array(distinct)]


def _closed_form(moments: _Moments) -> tuple[Array, float, Array] | None:
    """Return dRb, scale and lever arm by linear least squares of M and N.

    None if M is no multiple of a rotation. Wahba's solution alone would take the lever arm's
    share for a misalignment.
    """
    theta = _least_squares(moments)
    M, N = theta[:, :3], theta[:, 3:6]
    s = np.linalg.svd(M, compute_uv=False)
    if s[2] < _LEAST_SCALE or np.linalg.det(M) < 0:
        return None
    cross = -np.linalg.solve(M, N)
    lever_arm = 0.5 * np.array(
        [cross[2, 1] - cross[1, 2], cross[0, 2] - cross[2, 0], cross[1, 0] - cross[0, 1]]
    )
    return best_rotation(M), float(s.mean()), lever_arm


def _descend(
    moments: _Moments, starts: _Mountings, priors: dict[str, Parameter]
) -> tuple[Array, _Mountings]:
    """Return costs and mountings after damped Gauss-Newton on the moments, with the priors."""
    now, cost = starts, _cost(moments, starts, priors)
    damping = np.zeros(cost.size)
    active = np.arange(cost.size)
    for _ in range(_STEPS):
        part = now[active]
        step = _step(moments, part, priors, damping[active])
        new = part.moved(step)
        new_cost = _cost(moments, new, priors)
        better = (new.scale.min(axis=1) > _LEAST_SCALE) & (new_cost <= cost[active])
        done = better & (cost[active] - new_cost < _GAIN)
        k = active[better]
        for whole, improved in (
            (now.dRb, new.dRb),
            (now.scale, new.scale),
            (now.lever_arm, new.lever_arm),
            (now.bias, new.bias),
            (cost, new_cost),
        ):
            whole[k] = improved[better]
        eased = np.where(damping > 1e-3, damping / 10.0, 0.0)
        raised = np.maximum(10.0 * damping, 1e-2)
        damping[active] = np.where(better, eased[active], raised[active])
        active = active[~done & (damping[active] <= _MOST_DAMPING)]
        if active.size == 0:
            break
    return cost, now


def _step(moments: _Moments, m: _Mountings, priors: dict[str, Parameter], damping: Array) -> Array:
    """Return Gauss-Newton steps (S, 9 + n), the diagonal of the normal equations damped."""
    J = _derivative(m)
    weighted = moments.xx @ J
    count = J.shape[-1]
    flat, weighted_flat = J.reshape(-1, 21, count), weighted.reshape(-1, 21, count)
    misfit = (_theta(m) @ moments.xx - moments.xy.T).reshape(-1, 21, 1)
    deviation, sigma = _deviations(m, priors)
    gradient = (flat.transpose(0, 2, 1) @ misfit)[..., 0] + deviation / sigma**2
    H = flat.transpose(0, 2, 1) @ weighted_flat + np.diag(1.0 / sigma**2)
    H += damping[:, None, None] * (H * np.eye(count))
    return np.asarray(-np.linalg.solve(H, gradient[..., None])[..., 0], dtype=float)


def _theta(m: _Mountings) -> Array:
    """Return [M N beta], (S, 3, 7)."""
    M = m.scale[:, :, None] * m.dRb
    return np.concatenate([M, -M @ skew(m.lever_arm), m.bias[..., None]], axis=2)


def _derivative(m: _Mountings) -> Array:
    """Return d theta, (S, 3, 7, 9 + n), with respect to rotation, scale, lever arm, bias."""
    S, n = m.scale.shape
    M = m.scale[:, :, None] * m.dRb
    turned = np.einsum("sij,kjl->skil", M, _GENERATORS)
    rows = np.ones((1, 3, 1)) if n == 1 else np.eye(3)[:, :, None]
    grown = rows * m.dRb[:, None]
    cross = skew(m.lever_arm)[:, None]
    J = np.zeros((S, 9 + n, 3, 7))
    J[:, :3, :, :3], J[:, :3, :, 3:6] = turned, -turned @ cross
    J[:, 3 : 3 + n, :, :3], J[:, 3 : 3 + n, :, 3:6] = grown, -grown @ cross
    J[:, 3 + n : 6 + n, :, 3:6] = -turned
    J[:, 6 + n :, :, 6] = np.eye(3)
    return J.transpose(0, 2, 3, 1)


def _deviations(m: _Mountings, priors: dict[str, Parameter]) -> tuple[Array, Array]:
    """Return deviations from the prior, (S, 9 + n), and its standard deviation, (9 + n,).

    Stacked as steps are, and to first order in the rotation.
    """
    mean = priors[MISALIGNMENT].mean
    turned = log_so3(exp_so3(mean).T @ m.dRb) @ inverse_right_jacobian(mean).T
    deviation = np.concatenate(
        [
            turned,
            m.scale - 1.0 - priors[SCALE_ERROR].mean,
            m.lever_arm - priors[LEVER_ARM].mean,
            m.bias - priors[BIAS].mean,
        ],
        axis=1,
    )
    names = (MISALIGNMENT, SCALE_ERROR, LEVER_ARM, BIAS)
    sigma = np.concatenate([priors[name].sigma for name in names])
    return deviation, np.maximum(sigma, 1e-6)


def _cost(moments: _Moments, m: _Mountings, priors: dict[str, Parameter]) -> Array:
    """Return half the sum of squares of misfit and deviation from the prior, (S,)."""
    theta = _theta(m)
    products = (theta @ moments.xx) * theta - 2.0 * theta * moments.xy.T
    misfit = moments.yy + np.sum(products, axis=(1, 2))
    deviation, sigma = _deviations(m, priors)
    return np.asarray(0.5 * misfit + 0.5 * np.sum((deviation / sigma) ** 2, axis=1))
