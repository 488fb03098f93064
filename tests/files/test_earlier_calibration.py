"""Biases of the IMU from an earlier calibration: their walk, correlations with the DVL, files."""

from __future__ import annotations

import json
from dataclasses import replace

import gtsam
import msgspec
import numpy as np
import pytest
from builders import build_trial, edit, write_trial
from calibrations import calibration
from findings import of_code
from problems import SHORT, problem_of
from truth import TURNING, scenario

from factorgraph_dvl.baselines import sins
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.calibration_file import encode_calibration, load_calibration
from factorgraph_dvl.files.earlier_calibration import calibrated_by, with_biases_of
from factorgraph_dvl.files.trial_folder import load_trial, save_trial
from factorgraph_dvl.geometry.units import DEG_PER_HOUR
from factorgraph_dvl.graph import keys
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.replay import replay
from factorgraph_dvl.sensors.imu import BIASES
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solution import Calibration
from factorgraph_dvl.solvers.batch import solve

WALK_DEG_H_SQRT_H = 0.6
SEVEN = ("misalignment_deg", "scale_error", "lever_arm_m")


def earlier(*, epoch="2022-10-12T00:00:00Z", span=(100.0, 1000.0), **changes):
    return replace(calibration(**changes), epoch=epoch, span=span)


def walking(imu, walk=WALK_DEG_H_SQRT_H):
    settings = msgspec.structs.replace(imu.settings, gyro_bias_walk_deg_h_sqrt_h=walk)
    return replace(imu, settings=settings)


def both_from(trial, found):
    """IMU and DVL of a trial with the priors of one calibration."""
    imu = with_biases_of(trial.imu, found, "RFU", trial.epoch, "before.json", with_dvl=True)
    dvl = replace(calibrated_by(trial.dvl, found, "RFU", "before.json"), prior=imu.prior)
    return replace(trial, imu=imu, dvl=dvl)


def as_calibration(solution):
    fields = Calibration.__dataclass_fields__
    return Calibration(**{name: getattr(solution, name) for name in fields})


@pytest.mark.parametrize(
    ("epoch", "hours"),
    [
        ("2022-10-12T01:00:00Z", (3600 - 1000) / 3600),
        ("2022-10-12T00:08:20Z", 0.0),
        ("2022-10-11T23:00:00+00:00", (3600 + 100) / 3600),
    ],
    ids=["before", "meanwhile", "after"],
)
def test_variances_grow_by_the_walk_over_the_time_between(epoch, hours):
    imu, found = walking(build_trial().imu), earlier()
    own = with_biases_of(imu, found, "RFU", epoch, "before.json")
    gyro, accel = own.parameters(0.0)
    of_mean = 2.0 / 3.0 * 900.0 / 3600.0
    apart = hours + (imu.time[0] / 3600.0 if epoch.endswith("01:00:00Z") else 0.0)
    apart -= imu.time[0] / 3600.0 if epoch.endswith("+00:00") else 0.0
    std = np.sqrt(1.0 + WALK_DEG_H_SQRT_H**2 * (apart + of_mean))
    np.testing.assert_allclose(gyro.mean, np.array([1.0, 2.0, 3.0]) * DEG_PER_HOUR)
    np.testing.assert_allclose(gyro.sigma, np.full(3, std) * DEG_PER_HOUR)
    # The calibration has none of the accelerometers: theirs only walk if the settings say so.
    np.testing.assert_allclose(accel.sigma, imu.parameters(0.0)[1].sigma)
    np.testing.assert_allclose(found.covariance, earlier().covariance)


def test_no_bias_that_was_carried_is_surer_than_it_is():
    """Against random walks: an estimate of the mean, and the bias a while later."""
    rng = np.random.default_rng(0)
    n, draws, T, gap, q, first_std = 50, 20000, 2.0, 0.5, 0.36, 0.3
    step = rng.normal(0.0, np.sqrt(q * T / n), (draws, n))
    path = rng.normal(0.0, first_std, (draws, 1)) + np.cumsum(step, axis=1)
    mean = path.mean(axis=1)
    later = path[:, -1] + rng.normal(0.0, np.sqrt(q * gap), draws)
    prior = first_std**2 + q * T / 3.0
    for noise in (1e-3, 0.3, 1.0, 100.0):
        gain = prior / (prior + noise**2)
        estimate = gain * (mean + rng.normal(0.0, noise, draws))
        claimed = (1.0 - gain) * prior + q * (gap + 2.0 / 3.0 * T)
        truly = np.var(later - estimate)
        assert truly < 1.03 * claimed, noise
        assert claimed < 1.0 / 0.6 * truly, noise


