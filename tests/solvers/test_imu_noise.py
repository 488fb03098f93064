"""Noise of the IMU below what is stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from truth import scenario

from factorgraph_dvl.graph.inertial_chain import ACCEL_NOISE, GYRO_NOISE
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve, solved_problems
from factorgraph_dvl.solvers.imu_noise import lower_noise, squares_of
from factorgraph_dvl.statistics.variance_components import NoiseFactor

# As precise as the motion of a second must be measured for the noise of an IMU to show.
PRECISE = {
    "gnss": {"velocity_std_m_s": [0.001] * 3, "position_std_m": [0.02] * 3},
    "imu": {"accel_noise_ug_sqrt_hz": 100},
}


def stated(trial, factor):
    """Return a trial whose accelerometers are stated to be noisier by a factor."""
    settings = trial.imu.settings
    noise = factor * settings.accel_noise_ug_sqrt_hz
    settings = structs.replace(settings, accel_noise_ug_sqrt_hz=noise)
    return replace(trial, imu=replace(trial.imu, settings=settings))


@pytest.fixture(scope="module")
def trial():
    return simulate(scenario(noise=True, **PRECISE), seed=3)


def assumed(trial):
    solved, *_ = solved_problems(trial)
    return solved.problem.chain.imu.accel_noise_ug_sqrt_hz, solved


def test_noise_that_is_stated_too_large_is_found(trial):
    right, _ = assumed(trial)
    assert right == pytest.approx(100.0, rel=0.05)
    found, solved = assumed(stated(trial, 10.0))
    assert found == pytest.approx(100.0, rel=0.2)
    assert "noise of the IMU" in [step.change for step in solved.steps]


@pytest.mark.slow
def test_standard_deviations_are_those_of_the_right_noise(trial):
    one, other = (solve(each, rate_hz=1.0) for each in (trial, stated(trial, 10.0)))
    sigma = [np.sqrt(np.diag(each.covariance)) for each in (one, other)]
    # In a minute the noise is known to a seventh.
    np.testing.assert_allclose(sigma[1], sigma[0], rtol=0.15)


def test_noise_that_is_stated_is_kept(trial):
    final = replace(stated(trial, 10.0), noise="stated")
    found, solved = assumed(final)
    assert found == 1000.0
    assert "noise of the IMU" not in [step.change for step in solved.steps]


def test_sources_have_rows_of_their_own(trial):
    """Accelerometers that are stated ten times as noisy lower the squares of theirs alone."""
    solved, *_ = solved_problems(replace(stated(trial, 10.0), noise="stated"))
    problem, minimum = solved.problem, solved.minimum
    found = squares_of(problem, minimum.evaluation, minimum.information, (GYRO_NOISE, ACCEL_NOISE))
    squares, freedom = found[ACCEL_NOISE]
    assert freedom > 50.0
    assert squares < 0.1 * freedom
    # No sensor measures a turn of a second as well as the gyros.
    assert found[GYRO_NOISE][1] < 1.0
    factors = lower_noise(problem, minimum)
    assert list(factors) == ["accel_noise_ug_sqrt_hz"]


def test_a_factor_by_hand():
    # Prior: 0.414 degrees of freedom at a factor of 1.
    factor = NoiseFactor.of(25.0, 100.0)
    assert factor.factor[0] == pytest.approx(np.sqrt((25.0 + 0.4143) / (100.0 + 0.4143)), rel=1e-4)
    assert NoiseFactor.of(1.0, 5.0).factor[0] == 1.0
    assert NoiseFactor.of(1e-6, 1e4).factor[0] == 0.1
