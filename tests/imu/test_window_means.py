"""Means over windows against quadrature of the motion itself, and by hand."""

from __future__ import annotations

import numpy as np
import pytest
from problems import SHORT, problem_of
from truth import exact_states, scenario

from factorgraph_dvl.geometry.vectors import rotate
from factorgraph_dvl.imu.window_means import SHORTEST, windows
from factorgraph_dvl.sensors.protocol import Window

SWAY = {
    "roll": [{"amplitude_deg": 5, "frequency_hz": 0.4}],
    "pitch": [{"amplitude_deg": 3, "frequency_hz": 0.7, "phase_deg": 60}],
    "heave": [{"amplitude_m": 0.3, "frequency_hz": 0.5}],
}
TIME = np.array([2.03, 3.5, 5.21, 6.4])


def exact(scene):
    """Return the chain of a scenario, and its true states."""
    problem, _ = problem_of(scene)
    chain = problem.chain
    states = exact_states(scene, chain.frame, chain.node_time)
    return chain, states


@pytest.fixture(scope="module")
def moving():
    return exact(scenario(manoeuvres=SHORT, sway=SWAY))


def motion(moving, time, length=None, *, of_body=True):
    chain, states = moving
    window = None if length is None else Window(length, of_body)
    return chain.motion(chain.attach(time, window=window), states)


def body_velocity(at):
    return rotate(at.nRb.transpose(0, 2, 1), at.v_n)


def quadrature(moving, length, function):
    """Return the mean over windows of a function of the motion, by 40 points of Gauss."""
    points, weights = np.polynomial.legendre.leggauss(40)
    parts = [
        0.5 * w * function(motion(moving, TIME + 0.5 * length * x))
        for x, w in zip(points, weights, strict=True)
    ]
    return np.sum(parts, axis=0)


@pytest.mark.parametrize("length", [SHORTEST, 0.35, 1.0])
def test_means_in_body_axes_are_those_of_the_motion(moving, length):
    mean = motion(moving, TIME, length)
    for found, of in (
        (body_velocity(mean), body_velocity),
        (mean.omega_eb_b, lambda at: at.omega_eb_b),
    ):
        # The rotation of the Earth within a window is left out.
        np.testing.assert_allclose(found, quadrature(moving, length, of), atol=3e-5)


ARM = np.array([1.5, -3.0, 2.0])


def point_velocity(at):
    return at.v_n + rotate(at.nRb, np.cross(at.omega_eb_b, ARM))


@pytest.mark.parametrize("length", [SHORTEST, 0.35, 1.0])
def test_means_in_n_are_those_of_the_motion(moving, length):
    found = motion(moving, TIME, length, of_body=False)
    # While the Earth turns, gravity does: by g w T²/24, which is left out.
    np.testing.assert_allclose(found.v_n, quadrature(moving, length, lambda at: at.v_n), atol=5e-5)
    expected = quadrature(moving, length, point_velocity)
    off = np.abs(point_velocity(found) - expected).max()
    # Products of rate and acceleration, of third order in the length, are left out, too.
    assert off < 0.08 * np.abs(point_velocity(motion(moving, TIME)) - expected).max() + 3e-5
    transposed = found.v_n + rotate(found.nRb.transpose(0, 2, 1), np.cross(found.omega_eb_b, ARM))
    assert np.abs(transposed - expected).max() > 20.0 * off


@pytest.mark.parametrize("of_body", [True, False])
def test_a_circle_by_hand(of_body):
    """In body axes its velocity stays, and a rate that stays is its own mean.

    In n, both are those over a chord: sin(0.52) / 0.52 of them, with a turn of 60 deg.
    """
    moving = exact(
        scenario(
            manoeuvres=[{"turn_deg_s": 30, "duration_s": 12}],
            start={"lat_deg": 30, "lon_deg": 120, "height_m": 0, "heading_deg": 0, "speed_m_s": 2},
            sway={},
        )
    )
    mean = motion(moving, np.array([5.0, 6.3]), 2.0, of_body=of_body)
    share = 1.0 if of_body else 0.5 / (np.pi / 6.0)
    ahead = np.tile([0.0, 2.0 * share, 0.0], (2, 1))
    np.testing.assert_allclose(body_velocity(mean), ahead, atol=1.2e-4)
    np.testing.assert_allclose(np.degrees(mean.omega_eb_b[:, 2]), 2 * [-30.0 * share], atol=0.01)


