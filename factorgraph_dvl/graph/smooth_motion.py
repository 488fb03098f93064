"""Motion prior of trials without IMU: white angular acceleration, and white acceleration.

Without an IMU nothing carries the motion from one node to the next but the inertia of the vessel.
Its angular acceleration about the axes of the body is taken as white noise, and so is the
acceleration along axes of the track, which are level and turn with the heading: a vessel that
turns at constant rate and speed accelerates in n, but not along these (Barfoot, Tong and Särkkä,
Batch continuous-time trajectory estimation as exactly sparse Gaussian process regression, RSS
2014; Anderson and Barfoot, Full STEAM ahead, IROS 2015). Waves turn a vessel, not its velocity, so
the axes of the body are not those of the velocity.

From node k on, the attitude is nRb_k Exp(gamma(tau)), and the angular rate Jr(gamma) dgamma/dtau.
Between two nodes gamma and the position are cubics of Hermite, which values and rates at both ends
determine. Jr(phi) and its inverse are 1 + s(|phi|²) [phi x] + g(|phi|²) [phi x]², so these two
functions and their first derivatives give every Jacobian here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from scipy.special import factorial, zeta

from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.vectors import IDENTITY, Array, IntArray, cross, rotate, skew
from factorgraph_dvl.sensors.protocol import Linearization, Motion


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

        nRb Exp(theta), omega_b + d omega, p_n + dp, v_n + dv.
        """
        return SmoothStates(
            self.nRb @ exp_so3(delta[:, :3]),
            self.p_n + delta[:, 6:9],
            self.v_n + delta[:, 9:],
            self.omega_b + delta[:, 3:6],
        )


class Steps(NamedTuple):
    """Whitened residuals (K - 1, 12) of the prior, and their derivatives (K - 1, 12, 12).

    Rows: turn, shift, angular acceleration, acceleration. Columns: the tangent spaces of the nodes
    before and after.
    """

    residual: Array
    before: Array
    after: Array


@dataclass(frozen=True)
class Turns:
    """What turns the body from node to node.

    Parameters
    ----------
    span : ndarray, shape (K - 1,), s
        Time between the nodes.
    phi : ndarray, shape (K - 1, 3), rad
        Turn: the local variable gamma at the node after.
    start, end : ndarray, shape (K - 1, 3), rad/s
        Angular rates at both nodes.
    """

    span: Array
    phi: Array
    start: Array
    end: Array

    @cached_property
    def _function(self) -> _Function:
        return _Function(_INVERSE, self.phi)

    @cached_property
    def rate(self) -> Array:
        """Rate of gamma at the node after, Jr^-1(phi) end, (K - 1, 3)."""
        return self._function.times(self.end)

    @cached_property
    def inverse(self) -> Array:
        """Jr^-1(phi), (K - 1, 3, 3)."""
        return self._function.matrix()

    @cached_property
    def bend(self) -> Array:
        """Derivative of Jr^-1(phi) end by phi, (K - 1, 3, 3)."""
        return self._function.derivative(self.end)


def turns_of(time: Array, states: SmoothStates) -> Turns:
    """Return what turns the body from node to node; `time` (K,), s."""
    turn = states.nRb[:-1].transpose(0, 2, 1) @ states.nRb[1:]
    return Turns(np.diff(time), log_so3(turn), states.omega_b[:-1], states.omega_b[1:])


