"""Correlated noise: found in residuals, as stated, and left alone where noise is white."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import yaml
from monte_carlo import RUNS, rms_band
from problems import SHORT, problem_of
from truth import CONFIGS, CORRELATED, LONGER_TURNS_AND_BRAKING, config, merged, scenario

from factorgraph_dvl.analysis.error_statistics import motion_errors, trajectory_errors
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.simulation.faults import (
    clock_step,
    correlated_dvl,
    correlated_gnss,
    dvl_scale_walk,
    gauss_markov,
    with_faults,
)
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.correlated_noise import correlated_noise

LONG = {
    "noise": True,
    "manoeuvres": LONGER_TURNS_AND_BRAKING,
    "imu": {"rate_hz": 50, "gyro_noise_deg_sqrt_h": 0.005},
    "dvl": {"rate_hz": 5, "velocity_std_m_s": 0.01},
    "trial": {"dvl": {"velocity_std_m_s": 0.01}},
}


@pytest.fixture(scope="module")
def trial():
    return simulate(scenario(**LONG), 3)


def walking(trial, rate, seed):
    """Return a trial whose scale walks by a rate per √h, and which states it."""
    out = with_faults(trial, [dvl_scale_walk(rate)], seed)
    settings = msgspec.structs.replace(out.dvl.settings, scale_walk_std_sqrt_h=rate)
    return replace(out, dvl=replace(out.dvl, settings=settings))


@pytest.fixture(scope="module")
def wandering(trial):
    """Return the trial with 0.03 m/s over 8 s added to what the DVL measures."""
    rng = np.random.default_rng(1)
    error = 0.03 * gauss_markov(trial.dvl.time, 8.0, 3, rng)
    return replace(trial, dvl=replace(trial.dvl, velocity=trial.dvl.velocity + error))


def noise(solution):
    return {n.name: n for n in solution.noise}


def test_white_noise_has_no_correlation_time(trial):
    found = noise(solve(trial, rate_hz=1.0))
    assert all(n.correlation_time is None for n in found.values())


def test_correlated_noise_of_the_dvl_is_found(trial, wandering):
    solution = solve(wandering, rate_hz=1.0)
    assert solution.converged
    dvl = noise(solution)["dvl_velocity"]
    # 20 correlation times for each axis.
    assert np.exp(np.mean(np.log(dvl.correlation_time))) == pytest.approx(8.0, rel=0.5)
    # In all 0.0316 m/s, and in z, which nothing else shows, hardly a bias.
    np.testing.assert_allclose(dvl.factor[:2], 3.16, rtol=0.4)
    assert noise(solution)["gnss_position"].correlation_time is None
    # A velocity error of a random walk's length is no better known than its mean allows.
    scale = solution.estimate("scale_error")
    assert abs(scale.value[0] - 0.005) < 3.0 * scale.std[0]
    budget = {c.cause for c in solution.error_budget}
    assert "correlated noise of DVL velocity" in budget
    total = np.sqrt(sum(c.adds**2 for c in solution.error_budget))
    np.testing.assert_allclose(total, np.sqrt(np.diag(solution.covariance)), rtol=1e-5)


def test_stated_correlation_is_used_as_stated(wandering):
    settings = msgspec.structs.replace(
        wandering.dvl.settings,
        correlation_time_s=8.0,
        correlated_std_m_s=0.03,
        noise="stated",
    )
    stated = replace(wandering, dvl=replace(wandering.dvl, settings=settings))
    solution = solve(stated, rate_hz=1.0)
    assert "dvl_velocity" not in noise(solution)
    residual = next(r for r in solution.residuals if r.label == "DVL velocity")
    assert np.std(residual.residual / residual.sigma) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_noise_that_the_trajectory_follows_is_found():
    """Beside a cheap IMU the residuals of a DVL lose what is slower than a second."""
    times, squares = [], []
    for seed in range(4):
        scene = merged(
            LONG,
            {
                "imu": {"gyro_noise_deg_sqrt_h": 0.3, "accel_noise_ug_sqrt_hz": 150},
                "manoeuvres": [
                    *LONG["manoeuvres"],
                    {"accelerate_m_s2": 0.2, "to_m_s": 4},
                    *LONG["manoeuvres"],
                ],
                "dvl": {"correlated_share": 0.5, "correlation_time_s": 5},
            },
        )
        trial = simulate(scenario(**scene), seed)
        solution = solve(trial)
        times.append(noise(solution)["dvl_velocity"].correlation_time)
        position = trajectory_errors(solution, trial.reference).position
        squares.append(np.mean(position.normalised**2))
    assert np.exp(np.nanmean(np.log(times))) == pytest.approx(5.0, rel=0.5)
    # Measured: 1.5; as white noise of its long run, 4.5.
    assert np.mean(squares) < 2.0


def test_noise_over_a_second_counts_as_white_noise_of_its_long_run(trial):
    rng = np.random.default_rng(1)
    error = 0.1 * gauss_markov(trial.gnss.time, 1.0, 3, rng)
    gnss = replace(trial.gnss, velocity=trial.gnss.velocity + error)
    solution = solve(replace(trial, gnss=gnss), rate_hz=1.0)
    found = noise(solution)["gnss_velocity"]
    assert found.correlation_time is None
    np.testing.assert_allclose(found.factor, np.sqrt(2.0), rtol=0.15)
    residual = next(r for r in solution.residuals if r.label == "GNSS velocity")
    # 5 Hz: half of the variance counts 2 tau / dt = 10 times.
    np.testing.assert_allclose(np.median(residual.sigma, axis=0), 0.1 * np.sqrt(11.0), rtol=0.3)


def test_a_wandering_receiver_keeps_the_stated_deviation(trial):
    rng = np.random.default_rng(4)
    error = 2.0 * gauss_markov(trial.gnss.time, 30.0, 3, rng)
    quiet = trial.gnss.geodetic[:, 2] + error[:, 2]
    geodetic = np.column_stack([trial.gnss.geodetic[:, :2] + error[:, :2] / 6.4e6, quiet])
    gnss = replace(
        trial.gnss, geodetic=geodetic, position_std=np.full_like(trial.gnss.position_std, 2.0)
    )
    solution = solve(replace(trial, gnss=gnss), rate_hz=1.0)
    position = noise(solution)["gnss_position"]
    np.testing.assert_allclose(position.correlated_std[:2], 2.0, rtol=0.3)
    sigma = np.sqrt(solution.trajectory.position_cov[:, 0, 0])
    assert np.all(sigma > 0.5)


def test_a_scale_that_walks_is_reported_as_its_mean(trial):
    """Walks of 2 % in three minutes, where a constant scale contradicts the noise."""
    solution = solve(walking(trial, 0.1, 1), rate_hz=1.0)
    assert solution.converged
    assert solution.verdict.grade != "do not use"
    scale = solution.estimate("scale_error")
    assert np.abs(scale.value - trial.calibration_truth["scale_error"]) < 3.0 * scale.std
    assert scale.std < 0.002
    causes = {c.cause: c.assumed for c in solution.error_budget}
    assert causes["correlated noise of DVL velocity"] == "scale 0.1 /√h"
    # White noise is none of the scale.
    assert noise(solution)["dvl_velocity"].correlation_time is None


@pytest.mark.slow
def test_the_deviation_of_a_scale_that_walks_is_that_of_its_errors(trial):
    z = []
    for seed in range(RUNS):
        walked = walking(simulate(scenario(**LONG), 100 + seed), 0.03, seed)
        scale = solve(walked, rate_hz=1.0).estimate("scale_error")
        z.append((scale.value - walked.calibration_truth["scale_error"]) / scale.std)
    low, high = rms_band(RUNS)
    assert low < np.sqrt(np.mean(np.square(z))) < high


def test_nodes_reach_as_far_as_the_outliers():
    stated = {"correlation_time_s": 10, "correlated_std_m": [0.5, 0.5, 0.5]}
    problem, values = problem_of(scenario(manoeuvres=SHORT, trial={"gnss": stated}))
    label, time = "GNSS position", problem.observations[0].time
    assert problem.observations[0].label == label
    weights = np.ones((time.size, 3))
    weights[:10] = 0.0
    problem.robust_weights = {label: weights}
    problem.weigh(problem.evaluate(values))
    assert not problem.weights[0][:10].any()
    (process,) = correlated_noise(problem, problem.evaluate(values), ()).processes
    assert process.time[[0, -1]] == pytest.approx(time[[0, -1]])


@pytest.mark.slow
def test_a_clock_that_jumps_under_water_is_no_correlated_noise():
    """All fixes after a dive are 1 s late: noise that persists would explain it too.

    So would a bottom that moves by 1 mm/s: over a dive both leave the same error.
    """
    dive = yaml.safe_load((CONFIGS / "dive.yaml").read_text(encoding="utf-8"))
    next(m for m in dive["manoeuvres"] if "repeat" in m)["repeat"] = 1
    dive["gnss"]["outages_s"] = [[305, 1080]]
    dive |= {"trial": {}, "dvl": dive["dvl"] | {"no_lock_s": []}}
    trial = with_faults(simulate(parse_scenario(dive), 0), [clock_step("gnss", 1.0)])
    solution = solve(trial, rate_hz=1.0)
    assert all(found.correlation_time is None for found in solution.noise)
    assert solution.verdict.grade != "good"
    first = solution.verdict.reasons[0]
    assert (first.code, first.parameter) == (Code.CHANGED_ALONG_TRIAL, "gnss_time_offset_s")
    for name in ("misalignment_deg", "scale_error", "lever_arm_m"):
        error = solution.estimate(name).value - trial.calibration_truth[name]
        assert np.all(np.abs(error) < 3.0 * solution.estimate(name).std)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "label"),
    [
        (correlated_dvl(0.05), "DVL velocity"),
        (correlated_gnss(velocity_std_m_s=(0.5, 0.5, 0.5)), "GNSS velocity"),
    ],
    ids=["DVL", "GNSS"],
)
def test_noise_that_persists_at_ten_times_what_is_stated_leaves_a_minimum(fault, label):
    """The clock of GNSS is known to 10 ms then, and its cost is as rough as the IMU's samples."""
    data = yaml.safe_load((CONFIGS / "seed-a-phase-90.yaml").read_text(encoding="utf-8"))
    data["trial"] = {"imu": data["trial"]["imu"], "dvl": {"velocity_std_m_s": 0.001}}
    solution = solve(with_faults(simulate(parse_scenario(data), 0), [fault]), rate_hz=1.0)
    assert solution.converged
    assert solution.verdict.grade == "doubtful"
    assert solution.verdict.reasons[0].sensor == label