@pytest.mark.parametrize("of_body", [True, False])
@pytest.mark.parametrize("length", [-0.05, 0.07, 0.3, 1.0])
def test_derivatives_by_length_and_time(moving, length, of_body):
    h = 1e-4

    def mean(time, length):
        return motion(moving, time, length, of_body=of_body)

    middle = mean(TIME, length)
    longer, shorter = (mean(TIME, length + sign * h) for sign in (1.0, -1.0))
    later, earlier = (mean(TIME + sign * h, length) for sign in (1.0, -1.0))
    for found, change in (
        (middle.mean.v_by_length, longer.v_n - shorter.v_n),
        (middle.mean.omega_by_length, longer.omega_eb_b - shorter.omega_eb_b),
        (middle.a_n, later.v_n - earlier.v_n),
        (middle.alpha_b, later.omega_eb_b - earlier.omega_eb_b),
        (middle.changes[1], later.p_n - earlier.p_n),
    ):
        change = change / (2.0 * h)
        np.testing.assert_allclose(found, change, atol=1e-3 * np.abs(change).max())


def test_short_windows_have_the_opposite_effect_of_negative_ones_and_none_has_none(moving):
    chain, _ = moving
    inc = chain.segments.increments
    none, one, other = (
        windows(inc, TIME, Window(length)).mean.rate for length in (0.0, 0.08, -0.08)
    )
    np.testing.assert_allclose(one - none, none - other, atol=1e-12)
    assert np.abs(none).max() < 0.02 * np.abs(one).max()


def test_windows_end_where_the_samples_do(moving):
    chain, _ = moving
    inc = chain.segments.increments
    edge = np.array([inc.start[0], inc.end[-1]])
    assert np.isfinite(windows(inc, edge, Window(1.0)).mean.added).all()


@pytest.mark.parametrize("length", [0.06, 0.08, SHORTEST, 0.17, 0.31])
def test_derivatives_are_those_of_the_value_where_samples_are_noisy(length):
    """Also inside a sample, and without a jump at the length up to which it is a straight line."""
    noisy = scenario(
        manoeuvres=SHORT,
        sway=SWAY,
        noise=True,
        imu={"gyro_noise_deg_sqrt_h": 3.0, "accel_noise_ug_sqrt_hz": 3000.0},
    )
    moving = exact(noisy)
    h = 1e-5
    for at in (length - 2.0 * h, length + 2.0 * h):
        ahead, behind = (motion(moving, TIME, at + sign * h) for sign in (1.0, -1.0))
        found = motion(moving, TIME, at).mean
        for value, by_length in (("v_n", "v_by_length"), ("omega_eb_b", "omega_by_length")):
            change = (getattr(ahead, value) - getattr(behind, value)) / (2.0 * h)
            size = np.abs(change).max()
            np.testing.assert_allclose(getattr(found, by_length), change, atol=2e-3 * size)


@pytest.mark.parametrize("of_body", [True, False])
@pytest.mark.parametrize("length", [0.0, SHORTEST, 1.0])
def test_where_the_samples_end_a_window_is_cut(moving, length, of_body):
    """At the last sample hardly anything is left; 0.2 s before, the rest about the time."""
    end = moving[0].segments.increments.end[-1]
    at = np.array([end, end - 0.2])
    found = motion(moving, at, length, of_body=of_body)
    rest = motion(moving, at, min(length, 0.4), of_body=of_body)
    np.testing.assert_allclose(found.v_n[0], motion(moving, at).v_n[0], atol=3e-3)
    np.testing.assert_allclose(found.v_n[1], rest.v_n[1], atol=1e-6)
    # It does not grow with its length, and does with the time to the end.
    if length > 0.4:
        np.testing.assert_array_equal(found.mean.v_by_length, 0.0)
        step = 1e-3
        later, earlier = (
            motion(moving, at[1:] + s, length, of_body=of_body).v_n[0] for s in (step, -step)
        )
        np.testing.assert_allclose(found.a_n[1], (later - earlier) / (2.0 * step), atol=2e-3)
