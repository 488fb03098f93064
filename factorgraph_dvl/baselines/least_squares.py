"""Nonlinear least squares between the point sets, with lever arm and time offset.

    v_d = (1 + k) dRb (v_b + omega x l) + beta,  at time_s - offset.

Stands for the quaternion methods of Wang (2021) and, with the time offset, Liu (2022):
the same minimum, found by a trust-region Gauss-Newton method from several rotations
instead of by a genetic algorithm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import optimize

from factorgraph_dvl.baselines.outcome import Estimated, Outcome, prior_of
from factorgraph_dvl.baselines.point_sets import PointsAt, rotation_starts
from factorgraph_dvl.geometry.rotations import (
    exp_so3,
    inverse_right_jacobian,
    log_so3,
    right_jacobian,
)
from factorgraph_dvl.geometry.vectors import Array, skew
from factorgraph_dvl.sensors.parameters import Parameter

# Chosen: step, s, and reach, s, of the coarse search for the time offset; the step is a small
# fraction of the period of a vessel's roll.
_OFFSET_STEP = 0.04
_OFFSET_REACH = 1.0
# Chosen: half the span, s, of the difference quotient in time.
_STEP = 1e-3


@dataclass(frozen=True)
class _Problem:
    """Residuals as a function of steps from a rotation, and of the other parameters."""

    parameters: tuple[Parameter, ...]
    prior: Estimated
    points_at: PointsAt
    free: np.ndarray

    def values(self, R: Array, x: Array) -> tuple[Array, ...]:
        full = np.zeros(sum(p.mean.size for p in self.parameters))
        full[3:] = np.concatenate(self.prior.values[1:])
        full[self.free] = x
        out, at = [R @ exp_so3(full[:3])], 3
        for p in self.parameters[1:]:
            out.append(full[at : at + p.mean.size])
            at += p.mean.size
        return tuple(out)

    def sigma(self, R: Array, x: Array) -> Array:
        """Return the standard deviations of the velocities, (M, 3), near a solution."""
        dRb, _, arm, _, offset = self.values(R, x)
        P = self.points_at(float(offset[0])).covariance_d(dRb, arm)
        return np.sqrt(np.diagonal(P, axis1=1, axis2=2))

    def residual(self, x: Array, R: Array, sigma: Array) -> Array:
        """Return the whitened residuals of velocities and priors."""
        dRb, scale, arm, bias, offset = self.values(R, x)
        points = self.points_at(float(offset[0]))
        predicted = (1.0 + scale) * (points.at_dvl(arm) @ dRb.T) + bias
        others = (
            value - p.mean
            for p, value in zip(self.parameters[1:], (scale, arm, bias, offset), strict=True)
        )
        deviation = np.concatenate([self.deviation_from_prior(dRb), *others])[self.free]
        prior_sigma = np.concatenate([p.sigma for p in self.parameters])[self.free]
        return np.concatenate(
            [((predicted - points.v_d) / sigma).ravel(), deviation / prior_sigma]
        )

    def deviation_from_prior(self, dRb: Array) -> Array:
        """Return how far a rotation is from the prior's, to first order in it, (3,), rad."""
        mean = self.parameters[0].mean
        return inverse_right_jacobian(mean) @ log_so3(exp_so3(mean).T @ dRb)

    def jacobian(self, x: Array, R: Array, sigma: Array) -> Array:
        """Return the derivative of `residual`."""
        dRb, scale, arm, _, offset = self.values(R, x)
        points = self.points_at(float(offset[0]))
        at_dvl = points.at_dvl(arm)
        turned = at_dvl @ dRb.T
        M = np.broadcast_to(1.0 + scale, 3)[:, None] * dRb
        full_turn = np.zeros(3)
        full_turn[self.free[self.free < 3]] = x[self.free < 3]
        Jr = right_jacobian(full_turn)
        d_offset = np.zeros((len(points), 3, 1))
        if self.parameters[4].estimated and self.free[-1] == self.prior.covariance.shape[0] - 1:
            ahead, behind = (self.points_at(float(offset[0]) + h) for h in (_STEP, -_STEP))
            change = (ahead.at_dvl(arm) - behind.at_dvl(arm)) @ M.T
            d_offset = (change / (2.0 * _STEP))[:, :, None]
        columns = [
            -M @ skew(at_dvl) @ Jr,
            turned[:, :, None] * (np.ones((3, 1)) if scale.size == 1 else np.eye(3)),
            M @ skew(points.omega_b),
            np.broadcast_to(np.eye(3), (len(points), 3, 3)),
            d_offset,
        ]
        J = np.concatenate(columns, axis=2) / sigma[:, :, None]
        prior = np.eye(J.shape[2])
        here = self.deviation_from_prior(dRb)
        for i in range(3):
            nudge = Jr @ (1e-6 * np.eye(3)[i])
            prior[:3, i] = (self.deviation_from_prior(dRb @ exp_so3(nudge)) - here) / 1e-6
        prior_sigma = np.concatenate([p.sigma for p in self.parameters])[self.free]
        whitened = prior[np.ix_(self.free, self.free)] / prior_sigma[:, None]
        return np.concatenate([J[:, :, self.free].reshape(-1, self.free.size), whitened])

    def at_prior(self) -> Array:
        """Return the prior means of the free components, without a turn."""
        return np.concatenate([np.zeros(3), *self.prior.values[1:]])[self.free]


