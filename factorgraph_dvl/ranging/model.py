"""The planar factor graph: a chain of positions, a few constants, ranges and range rates.

    p_{k+1} = p_k + R(b)ᵀ d_k / (1 + s) + c dt - tau (n_k + n_{k+1}) / 2 + noise
    r       = (1 + e) |x|,                x = p_k + arm - place - offset
    dr/dt   = (1 + e) xᵀ v / |x|,         v = R(b)ᵀ w_k / (1 + s) - n_k + c + v_arm

    w_{k+1} - n_{k+1} = w_k - n_k + N(0, Q_k)

with the dead-reckoned displacement d and velocity w, the log's scale error s, the heading's
bias b (R(b) turns clockwise), the current c, the relative error of the sound speed e and each
beacon's offset. The noise n of heading and log at a node enters both the displacement (tau is
their sampling interval) and the velocity that predicts the range rate. Two independent noises
would give spurious information on the direction of the current. So would a velocity that may
change at will: noise of heading and log would count as motion, which range rates contradict.
So the velocity through the water is as smooth as the records show it to be
(`planar_track.velocity_change_psd`). Nodes are eliminated in order, the constants last: a banded
factorisation with a border.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.parameters import Parameter

# Chosen: a measurement this many standard deviations off is rejected, as are 0.05 % of good ones.
GATE = 3.5
# Defined: mean radius of the Earth, m; over 10 km a sphere errs by 3 cm in height.
EARTH_RADIUS = 6.371e6
# Chosen: keeps directions finite at a beacon, m.
_LEAST_DISTANCE = 1e-3


@dataclass(frozen=True)
class Ranging:
    """M rows of ranges and range rates, on a chain of N nodes.

    Parameters
    ----------
    node : ndarray of np.intp, shape (M,)
        Index of the node of each, not decreasing.
    beacon : ndarray of np.intp, shape (M,)
        Index of the beacon.
    range, rate : ndarray, shape (M,)
        Range, m, and range rate, m/s; nan where not measured.
    range_std, rate_std : ndarray, shape (M,)
        Standard deviations, m and m/s, with the noise of the depth.
    """

    node: NDArray[np.intp]
    beacon: NDArray[np.intp]
    range: Array
    rate: Array
    range_std: Array
    rate_std: Array


@dataclass(frozen=True)
class PlanarProblem:
    """What the smoother minimises.

    Parameters
    ----------
    time : ndarray, shape (N,), s
        Of the nodes.
    step : ndarray, shape (N - 1, 2), m
        Dead-reckoned displacements, east and north.
    step_cov : ndarray, shape (N - 1, 2, 2), m²
        Their covariance without the noise n at the ends.
    share : ndarray, shape (N - 1,), s
        Tau of the steps.
    velocity : ndarray, shape (N, 2), m/s
        Dead-reckoned velocity, east and north.
    velocity_cov : ndarray, shape (N, 2, 2), m²/s²
        Covariance of its noise.
    change_cov : ndarray, shape (N - 1, 2, 2), m²/s²
        Of the change of the true velocity over a step.
    height, climb : ndarray, shape (N,)
        Above the frame's origin and its rate, m, m/s.
    arm, arm_velocity : ndarray, shape (N, 3)
        Of the transponder from the reference point, in n.
    place : ndarray, shape (B, 3), m
        Stated positions of the beacons in n.
    ranging : Ranging
        Ranges and range rates.
    parameters : tuple of Parameter
        Constants with priors, fixed ones included.
    start_mean : ndarray, shape (2,), m
        Prior mean of the first position, east and north.
    start_cov : ndarray, shape (2, 2), m²
        Prior covariance of the first position.
    start_known : bool
        Whether that prior is measured, not a mere bound.
    tan_lat : float
        Tangent of the latitude, for the convergence of the meridians.
    """

    time: Array
    step: Array
    step_cov: Array
    share: Array
    velocity: Array
    velocity_cov: Array
    change_cov: Array
    height: Array
    climb: Array
    arm: Array
    arm_velocity: Array
    place: Array
    ranging: Ranging
    parameters: tuple[Parameter, ...]
    start_mean: Array
    start_cov: Array
    start_known: bool
    tan_lat: float

    @cached_property
    def constants(self) -> tuple[Parameter, ...]:
        """The parameters that are estimated."""
        return tuple(p for p in self.parameters if p.estimated)

    @cached_property
    def prior_sigma(self) -> Array:
        """Standard deviations of their priors, (c,)."""
        parts = [np.maximum(p.sigma, 1e-9) for p in self.constants]
        return np.concatenate([np.empty(0), *parts])

    @cached_property
    def si(self) -> Array:
        """SI values of their reported units, (c,)."""
        parts = [np.full(p.mean.size, p.si) for p in self.constants]
        return np.concatenate([np.empty(0), *parts])

    @cached_property
    def step_info(self) -> Array:
        """Inverse covariances of the steps, (N - 1, 2, 2), 1/m²."""
        return np.asarray(np.linalg.inv(self.step_cov), dtype=float)

    @cached_property
    def velocity_info(self) -> Array:
        """Inverse covariances of the noise of the velocity, (N, 2, 2), s²/m²."""
        return np.asarray(np.linalg.inv(self.velocity_cov), dtype=float)

    @cached_property
    def change_info(self) -> Array:
        """Inverse covariances of the changes of the velocity, (N - 1, 2, 2), s²/m²."""
        return np.asarray(np.linalg.inv(self.change_cov), dtype=float)

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Where each constant stands, by stem."""
        ends = np.cumsum([p.mean.size for p in self.constants])
        return {
            p.stem: slice(int(end) - p.mean.size, int(end))
            for p, end in zip(self.constants, ends, strict=True)
        }

    def rows(self, nodes: int) -> int:
        """Return how many measurements belong to the first nodes."""
        return int(np.searchsorted(self.ranging.node, nodes))

    def value(self, theta: Array, stem: str, size: int = 1) -> Array:
        """Return a constant by its stem; zero if it is not estimated."""
        place = self.columns.get(stem)
        return theta[place] if place is not None else np.zeros(size)

    def carried(self, x: Array, theta: Array, nodes: int) -> Array:
        """Return the states (n, 4) of at least one node, dead-reckoned on to (nodes, 4)."""
        n = x.shape[0]
        out = np.zeros((nodes, 4))
        out[: min(n, nodes)] = x[:nodes]
        if nodes > n:
            east = np.repeat(x[-1:, 0], nodes - n)
            moves, _ = self.moves(east, theta, slice(n - 1, nodes - 1))
            out[n:, :2] = x[-1, :2] + np.cumsum(moves, axis=0)
        return out

    def moves(self, east: Array, theta: Array, part: slice) -> tuple[Array, Array]:
        """Return displacements over ground (n, 2), and those through the water, turned."""
        # North at a place east of the origin is not that of n: meridians converge.
        through = self.turned(self.step[part], east, theta)
        current = self.value(theta, "current", 2)
        dt = np.diff(self.time)[part]
        return through + current * dt[:, None], through

    def turned(self, vectors: Array, east: Array, theta: Array) -> Array:
        """Return dead-reckoned vectors (n, 2), scaled and turned by the heading's errors."""
        angle = self.value(theta, "heading_bias")[0] + east / EARTH_RADIUS * self.tan_lat
        sine, cosine = np.sin(angle), np.cos(angle)
        scale = 1.0 / (1.0 + self.value(theta, "log_scale_error")[0])
        x, y = vectors.T
        return np.asarray(scale * np.stack([cosine * x - sine * y, cosine * y + sine * x], axis=1))

    def by_constants(self, through: Array, theta: Array, span: Array) -> Array:
        """Return the derivative of through + current * span by the constants, (n, 2, c).

        Parameters
        ----------
        through : ndarray, shape (n, 2)
            Displacements or velocities through the water, as `turned` returns them.
        theta : ndarray, shape (c,)
            Constants.
        span : ndarray, shape (n,)
            Time over which the current acts, s; 1 for a velocity.
        """
        out = np.zeros((through.shape[0], 2, theta.size))
        if "current" in self.columns:
            out[:, :, self.columns["current"]] = span[:, None, None] * np.eye(2)
        if "log_scale_error" in self.columns:
            column = self.columns["log_scale_error"]
            out[:, :, column] = -(through / (1.0 + theta[column]))[:, :, None]
        if "heading_bias" in self.columns:
            port = np.stack([-through[:, 1], through[:, 0]], axis=1)
            out[:, :, self.columns["heading_bias"]] = port[:, :, None]
        return out


