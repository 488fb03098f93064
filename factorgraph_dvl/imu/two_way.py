"""Motion between two nodes: carried forward from one and back from the other, and blended.

With the share s = 3 u² - 2 u³ of the node after, u from 0 at the node before to 1,

    nRb = nRb_f Exp(s Log(nRb_fᵀ nRb_b)),    v = v_f + s (v_b - v_f),    p and rate likewise.

At a node s does not change, so value and derivative are those of the motion carried from it, on
both of its sides: a time that moves over a node finds no jump. Both motions differ by what the
noise of the IMU adds up to from node to node; `noise_between` is what is left of it in between.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from weakref import WeakValueDictionary

import numpy as np

from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.vectors import Array, IntArray, cross, rotate
from factorgraph_dvl.imu.preintegration import Integrals, Segments
from factorgraph_dvl.imu.propagation import (
    Attachment,
    States,
    Transition,
    attach_smoothly,
    extrapolated,
    motion_at,
)
from factorgraph_dvl.imu.window_means import Windows, averaged, windows
from factorgraph_dvl.sensors.protocol import Linearization, Motion, Window


@dataclass(frozen=True, eq=False)
class TwoWay:
    """Where M times are attached to both nodes of their segments.

    Parameters
    ----------
    forward, backward : Attachment
        Attachments to the node before, and to the node after: its times and increments are
        negative.
    share, share_rate : ndarray, shape (M,)
        Share s of the motion carried back, and its time derivative, 1/s.
    bend : ndarray, shape (M,), s
        Ratio of s (1 - s) / 2 and the derivative of s, which both vanish at nodes.
    beyond : ndarray, shape (M,), s
        How much later than there each time is, where the chain does not cover it.
    windows : Windows, optional
        Windows about the times, of measurements that are means.
    """

    forward: Attachment
    backward: Attachment
    share: Array
    share_rate: Array
    bend: Array
    beyond: Array
    windows: Windows | None = None

    @property
    def node(self) -> IntArray:
        """Node before each, (M,)."""
        return self.forward.node

    @property
    def segment(self) -> IntArray:
        """Segment of each, (M,)."""
        return self.forward.segment


@dataclass(frozen=True)
class TwoWayTransition:
    """Derivatives of the motion at M times by both nodes.

    Parameters
    ----------
    at : TwoWay
        Attachment of the times.
    motion : Motion
        Motion at the times.
    forward, backward : Transition
        Values of the motions carried from either.
    """

    at: TwoWay
    motion: Motion
    forward: Transition
    backward: Transition


def attach_two_way(
    seg: Segments, time: Array, earth_rate_n: Array, window: Window | None = None
) -> TwoWay:
    """Attach times (M,) to both nodes of their segments; those not covered, where nearest.

    Times that something is still attached to are not attached anew.

    Parameters
    ----------
    seg : Segments
        Increments between the nodes.
    time : ndarray, shape (M,), s
        Times.
    earth_rate_n : ndarray, shape (3,), rad/s
        Earth rate in n.
    window : Window, optional
        Windows about the times, of measurements that are means.
    """
    known = vars(seg).setdefault("_attached", WeakValueDictionary())
    key = time.tobytes(), earth_rate_n.tobytes(), window
    found = known.get(key)
    if found is None:
        found = known[key] = _attached(seg, time, earth_rate_n, window)
    return found


def _attached(seg: Segments, time: Array, earth_rate_n: Array, window: Window | None) -> TwoWay:
    forward, beyond = attach_smoothly(seg, time, earth_rate_n)
    found = None
    if window is not None:
        found = windows(seg.increments, time, window)
        forward = replace(forward, alpha_sigma=found.slope_sigma, force_sigma=found.force_sigma)
    span = seg.duration[forward.segment]
    u = np.clip(forward.tau / span, 0.0, 1.0)
    tau = forward.tau - span
    place = replace(
        forward, node=forward.node + 1, tau=tau, turn=exp_so3(-tau[:, None] * earth_rate_n)
    )
    return TwoWay(
        forward=forward,
        backward=carried_back(seg.ends, forward, place),
        share=u**2 * (3.0 - 2.0 * u),
        share_rate=6.0 * u * (1.0 - u) / span,
        bend=span * u * (1.0 - u) * (3.0 - 2.0 * u) * (1.0 + 2.0 * u) / 12.0,
        beyond=beyond,
        windows=found,
    )


def carried_back(ends: Integrals, forward: Attachment, place: Attachment) -> Attachment:
    """Return increments from the nodes after, in the axes there.

    Parameters
    ----------
    ends : Integrals
        Over all S segments.
    forward : Attachment
        Attachment of M times to the nodes before.
    place : Attachment
        Place to the nodes after, with any increments.
    """
    whole = rows_of(ends, forward.segment)
    back = np.ascontiguousarray(whole.dR.transpose(0, 2, 1))
    return replace(
        place,
        dR=back @ forward.dR,
        dA=back @ (forward.dA - whole.dA),
        dV=rotate(back, forward.dV - whole.dV),
        dP=rotate(back, forward.dP - whole.dP - whole.dV * place.tau[:, None]),
        gyro=forward.gyro,
        alpha=forward.alpha,
        force=forward.force,
        rough=forward.rough,
        moving=None if forward.moving is None else rotate(back, forward.moving),
    )


def motion_two_way(at: TwoWay, states: States, gravity_n: Array, earth_rate_n: Array) -> Motion:
    """Return the motion at attached times; arguments as of `motion_at`."""
    one, other = (
        motion_at(way, states, gravity_n, earth_rate_n) for way in (at.forward, at.backward)
    )
    s, rate = at.share[:, None], at.share_rate[:, None]
    turn = log_so3(one.nRb.transpose(0, 2, 1) @ other.nRb)
    shift, change = other.p_n - one.p_n, other.v_n - one.v_n
    blended = replace(
        one,
        nRb=one.nRb @ exp_so3(s * turn),
        p_n=one.p_n + s * shift,
        v_n=one.v_n + s * change,
        omega_eb_b=one.omega_eb_b + s * (other.omega_eb_b - one.omega_eb_b),
        a_n=one.a_n + s * (other.a_n - one.a_n) + rate * change,
        alpha_b=one.alpha_b + rate * (other.omega_eb_b - one.omega_eb_b),
        turning_b=rate * turn,
        moving_n=rate * shift + (0.0 if one.moving_n is None else one.moving_n),
    )
    motion = extrapolated(blended, at.beyond)
    return motion if at.windows is None else averaged(motion, at.windows, gravity_n[at.segment])


def transition_two_way(
    at: TwoWay, states: States, motion: Motion, earth_rate_n: Array
) -> TwoWayTransition:
    """Return the derivatives of the motion at attached times by both nodes."""
    forward, backward = (
        Transition(way, states, motion, earth_rate_n) for way in (at.forward, at.backward)
    )
    return TwoWayTransition(at, motion, forward, backward)


def shares(
    lin: Linearization, transition: TwoWayTransition
) -> tuple[Linearization, Linearization]:
    """Return derivatives by the motion as those by the motions carried forward and back.

    Of attitudes to first order in the turn phi between both:

        (1 - s) (1 - s/2 [phi x]),    s (1 + (1 - s)/2 [phi x]).
    """
    at, turning = transition.at, transition.motion.turning_b
    share = at.share[:, None, None]
    ahead, behind = (
        {
            name: factor * jacobian
            for name in ("d_theta", "d_p", "d_v", "d_omega")
            if (jacobian := getattr(lin, name)) is not None
        }
        for factor in (1.0 - share, share)
    )
    if lin.d_theta is not None and turning is not None:
        across = cross(lin.d_theta, (at.bend[:, None] * turning)[:, None])
        ahead["d_theta"] -= across
        behind["d_theta"] += across
    return Linearization(lin.residual, **ahead), Linearization(lin.residual, **behind)


def noise_between(at: TwoWay) -> Array:
    """Return the variance (M,), s, that white noise of unit density leaves between the nodes.

    Of its integral W, given W(T) at the node after: of W(tau) - s W(T), with what is expected of
    W(T)² itself.
    """
    tau, span = at.forward.tau, at.forward.tau - at.backward.tau
    return np.asarray(tau * (1.0 - 2.0 * at.share) + at.share**2 * span)


def noise_averaged(at: TwoWay, length: float) -> Array:
    """Return what a window takes from `noise_between`, (M,), s: at most a sixth of its length.

    The mean of W over a window around tau takes the place of W(tau). W continues beyond the nodes.
    Next to one of them a window would have more noise, but the node follows it: that is none.

    Parameters
    ----------
    at : TwoWay
        Attachment of M times.
    length : float, s
        Length of the windows, above 0.
    """
    tau, span = at.forward.tau, at.forward.tau - at.backward.tau
    first, last = tau - 0.5 * length, tau + 0.5 * length
    before, inside = np.maximum(-first, 0.0), np.maximum(first, 0.0)
    square = np.where(
        before > 0.0,
        (before**3 + np.maximum(last, 0.0) ** 3) / (3.0 * length**2),
        inside + length / 3.0,
    )
    # Of the mean and W(T).
    within = np.clip(last, 0.0, span)
    both = (0.5 * (within**2 - inside**2) + span * np.maximum(last - span, 0.0)) / length
    return np.maximum(tau - square - 2.0 * at.share * (tau - both), 0.0)


def noise_curved(at: TwoWay, step: float) -> Array:
    """Return how far noise bends what is between the nodes towards zero, (M,), s.

    That is its covariance with twice itself less what it is a step before and after: its integral
    has a kink there, and is known at the nodes.
    """
    return np.asarray(np.clip(np.minimum(at.forward.tau, -at.backward.tau), 0.0, step))
