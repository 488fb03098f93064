"""The filter of single beams: exact without noise, lost beams, Jacobians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from kalman_trials import parameter

from factorgraph_dvl.baselines.beam_filter import (
    BeamPings,
    _by_groups,
    _linearised,
    attitude_errors,
    beam_filter,
)
from factorgraph_dvl.baselines.navigation import NavigationMotion
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.unit_vectors import turned
from factorgraph_dvl.geometry.vectors import rotate

NOMINAL = np.array(
    [[0.5, 0.0, -0.866], [-0.5, 0.0, -0.866], [0.0, 0.5, -0.866], [0.0, -0.5, -0.866]]
)
NOMINAL /= np.linalg.norm(NOMINAL, axis=1, keepdims=True)
TRUTH = np.concatenate([np.linspace(-0.02, 0.02, 8), [0.01, -0.01, 0.02, 0.0], [1.0, -0.5, 0.3]])


def pings(count=200):
    rng = np.random.default_rng(5)
    v, omega = rng.normal(0.0, 2.0, (count, 3)), rng.normal(0.0, 0.3, (count, 3))
    eye = np.broadcast_to(np.eye(3), (count, 3, 3))
    P = np.broadcast_to(1e-8 * np.eye(9), (count, 9, 9))
    zero = np.zeros((count, 3))
    motion = NavigationMotion(
        np.arange(float(count)), zero, v, eye, P, omega, zero, np.ones(count, bool)
    )
    turns, scale, arm = np.split(TRUTH, [8, 12])
    at_dvl = v + np.cross(omega, arm)
    measured = (1.0 + scale) * (at_dvl @ turned(NOMINAL, turns.reshape(4, 2)).T)
    return BeamPings(motion, NOMINAL, measured, np.full((count, 4), 0.01))


PARAMETERS = (
    parameter("beam_directions", np.zeros(8), np.full(8, 0.1)),
    parameter("beam_scale_error", np.zeros(4), np.full(4, 0.1)),
    parameter("lever_arm", np.zeros(3), np.full(3, 5.0)),
)


def test_without_noise_it_is_exact():
    outcome = beam_filter(pings(), PARAMETERS)
    assert outcome.converged
    np.testing.assert_allclose(np.concatenate(outcome.estimated.values), TRUTH, atol=1e-3)


def test_lost_beams_leave_the_others():
    lost = pings()
    lost.measured[::2, 0] = np.nan
    lost.measured[1::3, 2:] = np.nan
    outcome = beam_filter(lost, PARAMETERS)
    np.testing.assert_allclose(np.concatenate(outcome.estimated.values), TRUTH, atol=2e-3)
    none = replace(lost, measured=np.full_like(lost.measured, np.nan))
    np.testing.assert_array_equal(
        np.concatenate(beam_filter(none, PARAMETERS).estimated.values), 0
    )


def test_derivatives_against_differences():
    data, step = pings(5), 1e-6
    linear = _linearised(data, TRUTH)
    np.testing.assert_allclose(linear.predicted, data.measured, atol=1e-12)
    for i in range(TRUTH.size):
        h = step * np.eye(TRUTH.size)[i]
        numeric = _linearised(data, TRUTH + h).predicted - _linearised(data, TRUTH - h).predicted
        np.testing.assert_allclose(linear.by_state[:, :, 3 + i], numeric / (2 * step), atol=1e-7)


def turned_pings(count=5):
    """Pings of a body that is not level, with what its navigation axes see."""
    level = pings(count)
    rng = np.random.default_rng(6)
    nRb = exp_so3(rng.normal(0.0, 1.0, (count, 3)))
    m = level.motion
    return replace(level, motion=replace(m, nRb=nRb, velocity=rotate(nRb, m.v_b)))


def test_groups_have_no_error_at_the_truth_and_see_a_transposed_rotation():
    data = turned_pings()
    linear, measured = _by_groups(data, TRUTH)
    assert measured.shape == (5, 12)
    np.testing.assert_allclose(linear.predicted, measured, atol=1e-12)
    back = replace(data, motion=replace(data.motion, nRb=data.motion.nRb.transpose(0, 2, 1)))
    assert np.abs(_by_groups(back, TRUTH)[0].predicted - measured).max() > 0.1


def test_derivatives_of_groups_against_differences():
    data, step = turned_pings(), 1e-6
    linear, _ = _by_groups(data, TRUTH)
    for i in range(TRUTH.size):
        h = step * np.eye(TRUTH.size)[i]
        ends = [_by_groups(data, TRUTH + sign * h)[0].predicted for sign in (1.0, -1.0)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(linear.by_state[:, :, 3 + i], numeric, atol=1e-6)
    for i in range(3):
        ends = [
            _by_groups(
                replace(
                    data,
                    motion=replace(
                        data.motion, nRb=exp_so3(sign * step * np.eye(3)[i]) @ data.motion.nRb
                    ),
                ),
                TRUTH,
            )[0].predicted
            for sign in (1.0, -1.0)
        ]
        numeric = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(linear.by_state[:, :, i], numeric, atol=1e-6)


def test_one_group_by_hand():
    # Three beams along the axes, upside down, at rest but for 2 m/s ahead: the bow points east.
    data = turned_pings(1)
    east = np.array([[[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    motion = replace(
        data.motion, nRb=east, velocity=np.array([[2.0, 0.0, 0.0]]), omega_b=np.zeros((1, 3))
    )
    data = BeamPings(motion, np.eye(3), np.array([[0.0, 2.0, 0.0]]), np.full((1, 3), 0.01))
    linear, measured = _by_groups(data, np.zeros(12))
    np.testing.assert_allclose(linear.predicted, [[2.0, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(measured, linear.predicted, atol=1e-12)
    np.testing.assert_allclose(linear.variance, 1e-4 + 1e-8, rtol=1e-9)


def test_the_printed_filter_finds_the_attitude_error_too():
    data = turned_pings(300)
    phi = np.array([0.002, -0.001, 0.005])
    wrong = exp_so3(-phi) @ data.motion.nRb
    P = data.motion.covariance.copy()
    P[:, 6:, 6:] = 1e-4 * np.eye(3)
    data = replace(data, motion=replace(data.motion, nRb=wrong, covariance=P))
    outcome = beam_filter(data, PARAMETERS, printed=True)
    np.testing.assert_allclose(np.concatenate(outcome.estimated.values), TRUTH, atol=2e-3)
    _, found, _ = attitude_errors(data, outcome.estimated, printed=True)
    # The axes turn with the Earth by 7e-5 rad/s, and take the error along.
    np.testing.assert_allclose(found[-1], phi, atol=3e-4)
