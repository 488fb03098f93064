"""Elimination of the planar graph: banded along the chain, with the constants as a border."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from factorgraph_dvl.geometry.block_tridiagonal import banded, inverse_blocks
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.ranging.model import (
    PlanarProblem,
    RangingEvaluation,
    step_errors,
    velocity_changes,
)

# Chosen: radius of the trust region of positions, m, at a damping of 1; of constants it is their
# prior sigma.
_TRUSTED_M = 50.0


class System:
    """Normal equations: banded in the nodes' states, with the constants as a border."""

    def __init__(
        self,
        problem: PlanarProblem,
        x: Array,
        theta: Array,
        at: RangingEvaluation,
        weights: tuple[Array, Array],
        damping: float,
    ) -> None:
        n, c = x.shape[0], theta.size
        diagonal, off = np.zeros((n, 4, 4)), np.zeros((n - 1, 4, 4))
        border, g = np.zeros((n, 4, c)), np.zeros((n, 4))
        corner = np.diag(1.0 / problem.prior_sigma**2)
        h = theta / problem.prior_sigma**2

        start = np.linalg.inv(problem.start_cov)
        diagonal[0, :2, :2] += start
        g[0, :2] += start @ (x[0, :2] - problem.start_mean)
        noise = problem.velocity_info[:n]
        diagonal[:, 2:, 2:] += noise
        g[:, 2:] += np.einsum("kij,kj->ki", noise, x[:, 2:])

        error, through = step_errors(problem, x, theta)
        info = problem.step_info[: n - 1]
        half = 0.5 * problem.share[: n - 1, None, None] * np.eye(2)
        one = np.broadcast_to(np.eye(2), half.shape)
        before, after = (np.concatenate([sign * one, half], axis=2) for sign in (-1.0, 1.0))
        by_theta = -problem.by_constants(through, theta, np.diff(problem.time[:n]))
        weighted = info @ by_theta
        weighted_error = np.einsum("kij,kj->ki", info, error)
        for side, J in ((slice(0, n - 1), before), (slice(1, n), after)):
            transposed = J.transpose(0, 2, 1)
            diagonal[side] += transposed @ info @ J
            border[side] += transposed @ weighted
            g[side] += np.einsum("kij,kj->ki", transposed, weighted_error)
        off += before.transpose(0, 2, 1) @ info @ after
        # Products of matrices, as einsum does not use BLAS.
        stacked = by_theta.reshape(2 * (n - 1), c)
        corner += stacked.T @ weighted.reshape(2 * (n - 1), c)
        h += stacked.T @ weighted_error.reshape(2 * (n - 1))

        smooth = problem.change_info[: n - 1]
        weighted_error = np.einsum("kij,kj->ki", smooth, velocity_changes(problem, x))
        diagonal[:-1, 2:, 2:] += smooth
        diagonal[1:, 2:, 2:] += smooth
        off[:, 2:, 2:] -= smooth
        g[:-1, 2:] += weighted_error
        g[1:, 2:] -= weighted_error

        node = problem.ranging.node[: at.range_residual.size]
        for residual, by_x, by_constants, weight in (
            (at.range_residual, at.range_x, at.range_theta, weights[0]),
            (at.rate_residual, at.rate_x, at.rate_theta, weights[1]),
        ):
            used = weight > 0.0
            J, T, w = by_x[used], by_constants[used], weight[used]
            e = residual[used] * w
            # A node has one measurement of a kind: no index comes twice.
            diagonal[node[used]] += w[:, None, None] * J[:, :, None] * J[:, None, :]
            border[node[used]] += w[:, None, None] * J[:, :, None] * T[:, None, :]
            g[node[used]] += J * e[:, None]
            corner = corner + (T * w[:, None]).T @ T
            h = h + T.T @ e

        if damping > 0.0:
            diagonal[:, :2, :2] += damping / _TRUSTED_M**2 * np.eye(2)
            corner = corner + damping * np.diag(1.0 / problem.prior_sigma**2)
        self._diagonal, self._off = diagonal, off
        self._border = border.reshape(4 * n, c)
        self._g, self._h = g.reshape(4 * n), h
        self._factor = cholesky_banded(banded(diagonal, off), check_finite=False)
        self._influence = self._solve(self._border)
        self._schur = corner - self._border.T @ self._influence

    def _solve(self, right: Array) -> Array:
        return np.asarray(cho_solve_banded((self._factor, False), right, check_finite=False))

    def step(self) -> tuple[Array, Array]:
        """Return the Gauss-Newton step of states and constants."""
        return self.solve(self._g, self._h)

    def solve(self, g: Array, h: Array) -> tuple[Array, Array]:
        """Return the step against a gradient of states (4 n,) and constants (c,)."""
        dtheta = np.asarray(np.linalg.solve(self._schur, self._influence.T @ g - h), dtype=float)
        dx = -self._solve(g) - self._influence @ dtheta
        return dx.reshape(-1, 4), dtheta

    def covariance(self, *, last_only: bool) -> tuple[Array, Array, Array]:
        """Return covariances of states, of both, and of the constants."""
        n, c = self._diagonal.shape[0], self._h.size
        constants = np.asarray(np.linalg.inv(self._schur) if c else np.zeros((0, 0)), dtype=float)
        influence = self._influence.reshape(n, 4, c)
        if last_only:
            unit = np.zeros((4 * n, 4))
            unit[-4:] = np.eye(4)
            own, influence = self._solve(unit)[-4:][None], influence[-1:]
        else:
            own, _ = inverse_blocks(self._factor, 4)
        states = own + influence @ constants @ influence.transpose(0, 2, 1)
        return states, -influence @ constants, constants
