"""Whole solutions: exact without noise, and an answer or an honest refusal for every trial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exactness import INITIAL, assert_exact, pull
from findings import of_code
from problems import SHORT
from truth import CONING, config, scenario

from factorgraph_dvl.analysis.error_statistics import calibration_errors, trajectory_errors
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.plausibility.survey import survey
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers import batch, steps
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.minima import most_probable_minimum

STRAIGHT = {"manoeuvres": [{"straight_s": 60}], "sway": {}}


@pytest.mark.slow
def test_without_noise_the_trial_of_the_paper_is_exact():
    trial = simulate(config("seed-a-phase-90", noise=False), 0)
    solution = solve(trial)
    # The pull of the priors on the gyro biases is half a sigma, and tilts the horizon. What
    # it does not explain: 1 % of sigma, from steps of the rate in mid-sample and the
    # linearisation.
    assert_exact(trial, solution, limit=0.05, trajectory=0.6)
    dvl = calibration_errors(solution, trial.calibration_truth).error[:7]
    assert np.abs(dvl[:3]).max() < 2e-3
    assert np.abs(dvl[4:7]).max() < 1e-4
    assert all(e.observable.all() for e in solution.estimates[:3])


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({"start": {"heading_deg": 137}, "body_axes": "FRD"}, marks=pytest.mark.slow),
        {"start": {"lat_deg": -45, "lon_deg": 179.999, "heading_deg": 90}, "body_axes": "FLU"},
        pytest.param(
            {"gnss": {"lever_arm_m": [0.5, -3, 4]}, "start": {"heading_deg": 250}},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"dvl": {"rate_hz": 7, "phase_s": 0.031, "misalignment_deg": [20, -100, 140]}},
            marks=pytest.mark.slow,
        ),
        {
            "dvl": {"scale_error": [0.01, -0.02, 0.03]},
            "trial": {"dvl": {"scale_error_std": [0.1] * 3}},
        },
        {"dvl": {"time_offset_s": 0.08}, "trial": {"dvl": {"time_offset_std_s": 0.1}}},
        {"dvl": {"bias_m_s": [0.01, -0.02, 0.01]}, "trial": {"dvl": {"bias_std_m_s": [0.05] * 3}}},
        {"imu": {"sampling": "instantaneous"}},
        pytest.param({"gnss": {"velocity_std_m_s": None}}, marks=pytest.mark.slow),
        {"trial": {"gnss": {"lever_arm_std_m": [1, 1, 1]}}},
        {"imu": {"gaps_s": [[20.0, 23.0]]}},
        pytest.param({"imu": {"gaps_s": [[20.0, 50.0]]}}, marks=pytest.mark.slow),
        {"gnss": {"outages_s": [[15.0, 55.0]]}},
        {"dvl": {"no_lock_s": [[15.0, 55.0]]}},
        {"dvl": {"reference": "water"}, "current_m_s": [0.3, -0.2, 0.0]},
    ],
    ids=[
        "FRD",
        "south, FLU",
        "antenna",
        "7 Hz",
        "three scales",
        "time offset",
        "bias",
        "instantaneous",
        "positions only",
        "antenna unknown",
        "IMU gap 3 s",
        "IMU gap 30 s",
        "GNSS outage",
        "no lock",
        "through water",
    ],
)
def test_without_noise_every_variant_is_exact(changes):
    trial = simulate(scenario(**changes))
    solution = solve(trial)
    # Instantaneous samples do not tell when between them the acceleration begins: up to
    # 5 ms times 0.2 m/s², 0.16 of the scale's sigma.
    instantaneous = trial.imu.settings.sampling == "instantaneous"
    limits = {"limit": 0.25, "trajectory": 0.25} if instantaneous else {}
    assert_exact(trial, solution, **limits)


@pytest.mark.slow
def test_the_same_trial_gives_the_same_numbers():
    trial = simulate(scenario(noise=True), 5)
    one, two = solve(trial), solve(trial)
    for a, b in zip(one.estimates, two.estimates, strict=True):
        np.testing.assert_array_equal(a.value, b.value)
        np.testing.assert_array_equal(a.std, b.std)
    np.testing.assert_array_equal(one.trajectory.rph, two.trajectory.rph)
    np.testing.assert_array_equal(one.covariance, two.covariance)
    assert one.findings == two.findings


@pytest.mark.parametrize("rate", [1.0, 100.0])
def test_the_trajectory_comes_at_the_rate_asked_for(rate):
    trial = simulate(scenario(manoeuvres=SHORT))
    time = solve(trial, rate_hz=rate).trajectory.time
    np.testing.assert_allclose(np.diff(time), 1.0 / rate)


@pytest.mark.parametrize("interval", [pytest.param(0.2, marks=pytest.mark.slow), 2.0])
def test_the_states_may_be_denser_or_sparser(interval):
    trial = simulate(scenario(sway=CONING))
    assert_exact(trial, solve(trial, state_interval_s=interval))


@pytest.mark.parametrize("noise", [False, True])
def test_a_straight_run_says_what_it_does_not_show(noise):
    trial = simulate(scenario(noise=noise, **STRAIGHT), 1)
    solution = solve(trial)
    assert solution.converged
    assert solution.estimate("misalignment_deg").observable[1] == np.False_
    assert not solution.estimate("lever_arm_m").observable.any()
    assert solution.estimate("scale_error").observable.all()
    joined = " ".join(of_code(solution.findings, Code.NOT_OBSERVABLE))
    assert "misalignment_y_deg" in joined
    assert "a rotation about the velocity changes nothing" in joined
    assert "lever_arm_x_m, lever_arm_y_m, lever_arm_z_m not observable" in joined
    assert "the body turns too little" in joined
    found, explained = pull(solution, trial.calibration_truth)
    limit = 0.2 if not noise else 4.0
    assert np.abs(found - explained).max() < limit


def test_at_rest_nothing_is_shown():
    scene = scenario(noise=True, manoeuvres=[{"straight_s": 30}], sway={}, start={"speed_m_s": 0})
    solution = solve(simulate(scene, 1))
    for name in ("misalignment_deg", "scale_error", "lever_arm_m"):
        assert not solution.estimate(name).observable.any(), name
    assert of_code(solution.findings, Code.NOT_OBSERVABLE)


def test_a_very_short_trial():
    scene = scenario(noise=True, manoeuvres=[{"straight_s": 5}])
    trial = simulate(scene, 1)
    solution = solve(trial)
    assert np.all(np.isfinite(solution.covariance))
    assert not solution.estimate("accel_bias_ug").observable[:2].any()
    imu, t = trial.imu, trial.imu.time
    with pytest.raises(DataError, match="only 5 samples"):
        solve(
            replace(trial, imu=replace(imu, time=t[:5], gyro=imu.gyro[:5], accel=imu.accel[:5])),
            anyway=True,
        )


def test_without_gnss_but_with_a_start():
    trial = replace(simulate(scenario(trial=INITIAL), 0), gnss=None)
    solution = solve(trial)
    assert solution.converged
    # 100 ug know a change of speed of 2 m/s and turns at 8 deg/s to some 1e-4: the scale
    # is seen without any GNSS.
    assert solution.estimate("scale_error").std[0] < 5e-4
    assert_exact(trial, solution, trajectory=0.2)
    straight = replace(simulate(scenario(trial=INITIAL, **STRAIGHT), 0), gnss=None)
    solution = solve(straight)
    assert not solution.estimate("scale_error").observable.any()
    joined = " ".join(of_code(solution.findings, Code.NOT_OBSERVABLE))
    assert "add GNSS, and go farther" in joined
    assert "without GNSS nothing separates the errors of the IMU from the motion" in joined


def test_without_any_position_there_is_no_frame():
    trial = simulate(scenario())
    with pytest.raises(DataError, match="positions: no file has any"):
        solve(replace(trial, gnss=None))


def test_records_that_cannot_be_used_come_before_what_fails_with_them():
    trial = simulate(scenario())
    nothing = np.full_like(trial.dvl.velocity, np.nan)
    with pytest.raises(DataError, match="--anyway"):
        solve(replace(trial, dvl=replace(trial.dvl, velocity=nothing)))


def test_a_dvl_that_never_locks_and_no_dvl():
    trial = simulate(scenario(dvl={"no_lock_s": [[0.0, 100.0]]}))
    solution = solve(trial, anyway=True)
    assert solution.converged
    joined = " ".join(of_code(solution.findings, Code.NOT_OBSERVABLE))
    assert joined.count("the trial has no ping with a lock") == 3
    np.testing.assert_allclose(solution.estimate("lever_arm_m").std, 10.0, rtol=1e-6)
    np.testing.assert_allclose(solution.estimate("misalignment_deg").std, 180.0, rtol=1e-6)
    alone = solve(replace(trial, dvl=None))
    assert [e.name for e in alone.estimates] == ["gyro_bias_deg_h", "accel_bias_ug"]
    ours = solution.covariance[-6:, -6:]
    np.testing.assert_allclose(alone.covariance, ours, rtol=1e-5, atol=1e-9)


def test_held_parameters_stay():
    claims = {
        "misalignment_deg": [2, 2, 30],
        "misalignment_std_deg": [0, 0, 0],
        "lever_arm_m": [1.0, 1.2, 0.0],
        "lever_arm_std_m": [0, 0, 5],
        "scale_error": 0.005,
        "scale_error_std": 0,
    }
    trial = simulate(scenario(trial={"dvl": claims}))
    solution = solve(trial)
    np.testing.assert_allclose(solution.estimate("misalignment_deg").value, [2, 2, 30], atol=1e-12)
    np.testing.assert_array_equal(solution.estimate("misalignment_deg").std, np.zeros(3))
    np.testing.assert_array_equal(solution.estimate("scale_error").value, [0.005])
    arm = solution.estimate("lever_arm_m")
    np.testing.assert_allclose(arm.value, [1.0, 1.2, 1.4], atol=1e-4)
    assert arm.std[2] < 0.01
    np.testing.assert_allclose(arm.std[:2], 0.0, atol=1e-6)
    assert arm.observable.tolist() == [False, False, True]
    assert not {"lever_arm_m", "scale_error"} & {f.parameter for f in solution.findings}


def test_walking_biases_are_reported_as_their_mean():
    scene = scenario(
        noise=True,
        imu={"gyro_bias_walk_deg_h_sqrt_h": 5.0, "accel_bias_walk_ug_sqrt_h": 500.0},
    )
    trial = simulate(scene, 2)
    solution = solve(trial)
    assert solution.converged
    errors = calibration_errors(solution, trial.calibration_truth)
    assert np.abs(errors.normalised).max() < 4.0
    prior = solution.estimate("gyro_bias_deg_h").prior_std[0]
    # A walk of q in an hour: q² T / 3 is the variance of its mean over T.
    expected = np.hypot(0.05, 5.0 * np.sqrt(78.0 / 3600.0 / 3.0))
    assert prior == pytest.approx(expected, rel=1e-3)


def test_measurements_that_contradict_their_noise_are_told():
    scene = scenario(
        noise=True,
        dvl={"velocity_std_m_s": 0.05},
        trial={"dvl": {"velocity_std_m_s": 0.001, "velocity_std_fraction": 0.002}},
    )
    solution = solve(simulate(scene, 0))
    (finding,) = (f for f in solution.findings if f.code == Code.LARGE_RESIDUALS)
    assert finding.sensor == "DVL velocity"
    honest = solve(simulate(scenario(noise=True), 0))
    assert not {Code.LARGE_RESIDUALS, Code.DOES_NOT_FIT} & {f.code for f in honest.findings}


def test_residuals_of_an_honest_trial_are_white_and_unit():
    solution = solve(simulate(scenario(noise=True), 0))
    assert [r.label for r in solution.residuals] == [
        "GNSS position",
        "GNSS velocity",
        "DVL velocity",
    ]
    for r in solution.residuals:
        z = r.residual / r.sigma
        assert 0.9 < z.std() < 1.05
        assert abs(z.mean()) * np.sqrt(z.size) < 4.0


@pytest.mark.parametrize("name", ["rate_hz", "state_interval_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(ConfigError, match=name):
        solve(simulate(scenario(manoeuvres=SHORT)), **{name: value})


def test_the_reported_covariance_is_that_of_the_order():
    solution = solve(simulate(scenario(noise=True), 0))
    assert solution.order[:8] == (
        "misalignment_x_deg",
        "misalignment_y_deg",
        "misalignment_z_deg",
        "scale_error",
        "lever_arm_x_m",
        "lever_arm_y_m",
        "lever_arm_z_m",
        "gyro_bias_x_deg_h",
    )
    std = np.concatenate([e.std for e in solution.estimates])
    np.testing.assert_allclose(np.sqrt(np.diag(solution.covariance)), std)
    assert np.linalg.eigvalsh(solution.covariance / np.outer(std, std)).min() > 0.0
    attitude = solution.trajectory.rph_std / DEG
    # The heading hangs on turns of a minute; roll and pitch on gravity.
    assert np.all(attitude[:, :2] < 0.05)
    assert np.all(attitude[:, 2] < 1.0)


MEMS = {
    "imu": {"gyro_noise_deg_sqrt_h": 0.3, "accel_noise_ug_sqrt_hz": 200},
    "bias": {"imu": {"gyro_bias_std_deg_h": 20, "accel_bias_std_ug": 5000}},
}


@pytest.mark.parametrize(
    ("mounting_std", "walk"),
    [
        (1.0, 5),
        pytest.param(20.0, 0, marks=pytest.mark.slow),
        pytest.param(1.0, 0, marks=pytest.mark.slow),
        pytest.param(20.0, 5, marks=pytest.mark.slow),
    ],
)
def test_a_heading_that_only_the_mounting_tells_is_known_no_better(mounting_std, walk):
    imu = MEMS["bias"]["imu"] | {"gyro_bias_walk_deg_h_sqrt_h": walk}
    claims = {"imu": imu, "dvl": {"misalignment_std_deg": [mounting_std] * 3}}
    straight = {"manoeuvres": [{"straight_s": 100}], "sway": {}}
    truth = {"misalignment_deg": [0.4 * mounting_std, 0, 0.7 * mounting_std]}
    trial = simulate(scenario(noise=True, imu=MEMS["imu"], dvl=truth, trial=claims, **straight), 1)
    solution = solve(trial, rate_hz=1.0)
    heading = trajectory_errors(solution, trial.reference).attitude
    np.testing.assert_allclose(heading.std[:, 2] / DEG, mounting_std, rtol=0.05)
    assert 0.3 < np.abs(heading.normalised[:, 2]).max() < 2.0


def test_a_heading_that_the_earth_tells_is_not_lost_to_the_mounting():
    straight = {"manoeuvres": [{"straight_s": 120}], "sway": {}}
    trial = simulate(scenario(noise=True, dvl={"misalignment_deg": [2, 2, 30]}, **straight), 1)
    solution = solve(trial, rate_hz=1.0)
    # The mounting is not told about the velocity, and may be anything there.
    assert solution.estimate("misalignment_deg").std.max() > 100.0
    heading = trajectory_errors(solution, trial.reference).attitude
    assert np.max(heading.std[:, 2] / DEG) < 0.3
    assert np.abs(heading.normalised[:, 2]).max() < 3.0


@pytest.mark.slow
def test_noise_in_proportion_to_speed_leaves_the_scale_alone():
    errors = []
    for seed in range(8):
        dvl = {"velocity_std_fraction": 0.05}
        scene = scenario(noise=True, dvl=dvl, manoeuvres=[{"straight_s": 60}], sway={})
        trial = simulate(scene, seed)
        found = solve(trial, rate_hz=1.0).estimate("scale_error")
        errors += list((found.value - trial.calibration_truth["scale_error"]) / found.std)
    # By the measured speed it would be 0.005 too small.
    assert abs(np.mean(errors)) < 2.5 / np.sqrt(len(errors))


def test_minima_that_the_data_do_not_tell_apart_are_mixed():
    trial = simulate(scenario(manoeuvres=SHORT, noise=True), seed=1)
    one = solve(trial, rate_hz=1.0)
    (first, *rest) = one.estimates
    other = replace(
        one, estimates=(replace(first, value=first.value + np.array([0, 0, 180])), *rest)
    )
    assert most_probable_minimum([one, other], np.array([0.0, 30.0])) is one
    both = most_probable_minimum([other, one], np.array([1.0, 0.0]))
    np.testing.assert_array_equal(both.estimates[0].value, first.value)
    share = np.exp(-1.0) / (1.0 + np.exp(-1.0))
    assert both.estimates[0].std[2] == pytest.approx(180.0 * np.sqrt(share), rel=0.01)
    assert both.estimates[0].observable.tolist() == [True, True, False]
    (text,) = of_code(both.findings, Code.AMBIGUOUS)
    assert "2 minima" in text
    assert "0.73, 0.27" in text


@pytest.mark.parametrize(
    ("code", "severity", "anyway", "asked"),
    [
        (Code.FORCE_UNIT, "error", False, False),
        (Code.FORCE_UNIT, "error", True, True),
        # A window may explain a delay, and a warning contradicts nothing.
        (Code.CLOCK_OFFSET, "error", False, True),
        (Code.COURSE, "warning", False, True),
    ],
)
def test_records_that_contradict_each_other_are_solved_to_the_first_minimum(
    monkeypatch, code, severity, anyway, asked
):
    trial = simulate(scenario(manoeuvres=[{"straight_s": 65}]), 1)
    found = Finding(code, "a contradiction", "IMU", severity=severity)
    before = survey(trial)
    monkeypatch.setattr(
        batch, "survey", lambda trial: replace(before, findings=(*before.findings, found))
    )
    calls = []

    def explanation(problem, minimum, imu):
        calls.append(imu)

    monkeypatch.setattr(steps, "explanation", explanation)
    solution = solve(trial, anyway=anyway)
    assert bool(calls) == asked
    assert found in solution.verdict.reasons
    assert solution.verdict.grade == ("do not use" if severity == "error" else "doubtful")
