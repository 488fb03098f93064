"""Single beams: geometry, factor, lost beams, turntable, gauge, conversions."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import yaml
from beam_statistics import nees_of
from findings import of_code
from jacobians import check_jacobians, differentiate, random_motion
from scipy.stats import chi2
from truth import exact_motion, scenario

from factorgraph_dvl.analysis.beam_quality import beam_calibration
from factorgraph_dvl.analysis.dead_reckoning.before_after import before_after
from factorgraph_dvl.analysis.information.observability import observability
from factorgraph_dvl.analysis.information.segment_singular_values import (
    BeamMounting,
    BodyMotion,
    beam_rows,
)
from factorgraph_dvl.baselines import calibrate
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.external_results import read_truth
from factorgraph_dvl.files.solution_folder import load_solution, save_solution
from factorgraph_dvl.files.trial_folder import load_trial, save_trial
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.unit_vectors import tangent_axes, turned, turned_jacobian, turns_to
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.imu.attitude_history import AttitudeHistory
from factorgraph_dvl.planning.prediction import extend, predict
from factorgraph_dvl.plausibility.survey import survey
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.report.figures.observability import (
    history_figure,
    write_observability_figures,
)
from factorgraph_dvl.report.figures.solution import write_figures
from factorgraph_dvl.sensors.beam_geometry import (
    as_dvl,
    error_rows,
    error_velocity,
    group_velocities,
    groups,
    instrument_matrix,
    velocities,
)
from factorgraph_dvl.sensors.dvl_beams import DvlBeams, DvlBeamsSettings
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.simulation import plan_motion, simulate
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.information_along_trial import solve_with_history

JANUS_X = ((30.0, 45.0), (30.0, 315.0), (30.0, 225.0), (30.0, 135.0))
JANUS_PLUS = ((25.0, 0.0), (25.0, 90.0), (25.0, 180.0), (25.0, 270.0))
FOUR_AND_ONE = (*JANUS_PLUS, (0.0, 0.0))
THREE = ((30.0, 0.0), (30.0, 120.0), (30.0, 240.0))
SCALES = (0.01, -0.004, 0.002, -0.009)
SILENT = {
    "imu": {"gyro_bias_std_deg_h": 0.05, "accel_bias_std_ug": 100},
    "dvl": None,
    "initial": {"position_std_m": [1, 1, 1]},
}
ERRORS = ((0.9, -0.3), (-0.2, 0.5), (0.1, 0.8), (-0.6, -0.6))


def settings(slants=JANUS_X, **changes):
    return DvlBeamsSettings(slant_azimuth_deg=slants, **changes)


def beams(velocity, slants=JANUS_X, **changes):
    velocity = np.asarray(velocity, dtype=float)
    return DvlBeams(settings(slants, **changes), np.arange(len(velocity)) * 0.2, velocity)


def observation(m=5, *, values=None, lost=(), seed=0, **changes):
    """Return an observation of beams with random numbers, and values of its parameters."""
    rng = np.random.default_rng(seed)
    velocity = rng.normal(0.0, 2.0, (m, 4))
    for ping, beam in lost:
        velocity[ping, beam] = np.nan
    sensor = beams(velocity, **changes)
    (found,) = sensor.observations(None, "RFU")
    return found, sensor.parameters()


def beam_values(**changes):
    return {
        "beam_direction_b": np.array(ERRORS).ravel() * DEG,
        "beam_scale_error": np.array(SCALES),
        "lever_arm_m": np.array([1.0, -1.2, 1.4]),
    } | changes


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 3.0, 60.0])
def test_a_direction_and_its_coordinates_are_one(degrees):
    rng = np.random.default_rng(0)
    nominal = rng.normal(size=(50, 3))
    nominal[:2] = [[0, 0, -1], [0, 0, 1]]
    nominal /= np.linalg.norm(nominal, axis=1)[:, None]
    bearing = rng.uniform(0.0, 7.0, 50)
    eta = degrees * DEG * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    directions = turned(nominal, eta)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-14)
    angle = np.arccos(np.clip(np.sum(nominal * directions, axis=1), -1.0, 1.0))
    np.testing.assert_allclose(angle, degrees * DEG, atol=1e-7)
    np.testing.assert_allclose(turns_to(nominal, 3.0 * directions), eta, atol=1e-13)
    numerical = differentiate(lambda h: turned(nominal, eta + h), 2)
    np.testing.assert_allclose(turned_jacobian(nominal, eta), numerical, atol=1e-9)


def test_the_axes_of_a_direction_by_hand():
    # Straight down they are x and y. Of a beam 30 deg ahead of that, x stays, and y tilts
    # down with it.
    s, c = np.sin(30 * DEG), np.cos(30 * DEG)
    found = tangent_axes(np.array([[0.0, 0.0, -1.0], [0.0, s, -c]]))
    np.testing.assert_allclose(found[0], [[1, 0], [0, 1], [0, 0]], atol=1e-15)
    np.testing.assert_allclose(found[1], [[1, 0], [0, c], [0, s]], atol=1e-15)


def test_nominal_directions_three_ways_are_the_same_beams():
    vectors = settings().nominal_d
    root = np.sqrt(0.125)
    by_hand = [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    np.testing.assert_allclose(vectors[:, :2], np.array(by_hand) * root, atol=1e-15)
    np.testing.assert_allclose(vectors[:, 2], -np.cos(30 * DEG), atol=1e-15)
    alpha, theta = np.arcsin(root) / DEG, 60.0
    patent = DvlBeamsSettings(alpha_theta_deg=((alpha, theta),) * 4)
    np.testing.assert_allclose(patent.nominal_d, vectors, atol=1e-14)
    # A Janus in +: beams 1 and 3 are in the xz plane, where rounding may go beyond it.
    for slant in np.arange(5.0, 60.0):
        plus = DvlBeamsSettings(alpha_theta_deg=((slant, 90 - slant), (0, 90 - slant)) * 2)
        s, c = np.sin(slant * DEG), np.cos(slant * DEG)
        by_hand = [[s, 0, -c], [0, s, -c], [-s, 0, -c], [0, -s, -c]]
        np.testing.assert_allclose(plus.nominal_d, by_hand, atol=1e-7)
    given = DvlBeamsSettings(directions=tuple(map(tuple, (1.002 * vectors).tolist())))
    np.testing.assert_allclose(given.nominal_d, vectors, atol=1e-15)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "given one way"),
        ({"slant_azimuth_deg": JANUS_X, "directions": ((0, 0, -1),) * 3}, "found"),
        ({"slant_azimuth_deg": JANUS_X[:2]}, "three or more"),
        ({"slant_azimuth_deg": ((10, 0), (20, 0), (30, 180))}, "in one plane"),
        ({"directions": ((0, 0, -1), (0, 1, -1), (-1, 0, 0))}, "beam 2 has the length 1.41"),
        ({"alpha_theta_deg": ((20, 60), (20, 60), (31, 60), (20, 60))}, "those of beam 3 do"),
        ({"alpha_theta_deg": ((20, 60),) * 3}, "four beams"),
        ({"alpha_theta_deg": ((40, 60),) * 4}, "add up"),
        ({"slant_azimuth_deg": JANUS_X, "scale_error": (0.1, 0.2)}, "one number, or 4"),
        ({"slant_azimuth_deg": JANUS_X, "misalignment_std_deg": (1, 1, 1)}, "common"),
    ],
)
def test_settings_that_cannot_be(changes, message):
    with pytest.raises(ValueError, match=message):
        DvlBeamsSettings(**changes)


def test_beam_velocity_by_hand():
    # Heading north at 2 m/s, turning about the vertical at 0.1 rad/s, DVL 3 m ahead: it
    # moves 0.3 m/s to port as well.
    o, _ = observation(1)
    motion = Motion(
        nRb=np.eye(3)[None],
        p_n=np.zeros((1, 3)),
        v_n=np.array([[0.0, 2.0, 0.0]]),
        omega_eb_b=np.array([[0.0, 0.0, 0.1]]),
        a_n=np.zeros((1, 3)),
        alpha_b=np.zeros((1, 3)),
        omega_sigma=np.zeros((1, 3)),
    )
    values = {
        "beam_direction_b": np.zeros(8),
        "beam_scale_error": np.array([0.1, 0.0, 0.0, 0.0]),
        "lever_arm_m": np.array([0.0, 3.0, 0.0]),
    }
    r = np.sqrt(0.125)
    predicted = o.residual(motion, values) + o.measured
    by_hand = [[1.1 * (2.0 - 0.3) * r, (2.0 + 0.3) * r, (-2.0 + 0.3) * r, (-2.0 - 0.3) * r]]
    np.testing.assert_allclose(predicted, by_hand, atol=1e-15)


@pytest.mark.parametrize("lost", [(), ((0, 1), (2, 0), (2, 3))])
def test_beam_velocity_jacobians(lost):
    o, parameters = observation(lost=lost, misalignment_deg=(5.0, -4.0, 100.0))
    check_jacobians(o, random_motion(), beam_values(), parameters)


def test_common_parametrisation_jacobians():
    o, parameters = observation(parametrisation="common")
    values = {
        "misalignment_deg": exp_so3(np.array([10.0, -25.0, 130.0]) * DEG),
        "scale_error": np.array([0.03]),
        "lever_arm_m": np.array([1.0, -1.2, 1.4]),
    }
    check_jacobians(o, random_motion(), values, parameters)


def test_both_parametrisations_predict_the_same():
    turn, scale = exp_so3(np.array([0.5, -0.4, 0.8]) * DEG), 0.012
    motion, lever_arm = random_motion(), np.array([1.0, -1.2, 1.4])
    free, _ = observation()
    common, _ = observation(parametrisation="common")
    nominal = settings().nominal_d
    eta = turns_to(nominal, nominal @ turn)
    a = free.residual(
        motion, beam_values(beam_direction_b=eta.ravel(), beam_scale_error=np.full(4, scale))
    )
    b = common.residual(
        motion,
        {"misalignment_deg": turn, "scale_error": np.array([scale]), "lever_arm_m": lever_arm},
    )
    np.testing.assert_allclose(a, b, atol=1e-14)


def test_a_lost_beam_counts_nothing_and_the_others_as_before():
    whole, _ = observation(3)
    part, _ = observation(3, lost=((1, 2),))
    motion, values = random_motion(3), beam_values()
    assert np.isinf(part.sigma(motion, values)[1, 2])
    assert np.isfinite(part.residual(motion, values)).all()
    others = np.ones((3, 4), dtype=bool)
    others[1, 2] = False
    for method in ("residual", "sigma"):
        a, b = (getattr(o, method)(motion, values)[others] for o in (whole, part))
        np.testing.assert_array_equal(a, b)


def scene(slants=JANUS_X, **changes):
    n = len(slants)
    truth = {
        "rate_hz": 5,
        "slant_azimuth_deg": slants,
        "direction_error_deg": ERRORS[:1] * n if n > 4 else ERRORS[:n],
        "scale_error": SCALES[:1] * n if n > 4 else SCALES[:n],
        "lever_arm_m": [1.0, -1.2, 1.4],
        "velocity_std_m_s": 0.005,
        "velocity_std_fraction": 0.002,
    }
    turns = {
        "rate_hz": 10,
        "turns": [{"at_s": 20.3, "turn_deg": 90, "duration_s": 15, "ramp_s": 3}],
    }
    base = {
        "dvl": None,
        "dvl_beams": truth,
        "turntable": turns,
        "gnss": {"lever_arm_m": [0.3, -1.5, 4.0]},
        "trial": {"dvl": None},
    }
    return scenario(**(base | changes))


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
@pytest.mark.parametrize("slants", [JANUS_X, FOUR_AND_ONE, THREE])
def test_zero_error_at_the_truth_on_a_turntable(slants, body_axes):
    scn = scene(slants, body_axes=body_axes)
    trial = simulate(scn)
    frame = trial.frame()
    found = {o.label: o for aid in trial.aids for o in aid.observations(frame, "RFU")}
    truth = trial.calibration_truth
    eta = turns_to(trial.beams.nominal_b, truth["beam_direction_b"]).ravel()
    values = {**truth, "beam_direction_b": eta}
    for label, limit in (
        ("Beam velocity", 1e-13),
        # The monotone cubics of the estimator through the angle's samples, times 4 m.
        ("GNSS position", 2e-4),
        ("GNSS velocity", 5e-3),
    ):
        o = found[label]
        motion = exact_motion(plan_motion(scn), frame, o.time)
        assert np.abs(o.residual(motion, values)).max() < limit, label


def test_the_antenna_does_not_turn_with_the_body():
    scn = scene()
    trial = simulate(scn)
    frame = trial.frame()
    fixed = replace(trial.gnss, turning=None).observations(frame, "RFU")
    motion = exact_motion(plan_motion(scn), frame, fixed[0].time)
    error = fixed[0].residual(motion, trial.calibration_truth)
    late = fixed[0].time > 36.0
    # Turned by 90 deg, the level part of the lever arm is off by its length times sqrt 2.
    np.testing.assert_allclose(
        np.linalg.norm(error[late], axis=1), np.sqrt(2.0) * np.hypot(0.3, 1.5), atol=0.02
    )


def test_antenna_jacobians_on_a_turntable():
    scn = scene()
    trial = simulate(scn)
    during = (trial.gnss.time > 25.0) & (trial.gnss.time < 26.0)
    names = ("time", "geodetic", "velocity", "position_std", "velocity_std")
    few = replace(trial.gnss, **{name: getattr(trial.gnss, name)[during] for name in names})
    assert np.abs(few.carrier(few.time)[1]).max() > 0.05
    for o in few.observations(trial.frame(), "RFU"):
        motion = exact_motion(plan_motion(scn), trial.frame(), o.time)
        values = {"gnss_lever_arm_m": np.array([0.3, -1.5, 4.0])}
        check_jacobians(o, motion, values, few.parameters(), tolerance=1e-7)


def noisy(**changes):
    """Return a noisy trial of 70 s with a turntable."""
    claims = {"imu": {"gyro_bias_std_deg_h": 0.05, "accel_bias_std_ug": 100}}
    accurate = {
        "rate_hz": 5,
        "position_std_m": [0.01, 0.01, 0.02],
        "velocity_std_m_s": [0.03, 0.03, 0.03],
        "lever_arm_m": [0.3, -1.5, 4.0],
    }
    return scene(**({"noise": True, "gnss": accurate, "trial": claims | {"dvl": None}} | changes))


@pytest.fixture(scope="module")
def solved():
    trial = simulate(noisy(), 1)
    return trial, solve(trial)


def test_directions_and_scales_are_found(solved):
    trial, solution = solved
    assert solution.converged
    assert [e.name for e in solution.estimates[:3]] == [
        "beam_direction_b",
        "beam_scale_error",
        "lever_arm_m",
    ]
    nees, dof = nees_of(solution, trial.calibration_truth)
    assert dof == 15
    assert nees < chi2.ppf(0.999, dof)
    assert solution.estimate("beam_direction_b").observable.all()
    assert solution.estimate("beam_direction_b").std.max() < 0.15


def test_a_solution_keeps_its_directions_in_files(solved, tmp_path):
    trial, solution = solved
    save_solution(solution, tmp_path / "out")
    found = load_solution(tmp_path / "out")
    a, b = (s.estimate("beam_direction_b") for s in (solution, found))
    np.testing.assert_allclose(a.value, b.value, atol=1e-11)
    np.testing.assert_array_equal(a.std, b.std)
    np.testing.assert_array_equal(a.observable, b.observable)
    content = json.loads((tmp_path / "out" / "calibration.json").read_text())
    stated = content["parameters"]["beam_direction_b"]
    assert np.shape(stated["value"]) == (4, 3)
    assert np.shape(stated["std"]) == (4, 2)
    np.testing.assert_allclose(np.linalg.norm(stated["value"], axis=1), 1.0, atol=1e-14)
    order = content["covariance"]["order"]
    assert order[:3] == ["beam_direction_1x_deg", "beam_direction_1y_deg", "beam_direction_2x_deg"]
    assert len(order) == len(content["covariance"]["matrix"]) == 22
    truth = turns_to(trial.beams.nominal_b, trial.calibration_truth["beam_direction_b"]) / DEG
    np.testing.assert_allclose(truth, ERRORS, atol=1e-12)


def test_a_trial_keeps_beams_turntable_and_truth_in_files(tmp_path):
    trial = simulate(noisy(), 1)
    velocity = trial.beams.velocity
    velocity[3, 1] = np.nan
    save_trial(trial, tmp_path / "trial")
    found = load_trial(tmp_path / "trial")
    np.testing.assert_array_equal(found.beams.velocity, velocity)
    assert found.beams.settings == replace_file(trial.beams.settings, "dvl_beams.csv")
    np.testing.assert_allclose(found.gnss.turning.angle, trial.gnss.turning.angle, atol=1e-12)
    assert found.notes == ()
    truth = found.calibration_truth["beam_direction_b"]
    np.testing.assert_array_equal(truth, trial.calibration_truth["beam_direction_b"])
    values = read_truth(tmp_path / "trial" / "truth.json")
    np.testing.assert_array_equal(values["beam_direction_b"], truth)


def test_directions_given_twice_are_found_where_they_are(tmp_path):
    save_trial(simulate(noisy(), 1), tmp_path / "trial")
    file = tmp_path / "trial" / "trial.yaml"
    data = yaml.safe_load(file.read_text())
    data["dvl_beams"]["directions"] = [[0, 0, -1]] * 4
    file.write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError) as error:
        load_trial(tmp_path / "trial")
    assert re.match(r"trial.yaml line \d+: dvl_beams.directions: the beams'", str(error.value))


def replace_file(section, name):
    return msgspec.structs.replace(section, file=name)


def test_bad_files_are_named(tmp_path):
    save_trial(simulate(noisy(), 1), tmp_path / "trial")
    table = tmp_path / "trial" / "dvl_beams.csv"
    text = table.read_text()
    for old, new, message in (
        ("beam3_m_s", "beam5_m_s", "missing column beam3_m_s"),
        ("0.4,", "0.4,99", r"dvl_beams.csv line 3: beam1_m_s = 99"),
    ):
        table.write_text(text.replace(old, new, 1))
        with pytest.raises(DataError, match=message):
            load_trial(tmp_path / "trial")
    table.write_text(text)
    settings_file = tmp_path / "trial" / "trial.yaml"
    settings_file.write_text(settings_file.read_text().replace("slant_azimuth_deg", "directions"))
    with pytest.raises(ConfigError, match=r"dvl_beams\.directions"):
        load_trial(tmp_path / "trial")


@pytest.mark.parametrize("lost", [[1], [2, 3], [1, 2, 4]])
def test_beams_lost_for_good_leave_the_others(lost):
    gone = [{"beam": b, "from_s": 30, "to_s": 100} for b in lost]
    base = noisy().dvl_beams
    truth = {
        "rate_hz": 5,
        "slant_azimuth_deg": JANUS_X,
        "direction_error_deg": base.direction_error_deg,
        "scale_error": base.scale_error,
        "lever_arm_m": [1.0, -1.2, 1.4],
        "velocity_std_m_s": 0.005,
        "velocity_std_fraction": 0.002,
        "lost": gone,
    }
    trial = simulate(noisy(dvl_beams=truth), 2)
    solution = solve(trial)
    assert solution.converged
    nees, dof = nees_of(solution, trial.calibration_truth)
    assert nees < chi2.ppf(0.999, dof)
    assert solution.estimate("beam_direction_b").observable.all()
    residual = next(r for r in solution.residuals if r.label == "Beam velocity")
    count = np.isfinite(residual.residual).sum(axis=0)
    assert list(count < count.max()) == [b in lost for b in (1, 2, 3, 4)]
    np.testing.assert_array_equal(np.isfinite(residual.sigma), np.isfinite(residual.residual))


@pytest.mark.slow
def test_noise_in_proportion_to_velocity_leaves_the_scales_alone():
    base = msgspec.to_builtins(noisy().dvl_beams) | {"velocity_std_fraction": 0.05}
    errors = []
    for seed in range(6):
        trial = simulate(noisy(dvl_beams=base), seed)
        found = solve(trial, rate_hz=1.0).estimate("beam_scale_error")
        errors.append((found.value - SCALES) / found.std)
    # By the measured velocities they would be 0.005 too small, 1.4 sigma each.
    assert abs(np.mean(errors)) < 2.5 / np.sqrt(np.size(errors))


def unseen(solution):
    return of_code(solution.findings, Code.NOT_OBSERVABLE)


def test_a_beam_that_was_never_received_is_named():
    trial = simulate(noisy(), 1)
    trial.beams.velocity[:, 2] = np.nan
    solution = solve(trial)
    seen = solution.estimate("beam_direction_b").observable
    assert seen.tolist() == [True] * 4 + [False] * 2 + [True] * 2
    said = "beam_direction_3x_deg, beam_direction_3y_deg not observable: beam 3 was never received"
    assert any(text.startswith(said) for text in unseen(solution))
    trial.beams.velocity[:, 0] = np.nan
    for i in (1, 3):
        said = f"beam_direction_{i}x_deg, beam_direction_{i}y_deg not observable: beam {i} was"
        assert any(text.startswith(said) for text in unseen(solve(trial)))


@pytest.mark.slow
def test_each_beam_that_was_never_received_is_named(tmp_path):
    trial = simulate(noisy(turntable=None), 1)
    trial.beams.velocity[:, 1:] = np.nan
    solution = solve(trial)
    for beam in (2, 3, 4):
        said = f"beam_scale_error_{beam} not observable: beam {beam} was never received"
        assert said in unseen(solution)
    arm = next(f.text for f in solution.findings if f.parameter == "lever_arm_m")
    assert arm.endswith("too few beams were ever received: 1")
    # Nothing says how beams agree of which there is one.
    drawn = {file.name for file in write_figures(trial, solution, tmp_path)}
    assert "beam_residuals.png" in drawn
    assert "beam_quality.png" not in drawn


def test_a_single_ping_is_solved_and_written(tmp_path):
    trial = simulate(noisy(turntable=None), 1)
    sensor = replace(trial.beams, time=trial.beams.time[:1], velocity=trial.beams.velocity[:1])
    save_trial(replace(trial, others=(sensor,)), tmp_path / "trial")
    with pytest.raises(SystemExit) as done:
        main(["solve", str(tmp_path / "trial"), "--out", str(tmp_path / "out"), "--no-figures"])
    assert done.value.code == 0
    assert (tmp_path / "out" / "beams.csv").exists()


def test_the_common_mounting_is_found_from_anywhere():
    mounting = [20.0, -30.0, 150.0]
    truth = {
        "rate_hz": 5,
        "slant_azimuth_deg": JANUS_PLUS,
        "misalignment_deg": mounting,
        "scale_error": [0.01] * 4,
        "lever_arm_m": [1.0, -1.2, 1.4],
        "velocity_std_m_s": 0.005,
    }
    claims = {
        "imu": {"gyro_bias_std_deg_h": 0.05, "accel_bias_std_ug": 100},
        "dvl": None,
        "dvl_beams": {
            "parametrisation": "common",
            "misalignment_deg": [0, 0, 0],
            "misalignment_std_deg": [180, 180, 180],
        },
    }
    trial = simulate(noisy(dvl_beams=truth, trial=claims), 1)
    solution = solve(trial)
    assert solution.converged
    nees, dof = nees_of(solution, trial.calibration_truth)
    assert dof == 7
    assert nees < chi2.ppf(0.999, dof)
    np.testing.assert_allclose(solution.estimate("misalignment_deg").value, mounting, atol=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 4])
def test_a_common_mounting_that_is_far_off_does_not_mislead_poor_gyros(seed):
    imu = {"gyro_noise_deg_sqrt_h": 0.15, "accel_noise_ug_sqrt_hz": 60}
    imu |= {"gyro_bias_deg_h": "draw", "accel_bias_ug": "draw"}
    bias = {"gyro_bias_std_deg_h": 20, "accel_bias_std_ug": 2000}
    claims = {
        "imu": bias,
        "dvl": None,
        "dvl_beams": {"parametrisation": "common", "misalignment_std_deg": [180, 180, 180]}
        | {"misalignment_deg": [0, 0, 0]},
    }
    truth = {"rate_hz": 5, "slant_azimuth_deg": JANUS_X, "misalignment_deg": [170, 0, 0]}
    truth |= {"scale_error": [0.01] * 4, "velocity_std_m_s": 0.005}
    truth |= {"lever_arm_m": [1.0, -1.2, 1.4]}
    gnss = {"rate_hz": 1, "position_std_m": [2, 2, 4], "velocity_std_m_s": [0.3, 0.3, 0.3]}
    gnss |= {"lever_arm_m": [0.3, -1.5, 4.0]}
    parts = [{"straight_s": 20}, {"turn_deg_s": 6, "duration_s": 30, "ramp_s": 4}]
    parts += [{"straight_s": 60}, {"accelerate_m_s2": -0.1, "to_m_s": 2.5}, {"straight_s": 60}]
    parts += [{"turn_deg_s": -4, "duration_s": 30, "ramp_s": 4}, {"straight_s": 60}]
    changes = {
        "imu": imu | bias,
        "gnss": gnss,
        "dvl_beams": truth,
        "turntable": None,
        "trial": claims,
    }
    trial = simulate(noisy(manoeuvres=parts, **changes), seed)
    solution = solve(trial, rate_hz=1.0)
    assert solution.converged
    nees, dof = nees_of(solution, trial.calibration_truth)
    assert nees < chi2.ppf(0.999, dof)


def test_beams_beside_a_dvl_have_names_of_their_own():
    claims = {"imu": {"gyro_bias_std_deg_h": 0.05, "accel_bias_std_ug": 100}}
    dvl = {"rate_hz": 5, "misalignment_deg": [1, 2, 30], "velocity_std_m_s": 0.005}
    trial = simulate(noisy(dvl=dvl, trial=claims), 1)
    names = [p.name for aid in trial.aids for p in aid.parameters()]
    assert len(names) == len(set(names))
    assert {"lever_arm_m", "beam_lever_arm_m", "beam_direction_b"} <= set(names)
    assert "lever_arm_m" in {p.name for p in replace(trial, dvl=None).beams.parameters()}


def test_one_instrument_in_two_records_is_suspected(tmp_path):
    dvl = {"rate_hz": 5, "velocity_std_m_s": 0.005}
    claims = {"imu": {"gyro_bias_std_deg_h": 0.05, "accel_bias_std_ug": 100}}
    save_trial(simulate(noisy(dvl=dvl, trial=claims), 1), tmp_path / "same")
    assert [f.code for f in load_trial(tmp_path / "same").notes] == [Code.COUNTED_TWICE]
    apart = dvl | {"phase_s": 0.07}
    save_trial(simulate(noisy(dvl=apart, trial=claims), 1), tmp_path / "apart")
    assert load_trial(tmp_path / "apart").notes == ()


def test_without_another_direction_of_motion_the_beams_are_not_observable():
    calm = {"roll": [], "pitch": [], "yaw": [], "heave": []}
    straight = [{"straight_s": 70}]
    common = {"sway": calm, "manoeuvres": straight}
    table = noisy().turntable
    alone = solve(simulate(noisy(turntable=None, **common), 1))
    turned = solve(simulate(noisy(turntable=table_of(table), **common), 1))
    seen, seen_turned = (s.estimate("beam_direction_b") for s in (alone, turned))
    # Along x and the vertical nothing moves: of each beam only what the bow's way shows.
    assert not seen.observable[0::2].any()
    assert seen_turned.observable.all()
    assert any("turntable" in w and "beam_direction_1x_deg" in w for w in unseen(alone))


def table_of(truth):
    return msgspec.to_builtins(truth)


def test_the_filter_of_single_beams_agrees_with_the_graph(solved):
    trial, solution = solved
    other, history = calibrate(trial, "beams")
    assert other.converged
    assert history.names[0] == "beam_direction_1x_deg"
    nees, dof = nees_of(other, trial.calibration_truth)
    assert nees < chi2.ppf(0.999, dof)
    for name in ("beam_direction_b", "beam_scale_error", "lever_arm_m"):
        a, b = solution.estimate(name), other.estimate(name)
        assert np.abs((a.value - b.value) / a.std).max() < 1.5, name
        np.testing.assert_allclose(b.std, a.std, rtol=0.5)


def test_point_set_methods_take_beams_for_what_they_amount_to(solved):
    trial, _ = solved
    solution, _ = calibrate(trial, "point-set")
    assert "misalignment_deg" in {e.name for e in solution.estimates}


def gain(slants=JANUS_X):
    d_b = turned(settings(slants).nominal_d, np.array(ERRORS)[: len(slants)] * DEG)
    return (1.0 + np.array(SCALES)[: len(slants), None]) * d_b


def test_the_instrument_matrix_takes_beams_to_their_velocity():
    u = np.random.default_rng(0).normal(0.0, 2.0, (7, 3))
    A = gain()
    np.testing.assert_allclose(u @ A.T @ instrument_matrix(A).T, u, atol=1e-14)
    np.testing.assert_allclose(error_rows(A) @ A, 0.0, atol=1e-15)
    # A Janus of 30 deg by hand: x from the beams on both sides over 4 sin 30 cos 45.
    nominal = instrument_matrix(settings().nominal_d)
    part = 1.0 / (4.0 * np.sqrt(0.125))
    np.testing.assert_allclose(nominal[0], part * np.array([1, -1, -1, 1]), atol=1e-14)
    np.testing.assert_allclose(
        error_rows(settings().nominal_d), [[0.5, -0.5, 0.5, -0.5]], atol=1e-14
    )


def test_velocities_use_what_beams_there_are():
    u = np.random.default_rng(0).normal(0.0, 2.0, (5, 3))
    A = gain()
    record = u @ A.T
    record[1, 2] = record[2, :2] = record[3] = np.nan
    sigma = np.full(record.shape, 0.01)
    found, std = velocities(A, record, sigma)
    np.testing.assert_allclose(found[[0, 1, 4]], u[[0, 1, 4]], atol=1e-13)
    assert np.isnan(found[[2, 3]]).all()
    expected = 0.01 * np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
    np.testing.assert_allclose(std[0], expected, rtol=1e-12)
    assert np.all(std[1] > std[0])
    np.testing.assert_allclose(error_velocity(A, record)[[0, 4]], 0.0, atol=1e-14)
    assert np.isnan(error_velocity(A, record)[1:4]).all()
    assert groups(A) == [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]
    each = group_velocities(A, record)
    np.testing.assert_allclose(each[0], np.tile(u[0], (4, 1)), atol=1e-13)
    assert np.isfinite(each[1, :, 0]).tolist() == [False, True, False, False]


def test_beams_that_a_calibration_puts_in_one_plane_have_no_groups():
    flat = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])
    assert group_velocities(flat, np.ones((5, 4))).shape == (5, 0, 3)
    assert np.isnan(error_velocity(flat, np.ones((5, 4)))).all()


def test_the_error_velocity_scatters_as_a_beam_does():
    rng = np.random.default_rng(0)
    for slants in (JANUS_X, FOUR_AND_ONE):
        A = settings(slants).nominal_d
        error = error_velocity(A, rng.normal(0.0, 0.01, (20000, len(A))))
        np.testing.assert_allclose(np.sqrt(np.mean(error**2)), 0.01, rtol=0.02)
    assert np.isnan(error_velocity(settings(THREE).nominal_d, np.ones((3, 3)))).all()


def test_calibrated_beams_are_an_exact_dvl():
    trial = simulate(scene(turntable=None, gnss=None, trial=SILENT), 0)
    truth = trial.calibration_truth
    exact = (truth["beam_direction_b"], truth["beam_scale_error"], truth["lever_arm_m"])
    dvl = as_dvl(trial.beams, exact)
    values = {
        "misalignment_deg": np.eye(3),
        "scale_error": np.zeros(1),
        "lever_arm_m": np.array(dvl.settings.lever_arm_m),
        "dvl_bias_m_s": np.zeros(3),
        "time_offset_s": np.zeros(1),
        "current_m_s": np.zeros(2),
    }
    assert not any(p.estimated for p in dvl.parameters())
    (o,) = dvl.observations(trial.frame(), "RFU")
    scn = scene(turntable=None, gnss=None, trial=SILENT)
    motion = exact_motion(plan_motion(scn), trial.frame(), o.time)
    assert np.abs(o.residual(motion, values)).max() < 1e-12


def test_the_command_makes_a_dvl_that_solves(solved, tmp_path):
    trial, solution = solved
    save_trial(trial, tmp_path / "trial")
    save_solution(solution, tmp_path / "out")
    args = ["correct", str(tmp_path / "trial"), str(tmp_path / "out")]
    with pytest.raises(SystemExit) as done:
        main([*args, "--out", str(tmp_path / "instrument")])
    assert done.value.code == 0
    content = json.loads((tmp_path / "instrument" / "instrument.json").read_text())
    A = (1.0 + np.array(content["scale_error"]))[:, None] * np.array(content["directions_d"])
    np.testing.assert_allclose(np.array(content["beams_to_xyz"]) @ A, np.eye(3), atol=1e-12)
    settings_file = tmp_path / "trial" / "trial.yaml"
    data = yaml.safe_load(settings_file.read_text())
    del data["dvl_beams"]
    data["dvl"] = content["dvl"]
    settings_file.write_text(yaml.safe_dump(data))
    (tmp_path / "instrument" / "dvl.csv").rename(tmp_path / "trial" / "dvl.csv")
    as_log = solve(load_trial(tmp_path / "trial"))
    residual = next(r for r in as_log.residuals if r.label == "DVL velocity")
    rms = np.sqrt(np.mean((residual.residual / residual.sigma) ** 2))
    assert 0.9 < rms < 1.1


def reckoned(trial, values):
    attitude = AttitudeHistory(trial.imu, trial.reference, trial.body_axes, np.zeros(3))
    return before_after(trial, values, attitude.at)


@pytest.mark.parametrize("body_axes", ["RFU", "FRD"])
def test_dead_reckoning_by_the_true_beams_is_exact(body_axes):
    scn = scene(body_axes=body_axes)
    mounted = msgspec.structs.replace(scn.dvl_beams, misalignment_deg=(1.0, -2.0, 40.0))
    trial = simulate(msgspec.structs.replace(scn, dvl_beams=mounted))
    lost = trial.beams.velocity.copy()
    lost[::3, 1] = np.nan
    trial = replace(trial, others=(replace(trial.beams, velocity=lost), trial.others[1]))
    result = reckoned(trial, trial.calibration_truth)
    assert np.abs(result.calibrated.score.error).max() < 0.01
    # The antenna, by which it is scored then, stays with the ship while the body turns.
    attitude = AttitudeHistory(trial.imu, trial.reference, trial.body_axes, np.zeros(3))
    fixes = before_after(replace(trial, reference=None), trial.calibration_truth, attitude.at)
    assert fixes.scored_by == "GNSS"
    assert np.abs(fixes.calibrated.score.error).max() < 0.01
    # Nominal beams, half a degree and half a per cent off.
    assert result.uncalibrated.score.horizontal.max() > 0.5
    assert result.without_lever_arm.score.horizontal.max() > 0.5


def test_dead_reckoning_takes_a_common_calibration_and_no_other_beams():
    trial = simulate(scene())
    whole = reckoned(trial, trial.calibration_truth).calibrated.track.geodetic
    common = {"misalignment_deg": np.array([0.2, 0.0, 0.0]), "scale_error": np.zeros(1)}
    assert np.abs(reckoned(trial, common).calibrated.track.geodetic - whole).max() > 0.0
    three = {"beam_direction_b": trial.beams.nominal_b[:3]}
    for other in (three, {"lever_arm_m": np.ones(3)}):
        with pytest.raises(DataError, match="does not calibrate the 4 beams"):
            reckoned(trial, other)


def test_a_scale_of_each_axis_is_one_of_each_beam():
    sensor = beams(np.zeros((1, 4)))
    axes, vector = np.array([0.01, -0.02, 0.03]), np.array([0.0, 0.0, 90.0])
    values = {"misalignment_deg": vector, "scale_error": axes, "lever_arm_m": np.zeros(3)}
    found = beam_calibration(sensor, values)
    # The beams of a DVL that reads (1 + k) C v: d^T (1 + k) C v.
    rows = (1.0 + found.scale_error)[:, None] * found.directions_b
    C = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(rows, sensor.nominal_b @ np.diag(1.0 + axes) @ C, atol=1e-12)


@pytest.mark.parametrize("prefix", ["", "beam_"])
def test_the_lever_arm_of_beams_is_not_that_of_a_dvl_beside_them(prefix):
    # Calibrated beside a DVL, used without it, and the other way round.
    values = {
        "beam_direction_b": beams(np.zeros((1, 4))).nominal_b,
        "beam_scale_error": np.zeros(4),
        "lever_arm_m": np.ones(3),
    }
    sensor = replace(beams(np.zeros((1, 4))), prefix=prefix)
    np.testing.assert_array_equal(beam_calibration(sensor, values).lever_arm, np.ones(3))
    values["beam_lever_arm_m"] = np.full(3, 2.0)
    np.testing.assert_array_equal(beam_calibration(sensor, values).lever_arm, np.full(3, 2.0))


def test_the_command_dead_reckons_beams(solved, tmp_path):
    trial, solution = solved
    save_trial(trial, tmp_path / "trial")
    save_solution(solution, tmp_path / "solved")
    for calibration in (tmp_path / "solved", tmp_path / "trial" / "truth.json"):
        out = tmp_path / f"by-{calibration.stem}"
        args = ["deadreckon", tmp_path / "trial", calibration, "--out", out]
        with pytest.raises(SystemExit) as done:
            main([*map(str, args), "--no-figures"])
        assert done.value.code == 0
        found = json.loads((out / "deadreckon.json").read_text())
        assert found["global_error_m"] < 0.2 * found["uncalibrated"]["global_error_m"]


def test_a_record_is_not_made_of_another_instrument_or_of_nothing(solved, tmp_path, capsys):
    trial, solution = solved
    save_solution(solution, tmp_path / "solved")
    args = ["correct", str(tmp_path / "trial"), str(tmp_path / "solved"), "--out"]
    mounted = msgspec.structs.replace(trial.beams.settings, misalignment_deg=(0.0, 0.0, 30.0))
    two = trial.beams.velocity * [1, 1, np.nan, np.nan]
    for i, (changes, message) in enumerate(
        (
            ({"settings": mounted}, "Check that it is the same instrument"),
            ({"velocity": two}, "dvl_beams.csv: no ping has a velocity"),
        )
    ):
        others = (replace(trial.beams, **changes), trial.others[1])
        save_trial(replace(trial, others=others), tmp_path / "trial", force=True)
        with pytest.raises(SystemExit) as done:
            main([*args, str(tmp_path / f"out-{i}")])
        assert done.value.code == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / f"out-{i}").exists()


def test_terms_of_instruments_are_not_those_of_beams(solved, tmp_path, capsys):
    save_solution(solved[1], tmp_path / "solved")
    with pytest.raises(SystemExit) as done:
        main(["instrument", str(tmp_path / "solved")])
    assert done.value.code == 2
    assert "factorgraph-dvl correct" in capsys.readouterr().err


def surveyed(change):
    """Return what `inspect` says of the beams, their velocities changed."""
    trial = simulate(noisy(turntable=None), 1)
    velocity = change(trial.beams.velocity.copy())
    trial = replace(trial, others=(replace(trial.beams, velocity=velocity),))
    return [(f.severity, f.text) for f in survey(trial).findings if f.sensor == "DVL beams"]


def test_good_beams_have_no_problems():
    found = surveyed(lambda v: v)
    assert {severity for severity, _ in found} == {"ok"}
    assert any("no more than noise and priors explain" in text for _, text in found)


@pytest.mark.parametrize(
    ("change", "severity", "message"),
    [
        (lambda v: v[:, [0, 2, 1, 3]], "warning", "is their order"),
        (lambda v: v * [1, 1, -1, 1], "warning", "the sign of beam 3 or 4 reversed"),
        (lambda v: -v, "warning", "Moving in the direction of a beam must give it a positive"),
        (lambda v: v * [np.nan, np.nan, 1, 1], "warning", "there is no ping with three beams"),
        (lambda v: v * [1, 1, np.nan, 1], "note", "lost at 0, 0, 100, 0 % of the pings"),
    ],
)
def test_mistakes_in_beams_are_named(change, severity, message):
    assert any(s == severity and message in text for s, text in surveyed(change))


def test_singular_values_name_the_beams(solved):
    trial, solution = solved
    view = observability(solution, trial=trial).point_set
    assert view.states[:2] == ("beam_direction_1x_deg", "beam_direction_1y_deg")
    assert len(view.states) == 15
    # The rows are the derivatives of the prediction itself.
    nominal, turns = trial.beams.nominal_b, np.array(ERRORS).ravel() * DEG
    motion = random_motion()
    v_b = np.einsum("mji,mj->mi", motion.nRb, motion.v_n)
    arm = np.array([1.0, -1.2, 1.4])
    rows = beam_rows(
        BodyMotion(np.arange(5.0), v_b, motion.omega_eb_b),
        BeamMounting(nominal, turns, np.array(SCALES), arm),
    )

    def predicted(h):
        A = (1.0 + np.array(SCALES) + h[8:12])[:, None] * turned(
            nominal, (turns + h[:8]).reshape(-1, 2)
        )
        return (v_b + np.cross(motion.omega_eb_b, arm + h[12:])) @ A.T

    np.testing.assert_allclose(rows, differentiate(predicted, 15), atol=1e-8)


def test_what_beams_tell_is_drawn(solved, tmp_path):
    trial, solution = solved
    _, history = solve_with_history(trial)
    view = observability(solution, trial=trial, history=history)
    names = {file.stem for file in write_observability_figures(view, tmp_path)}
    assert names == {"singular_values", "std_along_trial", "correlation", "directions", "shares"}
    panel = history_figure(view.history, []).axes[0]
    looks = {(line.get_color(), line.get_linestyle()) for line in panel.get_lines()}
    assert len(looks) == 8
    assert panel.get_xlabel() == ""


def test_a_plan_foresees_what_beams_will_be_known_to(solved):
    _, solution = solved
    prediction = predict(noisy())
    for name in ("beam_direction_b", "beam_scale_error", "lever_arm_m"):
        found, foreseen = (s.estimate(name).std for s in (solution, prediction.solution))
        np.testing.assert_allclose(foreseen, found, rtol=0.15)
    truth = prediction.trial.calibration_truth["beam_direction_b"]
    directions = prediction.solution.estimate("beam_direction_b").directions
    np.testing.assert_allclose(directions, truth, atol=1e-12)


def test_a_plan_goes_on_with_the_turntable_where_it_stands():
    planned = noisy()
    first = predict(planned)
    history, _ = extend(planned, [{"straight_s": 30}], first.ending)
    assert history.names == first.history.names
