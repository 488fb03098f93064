"""Trials without IMU: a ship with a compass, an INS; what is found, and how sure it is."""

from __future__ import annotations

import importlib
import os
from dataclasses import replace

import gtsam
import msgspec
import numpy as np
import pytest
from monte_carlo import rms_band
from scipy.spatial.transform import Rotation
from truth import CONFIGS, SCHULER, config, with_ins

from factorgraph_dvl.analysis.error_statistics import calibration_errors
from factorgraph_dvl.analysis.instrument_terms import instrument_of
from factorgraph_dvl.errors import ConfigError, FactorgraphDvlError
from factorgraph_dvl.files.trial_folder import load_trial, save_trial
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import load_scenario, simulate
from factorgraph_dvl.solvers.batch import solve, solve_with_problem
from factorgraph_dvl.solvers.heading_and_misalignment import foremost
from factorgraph_dvl.solvers.known_parameters import wide, with_scattered_noise
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu

RUNS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "20"))
MOUNTING = ("misalignment_deg", "scale_error", "lever_arm_m")
# Longer trials have too many digits for the Cholesky factorisation of GTSAM's `Marginals`.
TURNS = [
    {"straight_s": 20},
    {"turn_deg_s": 4, "duration_s": 30, "ramp_s": 2},
    {"straight_s": 15},
    {"turn_deg_s": -4, "duration_s": 25, "ramp_s": 2},
]


def shortened(name="ship", repeat=1, **changes):
    scenario = load_scenario(CONFIGS / f"{name}.yaml")
    legs = scenario.manoeuvres[0]["manoeuvres"]
    manoeuvres = [{"repeat": repeat, "manoeuvres": legs}]
    return msgspec.structs.replace(scenario, manoeuvres=manoeuvres, **changes)


@pytest.fixture(scope="module")
def ship():
    return simulate(shortened(), 1)


@pytest.fixture(scope="module")
def solved(ship):
    return solve_with_problem(ship, rate_hz=1.0)


@pytest.fixture(scope="module")
def solution(solved):
    return solved[0]


def test_a_scale_that_walks_is_named_as_left_out(ship):
    settings = msgspec.structs.replace(ship.dvl.settings, scale_walk_std_sqrt_h=0.001)
    walking = replace(ship, dvl=replace(ship.dvl, settings=settings))
    for each, count in ((ship, 0), (walking, 1)):
        found = prepare_without_imu(each).findings
        assert sum(f.code == Code.ERROR_LEFT_OUT for f in found) == count


def deviations(solution, truth):
    return {
        name: (solution.estimate(name).value - truth[name]) / solution.estimate(name).std
        for name in MOUNTING
    }


def test_a_ship_with_compass_gnss_and_adcp_is_calibrated(ship, solution):
    assert solution.converged
    for name, z in deviations(solution, ship.calibration_truth).items():
        assert np.all(np.abs(z) < 4.0), name
    assert solution.estimate("misalignment_deg").std[2] < 0.35
    assert solution.estimate("scale_error").std[0] < 0.002
    assert not [f for f in solution.findings if f.severity != "note"]


def test_the_motion_is_that_of_the_ship(ship, solution):
    trajectory, true = solution.trajectory, ship.reference
    rows = np.searchsorted(true.time, trajectory.time - 1e-6)
    np.testing.assert_allclose(true.time[rows], trajectory.time, atol=1e-6)
    frame = ship.frame()
    off = frame.position(*trajectory.geodetic.T) - frame.position(*true.geodetic[rows].T)
    turned = trajectory.rph - true.rph[rows]
    turned = np.angle(np.exp(1j * turned))
    for error, covariance, largest in (
        (off, trajectory.position_cov, 2.5),
        (trajectory.velocity - true.velocity[rows], trajectory.velocity_cov, 2.0),
        (turned, trajectory.rph_cov, 2.0),
    ):
        std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        ratio = np.sqrt(np.mean((error / std) ** 2, axis=0))
        assert np.all(ratio < largest)


