"""Motion prior of trials without IMU: white acceleration of the body through the water.

Without an IMU nothing carries the motion from one node to the next but the inertia of the vessel.
Its angular acceleration and the acceleration of its velocity through the water, both along the
body axes, are taken as white noise: a prior on SE(3) (Barfoot, Tong and Särkkä, Batch
continuous-time trajectory estimation as exactly sparse Gaussian process regression, RSS 2014;
Anderson and Barfoot, Full STEAM ahead, IROS 2015). A vessel that turns at constant rate and speed
accelerates in n, but not along its own axes, so turns and legs need not differ in density.

From node k on, the motion through the water is T_k Exp(gamma(tau)), and the twist, angular rate
and velocity in body axes, is varpi = Jr(gamma) dgamma/dtau. Between two nodes the local variable
gamma is a cubic of Hermite, the mean of the prior given both.

Functions of twists are those of rotation vectors, with dual numbers for reals: gamma = phi +
eps rho with eps² = 0 (the principle of transference; Study, Geometrie der Dynamen, 1903).
Jr(phi) and its inverse are 1 + s(|phi|²) [phi x] + g(|phi|²) [phi x]², so these two functions, and
their first two derivatives, give every Jacobian here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from scipy.special import factorial, zeta

from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.vectors import IDENTITY, Array, IntArray, cross, rotate, skew
from factorgraph_dvl.sensors.protocol import Motion


@dataclass(frozen=True)
class SmoothStates:
    """Motion at K nodes.

    Parameters
    ----------
    nRb : ndarray, shape (K, 3, 3)
        Attitude, body to n.
    p_n, v_n : ndarray, shape (K, 3)
        Position and Earth-relative velocity in n, m, m/s.
    omega_b : ndarray, shape (K, 3), rad/s
        Angular rate of the body relative to n.
    """

    nRb: Array
    p_n: Array
    v_n: Array
    omega_b: Array

    def retracted(self, delta: Array) -> SmoothStates:
        """Return the states after a step (K, 12) in the tangent space.

        nRb Exp(theta), p_n + nRb dp, v_n + nRb dv, omega_b + d omega, as GTSAM's NavState.
        """
        return SmoothStates(
            self.nRb @ exp_so3(delta[:, :3]),
            self.p_n + rotate(self.nRb, delta[:, 3:6]),
            self.v_n + rotate(self.nRb, delta[:, 6:9]),
            self.omega_b + delta[:, 9:],
        )


class Steps(NamedTuple):
    """Whitened residuals (K - 1, 12) of the prior, and their derivatives.

    By the tangent spaces of the nodes before and after, (K - 1, 12, 12), and by the current in n,
    (K - 1, 12, 3).
    """

    residual: Array
    before: Array
    after: Array
    by_current: Array


class Derivatives(NamedTuple):
    """Derivatives by the tangents of the nodes before and after, (M, d, 12), and by the current.

    The current is that of the interval, in n: (M, d, 3).
    """

    before: Array
    after: Array
    by_current: Array


def motion_steps(time: Array, states: SmoothStates, current_n: Array, density: Array) -> Steps:
    """Return the residuals of the prior from node to node, of unit variance.

    e = [gamma - dt varpi_k; Jr^-1(gamma) varpi_k+1 - varpi_k], covariance Q x diag(q) with
    Q = [dt³/3 dt²/2; dt²/2 dt].

    Parameters
    ----------
    time : ndarray, shape (K,), s
        Of the nodes.
    states : SmoothStates
        At the nodes.
    current_n : ndarray, shape (K - 1, 3), m/s
        Velocity of the water between the nodes.
    density : ndarray, shape (6,) or (K - 1, 6)
        Power spectral densities q of the angular acceleration about the body axes, rad²/s³, and
        of the acceleration along them, m²/s³.
    """
    steps = node_steps(time, states, current_n)
    dt = steps.span[:, None]
    root = 1.0 / np.sqrt(np.broadcast_to(density, steps.gamma.shape))
    # Inverse of the Cholesky factor of Q.
    w_gg, w_rg, w_rr = np.sqrt(3.0 / dt**3) * root, -3.0 / dt**1.5 * root, 2.0 / np.sqrt(dt) * root
    moved, accelerated = steps.gamma - dt * steps.start, steps.rate - steps.start
    residual = np.concatenate([w_gg * moved, w_rg * moved + w_rr * accelerated], axis=1)
    by_gamma, by_rate, by_start = (np.zeros((len(root), 12, 6)) for _ in range(3))
    i = np.arange(6)
    by_gamma[:, i, i], by_gamma[:, 6 + i, i] = w_gg, w_rg
    by_rate[:, 6 + i, i] = w_rr
    by_start[:, i, i], by_start[:, 6 + i, i] = -dt * w_gg, -dt * w_rg - w_rr
    return Steps(residual, *steps.by_tangents(slice(None), by_gamma, by_rate, by_start))


@dataclass(frozen=True)
class Between:
    """Motion at M times between the nodes; `interpolated` makes it.

    Derivatives and variances are of rows J times the motion: theta of nRb Exp(theta), p_n, v_n,
    omega_eb_b, in this order. They take memory of M d 12 numbers and more, so many times are
    better asked for in parts.

    Parameters
    ----------
    node : ndarray of int, shape (M,)
        The node before each.
    motion : Motion
        At the times.
    tau : ndarray, shape (M,), s
        Time since the node before.
    gamma, rate : ndarray, shape (M, 6)
        Local variable and its derivative in time.
    u_b : ndarray, shape (M, 3), m/s
        Velocity through the water in body axes.
    steps : NodeSteps
        From node to node.
    """

    node: IntArray
    motion: Motion
    tau: Array
    gamma: Array
    rate: Array
    u_b: Array
    steps: NodeSteps

    def derivatives(self, rows: Array) -> Derivatives:
        """Return the derivatives of rows J (M, d, 12) times the motion."""
        pose, by_gamma, by_rate = self._by_local(rows)
        turned = pose @ self._right
        of_gamma, of_rate, _ = _hermite(self.tau, self.steps.span[self.node])
        through = [
            gain[:, None, None] * by_gamma + gain_rate[:, None, None] * by_rate
            for gain, gain_rate in zip(of_gamma, of_rate, strict=True)
        ]
        at_end, at_rate, at_start = through
        out = self.steps.by_tangents(self.node, at_end, at_rate, at_start)
        # The node before carries the motion: x Ad(Exp(-gamma)) = x - x Jr ad(gamma).
        out.before[..., :6] += pose - turned @ _adjoint(self.gamma)
        out.by_current[...] += self.tau[:, None, None] * rows[..., 3:6] + rows[..., 6:9]
        return out

    def variance(self, density: Array, rows: Array) -> Array:
        """Return the covariance (M, d, d) of rows J (M, d, 12) times the motion, given both nodes.

        Parameters
        ----------
        density : ndarray, shape (6,) or (K - 1, 6)
            As of `motion_steps`.
        rows : ndarray, shape (M, d, 12)
            J.
        """
        span = self.steps.span[self.node]
        tau = np.clip(self.tau, 0.0, span)
        rest = span - tau
        gg = tau**3 * rest**3 / (3.0 * span**3)
        gr = tau**2 * rest**2 * (rest - tau) / (2.0 * span**3)
        rr = tau * rest * (span**2 - 3.0 * tau * rest) / span**3
        return self._spread(density, rows, (gg, gr, rr))

    def _spread(self, density: Array, rows: Array, variances: tuple[Array, Array, Array]) -> Array:
        """Return the covariance from those of the local variable and its rate, over q."""
        _, by_gamma, by_rate = self._by_local(rows)
        q = (density[self.node] if density.ndim == 2 else density[None])[:, None, :]
        gg, gr, rr = (v[:, None, None] * q for v in variances)
        out = (gg * by_gamma + gr * by_rate) @ by_gamma.swapaxes(1, 2)
        return np.asarray(out + (gr * by_gamma + rr * by_rate) @ by_rate.swapaxes(1, 2))

    def _by_local(self, rows: Array) -> tuple[Array, Array, Array]:
        """Return derivatives (M, d, 6) by the pose, in body axes, and by gamma and its rate."""
        theta, position, velocity, omega = np.split(rows, 4, axis=2)
        position, velocity = position @ self.motion.nRb, velocity @ self.motion.nRb
        pose = np.concatenate([theta - velocity @ skew(self.u_b), position], axis=2)
        twist = np.concatenate([omega, velocity], axis=2)
        return pose, pose @ self._right + twist @ self._bend, twist @ self._right

    @cached_property
    def _right(self) -> Array:
        """Jr(gamma), (M, 6, 6)."""
        return _Function(_RIGHT, self.gamma).matrix()

    @cached_property
    def _bend(self) -> Array:
        """Derivative of Jr(gamma) rate by gamma, (M, 6, 6)."""
        return _Function(_RIGHT, self.gamma).derivative(self.rate)


def interpolated(
    time_of_nodes: Array,
    states: SmoothStates,
    current_n: Array,
    at: Array,
    node: IntArray | None = None,
    steps: NodeSteps | None = None,
) -> Between:
    """Return the motion at times `at` (M,), s; before the first node and after the last, theirs.

    The position's derivative in time is the velocity, and that of the attitude the rate.

    Parameters
    ----------
    time_of_nodes : ndarray, shape (K,), s
        Of the states.
    states : SmoothStates
        At the nodes.
    current_n : ndarray, shape (K - 1, 3), m/s
        Velocity of the water between the nodes.
    at : ndarray, shape (M,), s
        Times of the motion.
    node : ndarray of int, shape (M,), optional
        Nodes before, whose motion goes on where a time is not between them and the next.
    steps : NodeSteps, optional
        Of `node_steps`, if they are known.
    """
    steps = steps or node_steps(time_of_nodes, states, current_n)
    if node is None:
        node = np.clip(np.searchsorted(time_of_nodes, at, "right") - 1, 0, steps.span.size - 1)
        at = np.clip(at, time_of_nodes[0], time_of_nodes[-1])
    span = steps.span[node]
    tau = at - time_of_nodes[node]
    knots = np.stack([steps.gamma[node], steps.rate[node], steps.start[node]])
    gamma, rate, rate_of_rate = np.einsum("oim,imj->omj", _hermite(tau, span), knots)
    right = _Function(_RIGHT, gamma)
    twist = right.times(rate)
    twist_rate = right.times(rate_of_rate) + right.derivative_times(rate, rate)
    (omega, u), (alpha, u_rate) = (np.split(x, 2, axis=1) for x in (twist, twist_rate))
    start = states.nRb[node]
    nRb = start @ exp_so3(gamma[:, :3])
    current = current_n[node]
    motion = Motion(
        nRb=nRb,
        p_n=states.p_n[node] + tau[:, None] * current + rotate(start, _translation(gamma)),
        v_n=rotate(nRb, u) + current,
        omega_eb_b=omega,
        a_n=rotate(nRb, cross(omega, u) + u_rate),
        alpha_b=alpha,
        omega_sigma=np.zeros_like(omega),
    )
    return Between(node, motion, tau, gamma, rate, u, steps)


@dataclass(frozen=True)
class NodeSteps:
    """What leads from node to node.

    span (K - 1,) is the time between them, gamma the local variable at the node after; `start` and
    `end` are the twists of both nodes, rate = Jr^-1(gamma) end: (K - 1, 6).
    """

    span: Array
    nRb: Array
    gamma: Array
    start: Array
    end: Array
    rate: Array
    function: _Function

    @cached_property
    def inverse(self) -> Array:
        """Jr^-1(gamma), (K - 1, 6, 6)."""
        return self.function.matrix()

    @cached_property
    def bend(self) -> Array:
        """Derivative of Jr^-1(gamma) end by gamma, (K - 1, 6, 6)."""
        return self.function.derivative(self.end)

    def by_tangents(
        self, node: IntArray | slice, by_gamma: Array, by_rate: Array, by_start: Array
    ) -> Derivatives:
        """Return derivatives by the nodes from those by gamma, rate and start, (M, d, 6)."""
        inverse, nRb_end = self.inverse[node], self.nRb[1:][node]
        by_gamma = by_gamma + by_rate @ self.bend[node]
        pose, by_end = by_gamma @ inverse, by_rate @ inverse
        # Jl^-1 = Jr^-1 - ad.
        left = by_gamma @ _adjoint(self.gamma[node]) - pose
        before = _tangent(left, by_start, self.start[node, 3:])
        after = _tangent(pose, by_end, self.end[node, 3:])
        drift = by_end[..., 3:] + self.span[node][:, None, None] * pose[..., 3:]
        by_current = -drift @ nRb_end.swapaxes(1, 2)
        by_current -= by_start[..., 3:] @ self.nRb[:-1][node].swapaxes(1, 2)
        return Derivatives(before, after, by_current)


def node_steps(time: Array, states: SmoothStates, current_n: Array) -> NodeSteps:
    """Return what leads from node to node."""
    dt = np.diff(time)
    bRn = states.nRb.swapaxes(1, 2)
    phi = log_so3(bRn[:-1] @ states.nRb[1:])
    moved = rotate(bRn[:-1], np.diff(states.p_n, axis=0) - dt[:, None] * current_n)
    # The inverse of Jl(phi) is that of Jr(-phi).
    s, g = polyval((phi * phi).sum(axis=1), _INVERSE[:, 0])[..., None]
    across = cross(phi, moved)
    gamma = np.concatenate([phi, moved - s * across + g * cross(phi, across)], axis=1)
    start, end = (
        np.concatenate([states.omega_b[k], rotate(bRn[k], states.v_n[k] - current_n)], axis=1)
        for k in (slice(None, -1), slice(1, None))
    )
    function = _Function(_INVERSE, gamma)
    return NodeSteps(dt, states.nRb, gamma, start, end, function.times(end), function)


def _hermite(tau: Array, span: Array) -> Array:
    """Return weights (3, 3, M) of gamma's end, of the rates at its end and at its start.

    Of gamma, of its rate, and of the derivative of that.
    """
    s, r = tau / span, 1.0 - tau / span
    return np.array(
        [
            [s**2 * (3.0 - 2.0 * s), -tau * s * r, tau * r**2],
            [6.0 * s * r / span, s * (3.0 * s - 2.0), r * (1.0 - 3.0 * s)],
            [6.0 * (r - s) / span**2, (6.0 * s - 2.0) / span, (6.0 * s - 4.0) / span],
        ]
    )


def _translation(gamma: Array) -> Array:
    """Return the translation of Exp(gamma), Jl(phi) rho."""
    phi, rho = gamma[:, :3], gamma[:, 3:]
    s, g = polyval((phi * phi).sum(axis=1), _RIGHT[:, 0])[..., None]
    across = cross(phi, rho)
    return np.asarray(rho - s * across + g * cross(phi, across))


def _tangent(pose: Array, twist: Array, u_b: Array) -> Array:
    """Return derivatives (M, d, 12) by a node from those by its pose and its twist, (M, d, 6)."""
    theta = pose[..., :3] + twist[..., 3:] @ skew(u_b)
    return np.concatenate([theta, pose[..., 3:], twist[..., 3:], twist[..., :3]], axis=2)


def _adjoint(gamma: Array) -> Array:
    """Return ad(gamma) = [[phi x] 0; [rho x] [phi x]], (M, 6, 6)."""
    return _blocks(skew(_dual(gamma)))


def _powers(s: Array, g: Array) -> Array:
    """Return coefficients (n, 3, 2) of s and g in powers of |phi|², with two derivatives."""
    table = np.stack([s, g], axis=1)
    each = [np.pad(polyder(table, m), ((0, m), (0, 0))) for m in range(3)]
    return np.stack(each, axis=1)


# Taylor series, exact to the last digit up to |phi| = 2 pi, and of the inverse up to pi; closed
# forms lose their digits towards no rotation. Jr: s = -(1 - cos) / phi², g = (phi - sin) / phi³.
_N, _M = np.arange(20.0), np.arange(32.0)
_RIGHT = _powers(-((-1.0) ** _N) / factorial(2 * _N + 2), (-1.0) ** _N / factorial(2 * _N + 3))
# Jr^-1: s = 1/2, g = (1 - phi/2 cot(phi/2)) / phi².
_INVERSE = _powers(0.5 * (_M == 0), 2.0 * zeta(2 * _M + 2) / (2.0 * np.pi) ** (2 * _M + 2))


class _Function:
    """1 + s [gamma x] + g [gamma x]² of dual vectors gamma: Jr on SE(3) or its inverse.

    Dual numbers, vectors and matrices are arrays (2, M, ...): the real part, then the dual one.
    """

    def __init__(self, powers: Array, gamma: Array) -> None:
        self.gamma = _dual(gamma)
        self.square = _product(_dot, self.gamma, self.gamma)
        value = polyval(self.square[0], powers)
        dual = np.stack([value[:2], value[1:] * self.square[1]], axis=2)
        (self.s, self.g), (self.s_rate, self.g_rate) = dual

    def times(self, y: Array) -> Array:
        """Return the products with twists y (M, 6)."""
        across = _product(cross, self.gamma, _dual(y))
        twice = _product(cross, self.gamma, across)
        return _twist(
            _dual(y) + _product(_scale, self.s, across) + _product(_scale, self.g, twice)
        )

    def matrix(self) -> Array:
        """Return the matrices (M, 6, 6)."""
        twice = _product(_outer, self.gamma, self.gamma) - _diagonal(self.square)
        out = _product(_scale, self.s, skew(self.gamma)) + _product(_scale, self.g, twice)
        out[0] += IDENTITY
        return _blocks(out)

    def derivative(self, y: Array) -> Array:
        """Return the derivatives (M, 6, 6) of the products with y (M, 6) by gamma."""
        dual = _dual(y)
        along, mixed = self._along(dual), _product(_outer, self.gamma, dual)
        out = _product(_outer, along, self.gamma) - _product(_scale, self.s, skew(dual))
        inner = _diagonal(_product(_dot, self.gamma, dual))
        return _blocks(out + _product(_scale, self.g, mixed + inner))

    def derivative_times(self, y: Array, direction: Array) -> Array:
        """Return `derivative` of y times directions (M, 6)."""
        dual, d = _dual(y), _dual(direction)
        out = _product(_scale, _product(_dot, self.gamma, d), self._along(dual))
        out -= _product(_scale, self.s, _product(cross, dual, d))
        mixed = _product(_scale, _product(_dot, dual, d), self.gamma)
        mixed += _product(_scale, _product(_dot, self.gamma, dual), d)
        return _twist(out + _product(_scale, self.g, mixed))

    def _along(self, y: Array) -> Array:
        """Return what a change of gamma along itself adds, over its length and that of gamma."""
        across = _product(cross, self.gamma, y)
        twice = _product(cross, self.gamma, across)
        out = _product(_scale, self.s_rate, across) + _product(_scale, self.g_rate, twice)
        return np.asarray(2.0 * (out - _product(_scale, self.g, y)))


def _product(product: Callable[[Array, Array], Array], a: Array, b: Array) -> Array:
    """Return a bilinear product of dual quantities."""
    return np.stack([product(a[0], b[0]), product(a[0], b[1]) + product(a[1], b[0])])


def _dot(a: Array, b: Array) -> Array:
    """Return the scalar products (M,)."""
    return np.asarray((a * b).sum(axis=-1))


def _outer(a: Array, b: Array) -> Array:
    """Return the matrices a bᵀ, (M, 3, 3)."""
    return a[:, :, None] * b[:, None, :]


def _scale(a: Array, b: Array) -> Array:
    """Return vectors or matrices b times numbers a (M,)."""
    return a.reshape(-1, *(1,) * (b.ndim - 1)) * b


def _diagonal(a: Array) -> Array:
    """Return multiples of the unit matrix, (2, M, 3, 3)."""
    return a[..., None, None] * IDENTITY


def _dual(twist: Array) -> Array:
    """Return twists (M, 6) as dual vectors (2, M, 3)."""
    return twist.reshape(-1, 2, 3).swapaxes(0, 1)


def _twist(dual: Array) -> Array:
    """Return dual vectors (2, M, 3) as twists (M, 6)."""
    return np.concatenate([dual[0], dual[1]], axis=1)


def _blocks(dual: Array) -> Array:
    """Return dual matrices (2, M, 3, 3) as matrices (M, 6, 6) of twists."""
    out = np.zeros((dual.shape[1], 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = dual[0]
    out[:, 3:, :3] = dual[1]
    return out