def test_a_walk_over_a_time_that_is_not_known_is_refused():
    imu = walking(build_trial().imu)
    with pytest.raises(ConfigError, match=r"`epoch` in before\.json"):
        with_biases_of(imu, calibration(), "RFU", "2022-10-12T00:00:00Z", "before.json")
    with pytest.raises(ConfigError, match=r"`epoch` in trial\.yaml"):
        with_biases_of(imu, earlier(), "RFU", "", "before.json")
    # A bias that does not walk needs no time.
    still = with_biases_of(build_trial().imu, calibration(), "RFU", "", "before.json")
    np.testing.assert_allclose(still.parameters(0.0)[0].sigma, np.full(3, DEG_PER_HOUR))


def test_a_calibration_without_biases_is_refused():
    found = earlier()
    none = replace(found, estimates=found.estimates[:3], covariance=found.covariance[:7, :7])
    with pytest.raises(DataError, match="no biases of an IMU"):
        with_biases_of(build_trial().imu, none, "RFU", "", "before.json")


def rows(solution, names):
    order = [n for e in solution.estimates if e.name in names for n in e.component_names]
    return [solution.order.index(n) for n in order]


@pytest.fixture(scope="module")
def two():
    first = simulate(scenario(), 0)
    second = simulate(
        scenario(manoeuvres=[TURNING[0], TURNING[3], TURNING[1]], start={"heading_deg": 250}), 0
    )
    return first, second, solve(first)


def test_two_trials_know_what_both_know_of_dvl_and_imu_together(two):
    _, second, a = two
    b, both = solve(second), solve(both_from(second, as_calibration(a)))
    names = (*SEVEN, *BIASES)
    A, B, C = (s.covariance[np.ix_(rows(s, names), rows(s, names))] for s in (a, b, both))
    # Either alone knows the settings' prior of the biases; together it counts once.
    own = np.concatenate([np.zeros(7), np.full(3, 0.05**-2.0), np.full(3, 100.0**-2.0)])
    expected = np.linalg.inv(np.linalg.inv(A) + np.linalg.inv(B) - np.diag(own))
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        C / np.outer(scale, scale), expected / np.outer(scale, scale), atol=5e-3
    )
    gyro = both.estimate("gyro_bias_deg_h")
    np.testing.assert_allclose(gyro.prior_std, a.estimate("gyro_bias_deg_h").std, rtol=1e-9)
    # And what the result rests on is named.
    assert (
        "prior of gyro_bias_deg_h, accel_bias_ug, misalignment_deg, scale_error, lever_arm_m"
        in [c.cause for c in both.error_budget]
    )
    total = np.sqrt(sum(c.adds**2 for c in both.error_budget))
    np.testing.assert_allclose(total, np.sqrt(np.diag(both.covariance)), rtol=1e-4)


def test_biases_that_contradict_the_trial_are_named(two):
    _, second, a = two
    found = as_calibration(a)
    changed = tuple(
        replace(e, value=e.value + np.array([0.0, 0.0, 300.0])) if e.name == BIASES[1] else e
        for e in found.estimates
    )
    imu = with_biases_of(second.imu, replace(found, estimates=changed), "RFU", "", "before.json")
    (text,) = of_code(solve(replace(second, imu=imu)).findings, Code.PRIOR_CONTRADICTED)
    assert "before.json contradicts this trial" in text
    assert "accel_bias_z_ug" in text