def motion_steps(turns: Turns, states: SmoothStates, nRt: Array, density: Array) -> Steps:
    """Return the residuals of the prior from node to node, of unit variance.

    Of the attitude e = [phi - dt omega_k; Jr^-1(phi) omega_k+1 - omega_k], of the velocity u in
    axes of the track e = [shift - dt u_k; u_k+1 - u_k] with the shift of the position that a
    constant u makes in turning axes, covariance Q x diag(q) with Q = [dt³/3 dt²/2; dt²/2 dt].

    Parameters
    ----------
    turns : Turns
        Turns of the states.
    states : SmoothStates
        States at the nodes.
    nRt : ndarray, shape (K, 3, 3)
        Axes of the track to n.
    density : ndarray, shape (K - 1, 6)
        Power spectral densities q of the angular acceleration about the axes of the body, rad²/s³,
        and of the acceleration along those of the track, m²/s³.
    """
    dt = turns.span
    tRn = nRt.transpose(0, 2, 1)
    # The inverse of Jl(phi) is that of Jr(-phi).
    turn_of_track = log_so3(tRn[:-1] @ nRt[1:])
    to_shift = _Function(_INVERSE, -turn_of_track).matrix() @ tRn[:-1]
    shift = rotate(to_shift, np.diff(states.p_n, axis=0))
    u = rotate(tRn, states.v_n)
    start = np.concatenate([turns.start, u[:-1]], axis=1)
    moved = np.concatenate([turns.phi, shift], axis=1) - dt[:, None] * start
    change = np.concatenate([turns.rate, u[1:]], axis=1) - start
    # Inverse of the Cholesky factor of Q.
    root = 1.0 / np.sqrt(np.broadcast_to(density, start.shape))
    w_gg, w_rg, w_rr = (
        (gain[:, None] * root)
        for gain in (np.sqrt(3.0 / dt**3), -3.0 / dt**1.5, 2.0 / np.sqrt(dt))
    )
    residual = np.concatenate([w_gg * moved, w_rg * moved + w_rr * change], axis=1)
    inverse, left, one = turns.inverse, turns.inverse.transpose(0, 2, 1), np.eye(3)[None]
    span = dt[:, None, None]
    # By first row and column: derivatives of `moved` and of `change`.
    of_before = {
        (0, 0): (-left, -turns.bend @ left),
        (0, 3): (-span * one, -one),
        (3, 6): (-to_shift, None),
        (3, 9): (-span * tRn[:-1], -tRn[:-1]),
    }
    of_after = {
        (0, 0): (inverse, turns.bend @ inverse),
        (0, 3): (None, inverse),
        (3, 6): (to_shift, None),
        (3, 9): (None, tRn[1:]),
    }
    before, after = np.zeros((2, dt.size, 12, 12))
    for out, parts in ((before, of_before), (after, of_after)):
        for (row, column), (of_moved, of_change) in parts.items():
            first, second = slice(row, row + 3), slice(row + 6, row + 9)
            columns = slice(column, column + 3)
            if of_moved is not None:
                out[:, first, columns] = w_gg[:, first, None] * of_moved
                out[:, second, columns] = w_rg[:, first, None] * of_moved
            if of_change is not None:
                out[:, second, columns] += w_rr[:, first, None] * of_change
    return Steps(residual, before, after)


@dataclass(frozen=True)
class Place:
    """Where times (M,) are between nodes.

    Parameters
    ----------
    node : ndarray of int, shape (M,)
        The node before each, whose motion goes on where a time is not between it and the next.
    tau : ndarray, shape (M,), s
        Time since that node.
    span : ndarray, shape (M,), s
        Time from it to the next.
    """

    node: IntArray
    tau: Array
    span: Array


def place_of(time: Array, nodes: Array) -> Place:
    """Return where times (M,), s, are between nodes (K,), s; beyond these, where nearest."""
    node = np.searchsorted(nodes, time, side="right") - 1
    node = np.clip(node, 0, nodes.size - 2)
    return Place(node, time - nodes[node], nodes[node + 1] - nodes[node])


