"""Arcs of the IMU's record seen from their start."""

from __future__ import annotations

import numpy as np
from inertial import constant_segments

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import log_so3
from factorgraph_dvl.initialization.dead_reckoned_spans import arc_from_start

FRAME = LocalFrame(0.6, 2.0, 0.0)


def span(seconds=4.0, **signals):
    seg = constant_segments(seconds, **signals)
    return arc_from_start(seg, 0, FRAME, np.zeros((seg.node_time.size, 3)))


def test_a_constant_force_gives_speed_and_place():
    arc = span(accel=(0.5, 0.0, 9.8))
    time = arc.start + np.array([0.0, 1.3, 3.2])
    since = (time - arc.start)[:, None]
    _, turn, velocity, place = arc.carry(time)
    force = np.array([0.5, 0.0, 9.8])
    np.testing.assert_allclose(log_so3(turn), 0.0, atol=1e-12)
    np.testing.assert_allclose(velocity, since * force, atol=1e-9)
    np.testing.assert_allclose(place, since**2 / 2.0 * force, atol=1e-9)


def test_a_turning_force_goes_round_in_a_circle():
    w, f = 0.5, 2.0
    arc = span(gyro=(0.0, 0.0, w), accel=(f, 0.0, 0.0))
    t = 3.2
    _, turn, velocity, place = arc.carry(arc.start + np.array([t]))
    np.testing.assert_allclose(log_so3(turn[0]), [0.0, 0.0, w * t], atol=1e-9)
    expected = f / w * np.array([np.sin(w * t), 1.0 - np.cos(w * t), 0.0])
    np.testing.assert_allclose(velocity[0], expected, atol=1e-6)
    expected = f / w * np.array([(1.0 - np.cos(w * t)) / w, t - np.sin(w * t) / w, 0.0])
    # Within a segment the place follows the mean force: second order in its rotation.
    np.testing.assert_allclose(place[0], expected, atol=0.02)


def test_gravity_is_integrated_once_and_twice():
    arc = span()
    at, *_ = arc.carry(arc.start + np.array([2.7]))
    once, twice = arc.gravity_integrals(at)
    # Seen from axes kept in space, it turns with the Earth: 7.3e-5 rad/s, 9.8 m/s².
    np.testing.assert_allclose(once, 2.7 * arc.gravity[:1], rtol=1e-6, atol=4e-3)
    np.testing.assert_allclose(twice, 2.7**2 / 2.0 * arc.gravity[:1], rtol=1e-6, atol=4e-3)


def test_axes_kept_in_space_turn_against_the_earth():
    arc = span()
    (turn,) = arc.to_space(arc.start + np.array([3600.0]))
    np.testing.assert_allclose(log_so3(turn), 3600.0 * FRAME.earth_rate)


def test_times_off_the_arc_are_not_covered():
    arc = span()
    assert arc.covers(arc.start + np.array([-1.0, 0.5, 3.5, 60.0])).tolist() == [
        False,
        True,
        True,
        False,
    ]