def test_a_gross_error_turns_no_mounting(ship):
    short = ship.until(ship.dvl.time[160])
    fixes, velocity = short.gnss.geodetic.copy(), short.dvl.velocity.copy()
    fixes[120, 2] += 300.0
    velocity[150] += 3.0
    wrong = replace(
        short,
        gnss=replace(short.gnss, geodetic=fixes),
        dvl=replace(short.dvl, velocity=velocity),
    )
    a, b = (prepare_without_imu(each).values for each in (short, wrong))
    turned = a["misalignment_deg"] @ b["misalignment_deg"].T
    assert np.trace(turned) > 1.0 + 2.0 * np.cos(10.0 * DEG)
    assert abs(a["time_offset_s"][0] - b["time_offset_s"][0]) < 0.5


def test_clocks_agree_with_each_other(ship, solution):
    assert "gnss_time_offset_s" not in solution.order
    dvl, attitude = (solution.estimate(n) for n in ("time_offset_s", "attitude_time_offset_s"))
    i, j = (solution.order.index(n) for n in ("time_offset_s", "attitude_time_offset_s"))
    P = solution.covariance
    std = np.sqrt(P[i, i] + P[j, j] - 2.0 * P[i, j])
    assert std < 0.05
    assert abs(dvl.value[0] - attitude.value[0]) < 4.0 * std


def test_causes_add_up_to_the_variances(solution):
    total = np.sum([c.adds**2 for c in solution.error_budget], axis=0)
    np.testing.assert_allclose(total, np.diag(solution.covariance), rtol=1e-6)


def test_no_cause_is_the_slope_of_the_objective(solved):
    solution, found = solved
    priors = {c.cause for c in solution.error_budget if c.cause.startswith("prior of ")}
    own = {f"prior of {p.name}" for p in found.problem.parameters}
    assert found.problem.tilt is not None
    assert priors == own | {"prior of the first state"}
    causes = {c.cause for c in solution.error_budget} - priors
    assert causes == {
        "acceleration between states",
        *(f"noise of {o.label}" for o in found.problem.observations),
        *(f"lasting errors of {label}" for label in ("GNSS position", "Attitude")),
    }


def test_the_phase_is_known_better_relative_to_the_compass(solution):
    (note,) = (f for f in solution.findings if f.code == Code.HEADING_ERROR)
    alone, together = (float(part.split()[0]) for part in str(note).split("±")[1:])
    assert together < alone
    assert alone == pytest.approx(solution.estimate("misalignment_deg").std[2], rel=0.1)
    # A mean over the trial of what is stated of the compass, and hardly more is known of it.
    assert "Neither the misalignment nor the heading error is determined alone" in str(note)


@pytest.mark.parametrize(
    ("axes", "expected"),
    [
        # Turned by 100 deg to starboard: no axis points ahead, and z points down.
        (Rotation.from_euler("z", 100.0, degrees=True).as_matrix().T, ("x", 100.0)),
        (Rotation.from_euler("z", -80.0, degrees=True).as_matrix().T, ("y", 10.0)),
        # Turned over, with the y axis ahead.
        (np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), ("y", 0.0)),
    ],
)
def test_the_axis_that_points_ahead(axes, expected):
    name, angle = foremost(axes)
    assert (name, pytest.approx(angle)) == expected


@pytest.mark.slow
def test_a_mount_that_is_turned_far_is_said_by_a_bearing():
    scenario = shortened()
    dvl = msgspec.structs.replace(scenario.dvl, misalignment_deg=[0.0, 0.0, -60.0])
    solution = solve(simulate(shortened(dvl=dvl), 1), rate_hz=1.0)
    (note,) = (f for f in solution.findings if f.code == Code.HEADING_ERROR)
    values = dict(note.message.values)
    axis, angle, std = values["axis"], values["angle"], values["std"]
    terms = instrument_of(solution)
    assert axis == "x"
    ahead = terms.axes[0]
    assert angle == pytest.approx(np.degrees(np.arctan2(ahead[1], ahead[0])))
    # The DVL is turned to starboard, as its readings are to port.
    assert abs(angle - 60.0) < 4.0 * std
    assert std == pytest.approx(solution.estimate("misalignment_deg").std[2], rel=0.1)


