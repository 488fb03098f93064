"""Noise of the IMU below what is stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from truth import scenario

from factorgraph_dvl.graph.inertial_chain import ACCEL_NOISE, GYRO_NOISE, WALK
from factorgraph_dvl.imu.noise import with_recorded_noise
from factorgraph_dvl.sensors.imu import BIASES
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solved_problems
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


def test_noise_is_no_less_than_stated(trial):
    """An INS that was made of the same record would agree with it better than by its noise."""
    right, _ = assumed(trial)
    assert right == pytest.approx(100.0, rel=0.05)
    found, solved = assumed(stated(trial, 10.0))
    assert found == 1000.0
    assert "noise of the IMU" not in [step.change for step in solved.steps]


def vibrating(trial):
    """Return a trial whose accelerometers have 20 times the noise at high frequencies alone."""
    imu = trial.imu
    dt = float(np.median(np.diff(imu.time)))
    velocity = 20.0 * imu.settings.accel_noise_root_psd * np.sqrt(dt)
    velocity = velocity * np.random.default_rng(5).standard_normal(imu.accel.shape)
    return replace(trial, imu=replace(imu, accel=imu.accel + np.gradient(velocity, dt, axis=0)))


def test_noise_of_a_record_is_what_motion_shows_of_it(trial):
    """What vibrates bounds the noise from above, and hardly moves the vehicle."""
    shaking = vibrating(trial)
    recorded = with_recorded_noise(shaking.imu).settings.accel_noise_ug_sqrt_hz
    found, solved = assumed(shaking)
    assert recorded > 200.0
    assert 100.0 <= found < 0.7 * recorded
    assert "noise of the IMU" in [step.change for step in solved.steps]


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
    factors = lower_noise(problem, minimum, (GYRO_NOISE, ACCEL_NOISE))
    assert list(factors) == ["accel_noise_ug_sqrt_hz"]


def test_one_of_some_nodes_has_all_sources():
    """Walks of biases stand between the factors of the IMU: every other factor is none of them."""
    walk = {"gyro_bias_walk_deg_h_sqrt_h": 1.0, "accel_bias_walk_ug_sqrt_h": 100.0}
    solved, *_ = solved_problems(simulate(scenario(noise=True, imu=walk), seed=3))
    problem, minimum = solved.problem, solved.minimum
    sources = (GYRO_NOISE, ACCEL_NOISE, *map(WALK.format, BIASES))
    at = problem, minimum.evaluation, minimum.information, sources
    every, some = squares_of(*at), squares_of(*at, every=2)
    for source in (ACCEL_NOISE, *map(WALK.format, BIASES)):
        squares, freedom = every[source]
        assert some[source] == pytest.approx((squares / 2.0, freedom / 2.0), rel=0.3, abs=1.0)


def test_a_factor_by_hand():
    # Prior: 0.414 degrees of freedom at a factor of 1.
    factor = NoiseFactor.of(25.0, 100.0)
    assert factor.factor[0] == pytest.approx(np.sqrt((25.0 + 0.4143) / (100.0 + 0.4143)), rel=1e-4)
    few = NoiseFactor.of(1.0, 5.0)
    assert few.factor[0] == pytest.approx(np.sqrt(1.4143 / 5.4143), rel=1e-4)
    # Half the noise with 5 degrees of freedom: 2 sigma are 0.63.
    assert few.after(np.ones(1))[0] == 1.0
    assert NoiseFactor.of(1e-6, 1e4).factor[0] == 0.1