# Drifts of 1e-3 deg/h are 5e-9 rad/s, less than stands for zero in other parameters.
@pytest.mark.parametrize("std_deg_h", [1.0, 1e-3])
def test_the_cost_of_the_joint_prior_is_that_of_its_covariance(std_deg_h):
    scene = scenario(manoeuvres=SHORT)
    found = earlier()
    scale = np.concatenate([np.ones(7), np.full(3, std_deg_h)])
    found = replace(found, covariance=found.covariance * np.outer(scale, scale))
    problem, _ = problem_of(scene, both_from(simulate(scene), found))
    expected = {keys.bias(0), *(problem.key(n) for n in SEVEN)}
    (prior,) = [
        f
        for i in range(problem.graph.size())
        if set((f := problem.graph.at(i)).keys()) == expected
    ]
    at = gtsam.Values()
    gyro = np.array([1.0, 2.0, 3.0])
    off = std_deg_h * np.array([0.1, -0.2, 0.3])
    at.insert(keys.bias(0), gtsam.imuBias.ConstantBias(np.zeros(3), (gyro + off) * DEG_PER_HOUR))
    for name, value in problem.prior_values().items():
        if name in SEVEN:
            at.insert(problem.key(name), gtsam.Rot3(value) if value.ndim == 2 else value)
    away = np.concatenate([np.zeros(7), off])
    assert prior.error(at) == pytest.approx(
        0.5 * away @ np.linalg.solve(found.covariance, away), rel=1e-6
    )


def test_the_filter_starts_from_them_too():
    trial = simulate(scenario(manoeuvres=[{"straight_s": 20}]), 0)
    found = earlier()
    own = with_biases_of(trial.imu, found, "RFU", "", "before.json")
    sharp = replace(own.prior, covariance=1e-6 * own.prior.covariance)
    gyro = np.array([1.0, 2.0, 3.0]) * DEG_PER_HOUR
    carried = replace(own, prior=sharp, gyro=own.gyro + gyro)
    bias = sins(replace(trial, imu=carried))[1]
    np.testing.assert_allclose(bias, gyro, atol=0.01 * DEG_PER_HOUR)


def test_files_there_and_back(tmp_path):
    path = write_trial(tmp_path, replace(build_trial(), imu=walking(build_trial().imu)))
    edit(path / "trial.yaml", "dvl:\n", "dvl:\n  calibration: ../before\n")
    edit(path / "trial.yaml", "imu: {", "imu: {calibration: ../before/calibration.json, ")
    (tmp_path / "before").mkdir()
    (tmp_path / "before" / "calibration.json").write_bytes(encode_calibration(earlier()))
    again = load_calibration(tmp_path / "before")
    assert (again.epoch, again.span) == (earlier().epoch, earlier().span)
    trial = load_trial(path)
    assert trial.dvl.prior is trial.imu.prior
    assert set(trial.imu.prior.values) == {*SEVEN, *BIASES}
    save_trial(trial, tmp_path / "copy")
    copy = load_trial(tmp_path / "copy")
    assert copy.dvl.prior is copy.imu.prior
    for name in trial.imu.prior.values:
        np.testing.assert_allclose(copy.imu.prior.std(name), trial.imu.prior.std(name))
    np.testing.assert_allclose(copy.imu.bias_covariance(), trial.imu.bias_covariance())


@pytest.mark.slow
def test_a_replay_knows_of_biases_what_the_batch_does(two):
    _, second, a = two
    trial = both_from(second, as_calibration(a))
    batch, (replayed, _) = solve(trial), replay(trial, rate_hz=1.0)
    for name in (*BIASES, *SEVEN):
        one, other = batch.estimate(name), replayed.estimate(name)
        np.testing.assert_allclose(other.std, one.std, rtol=0.02)
        assert np.all(np.abs(other.value - one.value) < 0.2 * one.std), name


def test_what_cannot_be_used_is_named(tmp_path, two):
    path = write_trial(tmp_path)
    edit(path / "trial.yaml", "imu: {", "imu: {calibration: ../before.json, ")
    with pytest.raises(ConfigError, match=r"imu\.calibration: the file \.\./before\.json"):
        load_trial(path)
    first, _, solution = two
    with pytest.raises(DataError, match=r"imu\.calibration: before\.json.*this trial itself"):
        replace(
            first,
            imu=with_biases_of(first.imu, as_calibration(solution), "RFU", "", "before.json"),
        )
    unread = msgspec.structs.replace(first.imu.settings, calibration="x.json")
    with pytest.raises(ConfigError, match="has not been read"):
        replace(first.imu, settings=unread).parameters(0.0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("std", [0.5, 1e300])
def test_deviations_that_contradict_the_covariance_are_named(tmp_path, std):
    """The square of the second overflows."""
    content = json.loads(encode_calibration(earlier()))
    content["parameters"]["scale_error"]["std"] = [std]
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"diagonal.*do not agree"):
        load_calibration(file)