def test_a_trial_without_imu_survives_its_folder(ship, tmp_path):
    save_trial(ship, tmp_path / "ship")
    again = load_trial(tmp_path / "ship")
    assert again.imu is None
    assert again.inputs == ship.inputs
    np.testing.assert_allclose(again.attitude.rph, ship.attitude.rph, atol=1e-9)


def test_positions_are_needed_and_an_imu_is_asked_for(ship):
    with pytest.raises(FactorgraphDvlError, match="position"):
        solve(replace(ship, gnss=None))
    with pytest.raises(ConfigError, match="has no IMU"):
        _ = ship.inertial


def ins_scenario(repeat=1):
    return with_ins(shortened(repeat=repeat), SCHULER)


@pytest.mark.slow
def test_an_ins_alone_is_enough():
    trial = simulate(ins_scenario(), 3)
    solution = solve(trial, rate_hz=1.0)
    assert solution.converged
    assert "ins_time_offset_s" not in solution.order
    for name, z in deviations(solution, trial.calibration_truth).items():
        assert np.all(np.abs(z) < 4.0), name
    offset = solution.estimate("time_offset_s")
    assert abs(offset.value[0]) < 4.0 * offset.std[0]


@pytest.fixture(scope="module")
def short():
    return solve_with_problem(simulate(config("ship", manoeuvres=TURNS), 1), rate_hz=1.0)


def exported(problem, best):
    """Return the graph for GTSAM's own optimisers, and values away from the minimum."""
    graph, _ = problem.nonlinear_graph()
    steps = gtsam.VectorValues()
    for key, size in best.dims().items():
        steps.insert(key, np.full(size, 1e-4))
    return graph, best.retract(steps)


def assert_same(solution, problem, best, found, covariance_of):
    """Assert that a minimum of GTSAM's is that of `solve`, and so are the deviations."""
    for p in problem.parameters:
        key = problem.key(p.name)
        theirs = np.sqrt(np.diag(covariance_of(key)))
        if p.rotation:
            off = gtsam.Rot3.Logmap(best.atRot3(key).between(found.atRot3(key)))
        else:
            off = found.atVector(key) - best.atVector(key)
            if p.name in {e.name for e in solution.estimates}:
                std = solution.estimate(p.name).std * p.si
                np.testing.assert_allclose(theirs, std, rtol=0.01)
        assert np.abs(off / theirs).max() < 0.01, p.name


def test_gtsams_own_optimiser_and_marginals_agree(short):
    solution, solved = short
    assert solution.converged
    problem, evaluation = solved.problem, solved.minimum.evaluation
    assert np.abs(problem.tilt.gradient).max() > 0.0
    graph, start = exported(problem, evaluation.values)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setRelativeErrorTol(1e-12)
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()
    marginals = gtsam.Marginals(graph, found)
    assert_same(solution, problem, evaluation.values, found, marginals.marginalCovariance)


@pytest.mark.slow
def test_isam2_agrees(short):
    solution, solved = short
    problem, evaluation = solved.problem, solved.minimum.evaluation
    graph, start = exported(problem, evaluation.values)
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.setRelinearizeThreshold(1e-6)
    parameters.relinearizeSkip = 1
    isam = gtsam.ISAM2(parameters)
    isam.update(graph, start)
    for _ in range(6):
        isam.update()
    found = isam.calculateEstimate()
    assert_same(solution, problem, evaluation.values, found, isam.marginalCovariance)


