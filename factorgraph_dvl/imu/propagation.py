"""Motion at any time: carried forward from the node before, and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.geometry.records import concatenated
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import IDENTITY, Array, IntArray, cross, rotate, skew
from factorgraph_dvl.imu.between_samples import between_samples
from factorgraph_dvl.imu.increments import Partial
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.sensors.protocol import Linearization, Motion

# Times that are attached at once. Chosen: some ten megabytes.
_CHUNK = 16_000


@dataclass(frozen=True)
class States:
    """Navigation states and IMU biases at the K nodes.

    Parameters
    ----------
    nRb : ndarray, shape (K, 3, 3)
        Attitude, body to n.
    p_n, v_n : ndarray, shape (K, 3)
        Position and Earth-relative velocity in n, m, m/s.
    gyro_bias, accel_bias : ndarray, shape (K, 3)
        Biases in body, rad/s, m/s².
    """

    nRb: Array
    p_n: Array
    v_n: Array
    gyro_bias: Array
    accel_bias: Array


@dataclass(frozen=True, eq=False)
class Attachment:
    """Where M measurement times are attached to the chain, and the increments up to them.

    Parameters
    ----------
    segment : ndarray of int, shape (M,)
        Segment.
    node : ndarray of int, shape (M,)
        Node at its start.
    tau : ndarray, shape (M,), s
        Time since that node.
    dR, dA : ndarray, shape (M, 3, 3)
        Rotation up to the time, and its integral, s.
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
    rough, moving : ndarray, shape (M, 3), optional
        Rates at which attitude and position change, less gyro and dV, rad/s in the axes at the
        time, and m/s in those at the node.
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
    rough: Array | None = None
    moving: Array | None = None


def attach(seg: Segments, time: Array, earth_rate_n: Array, *, rates: bool = True) -> Attachment:
    """Attach times (M,), all covered by arcs, to the chain; without `rates` these are zero."""
    return _attach(seg, *_inside(seg, time), earth_rate_n, rates=rates)


def attach_smoothly(seg: Segments, time: Array, earth_rate_n: Array) -> tuple[Attachment, Array]:
    """Attach times (M,) so that the motion has a continuous derivative in each of them.

    Returns
    -------
    at : Attachment
        Where the chain is nearest.
    beyond : ndarray, shape (M,), s
        How much later than there each time is: 0 where the chain covers it.
    """
    inc = seg.increments
    index, since = _inside(seg, time)
    inside = np.clip(since, 0.0, inc.dt[index])
    beyond = since - inside
    return _attach(seg, index, inside, earth_rate_n, smoothly=True), beyond


def attach_with_ends(seg: Segments, time: Array, earth_rate_n: Array) -> Attachment:
    """Attach times (M,), and after them the ends of all segments to the nodes at their starts."""
    index, since = _inside(seg, time)
    last = seg.last - 1
    since = np.concatenate([since, seg.increments.dt[last]])
    return _attach(seg, np.concatenate([index, last]), since, earth_rate_n)


def _inside(seg: Segments, time: Array) -> tuple[IntArray, Array]:
    """Return the intervals of the chain that times (M,) are in, and the times since their start.

    A time on the edge of the chain may be off it by rounding.
    """
    index, since, _ = seg.increments.locate(time)
    inside = np.minimum(np.maximum(index, seg.first[0]), seg.last[-1] - 1)
    return inside, np.where(inside == index, since, time - seg.increments.start[inside])


def attach_inside(
    seg: Segments, time: Array, earth_rate_n: Array
) -> tuple[Attachment, NDArray[np.bool_]]:
    """Attach times (M,) to the chain where it is nearest, and return which it covers."""
    inc = seg.increments
    index, since, covered = inc.locate(time)
    nearest = inc.start[index] + np.clip(since, 0.0, inc.dt[index])
    return attach(seg, np.where(covered, time, nearest), earth_rate_n), covered


def segment_ends(seg: Segments, earth_rate_n: Array, *, rates: bool = True) -> Attachment:
    """Attach the ends of all segments to the nodes at their starts; `rates` as of `attach`."""
    index = seg.last - 1
    return _attach(seg, index, seg.increments.dt[index], earth_rate_n, rates=rates)


def _attach(
    seg: Segments,
    index: IntArray,
    since: Array,
    earth_rate_n: Array,
    *,
    rates: bool = True,
    smoothly: bool = False,
) -> Attachment:
    """Attach times `since` seconds after the start of intervals, some at a time."""
    inc, parts = seg.increments, []
    for a in range(0, max(index.size, 1), _CHUNK):
        own = slice(a, a + _CHUNK)
        part = (
            between_samples(inc, index[own], since[own])
            if smoothly
            else inc.partial(index[own], since[own], rates=rates)
        )
        parts.append(_attach_some(seg, index[own], since[own], part, earth_rate_n))
    return parts[0] if len(parts) == 1 else concatenated(parts)


