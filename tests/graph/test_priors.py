"""An earlier calibration as the prior of a trial: correlations, files, errors."""

from __future__ import annotations

import gc
import json
import weakref
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from builders import build_trial, edit, write_trial
from calibrations import ALPHA_DEG, calibration
from findings import of_code
from jacobians import differentiate
from problems import SHORT, problem_of
from truth import TURNING, scenario

from factorgraph_dvl.baselines import calibrate
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.calibration_file import encode_calibration
from factorgraph_dvl.files.earlier_calibration import calibrated_by
from factorgraph_dvl.files.trial_folder import load_trial, save_trial
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.graph.priors import Tilt, prior_mean
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.parameters import JointPrior
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solution import Calibration
from factorgraph_dvl.solvers.batch import solve

NAMES = ("misalignment_deg", "scale_error", "lever_arm_m")


def with_prior(trial, found, source="before.json"):
    return replace(trial, dvl=calibrated_by(trial.dvl, found, trial.body_axes, source))


def test_cost_and_jacobians_of_the_joint_prior():
    scene = scenario(manoeuvres=SHORT)
    found = calibration()
    problem, values = problem_of(scene, with_prior(simulate(scene), found))
    factors = [problem.graph.at(i) for i in range(problem.graph.size())]
    (prior,) = [f for f in factors if set(f.keys()) == {problem.key(n) for n in NAMES}]
    P = found.covariance[:7, :7]
    si = np.concatenate([np.full(3, np.pi / 180.0), np.ones(4)])
    away = 1e-4 * np.array([1.0, -2.0, 0.5, 0.3, -1.0, 2.0, 1.0])
    at = gtsam.Values()
    alpha = (ALPHA_DEG + away[:3]) * si[:3]
    at.insert(problem.key("misalignment_deg"), gtsam.Rot3(exp_so3(alpha)))
    at.insert(problem.key("scale_error"), np.array([0.01 + away[3]]))
    at.insert(problem.key("lever_arm_m"), np.array([1.0, 2.0, 3.0]) + away[4:])
    # Stated for the rotation vector: half of away' P^-1 away, to first order.
    expected = 0.5 * away @ np.linalg.solve(P, away)
    assert prior.error(at) == pytest.approx(expected, rel=1e-5)

    linear = prior.linearize(values)
    order = linear.keys()
    stacked = np.hstack(
        [linear.getA()[:, place] for place in _places(linear, values)]
    )  # fmt: skip
    numerical = []
    for key in order:
        size = values.dims()[key]

        def error(h, key=key):
            moved = gtsam.Values(values)
            step = gtsam.VectorValues()
            step.insert(key, h)
            return prior.unwhitenedError(moved.retract(step))

        numerical.append(differentiate(error, size))
    np.testing.assert_allclose(stacked, np.hstack(numerical), rtol=1e-5, atol=1e-5)


def _places(linear, values):
    at = 0
    for key in linear.keys():  # noqa: SIM118
        size = values.dims()[key]
        yield slice(at, at + size)
        at += size


def dvl_block(solution):
    return solution.covariance[:7, :7]


def test_two_trials_know_what_both_know_together():
    first = simulate(scenario(), 0)
    second = simulate(
        scenario(manoeuvres=[TURNING[0], TURNING[3], TURNING[1]], start={"heading_deg": 250}), 0
    )
    a, b = solve(first), solve(second)
    both = solve(with_prior(second, as_calibration(a)))
    expected = np.linalg.inv(np.linalg.inv(dvl_block(a)) + np.linalg.inv(dvl_block(b)))
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        dvl_block(both) / np.outer(scale, scale), expected / np.outer(scale, scale), atol=2e-3
    )
    np.testing.assert_allclose(both.estimates[0].prior_std, a.estimates[0].std, rtol=1e-9)


def as_calibration(solution):
    fields = Calibration.__dataclass_fields__
    return Calibration(**{name: getattr(solution, name) for name in fields})