def test_the_error_of_the_graph_is_the_cost_but_for_a_constant(short):
    _, solved = short
    problem, at = solved.problem, solved.minimum.evaluation.values
    graph, _ = problem.nonlinear_graph()
    rng = np.random.default_rng(1)
    off = []
    for scale in (0.0, 1e-5, 1e-4):
        step = gtsam.VectorValues()
        for key, size in at.dims().items():
            step.insert(key, scale * rng.normal(size=size))
        there = at.retract(step)
        off.append(graph.error(there) - problem.evaluate(there).cost)
    assert off[0] == pytest.approx(problem.tilt.constant)
    np.testing.assert_allclose(off, off[0], rtol=1e-10)


def test_problems_of_tests_have_the_slope_of_the_objective(short):
    _, solved = short
    problem, evaluation = solved.problem, solved.minimum.evaluation
    free = [wide(p, p.mean) if p.name == "gnss_lever_arm_m" else p for p in problem.all_parameters]
    test, at = with_scattered_noise(problem, evaluation, free)
    assert "gnss_lever_arm_m" in test.columns
    for name, own in test.columns.items():
        expected = problem.tilt.gradient[problem.columns[name]] if name in problem.columns else 0.0
        np.testing.assert_array_equal(test.tilt.gradient[own], expected)
    with_slope = test.linearize(at).gradientAtZero()
    test.tilt = None
    without = test.linearize(at).gradientAtZero()
    off = problem.difference(evaluation.parameters, problem.tilt.origin)
    for name, own in problem.columns.items():
        found = with_slope.at(test.key(name)) - without.at(test.key(name))
        gradient = problem.tilt.gradient[own]
        # In the tangent space at the minimum, which is turned by this from the slope's.
        turned = (
            np.linalg.norm(off[own]) * np.linalg.norm(gradient)
            if own.stop - own.start == 3
            else 0.0
        )
        np.testing.assert_allclose(found, gradient, rtol=1e-6, atol=turned + 1e-6)


def ratio(scenario, runs):
    """Return the pooled root mean square of errors over their standard deviations."""
    squares = []
    for seed in range(runs):
        trial = simulate(scenario, seed)
        found = solve(trial, rate_hz=0.1)
        errors = calibration_errors(found, trial.calibration_truth)
        keep = [n.startswith(("misalignment", "scale", "lever_arm")) for n in errors.names]
        std = np.sqrt(np.diag(errors.covariance))
        squares.append(np.mean((errors.error / np.where(std > 0, std, np.inf))[keep] ** 2))
    return np.sqrt(np.mean(squares))


@pytest.mark.slow
@pytest.mark.parametrize("make", [lambda: shortened(repeat=2), lambda: ins_scenario(repeat=2)])
def test_standard_deviations_hold(make):
    low, high = rms_band(7 * RUNS)
    assert low < ratio(make(), RUNS) < high


@pytest.mark.slow
def test_noise_of_a_compass_makes_no_lever_arm_shorter():
    """A lever arm times noisy rates would explain some of their noise."""
    made = shortened(repeat=2)
    noisy = msgspec.structs.replace(made.attitude, white_std_deg=(0.05, 0.05, 0.1))
    made = msgspec.structs.replace(made, attitude=noisy)
    off = []
    for seed in range(RUNS):
        trial = simulate(made, seed)
        off.append(deviations(solve(trial, rate_hz=0.1), trial.calibration_truth)["lever_arm_m"])
    assert np.all(np.abs(np.mean(off, axis=0)) < 4.0 / np.sqrt(RUNS))


@pytest.mark.slow
def test_white_noise_of_an_ins_moves_no_clock():
    trial = simulate(ins_scenario(repeat=2), 0)
    offset = solve(trial, rate_hz=0.1).estimate("time_offset_s")
    assert abs(offset.value[0]) < 4.0 * offset.std[0]