@dataclass(frozen=True)
class Between:
    """Motion at M times between the nodes; `interpolated` makes it.

    Parameters
    ----------
    place, turned : Place
        Where position and velocity are between nodes, and where attitude and rate are.
    motion : Motion
        Motion at the times.
    gamma, rate : ndarray, shape (M, 3)
        Local variable of the attitude and its derivative in time.
    states : SmoothStates
        States at the nodes.
    turns : Turns
        Turns from node to node.
    """

    place: Place
    turned: Place
    motion: Motion
    gamma: Array
    rate: Array
    states: SmoothStates
    turns: Turns

    def by_nodes(self, lin: Linearization) -> Array:
        """Return the derivatives (M, d, 24) of residuals by the tangents of the nodes around.

        Columns: attitude and rate at the nodes before and after `turned`, then position and
        velocity at those before and after `place`.
        """
        out = np.zeros((*lin.residual.shape, 24))
        if lin.d_theta is not None or lin.d_omega is not None:
            weights = _hermite(self.turned)[:2, :, :, None, None]
            self._add_turn(out, weights, lin.d_theta, lin.d_omega)
        if lin.d_p is not None or lin.d_v is not None:
            weights = _hermite(self.place)[:2, :, :, None, None]
            parts = zip(weights, (lin.d_p, lin.d_v), strict=True)
            by_end, by_end_rate, by_rate = np.sum(
                [w * by for w, by in parts if by is not None], axis=0
            )
            out[:, :, 12:15] = -by_end if lin.d_p is None else lin.d_p - by_end
            out[:, :, 15:18], out[:, :, 18:21], out[:, :, 21:24] = by_rate, by_end, by_end_rate
        return out

    def _add_turn(
        self, out: Array, weights: Array, by_theta: Array | None, by_omega: Array | None
    ) -> None:
        """Write derivatives by attitudes and rates from those by theta and omega_eb_b."""
        function = _Function(_RIGHT, self.gamma)
        right = function.matrix()
        by_gamma = 0.0 if by_theta is None else by_theta @ right
        by_end, by_end_rate, by_rate = weights[0] * by_gamma
        if by_omega is not None:
            bent, turned = by_omega @ function.derivative(self.rate), by_omega @ right
            more = zip(weights[0], weights[1], strict=True)
            of_end, of_end_rate, of_rate = (w * bent + w_rate * turned for w, w_rate in more)
            by_end, by_end_rate, by_rate = (
                by_end + of_end,
                by_end_rate + of_end_rate,
                by_rate + of_rate,
            )
        node = self.turned.node
        inverse = self.turns.inverse[node]
        by_phi = by_end + by_end_rate @ self.turns.bend[node]
        out[:, :, 6:9], out[:, :, 9:12] = by_phi @ inverse, by_end_rate @ inverse
        # Jl^-1 is the transpose of Jr^-1.
        out[:, :, 0:3], out[:, :, 3:6] = -by_phi @ inverse.transpose(0, 2, 1), by_rate
        if by_theta is not None:
            nRb = self.states.nRb[node]
            out[:, :, 0:3] += by_theta @ (self.motion.nRb.transpose(0, 2, 1) @ nRb)

    def missing(self, density: Array, nRt: Array) -> Array:
        """Return covariances of attitude, position and velocity in n given the nodes.

        Parameters
        ----------
        density : ndarray, shape (K - 1, 6)
            Densities, as for `motion_steps`.
        nRt : ndarray, shape (K, 3, 3)
            Axes of the track.

        Returns
        -------
        ndarray, shape (M, 3, 3, 3)
            In rad², m² and m²/s².
        """
        node = self.place.node
        of_turn = variance_between(self.turned.tau, self.turned.span)[0, :, None]
        of_value, _, of_rate = variance_between(self.place.tau, self.place.span)[..., None]
        turning, moving = density[self.turned.node, :3], density[node, 3:]
        axes = np.stack([self.motion.nRb, nRt[node], nRt[node]], axis=1)
        variance = np.stack([of_turn * turning, of_value * moving, of_rate * moving], axis=1)
        return np.asarray((axes * variance[:, :, None, :]) @ axes.swapaxes(2, 3))


def interpolated(turns: Turns, states: SmoothStates, place: Place, turned: Place) -> Between:
    """Return the motion at M times between nodes.

    The position's derivative in time is the velocity, and that of the attitude the rate.

    Parameters
    ----------
    turns : Turns
        Turns of the states.
    states : SmoothStates
        States at the nodes.
    place, turned : Place
        Where position and velocity are wanted between their nodes, and attitude and rate between
        theirs, which may be others.
    """
    node, own = place.node, turned.node
    weights = _hermite(place)[..., None]
    turn = np.stack([turns.phi[own], turns.rate[own], turns.start[own]])
    move = np.stack(
        [states.p_n[node + 1] - states.p_n[node], states.v_n[node + 1], states.v_n[node]]
    )
    of_turn = _hermite(turned)[..., None]
    gamma, rate, rate_of_rate = (of_turn * turn).sum(axis=1)
    shift, v_n, a_n = (weights * move).sum(axis=1)
    right = _Function(_RIGHT, gamma)
    motion = Motion(
        nRb=states.nRb[own] @ exp_so3(gamma),
        p_n=states.p_n[node] + shift,
        v_n=v_n,
        omega_eb_b=right.times(rate),
        a_n=a_n,
        alpha_b=right.times(rate_of_rate) + right.derivative_times(rate, rate),
        omega_sigma=np.zeros_like(rate),
    )
    return Between(place, turned, motion, gamma, rate, states, turns)


