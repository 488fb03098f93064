"""Motion carried forward from a node, by hand."""

from __future__ import annotations

import numpy as np
from inertial import constant_segments

from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.imu import propagation
from factorgraph_dvl.imu.propagation import (
    States,
    attach,
    attach_inside,
    extrapolated,
    motion_at,
    segment_ends,
)

NO_RATE = np.zeros(3)
GRAVITY = np.array([0.0, 0.0, -9.8])


def states_of(seg, gyro_bias=(0, 0, 0), accel_bias=(0, 0, 0)):
    """All nodes alike: level, at 100 m, with 2 m/s eastwards."""
    ones = np.ones((seg.node_time.size, 1))
    return States(
        np.tile(np.eye(3), (seg.node_time.size, 1, 1)),
        ones * [0.0, 0.0, 100.0],
        ones * [2.0, 0.0, 0.0],
        ones * gyro_bias,
        ones * accel_bias,
    )


def motion(seg, states, time):
    gravity = np.tile(GRAVITY, (seg.duration.size, 1))
    return motion_at(attach(seg, time, NO_RATE), states, gravity, NO_RATE)


def test_at_rest_against_gravity_nothing_changes_but_the_position():
    seg = constant_segments(3.0)
    found = motion(seg, states_of(seg), seg.node_time[0] + np.array([0.0, 0.37, 0.9]))
    np.testing.assert_allclose(found.v_n, np.tile([2.0, 0.0, 0.0], (3, 1)), atol=1e-9)
    np.testing.assert_allclose(found.p_n[:, 0], [0.0, 0.74, 1.8], atol=1e-9)
    np.testing.assert_allclose(found.a_n, 0.0, atol=1e-9)


def test_a_thrust_of_one_metre_per_second_squared():
    seg = constant_segments(3.0, accel=(0.0, 1.0, 9.8))
    found = motion(seg, states_of(seg), seg.node_time[:1] + 0.8)
    np.testing.assert_allclose(found.v_n, [[2.0, 0.8, 0.0]], atol=1e-9)
    np.testing.assert_allclose(found.p_n, [[1.6, 0.32, 100.0]], atol=1e-9)
    np.testing.assert_allclose(found.a_n, [[0.0, 1.0, 0.0]], atol=1e-9)


def test_a_bias_is_taken_off_rate_and_force():
    seg = constant_segments(3.0, gyro=(0.0, 0.0, 0.01), accel=(0.0, 0.05, 9.8))
    known = states_of(seg, gyro_bias=(0.0, 0.0, 0.01), accel_bias=(0.0, 0.05, 0.0))
    found = motion(seg, known, seg.node_time[:1] + 0.8)
    np.testing.assert_allclose(log_so3(found.nRb[0]), 0.0, atol=1e-9)
    # To first order in the bias: what is left is 0.01 rad/s times the thrust, times t²/2.
    np.testing.assert_allclose(found.v_n, [[2.0, 0.0, 0.0]], atol=0.01 * 0.05 * 0.8**2)
    np.testing.assert_allclose(found.omega_eb_b, 0.0, atol=1e-9)


def test_the_ends_of_segments_belong_to_the_nodes_before():
    seg = constant_segments(3.0, gyro=(0.0, 0.0, 0.1))
    at = segment_ends(seg, NO_RATE)
    np.testing.assert_array_equal(at.node, seg.origin)
    np.testing.assert_allclose(at.tau, seg.duration)
    np.testing.assert_allclose(log_so3(at.dR)[:, 2], 0.1 * seg.duration, atol=1e-12)


def test_times_off_the_chain_are_told_from_those_on_it():
    seg = constant_segments(3.0)
    _, covered = attach_inside(seg, np.array([-5.0, 1.5, 60.0]), NO_RATE)
    assert covered.tolist() == [False, True, False]


def test_a_motion_is_extrapolated_with_its_rates():
    seg = constant_segments(3.0, gyro=(0.0, 0.0, 0.2), accel=(0.0, 1.0, 9.8))
    late = np.array([0.05])
    time = seg.node_time[:1] + 0.4
    one, two = (motion(seg, states_of(seg), t) for t in (time, time + late))
    found = extrapolated(one, late)
    np.testing.assert_allclose(found.nRb, two.nRb, atol=1e-9)
    # A turning thrust changes its direction within the time: second order.
    np.testing.assert_allclose(found.v_n, two.v_n, atol=0.2 * late.item() ** 2)
    np.testing.assert_allclose(found.p_n, two.p_n, atol=0.2 * late.item() ** 3)
    np.testing.assert_allclose(found.nRb @ exp_so3([0, 0, -0.09]), np.eye(3)[None], atol=1e-9)


def test_times_are_attached_in_parts_as_at_once(monkeypatch):
    seg = constant_segments(3.0, gyro=(0.0, 0.0, 0.1))
    time = np.linspace(seg.node_time[0], seg.node_time[-1], 11)
    whole = attach(seg, time, NO_RATE)
    monkeypatch.setattr(propagation, "_CHUNK", 4)
    parts = attach(seg, time, NO_RATE)
    for name, values in vars(whole).items():
        np.testing.assert_array_equal(getattr(parts, name), values)