@pytest.mark.slow
def test_the_current_is_its_mean_over_the_trial():
    trial = simulate(shortened("ship-water"), 2)
    solution, solved = solve_with_problem(trial, rate_hz=0.1)
    # Before, it came out as 2 m/s that change within a minute, and no round settled.
    assert solution.converged
    assert abs(solution.estimate("scale_error").value[0]) < 0.05
    current = solution.estimate("current_m_s")
    off = current.value - trial.calibration_truth["current_m_s"]
    assert np.all(np.abs(off) < 4.0 * current.std)
    # What it is over much longer times is known much worse.
    (process,) = (p for p in solved.problem.processes if p.parameter == "current_m_s")
    assert np.all(current.std < 0.1 * process.sigma)
    causes = {c.cause for c in solution.error_budget}
    assert "changes of the current" in causes
    total = np.sum([c.adds**2 for c in solution.error_budget], axis=0)
    np.testing.assert_allclose(total, np.diag(solution.covariance), rtol=1e-6)


def test_a_current_that_changes_for_hours_moves_no_clock_of_the_start():
    trial = simulate(load_scenario(CONFIGS / "ship-water.yaml"), 1)
    start = prepare_without_imu(trial).values
    for name in ("time_offset_s", "attitude_time_offset_s"):
        assert abs(start[name][0]) < 0.5, name
    truth = exp_so3(trial.calibration_truth["misalignment_deg"] * DEG)
    assert np.linalg.norm(log_so3(start["misalignment_deg"] @ truth.T)) < 5.0 * DEG


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_no_slope_of_the_cost_makes_a_current_stronger(seed):
    solution = solve(simulate(shortened("ship-water", repeat=2), seed), rate_hz=0.1)
    assert solution.converged
    assert abs(solution.estimate("scale_error").value[0]) < 0.05


@pytest.mark.slow
def test_through_water_errors_are_as_large_as_their_standard_deviations():
    """The current is that of the trial: its mean, of which the simulation knows the truth."""
    off, current = [], []
    for seed in range(RUNS):
        trial = simulate(shortened("ship-water", repeat=2), seed)
        solution, truth = solve(trial, rate_hz=0.1), trial.calibration_truth
        off.append(np.concatenate(list(deviations(solution, truth).values())))
        found = solution.estimate("current_m_s")
        current.append((found.value - truth["current_m_s"]) / found.std)
    for each in (off, current):
        low, high = rms_band(np.size(each))
        assert low < np.sqrt(np.mean(np.square(each))) < high


@pytest.mark.slow
def test_through_water_standard_deviations_are_those_of_least_squares(monkeypatch):
    monkeypatch.syspath_prepend(CONFIGS.parent / "benchmarks")
    dense_standard_deviations = importlib.import_module("ships").dense_standard_deviations
    scenario = shortened("ship-water", repeat=5)
    trial = simulate(scenario, 1)
    solution = solve(trial, rate_hz=0.1)
    phase = solution.estimate("misalignment_deg").std[2] * DEG
    scale = solution.estimate("scale_error").std[0]
    found = np.array([phase, scale])
    assert np.all(found < 1.3 * dense_standard_deviations(trial, scenario, 60.0))
    # Means of a minute lose what turns show: of 10 s, they are 0.8 times as uncertain. The current
    # of one hour may also vary less than that of many, from which the reference takes it.
    assert np.all(found > 0.75 * dense_standard_deviations(trial, scenario, 10.0))


@pytest.mark.parametrize(("arm", "origin"), [(0.0, True), (1.0, False)])
def test_an_antenna_at_the_origin_is_no_parameter_to_be_tested(ship, arm, origin):
    """Another origin would only make the motion of the body smoother."""
    gnss = ship.gnss
    settings = msgspec.structs.replace(
        gnss.settings, lever_arm_m=(arm, 0.0, 0.0), lever_arm_std_m=(0.0, 0.0, 0.0)
    )
    prepared = prepare_without_imu(replace(ship, gnss=replace(gnss, settings=settings)))
    found = next(p for p in prepared.parameters if p.name == "gnss_lever_arm_m")
    assert (found.spec.plausible is None) == origin