def least_squares(points_at: PointsAt, parameters: Sequence[Parameter]) -> Outcome:
    """Calibrate by nonlinear least squares, from several starts.

    Parameters
    ----------
    points_at : PointsAt
        Returns the point sets for a time offset, s.
    parameters : sequence of Parameter
        Misalignment, scale error, lever arm, bias and time offset, with their priors; those with a
        standard deviation of zero are fixed.
    """
    parameters = tuple(parameters)
    prior = prior_of(parameters)
    sigma = np.concatenate([p.sigma for p in parameters])
    free = np.flatnonzero(sigma > 0.0)
    offset = float(parameters[4].mean[0])
    if parameters[4].estimated:
        offset = _coarse_offset(points_at, offset, float(parameters[4].sigma[0]))
    few = points_at(offset).thinned()
    held = np.flatnonzero(free < sum(p.mean.size for p in parameters[:4]))
    coarse = _Problem(parameters, prior, lambda _: few, free[held])
    ends = [
        _solve(coarse, R, coarse.at_prior(), rounds=1, most=15)
        for R in rotation_starts(parameters[0])
    ]
    best = min(ends, key=lambda end: float(end[0].cost))
    x0 = np.zeros(free.size)
    x0[held] = best[0].x
    if parameters[4].estimated:
        x0[-1] = offset
    problem = _Problem(parameters, prior, lru_cache(maxsize=4)(points_at), free)
    result, R = _solve(problem, best[1], x0, rounds=2, most=100)
    values = problem.values(R, result.x)
    covariance = np.zeros_like(prior.covariance)
    # Each column to its own size first, or units hide what is known.
    size = np.maximum(np.linalg.norm(result.jac, axis=0), 1e-300)
    J = result.jac / size
    covariance[np.ix_(free, free)] = np.linalg.inv(J.T @ J) / np.outer(size, size)
    used = [i for i, p in enumerate(parameters) if i < 3 or p.estimated]
    rows = np.concatenate([np.full(p.mean.size, i in used) for i, p in enumerate(parameters)])
    estimated = Estimated(
        tuple(parameters[i] for i in used),
        tuple(values[i] for i in used),
        covariance[np.ix_(rows, rows)],
    )
    return Outcome(estimated, int(result.nfev), converged=bool(result.success))


def _solve(
    problem: _Problem, R: Array, x0: Array, *, rounds: int, most: int
) -> tuple[optimize.OptimizeResult, Array]:
    """Return the minimum and the rotation that it is relative to, after `rounds` weightings."""
    turn = problem.free < 3
    for _ in range(rounds):
        sigma = problem.sigma(R, x0)
        result = optimize.least_squares(
            problem.residual,
            x0,
            problem.jacobian,
            args=(R, sigma),
            x_scale="jac",
            max_nfev=most,
        )
        R = problem.values(R, result.x)[0]
        result.x = x0 = np.where(turn, 0.0, result.x)
    return result, R


def _coarse_offset(points_at: PointsAt, mean: float, sigma: float) -> float:
    """Return the offset at which v_d = M v_b + N omega + beta fits best, with any M and N."""
    reach = min(4.0 * sigma, _OFFSET_REACH)
    count = int(np.ceil(reach / _OFFSET_STEP))
    grid = mean + np.arange(-count, count + 1) * _OFFSET_STEP

    def left_over(offset: float) -> float:
        points = points_at(offset).thinned()
        x = np.hstack([points.v_b, points.omega_b, np.ones((len(points), 1))])
        fit = np.linalg.lstsq(x, points.v_d, rcond=None)[0]
        return float(np.sum((points.v_d - x @ fit) ** 2))

    return float(grid[np.argmin([left_over(float(t)) for t in grid])])
