"""The motion between the states of a chain, with its covariance, at any rate."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import (
    BodyAxes,
    exp_so3,
    log_so3,
    rph_from_rotation,
    rph_jacobian,
)
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.imu.propagation import States, attach, motion_at, segment_ends
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.solution import Trajectory

# Rate of trajectories, Hz, whatever the rate of the states. Chosen: resolves a vessel's motion.
TRAJECTORY_RATE = 10.0
# What rounding may add to a time, in periods of that rate. Chosen: far above double precision.
EPOCH_ROUNDING = 1e-6


def trajectory_between(
    seg: Segments,
    states: States,
    P: Array,
    gravity_n: Array,
    frame: LocalFrame,
    body_axes: BodyAxes,
    time: Array,
) -> Trajectory:
    """Return the motion at times between the nodes of a chain.

    Parameters
    ----------
    seg : Segments
        Of K nodes.
    states : States
        At the nodes.
    P : ndarray, shape (K, 9, 9)
        Their covariances, in GTSAM's tangent space.
    gravity_n : ndarray, shape (S, 3)
        `LocalFrame.gravity_without_rotation` along the segments, m/s².
    frame, body_axes : LocalFrame or BodyAxes
        Of the states, and of what is returned.
    time : ndarray, shape (M,), s
        When the motion is wanted.
    """
    motion, fraction, node = _smoothed(seg, states, gravity_n, frame.earth_rate, time)
    lat, lon, height = frame.geodetic(motion.p_n)
    lRn = frame.level_from_tangent(lat, lon)
    nRb = lRn @ motion.nRb
    rph = rph_from_rotation(nRb, body_axes)

    n = seg.node_time.size
    # GTSAM's tangent space is in body axes, which differ from node to node; n does not.
    P_n = P.reshape(n, 3, 3, 3, 3)
    P_n = np.einsum("kia,kxayb,kjb->kxiyj", states.nRb, P_n, states.nRb)
    at = P_n[node] + fraction[:, None, None, None, None] * (P_n[node + 1] - P_n[node])

    def level(i: int) -> Array:
        return lRn @ at[:, i, :, i, :] @ lRn.transpose(0, 2, 1)

    to_rph = rph_jacobian(rph, body_axes) @ nRb.transpose(0, 2, 1)
    return Trajectory(
        time=time,
        geodetic=np.stack([lat, lon, height], axis=1),
        velocity=rotate(lRn, motion.v_n),
        rph=rph,
        position_cov=level(1),
        velocity_cov=level(2),
        rph_cov=to_rph @ level(0) @ to_rph.transpose(0, 2, 1),
    )


def epochs_between(start: float, end: float, rate_hz: float) -> Array:
    """Return the multiples of 1 / rate after a time and up to another, s."""
    first, last = np.floor(np.array([start, end]) * rate_hz + EPOCH_ROUNDING)
    return np.asarray(np.arange(first + 1.0, last + 1.0) / rate_hz + 0.0)


def _smoothed(
    seg: Segments, states: States, gravity_n: Array, earth_rate_n: Array, time: Array
) -> tuple[Motion, Array, np.ndarray]:
    """Return the motion between the nodes, carried forward and closed onto the node after.

    What the IMU is off at the next node is its noise over the segment; it is spread in
    proportion to time.
    """
    at = attach(seg, time, earth_rate_n)
    motion = motion_at(at, states, gravity_n, earth_rate_n)
    ends = motion_at(segment_ends(seg, earth_rate_n), states, gravity_n, earth_rate_n)
    after = seg.origin + 1
    fraction = np.clip(at.tau / seg.duration[at.segment], 0.0, 1.0)
    part = fraction[:, None]
    closing = log_so3(states.nRb[after] @ ends.nRb.transpose(0, 2, 1))
    closed = Motion(
        nRb=exp_so3(part * closing[at.segment]) @ motion.nRb,
        p_n=motion.p_n + part * (states.p_n[after] - ends.p_n)[at.segment],
        v_n=motion.v_n + part * (states.v_n[after] - ends.v_n)[at.segment],
        omega_eb_b=motion.omega_eb_b,
        a_n=motion.a_n,
        alpha_b=motion.alpha_b,
        omega_sigma=motion.omega_sigma,
    )
    return closed, fraction, at.node