def test_what_residuals_of_a_short_trial_lack_of_the_stated_deviation_persists():
    """Over 45 s an error over 100 s looks like a constant; white noise lacks nothing."""
    std = [0.5, 0.5, 0.5]
    for share, persists in ((0.7, True), (0.0, False)):
        gnss = {"position_std_m": std, "correlated_share": share}
        scene = config("seed-a-phase-90", reference_rate_hz=10, gnss=gnss)
        trial = simulate(scene, 2).until(45.0)
        solution = solve(trial, rate_hz=1.0)
        position = noise(solution)["gnss_position"]
        assert (position.correlated_std is not None) == persists
        if persists:
            np.testing.assert_allclose(position.correlated_std, 0.5 * np.sqrt(0.7), rtol=0.15)
        found = motion_errors(solution.trajectory, trial.reference).position
        assert found.nees.mean() < 12.0


@pytest.mark.slow
def test_a_short_trial_leaves_the_stated_deviation_of_what_wanders_for_longer():
    """Within 45 s an error over 100 s is nearly constant, and looks as if there were none."""
    scene = config("seed-a-phase-90", reference_rate_hz=10, **CORRELATED)
    nees = []
    for seed in range(4):
        trial = simulate(scene, seed).until(45.0)
        solution = solve(trial, rate_hz=1.0)
        nees.append(motion_errors(solution.trajectory, trial.reference).position.nees.mean())
    assert np.mean(nees) < 6.0
