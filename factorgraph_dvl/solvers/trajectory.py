"""The motion between the states of a chain, with its covariance, at any rate."""

from __future__ import annotations

from dataclasses import fields, replace

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
# Times whose motion is found at once. Chosen: some ten megabytes.
_CHUNK = 8192


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
    closing = _closing(seg, states, gravity_n, frame.earth_rate)
    # GTSAM's tangent space is in body axes, which differ from node to node; n does not.
    blocks = np.stack([P[:, i : i + 3, i : i + 3] for i in (0, 3, 6)], axis=1)
    R = states.nRb[:, None]
    P_n = R @ blocks @ R.transpose(0, 1, 3, 2)

    def part(time: Array) -> Trajectory:
        motion, fraction, node = _smoothed(seg, states, closing, gravity_n, frame.earth_rate, time)
        lat, lon, height = frame.geodetic(motion.p_n)
        lRn = frame.level_from_tangent(lat, lon)
        nRb = lRn @ motion.nRb
        rph = rph_from_rotation(nRb, body_axes)
        at = P_n[node] + fraction[:, None, None, None] * (P_n[node + 1] - P_n[node])
        of_attitude, of_position, of_velocity = (
            lRn @ at[:, i] @ lRn.transpose(0, 2, 1) for i in range(3)
        )
        to_rph = rph_jacobian(rph, body_axes) @ nRb.transpose(0, 2, 1)
        return Trajectory(
            time=time,
            geodetic=np.stack([lat, lon, height], axis=1),
            velocity=rotate(lRn, motion.v_n),
            rph=rph,
            position_cov=of_position,
            velocity_cov=of_velocity,
            rph_cov=to_rph @ of_attitude @ to_rph.transpose(0, 2, 1),
        )

    parts = [part(time[i : i + _CHUNK]) for i in range(0, max(time.size, 1), _CHUNK)]
    if len(parts) == 1:
        return parts[0]
    columns = {f.name: [getattr(each, f.name) for each in parts] for f in fields(Trajectory)}
    return Trajectory(**{name: np.concatenate(each) for name, each in columns.items()})


def epochs_between(start: float, end: float, rate_hz: float) -> Array:
    """Return the multiples of 1 / rate after a time and up to another, s."""
    first, last = np.floor(np.array([start, end]) * rate_hz + EPOCH_ROUNDING)
    return np.asarray(np.arange(first + 1.0, last + 1.0) / rate_hz + 0.0)


def _closing(
    seg: Segments, states: States, gravity_n: Array, earth_rate_n: Array
) -> tuple[Array, Array, Array]:
    """Return what the motion is off at the ends of segments: rotation vector, position, velocity.

    It is the noise of the IMU over the segment.
    """
    ends = motion_at(segment_ends(seg, earth_rate_n), states, gravity_n, earth_rate_n)
    after = seg.origin + 1
    return (
        log_so3(states.nRb[after] @ ends.nRb.transpose(0, 2, 1)),
        states.p_n[after] - ends.p_n,
        states.v_n[after] - ends.v_n,
    )


def _smoothed(
    seg: Segments,
    states: States,
    closing: tuple[Array, Array, Array],
    gravity_n: Array,
    earth_rate_n: Array,
    time: Array,
) -> tuple[Motion, Array, np.ndarray]:
    """Return the motion between the nodes, carried forward and closed onto the node after.

    What it is off there is spread in proportion to time.
    """
    at = attach(seg, time, earth_rate_n)
    motion = motion_at(at, states, gravity_n, earth_rate_n)
    fraction = np.clip(at.tau / seg.duration[at.segment], 0.0, 1.0)
    turn, shift, change = (fraction[:, None] * each[at.segment] for each in closing)
    closed = replace(
        motion,
        nRb=exp_so3(turn) @ motion.nRb,
        p_n=motion.p_n + shift,
        v_n=motion.v_n + change,
    )
    return closed, fraction, at.node
