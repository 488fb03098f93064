"""Increments to preintegrated segments between nodes, and to the motion within them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, cross, rotate, skew
from factorgraph_dvl.imu.increments import Increments, IntArray
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.sensors.protocol import Motion

# Velocity noise that GTSAM adds to the position; only to keep its covariance regular.
_INTEGRATION_ROOT_PSD = 1e-7


@dataclass(frozen=True)
class States:
    """Navigation states and IMU biases at the K nodes.

    Parameters
    ----------
    nRb : ndarray, shape (K, 3, 3)
    p_n, v_n : ndarray, shape (K, 3)
    gyro_bias, accel_bias : ndarray, shape (K, 3), SI
    """

    nRb: Array
    p_n: Array
    v_n: Array
    gyro_bias: Array
    accel_bias: Array


@dataclass(frozen=True)
class Segments:
    """The chain: nodes, the segments between them, and increments since each segment's start.

    Parameters
    ----------
    increments : Increments
    node_time : ndarray, shape (K,), s
    first, last : ndarray of int, shape (S,)
        First and last-plus-one interval of each segment.
    origin : ndarray of int, shape (S,)
        Node at the start of each segment; the node at its end is the next one.
    arc_nodes : ndarray of int, shape (A, 2)
        First and last node of each arc.
    phi, dv : ndarray, shape (N, 3)
        Increments over the intervals.
    dR : ndarray, shape (N, 3, 3)
    dV, dP : ndarray, shape (N, 3)
        Since the segment's start, at the start of each interval, in the axes at the segment's
        start.
    dA : ndarray, shape (N, 3, 3), s
        Integral of dR.
    """

    increments: Increments
    node_time: Array
    first: IntArray
    last: IntArray
    origin: IntArray
    arc_nodes: IntArray
    phi: Array
    dv: Array
    dR: Array
    dV: Array
    dP: Array
    dA: Array

    @property
    def duration(self) -> Array:
        """Length of the segments, (S,), s."""
        return self.node_time[self.origin + 1] - self.node_time[self.origin]

    def totals(self) -> tuple[Array, Array, Array]:
        """Return dR (S, 3, 3), dV, dP (S, 3) over whole segments."""
        i = self.last - 1
        dt = self.increments.dt[i][:, None]
        turned = rotate(self.dR[i], self.dv[i])
        return (
            self.dR[i] @ exp_so3(self.phi[i]),
            self.dV[i] + turned,
            self.dP[i] + self.dV[i] * dt + 0.5 * turned * dt,
        )


def segments(inc: Increments, interval: float, epochs: Array | None = None) -> Segments:
    """Divide the arcs into segments of about `interval` seconds and integrate over each.

    Parameters
    ----------
    inc : Increments
    interval : float
        Length of the segments, s.
    epochs : ndarray, shape (M,), optional
        Times, s, of which each has a node at most a sample before it; the segments between them
        are no longer than `interval`. None: no such times.
    """
    first, last, origin, arc_nodes, node_time = [], [], [], [], []
    n_nodes = 0
    for a, b in inc.arcs:
        length = inc.start[b - 1] + inc.dt[b - 1] - inc.start[a]
        if epochs is None:
            pieces = max(round(length / interval), 1)
            targets = inc.start[a] + length * np.arange(1, pieces) / pieces
            inner = a + _nearest(inc.start[a:b], targets)
        else:
            index, _, covered = inc.locate(epochs)
            wanted = index[covered & (index >= a) & (index < b)]
            edges = np.append(inc.start[a:b], inc.end[b - 1])
            inner = a + _filled(np.unique(np.append(wanted - a, [0, b - a])), edges, interval)
        cuts = np.unique(np.concatenate([[a], inner, [b]]))
        first.append(cuts[:-1])
        last.append(cuts[1:])
        origin.append(n_nodes + np.arange(cuts.size - 1))
        node_time.append(np.append(inc.start[cuts[:-1]], inc.start[b - 1] + inc.dt[b - 1]))
        arc_nodes.append((n_nodes, n_nodes + cuts.size - 1))
        n_nodes += cuts.size
    i0, i1 = np.concatenate(first), np.concatenate(last)
    n = inc.start.size
    phi, dv = inc.over(np.arange(n))
    turn = exp_so3(phi)
    left = np.eye(3) + 0.5 * skew(phi)
    dR, dA = np.empty((n, 3, 3)), np.empty((n, 3, 3))
    dV, dP = np.empty((n, 3)), np.empty((n, 3))
    R, A = np.tile(np.eye(3), (i0.size, 1, 1)), np.zeros((i0.size, 3, 3))
    V, P = np.zeros((i0.size, 3)), np.zeros((i0.size, 3))
    for j in range(int((i1 - i0).max())):
        live = i0 + j < i1
        i = i0[live] + j
        dt = inc.dt[i][:, None]
        r = R[live]
        dR[i], dV[i], dP[i], dA[i] = r, V[live], P[live], A[live]
        turned = rotate(r, dv[i])
        P[live] += V[live] * dt + 0.5 * turned * dt
        V[live] += turned
        A[live] += np.matmul(r, left[i]) * dt[:, :, None]
        R[live] = np.matmul(r, turn[i])
    return Segments(
        increments=inc,
        node_time=np.concatenate(node_time),
        first=i0,
        last=i1,
        origin=np.concatenate(origin),
        arc_nodes=np.array(arc_nodes),
        phi=phi,
        dv=dv,
        dR=dR,
        dV=dV,
        dP=dP,
        dA=dA,
    )


def one_segment(inc: Increments, first: int, last: int) -> Segments:
    """Return intervals [first, last) of a single arc as a chain of two nodes.

    Increments outside them stay zero.
    """
    n, inside = inc.start.size, np.arange(first, last)
    phi, dv = np.zeros((n, 3)), np.zeros((n, 3))
    phi[inside], dv[inside] = inc.over(inside)
    turn = exp_so3(phi[inside])
    dR = np.zeros((n, 3, 3))
    R = np.eye(3)
    for i, step in zip(inside.tolist(), turn, strict=True):
        dR[i] = R
        R = R @ step
    dt = inc.dt[inside, None]
    turned = rotate(dR[inside], dv[inside])
    swept = dR[inside] @ (np.eye(3) + 0.5 * skew(phi[inside])) * dt[:, :, None]
    dV, dP, dA = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3, 3))
    dV[first + 1 : last] = np.cumsum(turned[:-1], axis=0)
    dA[first + 1 : last] = np.cumsum(swept[:-1], axis=0)
    dP[first + 1 : last] = np.cumsum((dV[inside] * dt + 0.5 * turned * dt)[:-1], axis=0)
    return Segments(
        increments=inc,
        node_time=np.array([inc.start[first], inc.start[last - 1] + inc.dt[last - 1]]),
        first=np.array([first]),
        last=np.array([last]),
        origin=np.array([0]),
        arc_nodes=np.array([[0, 1]]),
        phi=phi,
        dv=dv,
        dR=dR,
        dV=dV,
        dP=dP,
        dA=dA,
    )


def _filled(cuts: IntArray, edges: Array, interval: float) -> IntArray:
    """Return cuts with others between them wherever they are more than `interval` apart."""
    out = [cuts]
    for i in np.flatnonzero(np.diff(edges[cuts]) > 1.5 * interval).tolist():
        begin, end = edges[cuts[i]], edges[cuts[i + 1]]
        pieces = round((end - begin) / interval)
        targets = begin + (end - begin) * np.arange(1, pieces) / pieces
        out.append(_nearest(edges, targets))
    return np.concatenate(out)


def _nearest(grid: Array, targets: Array) -> IntArray:
    right = np.clip(np.searchsorted(grid, targets), 1, grid.size - 1)
    return np.where(targets - grid[right - 1] < grid[right] - targets, right - 1, right)


def preintegrate(
    seg: Segments, settings: ImuSettings, gravity_n: Array, earth_rate_n: Array
) -> list[gtsam.PreintegratedImuMeasurementsG]:
    """Return GTSAM's preintegrated measurements of all segments.

    The increments go in as the constant rate and force that give them exactly in GTSAM's
    Galilean preintegration. Its default kind integrates in the tangent space with an
    error of first order in the sample time: 1 deg/h on a rolling, turning vessel at
    1 kHz.

    Parameters
    ----------
    seg : Segments
    settings : ImuSettings
        Noise of the IMU.
    gravity_n : ndarray, shape (S, 3)
        `LocalFrame.gravity_without_rotation` along the segments, m/s².
    earth_rate_n : ndarray, shape (3,), rad/s
    """
    inc = seg.increments
    dt = inc.dt[:, None]
    rate = seg.phi / dt
    mean_force = seg.dv / dt
    once = cross(seg.phi, mean_force)
    force = mean_force - once / 2.0 + cross(seg.phi, once) / 12.0
    rates, forces, steps = list(rate), list(force), inc.dt.tolist()
    gyro_psd = settings.gyro_noise_root_psd**2 * np.eye(3)
    accel_psd = settings.accel_noise_root_psd**2 * np.eye(3)
    integration_psd = _INTEGRATION_ROOT_PSD**2 * np.eye(3)
    is_open = np.any(inc.open_sigma > 0.0, axis=1)
    out = []
    for s in range(seg.first.size):
        a, b = int(seg.first[s]), int(seg.last[s])
        params = gtsam.PreintegrationParams(gravity_n[s])
        params.setOmegaCoriolis(earth_rate_n)
        params.setIntegrationCovariance(integration_psd)
        extra_gyro, extra_accel = 0.0, 0.0
        if np.any(is_open[a:b]):
            extra = (inc.open_sigma[a:b] * inc.dt[a:b, None]) ** 2
            extra_gyro = extra[:, :3].sum() / seg.duration[s]
            extra_accel = extra[:, 3:].sum() / seg.duration[s]
        params.setGyroscopeCovariance(gyro_psd + extra_gyro * np.eye(3))
        params.setAccelerometerCovariance(accel_psd + extra_accel * np.eye(3))
        pim = gtsam.PreintegratedImuMeasurementsG(params)
        add = pim.integrateMeasurement
        for i in range(a, b):
            add(forces[i], rates[i], steps[i])
        out.append(pim)
    return out


@dataclass(frozen=True)
class Attachment:
    """Where M measurement times hang on the chain, and the increments up to them.

    Parameters
    ----------
    segment : ndarray of int, shape (M,)
        Segment.
    node : ndarray of int, shape (M,)
        Node at its start.
    tau : ndarray, shape (M,), s
        Time since that node.
    dR, dA : ndarray, shape (M, 3, 3)
    dV, dP : ndarray, shape (M, 3)
        Increments up to the time.
    gyro, alpha, force : ndarray, shape (M, 3)
        Rate (rad/s), its derivative, specific force at the time.
    omega_sigma : ndarray, shape (M, 3), rad/s
        Standard deviation of the rate.
    alpha_sigma, force_sigma : ndarray, shape (M,)
        Standard deviation of alpha and force from noise.
    turn : ndarray, shape (M, 3, 3)
        Exp(-earth_rate tau).
    """

    segment: IntArray
    node: IntArray
    tau: Array
    dR: Array
    dA: Array
    dV: Array
    dP: Array
    gyro: Array
    alpha: Array
    force: Array
    omega_sigma: Array
    alpha_sigma: Array
    force_sigma: Array
    turn: Array


def attach(seg: Segments, time: Array, earth_rate_n: Array) -> Attachment:
    """Attach times (M,), all covered by arcs, to the chain."""
    index, since, _ = seg.increments.locate(time)
    # A time on the edge of the chain may be off it by rounding.
    inside = np.clip(index, seg.first[0], seg.last[-1] - 1)
    since = np.where(inside == index, since, time - seg.increments.start[inside])
    return _attach(seg, inside, since, earth_rate_n)


def segment_ends(seg: Segments, earth_rate_n: Array) -> Attachment:
    """Attach the ends of all segments to the nodes at their starts."""
    index = seg.last - 1
    return _attach(seg, index, seg.increments.dt[index], earth_rate_n)


def _attach(seg: Segments, index: IntArray, since: Array, earth_rate_n: Array) -> Attachment:
    inc = seg.increments
    part = inc.partial(index, since)
    segment = np.searchsorted(seg.first, index, side="right") - 1
    node = seg.origin[segment]
    dR = seg.dR[index]
    turned = rotate(dR, part.dv)
    h = since[:, None]
    tau = inc.start[index] + since - seg.node_time[node]
    return Attachment(
        segment=segment,
        node=node,
        tau=tau,
        dR=dR @ exp_so3(part.phi),
        dA=seg.dA[index] + dR @ (np.eye(3) + 0.5 * skew(part.phi)) * h[:, :, None],
        dV=seg.dV[index] + turned,
        dP=seg.dP[index] + seg.dV[index] * h + 0.5 * turned * h,
        gyro=part.omega,
        alpha=part.alpha,
        force=part.force,
        omega_sigma=part.omega_sigma,
        alpha_sigma=part.alpha_sigma,
        force_sigma=part.force_sigma,
        turn=exp_so3(-tau[:, None] * earth_rate_n),
    )


@dataclass(frozen=True)
class Transition:
    """Derivatives of the motion at M times with respect to the node before.

    The node's tangent space is GTSAM's: theta in nRb Exp(theta), and position and
    velocity in body axes. A block is computed when a sensor asks for it. What is left out is
    of second order in the Earth's rate, or below 1e-4 of the bias's share.

    Parameters
    ----------
    at : Attachment
        Attachment of the M times.
    states : States
        At the nodes.
    motion : Motion
        At the times.
    earth_rate_n : ndarray, shape (3,), rad/s
    """

    at: Attachment
    states: States
    motion: Motion
    earth_rate_n: Array

    @cached_property
    def _turned(self) -> Array:
        return self.at.turn @ self.states.nRb[self.at.node]

    @cached_property
    def _increments(self) -> tuple[Array, Array, Array]:
        k = self.at.node
        return _with_bias(self.at, self.states.gyro_bias[k], self.states.accel_bias[k])

    @cached_property
    def _cross_rate(self) -> Array:
        return skew(self.earth_rate_n)

    @property
    def _tau(self) -> Array:
        return self.at.tau[:, None, None]

    @cached_property
    def theta_theta(self) -> Array:
        """Attitude by attitude, (M, 3, 3)."""
        return self._increments[0].transpose(0, 2, 1)

    @cached_property
    def theta_gyro(self) -> Array:
        """Attitude by gyro bias."""
        return -self.theta_theta @ self.at.dA

    @cached_property
    def omega_theta(self) -> Array:
        """Rate relative to the Earth by attitude at the time; by gyro bias it is -I."""
        return -skew(rotate(self.motion.nRb.transpose(0, 2, 1), self.earth_rate_n))

    @cached_property
    def p_theta(self) -> Array:
        """Position by attitude."""
        return -self._turned @ skew(self._increments[2])

    @cached_property
    def p_p(self) -> Array:
        """Position by position."""
        R = self.states.nRb[self.at.node]
        return self._turned + self._tau * (self.at.turn @ (self._cross_rate @ R))

    @cached_property
    def p_v(self) -> Array:
        """Position by velocity."""
        return self._tau * self._turned

    @cached_property
    def p_gyro(self) -> Array:
        """Position by gyro bias."""
        return self.v_gyro * (self._tau / 3.0)

    @cached_property
    def p_accel(self) -> Array:
        """Position by accelerometer bias."""
        return self.v_accel * (self._tau / 2.0)

    @cached_property
    def v_theta(self) -> Array:
        """Velocity by attitude."""
        return -self._turned @ skew(self._increments[1]) - self._cross_rate @ self.p_theta

    @cached_property
    def v_v(self) -> Array:
        """Velocity by velocity."""
        return self._turned - self._cross_rate @ self.p_v

    @cached_property
    def v_gyro(self) -> Array:
        """Velocity by gyro bias, for force and rate constant since the node."""
        return self._turned @ (0.5 * skew(self.at.dV) @ self.at.dA)

    @cached_property
    def v_accel(self) -> Array:
        """Velocity by accelerometer bias."""
        return -self._turned @ self.at.dA


def motion_at(at: Attachment, states: States, gravity_n: Array, earth_rate_n: Array) -> Motion:
    """Return the motion at attached times, carried forward from the nodes before.

    Motion over a rotating Earth in closed form: in axes that keep their direction in
    space while they follow the origin of n, with position p_J and velocity
    v_J = v + w x p at the node,

        p_J(tau) = p_J + v_J tau + nRb dP + g tau²/2 + w x g tau³/6
        p(tau)   = Exp(-w tau) p_J(tau),   v(tau) = Exp(-w tau) v_J(tau) - w x p(tau)
        nRb(tau) = Exp(-w tau) nRb dR.

    Parameters
    ----------
    at : Attachment
        Attachment of M times.
    states : States
        At the K nodes.
    gravity_n : ndarray, shape (S, 3)
        `LocalFrame.gravity_without_rotation` along the segments, m/s².
    earth_rate_n : ndarray, shape (3,), rad/s
        W.
    """
    k = at.node
    R, p, v = states.nRb[k], states.p_n[k], states.v_n[k]
    bg, ba = states.gyro_bias[k], states.accel_bias[k]
    g = gravity_n[at.segment]
    w = earth_rate_n
    tau = at.tau[:, None]
    dR, dV, dP = _with_bias(at, bg, ba)
    v_J = v + cross(w, p)
    wg = cross(w, g)
    p_end = rotate(
        at.turn, p + v_J * tau + rotate(R, dP) + g * (tau**2 / 2.0) + wg * (tau**3 / 6.0)
    )
    v_end = rotate(at.turn, v_J + rotate(R, dV) + g * tau + wg * (tau**2 / 2.0))
    v_end = v_end - cross(w, p_end)
    nRb = at.turn @ R @ dR
    a_n = rotate(nRb, at.force - ba) + g - 2.0 * cross(w, v_end) - cross(w, cross(w, p_end))
    return Motion(
        nRb=nRb,
        p_n=p_end,
        v_n=v_end,
        omega_eb_b=at.gyro - bg - rotate(nRb.transpose(0, 2, 1), np.broadcast_to(w, v.shape)),
        a_n=a_n,
        alpha_b=at.alpha,
        omega_sigma=at.omega_sigma,
    )


def extrapolated(motion: Motion, late: float) -> Motion:
    """Return a motion `late` seconds later, to first order in all that changes.

    Smooth in time where the increments are as rough as the noise of the samples: so a time
    offset has a minimum to converge to.
    """
    omega = motion.omega_eb_b + motion.alpha_b * late
    mean_rate = 0.5 * (motion.omega_eb_b + omega)
    return replace(
        motion,
        nRb=motion.nRb @ exp_so3(mean_rate * late),
        p_n=motion.p_n + motion.v_n * late + 0.5 * motion.a_n * late**2,
        v_n=motion.v_n + motion.a_n * late,
        omega_eb_b=omega,
    )


def _with_bias(at: Attachment, bg: Array, ba: Array) -> tuple[Array, Array, Array]:
    """Return dR, dV, dP corrected to first order for the biases."""
    turned = rotate(at.dA, bg)
    v_gyro = 0.5 * cross(at.dV, turned)
    v_accel = rotate(at.dA, ba)
    tau = at.tau[:, None]
    return (
        at.dR @ exp_so3(-rotate(at.dR.transpose(0, 2, 1), turned)),
        at.dV + v_gyro - v_accel,
        at.dP + v_gyro * (tau / 3.0) - 0.5 * tau * v_accel,
    )