def _attach_some(
    seg: Segments, index: IntArray, since: Array, part: Partial, earth_rate_n: Array
) -> Attachment:
    inc = seg.increments
    segment = seg.first.searchsorted(index, side="right") - 1
    node = seg.origin[segment]
    before = seg.since_start(index)
    dR = before.dR
    turned = rotate(dR, part.dv)
    h = since[:, None]
    tau = inc.start[index] + since - seg.node_time[node]
    turned_by, turn = exp_so3(np.array([part.phi, -tau[:, None] * earth_rate_n]))
    return Attachment(
        segment=segment,
        node=node,
        tau=tau,
        dR=dR @ turned_by,
        dA=before.dA + dR @ (IDENTITY + 0.5 * skew(part.phi)) * h[:, :, None],
        dV=before.dV + turned,
        dP=before.dP + before.dV * h + rotate(dR, part.dp),
        gyro=part.omega,
        alpha=part.alpha,
        force=part.force,
        omega_sigma=part.omega_sigma,
        alpha_sigma=part.alpha_sigma,
        force_sigma=part.force_sigma,
        turn=turn,
        rough=part.rough,
        moving=None if part.moving is None else rotate(dR, part.moving),
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
        States at the nodes.
    motion : Motion
        Motion at the times.
    earth_rate_n : ndarray, shape (3,), rad/s
        Earth rate in n.
    increments : tuple of ndarray, optional
        What `with_bias` returned, if it was asked before.
    """

    at: Attachment
    states: States
    motion: Motion
    earth_rate_n: Array
    increments: tuple[Array, Array, Array] | None = None

    @cached_property
    def turned(self) -> Array:
        """Axes of the node before, carried with the Earth, to n, (M, 3, 3)."""
        return self.at.turn @ self.states.nRb[self.at.node]

    @cached_property
    def moved(self) -> tuple[Array, Array, Array]:
        """Increments without what biases add, as of `with_bias`."""
        return self.increments or with_bias(self.at, self.states)

    @cached_property
    def _cross_rate(self) -> Array:
        return skew(self.earth_rate_n)

    @property
    def _tau(self) -> Array:
        return self.at.tau[:, None, None]

    @cached_property
    def omega_theta(self) -> Array:
        """Rate relative to the Earth by attitude at the time; by gyro bias it is -I."""
        return -skew(rotate(self.motion.nRb.transpose(0, 2, 1), self.earth_rate_n))

    @cached_property
    def p_p(self) -> Array:
        """Position by position."""
        R = self.states.nRb[self.at.node]
        return self.turned + self._tau * (self.at.turn @ (self._cross_rate @ R))


def attitude_jacobian(lin: Linearization, transition: Transition) -> Array | None:
    """Return the derivative by the attitude at the times, that through the rate included.

    None where it is zero; else (M, d, 3).
    """
    if lin.d_omega is None:
        return lin.d_theta
    by_rate = lin.d_omega @ transition.omega_theta
    return by_rate if lin.d_theta is None else lin.d_theta + by_rate


def motion_at(
    at: Attachment,
    states: States,
    gravity_n: Array,
    earth_rate_n: Array,
    increments: tuple[Array, Array, Array] | None = None,
) -> Motion:
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
        States at the K nodes.
    gravity_n : ndarray, shape (S, 3)
        `LocalFrame.gravity_without_rotation` along the segments, m/s².
    earth_rate_n : ndarray, shape (3,), rad/s
        W.
    increments : tuple of ndarray, optional
        What `with_bias` returned, if it was asked before.
    """
    k = at.node
    R, p, v = states.nRb[k], states.p_n[k], states.v_n[k]
    bg, ba = states.gyro_bias[k], states.accel_bias[k]
    dR, dV, dP = increments or with_bias(at, states)
    g = gravity_n[at.segment]
    w = earth_rate_n
    tau = at.tau[:, None]
    # Vectors times this are their products with w.
    by_w = skew(w).T
    v_J = v + p @ by_w
    wg = g @ by_w
    p_end = rotate(
        at.turn, p + v_J * tau + rotate(R, dP) + g * (tau**2 / 2.0) + wg * (tau**3 / 6.0)
    )
    v_end = rotate(at.turn, v_J + rotate(R, dV) + g * tau + wg * (tau**2 / 2.0))
    carried = p_end @ by_w
    v_end = v_end - carried
    nRb = at.turn @ R @ dR
    a_n = rotate(nRb, at.force - ba) + g - (2.0 * v_end + carried) @ by_w
    return Motion(
        nRb=nRb,
        p_n=p_end,
        v_n=v_end,
        omega_eb_b=at.gyro - bg - w @ nRb,
        a_n=a_n,
        alpha_b=at.alpha,
        omega_sigma=at.omega_sigma,
        rough_b=at.rough,
        moving_n=None if at.moving is None else rotate(at.turn, rotate(R, at.moving)),
    )


def extrapolated(motion: Motion, late: Array) -> Motion:
    """Return a motion at times that are later by (M,) s, to first order in all that changes.

    Smooth in time where the increments are as rough as the noise of the samples: so a time
    offset has a minimum to converge to.
    """
    if not late.any():
        return motion
    late = late[:, None]
    omega = motion.omega_eb_b + motion.alpha_b * late
    mean_rate = 0.5 * (motion.omega_eb_b + omega)
    return replace(
        motion,
        nRb=motion.nRb @ exp_so3(mean_rate * late),
        p_n=motion.p_n + motion.v_n * late + 0.5 * motion.a_n * late**2,
        v_n=motion.v_n + motion.a_n * late,
        omega_eb_b=omega,
    )


def with_bias(at: Attachment, states: States) -> tuple[Array, Array, Array]:
    """Return dR (M, 3, 3), dV, dP (M, 3), corrected to first order for the biases."""
    bg, ba = states.gyro_bias[at.node], states.accel_bias[at.node]
    turned = rotate(at.dA, bg)
    v_gyro = 0.5 * cross(at.dV, turned)
    v_accel = rotate(at.dA, ba)
    tau = at.tau[:, None]
    return (
        at.dR @ exp_so3(-rotate(at.dR.transpose(0, 2, 1), turned)),
        at.dV + v_gyro - v_accel,
        at.dP + v_gyro * (tau / 3.0) - 0.5 * tau * v_accel,
    )
