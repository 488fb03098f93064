"""The closed form and its covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kalman_trials import MISALIGNMENT, NO_ARM, SCALE, VARIED, angle_between, exact_points
from truth import scenario

from factorgraph_dvl.baselines import kalman
from factorgraph_dvl.baselines.wahba import wahba
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.simulation import simulate


def test_wahba_takes_its_covariance_from_the_residuals():
    trial = simulate(scenario(noise=True, manoeuvres=VARIED, dvl=NO_ARM), 0)
    solution = kalman(trial, "wahba")
    assert angle_between(solution, [2, 2, 30]) < 0.2
    loud = replace(trial.dvl, velocity=trial.dvl.velocity + 0.0)
    loud.velocity[:] += np.random.default_rng(0).normal(0.0, 0.1, loud.velocity.shape)
    noisy = kalman(replace(trial, dvl=loud), "wahba")
    assert np.all(noisy.estimates[0].std > 3.0 * solution.estimates[0].std)


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [0.0, 0.0, np.pi], [1.0, -2.0, 0.5]])
def test_the_closed_form_is_exact(turn):
    arm = np.array([1.0, -0.5, 2.0])
    points = exact_points(misalignment=turn, scale=-0.03, arm=arm)
    found = wahba(points, MISALIGNMENT, SCALE, arm).estimated
    np.testing.assert_allclose(found.values[0], exp_so3(turn), atol=1e-12)
    np.testing.assert_allclose(found.values[1], -0.03, atol=1e-12)


def test_what_the_velocities_leave_open_keeps_the_prior():
    points = exact_points(50)
    straight = replace(points, v_b=np.tile([0.0, 4.0, 0.0], (50, 1)), omega_b=np.zeros((50, 3)))
    straight = replace(straight, v_d=straight.v_b)
    std = np.sqrt(np.diag(wahba(straight, MISALIGNMENT, SCALE, np.zeros(3)).estimated.covariance))
    np.testing.assert_allclose(std[1], 3.0, rtol=1e-6)
    assert std[[0, 2]].max() < 1e-3
