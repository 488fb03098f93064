"""Motion prior of a chain without IMU: white acceleration, and processes of errors beside it.

Without an IMU nothing carries the motion from one state to the next but the inertia of the
vessel: its acceleration is taken as white noise (Barfoot, Tong and Särkkä, Batch continuous-time
trajectory estimation as exactly sparse Gaussian process regression, RSS 2014; Anderson and
Barfoot, Full STEAM ahead, IROS 2015), and the motion between two states follows from both, with a
variance.
Errors that last, of attitudes, fixes and the current, are Gauss-Markov processes of unit variance.

Attitude is no state. A gyrocompass or AHRS says how the body points to a fraction of a degree at
once, and no prior of angular acceleration improves on that. What is not known is its error, which
is slow: that is a process, or a constant with a prior, and turns the velocity that a DVL sees. So
every equation is linear in the states, a ship needs no start values of attitude, and twelve hours
take seconds; as a state, attitude would cost a Lie-group prior for the same result. Rates that
turn lever arms come from the record of attitude, with a standard deviation.

Accelerations of different spans, as of legs and turns, have densities of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.vectors import Array

# Position and velocity.
_MOTION = 6
# Standard deviations of the first state, m and m/s. Chosen: they only keep the chain regular.
_FREE = np.repeat([1e5, 1e2], 3)


@dataclass(frozen=True)
class ChainProcess:
    """A first-order Gauss-Markov process; its states have unit variance.

    Parameters
    ----------
    name : str
        What it is an error of.
    sigma : ndarray, shape (d,)
        Standard deviations of the components, SI.
    tau : float
        Correlation time, s.
    """

    name: str
    sigma: Array
    tau: float


@dataclass(frozen=True)
class Interpolation:
    """State at M times, x = L x_k + U x_k+1 + noise of variance V.

    Of position and velocity L and U are the same along each axis; of processes they are diagonal.

    Parameters
    ----------
    node : ndarray of int, shape (M,)
        K.
    motion_before, motion_after : ndarray, shape (M, 2, 2)
        L and U of position and velocity along an axis.
    motion_variance : ndarray, shape (M, 2, 2, 3)
        V of position and velocity, by axis.
    motion_variance_rate : ndarray, shape (M, 2, 2, 3)
        Its derivative in time.
    acceleration : ndarray, shape (M, 4)
        Derivative of the velocity in time by position and velocity of both nodes.
    process_before, process_after, process_variance : ndarray, shape (M, n - 6)
        Diagonals of L, U and V.
    """

    node: np.ndarray
    motion_before: Array
    motion_after: Array
    motion_variance: Array
    motion_variance_rate: Array
    acceleration: Array
    process_before: Array
    process_after: Array
    process_variance: Array

    def states(self, nodes: Array) -> Array:
        """Return the states (M, n) between those of the nodes, (K, n)."""
        before, after = nodes[self.node], nodes[self.node + 1]
        motion = np.einsum("mij,mjk->mik", self.motion_before, _by_axis(before))
        motion += np.einsum("mij,mjk->mik", self.motion_after, _by_axis(after))
        lasting = self.process_before * before[:, _MOTION:]
        lasting += self.process_after * after[:, _MOTION:]
        return np.concatenate([motion.reshape(-1, _MOTION), lasting], axis=1)

    def accelerations(self, nodes: Array) -> Array:
        """Return the accelerations (M, 3) between the states of the nodes, (K, n)."""
        ends = np.concatenate([nodes[self.node, :_MOTION], nodes[self.node + 1, :_MOTION]], axis=1)
        return np.asarray((self.acceleration[:, None, :] @ ends.reshape(-1, 4, 3))[:, 0])

    def by_nodes(self, by_state: Array) -> tuple[Array, Array]:
        """Return J L and J U, (M, d, n), from derivatives J by the states between."""
        return (
            _times(by_state, self.motion_before, self.process_before),
            _times(by_state, self.motion_after, self.process_after),
        )

    def variance(self, by_state: Array) -> Array:
        """Return J V Jᵀ, (M, d, d), from derivatives J (M, d, n) by the states between."""
        by_noise = _times(by_state, self.motion_variance, self.process_variance)
        return np.asarray(by_noise @ by_state.transpose(0, 2, 1))

    def variance_rate(self, by_state: Array) -> Array:
        """Return the derivative of J V Jᵀ in time, that of processes apart."""
        none = np.zeros_like(self.process_variance)
        by_noise = _times(by_state, self.motion_variance_rate, none)
        return np.asarray(by_noise @ by_state.transpose(0, 2, 1))


@dataclass(frozen=True)
class MotionChain:
    """States at K times: position, velocity, then the processes one after the other.

    Parameters
    ----------
    time : ndarray, shape (K,), s
        Of the nodes.
    density : ndarray, shape (K - 1, 3)
        Power spectral density of the acceleration east, north, up between the nodes, m²/s³.
    processes : tuple of ChainProcess
        Errors that last.
    """

    time: Array
    density: Array
    processes: tuple[ChainProcess, ...] = ()

    @property
    def size(self) -> int:
        """Number of states of a node."""
        return _MOTION + sum(p.sigma.size for p in self.processes)

    def place(self, name: str) -> slice:
        """Return the states of a process."""
        at = _MOTION
        for p in self.processes:
            if p.name == name:
                return slice(at, at + p.sigma.size)
            at += p.sigma.size
        raise KeyError(name)

    def has(self, name: str) -> bool:
        """Whether there is a process of that name."""
        return any(p.name == name for p in self.processes)

    def transitions(self) -> tuple[Array, Array]:
        """Return rows of unit noise, W (x_k+1 - F x_k): W F with its sign, and W, (K - 1, n, n).

        Of the acceleration: F = [1 dt; 0 1], Q = q [dt³/3 dt²/2; dt²/2 dt]; of a process:
        F = exp(-dt / tau), Q = 1 - F².
        """
        dt = np.diff(self.time)
        n = self.size
        before, after = np.zeros((dt.size, n, n)), np.zeros((dt.size, n, n))
        root = 1.0 / np.sqrt(self.density)
        # Inverse of the Cholesky factor of Q / q.
        t = dt[:, None]
        w_pp, w_vp = np.sqrt(3.0 / t**3), -3.0 / np.sqrt(t**3)
        w_vv = 2.0 / np.sqrt(t)
        for i in range(3):
            p, v = i, 3 + i
            r = root[:, i]
            after[:, p, p] = r * w_pp[:, 0]
            after[:, v, p] = r * w_vp[:, 0]
            after[:, v, v] = r * w_vv[:, 0]
            before[:, p, p] = -after[:, p, p]
            before[:, p, v] = -after[:, p, p] * dt
            before[:, v, p] = -after[:, v, p]
            before[:, v, v] = -after[:, v, p] * dt - after[:, v, v]
        at = _MOTION
        for process in self.processes:
            phi = np.exp(-dt / process.tau)
            weight = 1.0 / np.sqrt(-np.expm1(-2.0 * dt / process.tau))
            for i in range(at, at + process.sigma.size):
                after[:, i, i], before[:, i, i] = weight, -phi * weight
            at += process.sigma.size
        return before, after

    def first(self) -> Array:
        """Return the inverse standard deviations of the first node, (n,)."""
        return np.concatenate([1.0 / _FREE, np.ones(self.size - _MOTION)])

    def log_determinant(self) -> float:
        """Return the logarithm of the determinant of the prior information."""
        _, after = self.transitions()
        diagonal = np.diagonal(after, axis1=1, axis2=2)
        return 2.0 * float(np.sum(np.log(diagonal)) + np.sum(np.log(self.first())))

    def covers(self, time: Array) -> np.ndarray:
        """Whether times (M,) lie between the first node and the last."""
        return np.asarray((time >= self.time[0]) & (time <= self.time[-1]))

    def at(self, time: Array, lasting: Array | None = None) -> Interpolation:
        """Return the interpolation to times (M,), s.

        Positions are cubic Hermite polynomials of the nodes, and velocities their derivatives:
        the mean of a white-acceleration prior between two states.

        Parameters
        ----------
        time : ndarray, shape (M,), s
            Of the motion.
        lasting : ndarray, shape (M,), s, optional
            Of the processes, between the same nodes; by default the same.
        """
        k = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, self.time.size - 2)
        span = self.time[k + 1] - self.time[k]
        tau = np.clip(time - self.time[k], 0.0, span)
        s, rest = tau / span, span - tau
        # Variance between known ends, over q.
        v_pp = tau**3 * rest**3 / (3.0 * span**3)
        v_pv = tau**2 * rest**2 * (rest - tau) / (2.0 * span**3)
        v_vv = tau * rest * (span**2 - 3.0 * tau * rest) / span**3
        left = rest - tau
        r_pp = tau**2 * rest**2 * left / span**3
        r_pv = tau * rest * (left**2 - tau * rest) / span**3
        r_vv = left * (span**2 - 6.0 * tau * rest) / span**3
        p_after, v_after = 3.0 * s**2 - 2.0 * s**3, 6.0 * (s - s**2) / span
        before = _blocks(1.0 - p_after, span * s * (1 - s) ** 2, -v_after, 3 * s**2 - 4 * s + 1.0)
        after = _blocks(p_after, -span * s**2 * (1.0 - s), v_after, 3.0 * s**2 - 2.0 * s)
        acceleration = np.stack(
            [
                (12.0 * s - 6.0) / span**2,
                (6.0 * s - 4.0) / span,
                (6.0 - 12.0 * s) / span**2,
                (6.0 * s - 2.0) / span,
            ],
            axis=1,
        )
        if lasting is not None:
            tau = np.clip(lasting - self.time[k], 0.0, span)
            rest = span - tau
        density = self.density[k][:, None, None, :]
        own = np.array([p.tau for p in self.processes])
        size = [p.sigma.size for p in self.processes]
        scaled = [t[:, None] / own for t in (span, tau, rest)]
        whole, since, until = (np.sinh(t) for t in scaled)
        missing = np.expm1(-2.0 * scaled[1]) * np.expm1(-2.0 * scaled[2])
        return Interpolation(
            node=k,
            motion_before=before,
            motion_after=after,
            motion_variance=_blocks(v_pp, v_pv, v_pv, v_vv)[..., None] * density,
            motion_variance_rate=_blocks(r_pp, r_pv, r_pv, r_vv)[..., None] * density,
            acceleration=acceleration,
            process_before=np.repeat(until / whole, size, axis=1),
            process_after=np.repeat(since / whole, size, axis=1),
            process_variance=np.repeat(missing / -np.expm1(-2.0 * scaled[0]), size, axis=1),
        )


def _by_axis(states: Array) -> Array:
    """Return position and velocity (M, 2, 3) of states (M, n)."""
    return states[:, :_MOTION].reshape(-1, 2, 3)


def _blocks(pp: Array, pv: Array, vp: Array, vv: Array) -> Array:
    """Return matrices (M, 2, 2) from their elements (M,)."""
    return np.stack([np.stack([pp, pv], axis=1), np.stack([vp, vv], axis=1)], axis=1)


def _times(J: Array, motion: Array, process: Array) -> Array:
    """Return J (M, d, n) times matrices by axis, (M, 2, 2) or (M, 2, 2, 3), and a diagonal."""
    if motion.ndim == 3:
        motion = motion[..., None]
    motion = np.broadcast_to(motion, (*motion.shape[:3], 3))
    # One product of whole rows: those of three elements take longer.
    out = J * np.concatenate([motion[:, 0, 0], motion[:, 1, 1], process], axis=1)[:, None]
    out[:, :, :3] += J[:, :, 3:_MOTION] * motion[:, None, 1, 0]
    out[:, :, 3:_MOTION] += J[:, :, :3] * motion[:, None, 0, 1]
    return np.asarray(out)


def chain_nodes(time: Array, turning: Sequence[bool] | np.ndarray, interval: float) -> Array:
    """Return times of nodes: some of given times (M,), all of them where the body turns.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Where nodes may be, in order.
    turning : sequence of bool
        Whether the body turns there.
    interval : float
        Least time between nodes where it does not, s.
    """
    kept = [0]
    for i in range(1, time.size):
        if turning[i] or time[i] - time[kept[-1]] >= interval:
            kept.append(i)
    if kept[-1] != time.size - 1:
        kept.append(time.size - 1)
    return np.asarray(time[kept])