@dataclass(frozen=True)
class RangingEvaluation:
    """Whitened residuals and Jacobians of the measurements; residuals are nan where none.

    `rate_gate` are the residuals of the rates with the noise of the velocity in their standard
    deviations in place of the state: the gate judges by these.
    """

    range_residual: Array
    rate_residual: Array
    rate_gate: Array
    range_x: Array
    rate_x: Array
    range_theta: Array
    rate_theta: Array


def evaluate(problem: PlanarProblem, x: Array, theta: Array) -> RangingEvaluation:
    """Return residuals and Jacobians of the measurements of the first n nodes.

    Parameters
    ----------
    problem : PlanarProblem
        Of at least n nodes.
    x : ndarray, shape (n, 4)
        Positions, m, and noise of the velocity, m/s.
    theta : ndarray, shape (c,)
        Constants.
    """
    r = problem.ranging
    rows = problem.rows(x.shape[0])
    node, beacon = r.node[:rows], r.beacon[:rows]
    at = x[node, :2]
    down = np.sum(at**2, axis=1) / (2.0 * EARTH_RADIUS)
    offsets, offset_columns = _offsets(problem, theta)
    from_beacon = np.column_stack([at, problem.height[node] - down])
    from_beacon = from_beacon + problem.arm[node] - (problem.place + offsets)[beacon]
    distance = np.maximum(np.linalg.norm(from_beacon, axis=1), _LEAST_DISTANCE)
    direction = from_beacon / distance[:, None]
    through = problem.turned(problem.velocity[node], at[:, 0], theta)
    current = problem.value(theta, "current", 2)
    velocity = np.column_stack([through - x[node, 2:] + current, problem.climb[node]])
    velocity = velocity + problem.arm_velocity[node]
    speed = np.sum(direction * velocity, axis=1)
    scale = 1.0 + problem.value(theta, "sound_speed_error")[0]
    across = (velocity - speed[:, None] * direction) / distance[:, None]

    columns = problem.columns
    range_theta = np.zeros((rows, theta.size))
    by_constants = problem.by_constants(through, theta, np.ones(rows))
    rate_theta = scale * np.einsum("mi,mic->mc", direction[:, :2], by_constants)
    if "sound_speed_error" in columns:
        range_theta[:, columns["sound_speed_error"]] = distance[:, None]
        rate_theta[:, columns["sound_speed_error"]] = speed[:, None]
    for b, place in offset_columns.items():
        own = beacon == b
        range_theta[own, place] = -scale * direction[own]
        rate_theta[own, place] = -scale * across[own]

    range_std, rate_std = r.range_std[:rows], r.rate_std[:rows]
    rate_residual = (scale * speed - r.rate[:rows]) / rate_std
    flat = scale * direction[:, :2] / rate_std[:, None]
    alone = rate_residual + np.sum(flat * x[node, 2:], axis=1)
    spread = 1.0 + np.einsum("mi,mij,mj->m", flat, problem.velocity_cov[node], flat)
    range_x = np.column_stack([scale * direction[:, :2], np.zeros((rows, 2))])
    rate_x = np.column_stack([scale * across[:, :2], -scale * direction[:, :2]])
    return RangingEvaluation(
        (scale * distance - r.range[:rows]) / range_std,
        rate_residual,
        alone / np.sqrt(spread),
        range_x / range_std[:, None],
        rate_x / rate_std[:, None],
        range_theta / range_std[:, None],
        rate_theta / rate_std[:, None],
    )


