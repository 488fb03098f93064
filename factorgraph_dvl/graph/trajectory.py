"""The motion between the states of a chain, with its covariance, at any rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.records import concatenated, rows_of
from factorgraph_dvl.geometry.rotations import (
    BodyAxes,
    exp_so3,
    log_so3,
    rph_from_rotation,
    rph_jacobian,
)
from factorgraph_dvl.geometry.vectors import Array, IntArray, rotate
from factorgraph_dvl.graph.chain import ChainStates
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.imu.propagation import (
    Attachment,
    States,
    attach,
    attach_with_ends,
    motion_at,
    segment_ends,
)
from factorgraph_dvl.sensors.protocol import Motion

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
        Segments of K nodes.
    states : States
        States at the nodes.
    P : ndarray, shape (K, 9, 9)
        Their covariances, in GTSAM's tangent space.
    gravity_n : ndarray, shape (S, 3)
        `LocalFrame.gravity_without_rotation` along the segments, m/s².
    frame, body_axes : LocalFrame or BodyAxes
        Frame and axes of the states, and of what is returned.
    time : ndarray, shape (M,), s
        When the motion is wanted.
    """
    last = segment_ends(seg, frame.earth_rate, rates=False)
    ends = motion_at(last, states, gravity_n, frame.earth_rate)
    closing = _closing(ends, states, seg.origin + 1)
    P_n = tangent_in_n(P, states.nRb)

    def part(time: Array) -> Trajectory:
        at = attach(seg, time, frame.earth_rate, rates=False)
        motion = motion_at(at, states, gravity_n, frame.earth_rate)
        fraction = np.clip(at.tau / seg.duration[at.segment], 0.0, 1.0)
        motion = _closed(motion, fraction, at.segment, closing)
        return reported(time, motion, between(P_n, at.node, fraction), frame, body_axes)

    parts = [part(time[i : i + _CHUNK]) for i in range(0, max(time.size, 1), _CHUNK)]
    return parts[0] if len(parts) == 1 else concatenated(parts)


def epochs_between(start: float, end: float, rate_hz: float) -> Array:
    """Return the multiples of 1 / rate after a time and up to another, s."""
    first, last = (math.floor(time * rate_hz + EPOCH_ROUNDING) for time in (start, end))
    return np.asarray(np.arange(first + 1, last + 1) / rate_hz)


@dataclass(frozen=True)
class Epochs:
    """Times in successive segments of a chain, and their ends, attached to the nodes before.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        The times.
    at : Attachment
        Attachment of the M times and the ends of the S segments; node i is the one before
        segment i.
    duration : ndarray, shape (S,), s
        Durations of the segments.
    """

    time: Array
    at: Attachment
    duration: Array


def attached_epochs(
    seg: Segments, time: Array, earth_rate_n: Array, others: Array
) -> tuple[Epochs, Attachment]:
    """Attach times (M,) in a single segment: once, however often the states change.

    Parameters
    ----------
    seg : Segments
        The segment.
    time : ndarray, shape (M,), s
        The times.
    earth_rate_n : ndarray, shape (3,), rad/s
        Earth rate in n.
    others : ndarray, shape (N,), s
        Other times to attach with them.

    Returns
    -------
    epochs : Epochs
        The times, attached.
    at : Attachment
        Attachment of the others.
    """
    at = attach_with_ends(seg, np.concatenate([others, time]), earth_rate_n)
    epochs = Epochs(time, rows_of(at, slice(others.size, None)), seg.duration)
    return epochs, rows_of(at, slice(others.size))


def successive(parts: Sequence[Epochs]) -> Epochs:
    """Return times in single segments that follow each other as those of one chain."""
    if len(parts) == 1:
        return parts[0]
    at = concatenated([part.at for part in parts])
    size = [part.at.tau.size for part in parts]
    number = np.arange(len(parts)).repeat(size)
    at = replace(at, segment=at.segment + number, node=at.node + number)
    ends = np.cumsum(size) - 1
    times = np.delete(np.arange(number.size), ends)
    return Epochs(
        np.concatenate([part.time for part in parts]),
        rows_of(at, np.concatenate([times, ends])),
        np.concatenate([part.duration for part in parts]),
    )


def trajectory_at(
    epochs: Epochs,
    states: States,
    P: Array,
    gravity_n: Array,
    frame: LocalFrame,
    body_axes: BodyAxes,
) -> Trajectory:
    """Return the motion at epochs in S segments between S + 1 nodes.

    Parameters
    ----------
    epochs : Epochs
        When the motion is wanted.
    states, P, gravity_n, frame, body_axes : optional
        The same as for `trajectory_between`.
    """
    motion = motion_at(epochs.at, states, gravity_n, frame.earth_rate)
    count, size = epochs.time.size, epochs.duration.size
    closing = _closing(rows_of(motion, slice(count, None)), states, np.arange(size) + 1)
    segment = epochs.at.segment[:count]
    fraction = np.clip(epochs.at.tau[:count] / epochs.duration[segment], 0.0, 1.0)
    motion = _closed(rows_of(motion, slice(count)), fraction, segment, closing)
    covariance = between(tangent_in_n(P, states.nRb), segment, fraction)
    return reported(epochs.time, motion, covariance, frame, body_axes)


def _closing(ends: Motion, states: States, after: IntArray) -> tuple[Array, Array, Array]:
    """Return what the motion is off at the ends of segments: rotation vector, position, velocity.

    It is the noise of the IMU over the segment.
    """
    return (
        log_so3(states.nRb[after] @ ends.nRb.transpose(0, 2, 1)),
        states.p_n[after] - ends.p_n,
        states.v_n[after] - ends.v_n,
    )


def _closed(
    motion: Motion, fraction: Array, segment: IntArray, closing: tuple[Array, Array, Array]
) -> Motion:
    """Return a motion carried forward, closed onto the nodes after in proportion to time."""
    turn, shift, change = (fraction[:, None] * each[segment] for each in closing)
    return replace(
        motion,
        nRb=exp_so3(turn) @ motion.nRb,
        p_n=motion.p_n + shift,
        v_n=motion.v_n + change,
    )


def tangent_in_n(P: Array, nRb: Array) -> Array:
    """Return the covariances of attitude, position and velocity in n, (K, 3, 3, 3)."""
    # GTSAM's tangent space is in body axes, which differ from node to node; n does not.
    blocks = np.empty((len(P), 3, 3, 3))
    for i in range(3):
        blocks[:, i] = P[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
    R = nRb[:, None]
    return np.asarray(R @ blocks @ R.transpose(0, 1, 3, 2))


def between(P_n: Array, node: IntArray, fraction: Array) -> Array:
    """Return covariances between those of nodes and of the next, (M, 3, 3, 3)."""
    before = P_n[node]
    return np.asarray(before + fraction[:, None, None, None] * (P_n[node + 1] - before))


def reported(
    time: Array, motion: ChainStates, P_n: Array, frame: LocalFrame, body_axes: BodyAxes
) -> Trajectory:
    """Return a motion with its covariances in the frames of a trajectory."""
    lat, lon, height = frame.geodetic(motion.p_n)
    lRn = frame.level_from_tangent(lat, lon)
    nRb = lRn @ motion.nRb
    rph = rph_from_rotation(nRb, body_axes)
    of_attitude, of_position, of_velocity = (
        lRn @ P_n[:, i] @ lRn.transpose(0, 2, 1) for i in range(3)
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