def test_what_a_short_trial_cannot_refine_is_kept():
    trial = simulate(scenario(manoeuvres=[{"straight_s": 40}], sway={}), 0)
    found = calibration(alpha=np.array([2.0, 2.0, 30.0]))
    solution = solve(with_prior(trial, found))
    assert solution.converged
    misalignment = solution.estimate("misalignment_deg")
    assert (misalignment.std <= misalignment.prior_std * (1 + 1e-6)).all()
    (text,) = of_code(solution.findings, Code.PRIOR_KEPT)
    assert "before.json" in text
    assert "lever_arm_z_m" in text
    unseen = [f.parameter for f in solution.findings if f.code == Code.NOT_OBSERVABLE]
    assert "misalignment_deg" not in unseen
    # Biases of the IMU are those of the day.
    assert solution.estimate("gyro_bias_deg_h").prior_value == pytest.approx(np.zeros(3))


def test_kalman_takes_values_and_standard_deviations():
    trial = simulate(scenario(), 0)
    found = calibration(alpha=np.array([2.0, 2.0, 30.0]))
    solution, _ = calibrate(with_prior(trial, found))
    estimate = solution.estimate("misalignment_deg")
    np.testing.assert_allclose(estimate.prior_std, [0.1, 0.2, 0.3])
    assert any(
        "do not use its correlations" in text
        for text in of_code(solution.findings, Code.METHOD_LIMITS)
    )


def write_calibrated(folder, found, key="calibration: ../before.json"):
    path = write_trial(folder)
    edit(path / "trial.yaml", "dvl:\n", f"dvl:\n  {key}\n")
    (folder / "before.json").write_bytes(encode_calibration(found))
    return path


def test_files_there_and_back(tmp_path):
    path = write_calibrated(tmp_path, calibration(scale=3))
    trial = load_trial(path)
    assert tuple(trial.dvl.prior.values) == NAMES
    assert {p.name: p.mean.size for p in trial.dvl.parameters()}["scale_error"] == 3
    np.testing.assert_allclose(trial.dvl.prior_means()["misalignment_deg"], np.radians(ALPHA_DEG))
    assert (trial.dvl.nominal().prior_means()["misalignment_deg"] == 0.0).all()
    save_trial(trial, tmp_path / "elsewhere" / "copy")
    again = load_trial(tmp_path / "elsewhere" / "copy")
    np.testing.assert_array_equal(again.dvl.prior.covariance, trial.dvl.prior.covariance)
    assert again.dvl.settings.misalignment_std_deg == trial.dvl.settings.misalignment_std_deg


def corrupted(change):
    data = json.loads(encode_calibration(calibration()))
    change(data)
    return json.dumps(data)