def _offsets(problem: PlanarProblem, theta: Array) -> tuple[Array, dict[int, slice]]:
    out = np.zeros_like(problem.place)
    columns = {}
    names = [p.stem for p in problem.parameters if p.stem.startswith("beacon_")]
    for b, stem in enumerate(names):
        if stem in problem.columns:
            columns[b] = problem.columns[stem]
            out[b] = theta[columns[b]]
    return out, columns


def step_errors(problem: PlanarProblem, x: Array, theta: Array) -> tuple[Array, Array]:
    """Return errors of the steps (n - 1, 2), and the displacements through the water."""
    n = x.shape[0]
    moves, through = problem.moves(x[:-1, 0], theta, slice(0, n - 1))
    wander = 0.5 * problem.share[: n - 1, None] * (x[1:, 2:] + x[:-1, 2:])
    return np.diff(x[:, :2], axis=0) - moves + wander, through


def velocity_changes(problem: PlanarProblem, x: Array) -> Array:
    """Return the changes of the velocity through the water between nodes, (n - 1, 2), m/s."""
    return np.diff(problem.velocity[: x.shape[0]] - x[:, 2:], axis=0)


def terms(problem: PlanarProblem, x: Array, theta: Array, at: RangingEvaluation) -> Array:
    """Return the terms of the cost: rows, steps, noise and changes of the velocity, priors."""
    squares = np.nan_to_num(np.concatenate([at.range_residual, at.rate_residual])) ** 2
    judged = np.nan_to_num(np.concatenate([at.range_residual, at.rate_gate])) ** 2
    error, _ = step_errors(problem, x, theta)
    info = problem.step_info[: error.shape[0]]
    change = velocity_changes(problem, x)
    from_mean = x[0, :2] - problem.start_mean
    parts = [
        np.where(judged > GATE**2, GATE**2, squares),
        np.einsum("ki,kij,kj->k", error, info, error),
        np.einsum("ki,kij,kj->k", x[:, 2:], problem.velocity_info[: x.shape[0]], x[:, 2:]),
        np.einsum("ki,kij,kj->k", change, problem.change_info[: change.shape[0]], change),
        (theta / problem.prior_sigma) ** 2,
        [from_mean @ np.linalg.solve(problem.start_cov, from_mean)],
    ]
    return 0.5 * np.concatenate(parts)
