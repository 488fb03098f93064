"""The filter of single beams: exact without noise, lost beams, Jacobians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from kalman_trials import parameter

from factorgraph_dvl.baselines.beam_filter import BeamPings, _linearised, beam_filter
from factorgraph_dvl.baselines.navigation import NavigationMotion
from factorgraph_dvl.geometry.unit_vectors import turned

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
        np.arange(float(count)), zero, v, eye, P, v, 1e-8 * eye, omega, zero, np.ones(count, bool)
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