def variance_between(tau: Array, span: Array) -> Array:
    """Return variance of a value, covariance with its rate, and variance of that, (3, M).

    Given both nodes, over the density.

    Parameters
    ----------
    tau, span : ndarray, shape (M,), s
        Times since the node before, and from it to the next.
    """
    inside = np.clip(tau, 0.0, span)
    beyond = tau - inside
    tau, rest = inside, span - inside
    of_both = tau**2 * rest**2 * (rest - tau) / 2.0
    of_rate = tau * rest * (span**2 - 3.0 * tau * rest)
    between = np.stack([tau**3 * rest**3 / 3.0, of_both, of_rate]) / span**3
    far = np.abs(beyond)
    return between + np.stack([far**3 / 3.0, far * beyond / 2.0, far])


def _hermite(place: Place) -> Array:
    """Return weights (3, 3, M) of what changes from node to node, of its rates at end and start.

    Of its value, of its rate, and of the derivative of that. Beyond the nodes the rate stays.
    """
    tau, span = place.tau, place.span
    inside = np.clip(tau, 0.0, span)
    beyond = tau - inside
    tau, s, r = inside, inside / span, 1.0 - inside / span
    value, rate, bend = np.array(
        [
            [s**2 * (3.0 - 2.0 * s), -tau * s * r, tau * r**2],
            [6.0 * s * r / span, s * (3.0 * s - 2.0), r * (1.0 - 3.0 * s)],
            [6.0 * (r - s) / span**2, (6.0 * s - 2.0) / span, (6.0 * s - 4.0) / span],
        ]
    )
    return np.array([value + beyond * rate, rate, bend * (beyond == 0.0)])


def _powers(s: Array, g: Array) -> Array:
    """Return coefficients (n, 2, 2) of s and g in powers of |phi|², with their derivatives."""
    table = np.stack([s, g], axis=1)
    return np.stack([table, np.pad(polyder(table), ((0, 1), (0, 0)))], axis=1)


# Taylor series, exact to 1e-12 up to |phi| = pi; closed forms lose their digits towards no
# rotation. Jr: s = -(1 - cos) / phi², g = (phi - sin) / phi³.
_N, _M = np.arange(12.0), np.arange(24.0)
_RIGHT = _powers(-((-1.0) ** _N) / factorial(2 * _N + 2), (-1.0) ** _N / factorial(2 * _N + 3))
# Jr^-1: s = 1/2, g = (1 - phi/2 cot(phi/2)) / phi².
_INVERSE = _powers(0.5 * (_M == 0), 2.0 * zeta(2 * _M + 2) / (2.0 * np.pi) ** (2 * _M + 2))


class _Function:
    """1 + s [gamma x] + g [gamma x]² of vectors gamma (M, 3): Jr or its inverse."""

    def __init__(self, powers: Array, gamma: Array) -> None:
        self.gamma = gamma
        square = (gamma * gamma).sum(axis=1)
        (self.s, self.g), (self.s_rate, self.g_rate) = polyval(square, powers)[..., None]

    def times(self, y: Array) -> Array:
        """Return the products with vectors y (M, 3)."""
        across = cross(self.gamma, y)
        return np.asarray(y + self.s * across + self.g * cross(self.gamma, across))

    def matrix(self) -> Array:
        """Return the matrices (M, 3, 3)."""
        across = skew(self.gamma)
        return np.asarray(
            IDENTITY + self.s[..., None] * across + self.g[..., None] * (across @ across)
        )

    def derivative(self, y: Array) -> Array:
        """Return the derivatives (M, 3, 3) of the products with y (M, 3) by gamma."""
        across = cross(self.gamma, y)
        along = 2.0 * (self.s_rate * across + self.g_rate * cross(self.gamma, across))
        out = along[:, :, None] * self.gamma[:, None, :] - self.s[..., None] * skew(y)
        twice = skew(across) + skew(self.gamma) @ skew(y)
        return np.asarray(out - self.g[..., None] * twice)

    def derivative_times(self, y: Array, direction: Array) -> Array:
        """Return `derivative` of y times directions (M, 3)."""
        across = cross(self.gamma, y)
        along = 2.0 * (self.s_rate * across + self.g_rate * cross(self.gamma, across))
        out = along * (self.gamma * direction).sum(axis=1, keepdims=True)
        out += self.s * cross(direction, y)
        more = cross(direction, across) + cross(self.gamma, cross(direction, y))
        return np.asarray(out + self.g * more)
