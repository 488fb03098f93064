"""Steps: however they are cut, they add up."""

from __future__ import annotations

import numpy as np
import pytest
from kalman_trials import samples_of
from truth import scenario

from factorgraph_dvl.baselines.strapdown import compose, exp_small
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.simulation import simulate


@pytest.fixture(scope="module")
def exact_trial():
    return simulate(scenario())


def test_steps_add_up_however_they_are_cut(exact_trial):
    samples = samples_of(exact_trial)
    cuts = np.sort(np.concatenate([[0.0, 10.0], np.random.default_rng(0).uniform(0, 10, 60)]))
    parts = compose(samples, cuts[:-1], cuts[1:])
    whole = compose(samples, cuts[:1], cuts[-1:])
    turn, dv, dp, bias_jacobian = np.eye(3), np.zeros(3), np.zeros(3), np.zeros((3, 3))
    for k, T in enumerate(parts.duration):
        dp = dp + dv * T + turn @ parts.dp[k]
        dv = dv + turn @ parts.dv[k]
        bias_jacobian = bias_jacobian + turn @ parts.bias_jacobian[k]
        turn = turn @ parts.turn[k]
    np.testing.assert_allclose(turn, whole.turn[0], atol=1e-12)
    np.testing.assert_allclose(dv, whole.dv[0], atol=1e-7)
    np.testing.assert_allclose(dp, whole.dp[0], atol=1e-5)
    np.testing.assert_allclose(bias_jacobian, whole.bias_jacobian[0], atol=1e-5)
    np.testing.assert_allclose(parts.gyro_variance.sum(), whole.gyro_variance[0])


def test_small_rotations_are_those_of_the_exponential():
    phi = np.random.default_rng(0).uniform(-5e-3, 5e-3, (100, 3))
    np.testing.assert_allclose(exp_small(phi), exp_so3(phi), atol=1e-12)
