"""The motion between states, with its covariance."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
from inertial import constant_segments

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.graph.trajectory import (
    attached_epochs,
    epochs_between,
    successive,
    trajectory_at,
    trajectory_between,
)
from factorgraph_dvl.imu.preintegration import one_segment
from factorgraph_dvl.imu.propagation import States

FRAME = LocalFrame(0.6, 2.0, 0.0)


def chain(heading=0.0):
    """Three seconds at rest on a body that heads somewhere."""
    seg = constant_segments(3.0)
    k = seg.node_time.size
    nRb = np.tile(rotation_from_rph([0.0, 0.0, heading], "RFU"), (k, 1, 1))
    zero = np.zeros((k, 3))
    return seg, States(nRb, zero, zero, zero, zero)


def between(seg, states, P, time):
    gravity = np.tile(FRAME.gravity_without_rotation(np.zeros((1, 3))), (seg.duration.size, 1))
    return trajectory_between(seg, states, P, gravity, FRAME, "RFU", time)


def test_at_a_node_the_covariance_is_that_of_the_node_in_local_axes():
    seg, states = chain(heading=np.pi / 2)
    P = np.zeros((seg.node_time.size, 9, 9))
    # Towards the bow 3 m, across 1 m; of the heading 0.1 rad.
    P[:, 3:6, 3:6] = np.diag([1.0, 9.0, 4.0])
    P[:, :3, :3] = np.diag([0.0, 0.0, 0.01])
    found = between(seg, states, P, seg.node_time[1:2])
    # The bow points east.
    np.testing.assert_allclose(found.position_std, [[3.0, 1.0, 2.0]], atol=1e-6)
    np.testing.assert_allclose(found.rph_std, [[0.0, 0.0, 0.1]], atol=1e-6)
    np.testing.assert_allclose(found.rph[0], [0.0, 0.0, np.pi / 2], atol=1e-9)


def test_between_two_nodes_the_covariance_is_interpolated():
    seg, states = chain()
    P = np.zeros((seg.node_time.size, 9, 9))
    P[1, 6:, 6:] = 4.0 * np.eye(3)
    half = seg.node_time[:1] + 0.5 * seg.duration[:1]
    found = between(seg, states, P, half)
    np.testing.assert_allclose(found.velocity_cov[0], 2.0 * np.eye(3), atol=1e-6)


def test_what_the_imu_is_off_at_the_next_node_is_spread_over_the_segment():
    seg, states = chain()
    nRb, p_n = states.nRb.copy(), states.p_n.copy()
    times = seg.node_time[0] + np.array([0.25, 0.5]) * seg.duration[0]
    before = between(seg, states, np.zeros((seg.node_time.size, 9, 9)), times)
    nRb[1] = exp_so3([0.0, 0.0, -2.0 * DEG]) @ nRb[1]
    p_n[1] += [0.4, 0.0, 0.0]
    moved = replace(states, nRb=nRb, p_n=p_n)
    after = between(seg, moved, np.zeros((seg.node_time.size, 9, 9)), times)
    np.testing.assert_allclose(after.rph[:, 2] - before.rph[:, 2], [0.5 * DEG, DEG], atol=1e-6)
    apart = FRAME.position(*after.geodetic.T) - FRAME.position(*before.geodetic.T)
    np.testing.assert_allclose(apart, [[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]], atol=1e-6)


def test_segments_one_by_one_give_the_motion_of_the_chain():
    seg, states = chain(heading=0.3)
    rng = np.random.default_rng(0)
    k = seg.node_time.size
    states = replace(states, p_n=rng.standard_normal((k, 3)), v_n=rng.standard_normal((k, 3)))
    root = 0.01 * rng.standard_normal((k, 9, 9))
    P = root @ root.transpose(0, 2, 1)
    edges = seg.node_time
    times = [epochs_between(a, b, 10.0) for a, b in pairwise(edges)]
    parts = [
        attached_epochs(
            one_segment(seg.increments, int(a), int(b)), time, FRAME.earth_rate, np.empty(0)
        )[0]
        for a, b, time in zip(seg.first, seg.last, times, strict=True)
    ]
    gravity = np.tile(FRAME.gravity_without_rotation(np.zeros((1, 3))), (k - 1, 1))
    found = trajectory_at(successive(parts), states, P, gravity, FRAME, "RFU")
    whole = between(seg, states, P, np.concatenate(times))
    for field in fields(whole):
        np.testing.assert_allclose(
            getattr(found, field.name), getattr(whole, field.name), rtol=1e-9, atol=1e-12
        )


def test_epochs_are_the_multiples_after_a_time_and_up_to_another():
    np.testing.assert_allclose(epochs_between(0.2, 0.5, 10.0), [0.3, 0.4, 0.5])
    np.testing.assert_allclose(epochs_between(0.21, 0.49, 10.0), [0.3, 0.4])
    assert epochs_between(0.2, 0.25, 10.0).size == 0