BAD = {
    "did not converge": (lambda d: d.update(converged=False), "did not converge"),
    "other axes": (lambda d: d.update(body_axes="FRD"), "FRD axes"),
    "no DVL": (
        lambda d: d.update(
            parameters={}, covariance={"order": [], "matrix": []},
        ),
        "no parameter of the DVL",
    ),
    "a number missing": (
        lambda d: d["parameters"]["lever_arm_m"]["value"].__setitem__(1, None),
        "lever_arm_m is not a number",
    ),
    "negative variance": (
        lambda d: d["covariance"]["matrix"][0].__setitem__(0, -1.0),
        "do not agree",
    ),
    "another variance": (
        lambda d: d["covariance"]["matrix"][4].__setitem__(4, 9.0),
        "do not agree",
    ),
    "a name twice": (
        lambda d: d["covariance"]["order"].__setitem__(0, d["covariance"]["order"][1]),
        "does not name the components of",
    ),
    "no scale left": (
        lambda d: d["parameters"]["scale_error"].update(value=[-1.0]),
        "scale_error is -1; expected numbers above -1",
    ),
    "not symmetric": (
        lambda d: d["covariance"]["matrix"][0].__setitem__(1, 0.03),
        "the covariance is not one",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_calibrations_are_named(tmp_path, case):
    change, message = BAD[case]
    path = write_calibrated(tmp_path, calibration())
    (tmp_path / "before.json").write_text(corrupted(change))
    with pytest.raises(DataError, match=message) as caught:
        load_trial(path)
    assert "before.json" in str(caught.value)


def test_rows_of_the_covariance_go_by_their_names(tmp_path):
    path = write_calibrated(tmp_path, calibration())
    expected = load_trial(path).dvl.prior.covariance

    def shuffled(data):
        order, matrix = data["covariance"]["order"], data["covariance"]["matrix"]
        rows = np.random.default_rng(1).permutation(len(order))
        data["covariance"]["order"] = [order[i] for i in rows]
        data["covariance"]["matrix"] = np.array(matrix)[np.ix_(rows, rows)].tolist()

    (tmp_path / "before.json").write_text(corrupted(shuffled))
    np.testing.assert_array_equal(load_trial(path).dvl.prior.covariance, expected)


def test_a_calibration_that_states_no_axes_is_in_those_of_the_trial(tmp_path):
    path = write_calibrated(tmp_path, calibration())
    settings = path / "trial.yaml"
    settings.write_text(settings.read_text().replace("body_axes: RFU", "body_axes: FRD"))
    (tmp_path / "before.json").write_text(corrupted(lambda d: d.pop("body_axes")))
    np.testing.assert_allclose(
        load_trial(path).dvl.prior_means()["misalignment_deg"], np.radians(ALPHA_DEG)
    )


def test_a_file_that_is_missing_or_no_json_is_named(tmp_path):
    path = write_calibrated(tmp_path, calibration(), key="calibration: ../nowhere.json")
    with pytest.raises(ConfigError, match=r"dvl\.calibration: the file \.\./nowhere\.json"):
        load_trial(path)
    (tmp_path / "nowhere.json").write_text("{")
    with pytest.raises(DataError, match=r"nowhere\.json: cannot be read"):
        load_trial(path)


def test_a_calibration_that_was_not_read_is_refused():
    trial = build_trial()
    dvl = replace(trial.dvl, settings=replace_calibration(trial.dvl.settings))
    with pytest.raises(ConfigError, match="has not been read"):
        dvl.parameters()


def replace_calibration(settings):
    import msgspec

    return msgspec.structs.replace(settings, calibration="x.json")


def test_an_asymmetric_joint_prior_is_refused():
    with pytest.raises(DataError, match="the covariance is not one"):
        JointPrior("x", {"lever_arm_m": np.zeros(3)}, np.eye(2))


def test_a_problem_with_a_joint_prior_is_freed():
    # GTSAM would keep a callback that knows the problem, and with it all its arrays.
    scene = scenario(manoeuvres=SHORT)
    problem, values = problem_of(scene, with_prior(simulate(scene), calibration()))
    problem.fix_directions(np.eye(7)[:, :1], problem.prior_values())
    problem.evaluate(values)
    known = weakref.ref(problem)
    del problem
    gc.collect()
    assert known() is None


def test_a_tilt_holds_parameters_where_they_are():
    problem, values = problem_of(scenario(manoeuvres=SHORT))
    parameters, keys = (
        problem.parameters,
        {p.name: problem.key(p.name) for p in problem.parameters},
    )
    origin = {p.name: prior_mean(p) for p in parameters}
    sigma = np.concatenate([p.sigma for p in parameters])
    gradient = np.arange(1.0, sigma.size + 1.0)
    tilt = Tilt(gradient, sigma, origin, np.diag(1.0 / sigma))
    factor = tilt.factor(parameters, keys)
    moved = problem.evaluate(values).parameters
    off = problem.difference(moved, origin)
    # By hand: the gradient times the step, and half of each step over its sigma squared.
    expected = gradient @ off + 0.5 * np.sum((off / sigma) ** 2)
    assert tilt.cost(parameters, origin) == 0.0
    assert tilt.cost(parameters, moved) == pytest.approx(expected, rel=1e-12)
    assert factor.error(values) - tilt.constant == pytest.approx(expected, abs=1e-8)
    linear = factor.linearize(values)
    jacobian, _ = linear.jacobian()
    assert jacobian.shape == (1 + sigma.size, sigma.size)
    for p in parameters:

        def error(step, key=keys[p.name]):
            delta = gtsam.VectorValues()
            delta.insert(key, step)
            return factor.unwhitenedError(values.retract(delta))

        numerical = differentiate(error, p.mean.size, step=1e-5)
        own = jacobian[:, problem.columns[p.name]]
        np.testing.assert_allclose(own, numerical, rtol=1e-5, atol=1e-5)
    # Held, they stay; without a hold, the factor is the gradient alone.
    held = Tilt.holding(parameters, origin)
    assert held.cost(parameters, moved) > 1e6 * 0.5 * np.sum((off / sigma) ** 2)
    assert replace(tilt, hold=None).cost(parameters, moved) == pytest.approx(gradient @ off)
