"""The Kalman point-set approach: navigation, calibrators, and what they admit to."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from builders import write_trial
from pyins.strapdown import Integrator
from truth import SWELL, config, scenario

from factorgraph_dvl.analysis.error_statistics import (
    calibration_errors,
    paper_accuracy,
    trajectory_errors,
)
from factorgraph_dvl.baselines import DVL_METHODS, METHODS, calibrate, kalman
from factorgraph_dvl.baselines.ins_gnss import FilterState, Fixes, run_filter, smooth
from factorgraph_dvl.baselines.navigation import motion_at, navigate
from factorgraph_dvl.baselines.point_set_filter import measurement_matrix
from factorgraph_dvl.baselines.strapdown import compose, prepare
from factorgraph_dvl.cli import main
from factorgraph_dvl.cli.solve import KalmanMethod
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG, MICRO_G
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.io.solution_folder import load_solution
from factorgraph_dvl.io.tables import read_table
from factorgraph_dvl.simulation import simulate

SEEDS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "50"))
STILL = {"manoeuvres": [{"straight_s": 40}], "sway": {}}
NO_ARM = {"lever_arm_m": [0, 0, 0]}
# Speeds from 2 to 5 m/s, and enough of a swell to turn the velocity in the body.
VARIED = [
    {"straight_s": 20},
    {"accelerate_m_s2": -0.2, "to_m_s": 2},
    {"straight_s": 20},
    {"turn_deg_s": 6, "duration_s": 20, "ramp_s": 4},
    {"accelerate_m_s2": 0.2, "to_m_s": 5},
    {"turn_deg_s": -6, "duration_s": 20, "ramp_s": 4},
    {"straight_s": 20},
]


def angle_between(solution, truth_deg):
    found = exp_so3(solution.estimate("misalignment_deg").value * DEG)
    return float(np.linalg.norm(log_so3(found.T @ exp_so3(np.array(truth_deg) * DEG)))) / DEG


def samples_of(trial):
    return prepare(increments(trial.imu)[0], trial.imu.settings)


@pytest.fixture(scope="module")
def exact_trial():
    return simulate(scenario())


# Steps and strapdown


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


def test_strapdown_agrees_with_pyins():
    trial = simulate(scenario(body_axes="FRD", imu={"rate_hz": 100}))
    samples = samples_of(trial)
    inc, ref = samples.increments, trial.reference
    time = np.arange(0.0, 60.01, 0.5)
    gap = np.full((time.size, 3), np.nan)
    free = run_filter(
        time,
        compose(samples, time[:-1], time[1:]),
        Fixes(gap, gap, gap, gap, gap, np.zeros(3)),
        FilterState(
            ref.geodetic[0],
            ref.velocity[0],
            rotation_from_rph(ref.rph[0], "FRD"),
            np.zeros(3),
            np.zeros(3),
            np.eye(15) * 1e-6,
        ),
        (0.0, 0.0),
    ).track

    phi, dv = inc.over(np.arange(6000))
    oracle = Integrator(
        pd.Series(
            np.concatenate(
                [
                    ref.geodetic[0, :2] / DEG,
                    ref.geodetic[0, 2:],
                    ref.velocity[0, [1, 0]],
                    -ref.velocity[0, 2:],
                    ref.rph[0] / DEG,
                ]
            ),
            index=["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"],
            name=0.0,
        )
    )
    table = pd.DataFrame(
        np.column_stack([inc.dt[:6000], phi, dv]),
        index=inc.end[:6000],
        columns=["dt", "theta_x", "theta_y", "theta_z", "dv_x", "dv_y", "dv_z"],
    )
    theirs = oracle.integrate(table).iloc[-1]
    ours = free.velocity[-1]
    np.testing.assert_allclose(ours, theirs[["VE", "VN", "VD"]] * [1, 1, -1], atol=1e-4)
    np.testing.assert_allclose(free.geodetic[-1, :2] / DEG, theirs[["lat", "lon"]], atol=2e-8)
    turn = rotation_from_rph(theirs[["roll", "pitch", "heading"]].to_numpy() * DEG, "FRD")
    assert np.linalg.norm(log_so3(turn.T @ free.nRb[-1])) < 1e-7


# SINS/GNSS


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"gnss": {"lever_arm_m": [0.5, -1.5, 4]}},
        {"gnss": {"velocity_std_m_s": None}},
        {"body_axes": "FRD", "start": {"heading_deg": 190}},
        {"gnss": {"rate_hz": 1, "phase_s": 0.37, "jitter_s": 0.1}},
        {"gnss": {"outages_s": [[20, 35]]}},
        {"trial": {"initial": {"attitude_std_deg": [0.5, 0.5, 2]}}},
    ],
    ids=["plain", "antenna", "no velocity", "axes", "clock", "outage", "prior"],
)
def test_without_noise_navigation_is_exact(changes):
    trial = simulate(scenario(**changes))
    solution = kalman(trial, "wahba")
    errors = trajectory_errors(solution, trial.reference)
    for vector in (errors.position, errors.velocity, errors.attitude):
        assert np.sqrt(np.mean(vector.normalised**2)) < 0.1


def test_navigation_is_honest():
    nees = []
    for seed in range(6):
        trial = simulate(scenario(noise=True, manoeuvres=VARIED), seed)
        navigation = navigate(trial, trial.dvl.time)
        motion = motion_at(navigation, trial.reference.time[10:-10])
        at = motion.covered
        truth = rotation_from_rph(trial.reference.rph[10:-10][at], trial.body_axes)
        error = np.hstack(
            [
                trial.reference.velocity[10:-10][at] - motion.velocity[at],
                log_so3(truth @ motion.nRb[at].transpose(0, 2, 1)),
            ]
        )
        P = motion.covariance[at, 3:, 3:]
        nees.append(np.mean(np.sum(error * np.linalg.solve(P, error[..., None])[..., 0], axis=1)))
    assert 3.0 < np.mean(nees) < 10.0  # 6, of a few independent errors for each seed


def test_the_smoother_beats_the_filter():
    trial = simulate(scenario(noise=True), 3)
    samples = samples_of(trial)
    time = trial.gnss.time
    fixes = Fixes(
        trial.gnss.geodetic,
        trial.gnss.velocity,
        trial.gnss.position_std**2,
        trial.gnss.velocity_std**2,
        np.zeros((time.size, 3)),
        np.zeros(3),
    )
    ref = trial.reference
    at = np.searchsorted(ref.time, time[0] - 1e-6)
    variances = np.repeat([1.0, 0.01, (0.1 * DEG) ** 2, (3e-7) ** 2, (100 * MICRO_G) ** 2], 3)
    start = FilterState(
        ref.geodetic[at],
        ref.velocity[at],
        rotation_from_rph(ref.rph[at], trial.body_axes),
        np.zeros(3),
        np.zeros(3),
        np.diag(variances),
    )
    forward = run_filter(time, compose(samples, time[:-1], time[1:]), fixes, start, (0.0, 0.0))
    smoothed = smooth(forward)
    filtered = forward.track
    truth = ref.velocity[np.searchsorted(ref.time, time - 1e-6)]
    before = np.sqrt(np.mean((filtered.velocity - truth) ** 2))
    after = np.sqrt(np.mean((smoothed.velocity - truth) ** 2))
    assert after < 0.8 * before
    change = np.diagonal(filtered.covariance - smoothed.covariance, axis1=1, axis2=2)
    assert np.all(change >= -1e-9 * np.diagonal(filtered.covariance, axis1=1, axis2=2))
    np.testing.assert_array_equal(smoothed.covariance[-1], filtered.covariance[-1])


def test_after_a_gap_the_filter_starts_again():
    trial = simulate(scenario(imu={"gaps_s": [[25.0, 40.0]]}))
    solution = kalman(trial)
    assert "starts again at 40" in " ".join(solution.warnings)
    assert angle_between(solution, [2, 2, 30]) < 0.01
    assert not np.any((solution.trajectory.time > 25.01) & (solution.trajectory.time < 39.9))


def test_without_velocities_fixes_may_cross_180_degrees():
    def solved(lon):
        start = {"lat_deg": 36, "lon_deg": lon, "heading_deg": 90, "speed_m_s": 4}
        trial = simulate(scenario(noise=True, start=start), 1)
        assert lon == 121 or np.ptp(trial.gnss.geodetic[:, 1]) > 6
        nothing = np.full_like(trial.gnss.velocity, np.nan)
        return kalman(replace(trial, gnss=replace(trial.gnss, velocity=nothing)))

    across, elsewhere = solved(179.9995), solved(121)
    assert np.abs(across.trajectory.geodetic[:, 1]).max() <= np.pi
    std = elsewhere.estimate("misalignment_deg").std
    values = [s.estimate("misalignment_deg").value for s in (across, elsewhere)]
    assert np.all(np.abs(values[0] - values[1]) < 0.1 * std)


def test_walking_biases_are_reported_as_their_mean():
    walk = {"gyro_bias_walk_deg_h_sqrt_h": 0.1, "accel_bias_walk_ug_sqrt_h": 50}
    solution = kalman(simulate(scenario(noise=True, imu=walk), 1))
    assert np.all(np.isfinite(solution.covariance))
    assert solution.estimate("gyro_bias_deg_h").prior_std[0] > 0.05


# Calibrators


def test_the_measurement_matrix_is_that_of_the_format():
    rng = np.random.default_rng(1)
    v, omega = rng.normal(size=3), rng.normal(size=3)

    def z(x):
        return (1 + x[3]) * exp_so3(x[:3]) @ (v + np.cross(omega, x[4:])) - v

    step = 1e-6
    numeric = np.stack([(z(step * e) - z(-step * e)) / (2 * step) for e in np.eye(7)], axis=1)
    np.testing.assert_allclose(measurement_matrix(v[None], omega[None])[0], numeric, atol=1e-8)


@pytest.mark.parametrize("phase", ["0", "90"])
def test_seven_states_reach_the_accuracy_of_the_paper(phase):
    trial = simulate(config(f"seed-a-phase-{phase}"), 0)
    solution, history = calibrate(trial)
    assert paper_accuracy(solution.estimates, trial.calibration_truth) > 97.3
    assert history.names[:4] == (
        "misalignment_x_deg",
        "misalignment_y_deg",
        "misalignment_z_deg",
        "scale_error",
    )
    assert np.all(np.diff(history.time) > 0)
    assert history.std[-1, 2] < 1e-3 * history.std[0, 2]
    np.testing.assert_allclose(history.values[-1, 2], 30.0, atol=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["0", "90"])
def test_seven_states_over_seeds(phase):
    accuracy, normalised = [], []
    for seed in range(min(SEEDS, 20)):
        trial = simulate(config(f"seed-a-phase-{phase}"), seed)
        solution = kalman(trial)
        accuracy.append(paper_accuracy(solution.estimates, trial.calibration_truth))
        errors = calibration_errors(solution, trial.calibration_truth)
        normalised.append(errors.normalised)
    assert np.mean(accuracy) > 98.5
    ratio = np.sqrt(np.mean(np.square(normalised), axis=0))
    # The heading error of SINS/GNSS stays the same from ping to ping, and the filter takes
    # it for new each time.
    assert ratio[2] > 2.0
    # The SINS/GNSS filter itself is honest.
    assert np.all(ratio[7:] < 1.6)


@pytest.mark.parametrize(
    "misalignment", [[0, 0, 30], [0, 0, 90], [0, 0, 180], [0, 180, 0], [100, -80, 60]], ids=str
)
@pytest.mark.parametrize("method", DVL_METHODS)
def test_without_noise_large_misalignments_are_exact(method, misalignment):
    knows_arm = method in ("nine-state", "wahba")
    claims = {"lever_arm_m": [1, 1.2, 1.4]} if knows_arm else {}
    scene = scenario(
        manoeuvres=VARIED, dvl={"misalignment_deg": misalignment}, trial={"dvl": claims}
    )
    solution = kalman(simulate(scene), method)
    assert solution.converged
    assert solution.solver == f"kalman-{method}"
    assert angle_between(solution, misalignment) < 1e-3
    np.testing.assert_allclose(solution.estimate("scale_error").value, 0.005, atol=1e-4)
    if not knows_arm:
        np.testing.assert_allclose(
            solution.estimate("lever_arm_m").value, [1, 1.2, 1.4], atol=2e-3
        )


def nine_state_trial(manoeuvres, sway=SWELL):
    return simulate(
        scenario(
            noise=True,
            manoeuvres=manoeuvres,
            sway=sway,
            gnss={"position_std_m": [0.02, 0.02, 0.04], "velocity_std_m_s": [0.02, 0.02, 0.02]},
            dvl={
                "misalignment_deg": [1, -1, 2],
                "scale_error": [0.01, -0.02, 0.005],
                "bias_m_s": [0.02, -0.03, 0.01],
                **NO_ARM,
            },
            trial={"dvl": {"bias_std_m_s": [0.2, 0.2, 0.2]}},
        ),
        2,
    )


def test_nine_states_separate_bias_and_scale_when_the_speed_varies():
    solution, history = calibrate(nine_state_trial(VARIED), "nine-state")
    bias, scale = solution.estimate("dvl_bias_m_s"), solution.estimate("scale_error")
    assert bias.observable[1]
    assert scale.observable[1]
    np.testing.assert_allclose(bias.value[1], -0.03, atol=0.01)
    np.testing.assert_allclose(scale.value[1], -0.02, atol=0.003)
    np.testing.assert_allclose(history.values[-1, :3], solution.estimates[0].value, atol=1e-6)


def test_nine_states_say_when_bias_and_scale_do_not_separate():
    solution = kalman(nine_state_trial([{"straight_s": 60}], sway={}), "nine-state")
    assert not solution.estimate("dvl_bias_m_s").observable[1]
    assert not solution.estimate("scale_error").observable[1]
    assert "bias and scale separate only where the speed" in " ".join(solution.warnings)


def test_wahba_takes_its_covariance_from_the_residuals():
    trial = simulate(scenario(noise=True, manoeuvres=VARIED, dvl=NO_ARM), 0)
    solution = kalman(trial, "wahba")
    assert angle_between(solution, [2, 2, 30]) < 0.2
    loud = replace(trial.dvl, velocity=trial.dvl.velocity + 0.0)
    loud.velocity[:] += np.random.default_rng(0).normal(0.0, 0.1, loud.velocity.shape)
    noisy = kalman(replace(trial, dvl=loud), "wahba")
    assert np.all(noisy.estimates[0].std > 3.0 * solution.estimates[0].std)


def test_least_squares_finds_a_time_offset():
    scene = scenario(
        noise=True, dvl={"time_offset_s": 0.08}, trial={"dvl": {"time_offset_std_s": 0.5}}
    )
    solution = kalman(simulate(scene, 1), "least-squares")
    offset = solution.estimate("time_offset_s")
    assert offset.observable[0]
    np.testing.assert_allclose(offset.value, 0.08, atol=max(5.0 * offset.std[0], 1e-3))
    assert "time_offset_s" in " ".join(kalman(simulate(scene, 1)).warnings)


# What cannot be done


@pytest.mark.parametrize("method", DVL_METHODS)
@pytest.mark.parametrize(
    "changes",
    [
        STILL,
        {**STILL, "start": {"speed_m_s": 0}},
        {"dvl": {"no_lock_s": [[0.0, 100.0]]}},
        {"trial": {"dvl": {"misalignment_std_deg": [0, 0, 0], "scale_error_std": 0}}},
    ],
    ids=["straight", "at rest", "no lock", "held"],
)
def test_what_is_not_observable_is_said(method, changes):
    solution = kalman(simulate(scenario(noise=True, **changes), 1), method)
    assert np.all(np.isfinite(solution.covariance))
    assert not solution.estimate("misalignment_deg").observable.all()
    assert all(np.all(np.isfinite(e.value)) for e in solution.estimates)
    assert "not observable" in " ".join(solution.warnings)
    n = sum(e.value.size for e in solution.estimates) - 6
    assert not solution.covariance[:n, n:].any()


def test_bad_input():
    trial = simulate(scenario())
    with pytest.raises(DataError, match="needs GNSS positions"):
        kalman(replace(trial, gnss=None))
    with pytest.raises(DataError, match="no DVL"):
        kalman(replace(trial, dvl=None))
    with pytest.raises(ConfigError, match="method is 'ukf'"):
        kalman(trial, "ukf")
    with pytest.raises(ConfigError, match="rate_hz"):
        kalman(trial, rate_hz=0.0)
    with pytest.raises(ConfigError, match="through the water"):
        kalman(simulate(scenario(dvl={"reference": "water"})))
    late = replace(trial.gnss, time=trial.gnss.time + 1e4)
    with pytest.raises(DataError, match="no GNSS position while"):
        kalman(replace(trial, gnss=late))


def run(*args):
    with pytest.raises(SystemExit) as caught:
        main([str(arg) for arg in args])
    return caught.value.code


def test_command_line(tmp_path, capsys):
    trial = write_trial(tmp_path, simulate(scenario(noise=True), 0))
    out = tmp_path / "out"
    assert [m.value for m in KalmanMethod if not m.planar] == list(METHODS)
    assert run("kalman", trial, "--out", out, "--quiet", "--no-figures", "--rate", "5") == 0
    assert {p.name for p in out.iterdir()} == {
        "calibration.json",
        "instrument.yaml",
        "trajectory.csv",
        "history.csv",
    }
    solution = load_solution(out)
    assert solution.solver == "kalman-point-set"
    np.testing.assert_allclose(np.diff(solution.trajectory.time), 0.2)
    columns = ["time_s", "misalignment_z_deg", "misalignment_z_deg_std", "lever_arm_z_m_std"]
    history = read_table(out / "history.csv", columns)
    assert history["misalignment_z_deg_std"][-1] < history["misalignment_z_deg_std"][0]
    again = ("kalman", trial, "--out", out, "--method", "wahba", "--no-figures")
    assert run(*again) == 2
    # It has no lever arm, and the sway shows one of 1 m: it writes its answer, but warns of it.
    assert run(*again, "--force") == 1
    assert "the model does not fit the data" in capsys.readouterr().err
    assert not (out / "history.csv").exists()
    assert run("kalman", trial, "--out", tmp_path / "x", "--method", "ukf") == 2
    (trial / "gnss.csv").write_text("time_s,lat_deg,lon_deg,height_m\n1,,,\n2,,,\n")
    assert run("kalman", trial, "--out", tmp_path / "y") == 2
    assert "none of its rows holds a measurement" in " ".join(capsys.readouterr().err.split())
