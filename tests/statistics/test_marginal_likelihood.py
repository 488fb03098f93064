"""Likelihood of the constants with the states integrated out, against dense matrices."""

from __future__ import annotations

from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from problems import ALL_FREE, IMU_ERRORS, SHORT, problem_of
from truth import CORRELATED, merged, scenario

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import STANDARD_GRAVITY
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.problem import Problem, Rows
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solved_problems
from factorgraph_dvl.solvers.levenberg_marquardt import factorized
from factorgraph_dvl.statistics.elimination import eliminated
from factorgraph_dvl.statistics.marginal_likelihood import (
    log_determinant_gradient,
    marginal_objective,
    restricted_objective,
)

CLOCKS = {"gnss": {"time_offset_std_s": 0.05}, "dvl": {"time_offset_std_s": 0.05}}
CLOCK_OFFSETS = ("gnss_time_offset_s", "time_offset_s")
SCENES = {
    "all constants": {"trial": merged(ALL_FREE, CLOCKS)},
    "errors of the IMU": {"trial": merged(ALL_FREE, {"imu": IMU_ERRORS})},
    "walking biases": {
        "trial": ALL_FREE,
        "imu": {"gyro_bias_walk_deg_h_sqrt_h": 1.0, "accel_bias_walk_ug_sqrt_h": 100.0},
    },
}


def system(name):
    problem, values = problem_of(scenario(manoeuvres=SHORT, **SCENES[name]))
    evaluation = problem.weighed(problem.evaluate(values))
    for _ in range(2):
        step = factorized(problem, evaluation)[1]
        evaluation = problem.weighed(problem.evaluate(evaluation.values.retract(step)))
    return problem, evaluation, factorized(problem, evaluation)[0]


def dense(problem, evaluation):
    """Return the Jacobian of states and of constants, and the right-hand side."""
    order, sizes = problem.ordering(), evaluation.values.dims()
    jacobian, rhs = problem.linearize(evaluation).jacobian(order)
    count = sum(sizes[problem.key(p.name)] for p in problem.parameters)
    return jacobian[:, :-count], jacobian, rhs


def log_determinant(jacobian):
    """Return log det of the information, from QR of scaled columns."""
    scale = np.linalg.norm(jacobian, axis=0)
    R = np.linalg.qr(jacobian / scale, mode="r")
    return 2.0 * float(np.log(np.abs(np.diag(R))).sum() + np.log(scale).sum())


def left(jacobian, rhs):
    """Return the sum of squares that is left at the minimum."""
    Q, _ = np.linalg.qr(jacobian / np.linalg.norm(jacobian, axis=0))
    return float(rhs @ rhs - np.sum((Q.T @ rhs) ** 2))


@pytest.mark.parametrize("name", SCENES)
def test_objectives_are_those_of_dense_matrices(name):
    problem, evaluation, information = system(name)
    states, every, rhs = dense(problem, evaluation)
    noise = 2.0 * sum(float(each.sum()) for each in problem.log_sigma(evaluation))
    noise += priors(problem) + noise_of_the_imu(problem)
    if name == "walking biases":
        # Steps from node to node, of three axes each: per root hour, as segments last a second.
        steps = np.sqrt(np.diff(problem.chain.node_time) / 3600.0)
        accel, gyro = 100e-6 * STANDARD_GRAVITY, np.radians(1.0) / 3600.0
        noise += 6.0 * float(np.log(steps * accel).sum() + np.log(steps * gyro).sum())
    for objective, jacobian in ((marginal_objective, states), (restricted_objective, every)):
        expected = left(states, rhs) + log_determinant(jacobian) + noise
        assert objective(problem, evaluation, information) == pytest.approx(expected, abs=1e-5)


def priors(problem):
    """Return log det of the covariance of the priors, independent of each other here."""
    out = 2.0 * sum(float(np.log(p.sigma).sum()) for p in problem.parameters)
    for p in problem.parameters:
        angle = float(np.linalg.norm(p.mean))
        if p.rotation and angle > 0.0:
            # Stated of the rotation vector; det of the right Jacobian is 2 (1 - cos a) / a².
            out += 2.0 * np.log(2.0 * (1.0 - np.cos(angle)) / angle**2)
    return out


def noise_of_the_imu(problem):
    """Return log det of the noise of gyros and accelerometers, up to a constant: 3 and 6 rows."""
    imu = problem.chain.imu
    # rad/s/√Hz and m/s²/√Hz.
    gyro = np.radians(imu.gyro_noise_deg_sqrt_h) / 60.0
    accel = imu.accel_noise_ug_sqrt_hz * 1e-6 * STANDARD_GRAVITY
    own = 3.0 * np.log(gyro) + 6.0 * np.log(accel)
    return 2.0 * problem.chain.count * own


def sigma_of(problem, information):
    every = np.eye(len(problem.prior_root))
    wanted = {problem.key(name): every[:, own] for name, own in problem.columns.items()}
    return np.sqrt(np.diag(information.covariance_of([wanted])))


def differences(problem, evaluation, names, sigma, at):
    """Return central differences of a function of the parameters, with the steps' places."""
    for p in problem.parameters:
        if p.name not in names:
            continue
        own, value = problem.columns[p.name], evaluation.parameters[p.name]
        for i, k in enumerate(range(own.start, own.stop)):
            h = min(0.3 * sigma[k], 1e-3)
            ends = []
            for step in (h, -h):
                by = step * np.eye(own.stop - own.start)[i]
                moved = value @ exp_so3(by) if p.rotation else value + by
                ends.append(at({**evaluation.parameters, p.name: moved}))
            yield k, (ends[0] - ends[1]) / (2.0 * h)


@pytest.mark.parametrize("name", SCENES)
def test_gradient_is_that_of_the_dense_determinant(name):
    problem, evaluation, information = system(name)
    sigma = sigma_of(problem, information)
    gradient = log_determinant_gradient(problem, evaluation, information)

    def at(parameters):
        moved = problem.evaluate(problem.values(evaluation.states, parameters))
        return log_determinant(dense(problem, moved)[0])

    names = {p.name for p in problem.parameters} - {*CLOCK_OFFSETS}
    for k, expected in differences(problem, evaluation, names, sigma, at):
        # What the scale does: 0.1 standard deviations.
        assert abs(sigma[k] * (gradient[k] - expected)) < 1e-6
    assert np.abs(sigma * gradient).max() > 0.05


def test_errors_that_persist_are_states():
    trial = {"trial": merged(CORRELATED["trial"], ALL_FREE)}
    scene = merged(CORRELATED, trial) | {"manoeuvres": SHORT}
    problem, values = problem_of(scenario(**scene))
    time = np.arange(0.0, 10.0)
    labels = [o.label for o in problem.observations]
    processes = [
        Process(label, i, np.full(3, 0.01), np.full(3, 5.0), time)
        for i, label in enumerate(labels)
    ]
    problem = Problem(
        problem.chain, problem.observations, problem.all_parameters, processes=processes
    )
    states, parameters = problem_values(problem, values)
    evaluation = problem.weighed(problem.evaluate(problem.values(states, parameters)))
    information = factorized(problem, evaluation)[0]
    sigma = sigma_of(problem, information)
    gradient = log_determinant_gradient(problem, evaluation, information)
    own, _, rhs = dense(problem, evaluation)
    noise = 2.0 * sum(float(each.sum()) for each in problem.log_sigma(evaluation))
    # c_{j+1} = phi c_j + noise of variance 1 - phi².
    noise += sum(3 * 9 * np.log(-np.expm1(-2.0 / 5.0)) for _ in processes)
    noise += priors(problem) + noise_of_the_imu(problem)
    expected = left(own, rhs) + log_determinant(own) + noise
    found = marginal_objective(problem, evaluation, information)
    assert found == pytest.approx(expected, rel=1e-9)

    def at(parameters):
        moved = problem.evaluate(problem.values(evaluation.states, parameters))
        return log_determinant(dense(problem, moved)[0])

    for k, expected in differences(problem, evaluation, ["scale_error"], sigma, at):
        assert abs(sigma[k] * (gradient[k] - expected)) < 1e-6


def problem_values(problem, values):
    for process in problem.processes:
        for j in range(process.time.size):
            values.insert(process.key(j), np.zeros(process.size))
    return problem.arrays(values)


# Fractions of a standard deviation by which the term moves constants of a trial with an IMU:
# measured 0.0167 in 87 states with DVL and GNSS at 2 Hz, 0.0025 in 454 with both at 5 Hz, both of
# the scale.
@pytest.mark.parametrize(
    ("path", "most"), [("examples/short.yaml", 0.02), ("configs/seed-a-phase-90.yaml", 0.003)]
)
def test_the_term_hardly_moves_a_trial_with_an_imu(path, most):
    solved, *_ = solved_problems(simulate(path, seed=1))
    problem = solved.problem
    evaluation = problem.weighed(solved.minimum.evaluation)
    information = factorized(problem, evaluation)[0]
    gradient = log_determinant_gradient(problem, evaluation, information)
    moved = np.abs(0.5 * sigma_of(problem, information) * gradient)
    (scale,) = np.r_[problem.columns["scale_error"]]
    assert moved[scale] == moved.max() < most
    assert np.delete(moved, scale).max() < 1e-3


X1, X2, C = keys.node(1), keys.node(2), keys.calibration(0, 1)


def by_hand(c, x):
    """Return a walk x of two steps of unit variance that was measured as c x, y = 1 and 2.

    Both noises are 1, and the prior of c is 2 ± 1.
    """
    unit = gtsam.noiseModel.Unit.Create(1)
    gaussian = gtsam.GaussianFactorGraph()
    gaussian.add(X1, np.eye(1), np.array([-x[0]]), unit)
    gaussian.add(X1, -np.eye(1), X2, np.eye(1), np.array([x[0] - x[1]]), unit)
    gaussian.add(C, np.eye(1), np.array([2.0 - c]), unit)
    miss = c * x - np.array([1.0, 2.0])
    for key, value, residual in zip((X1, X2), x, miss, strict=True):
        gaussian.add(key, c * np.eye(1), C, np.array([[value]]), np.array([-residual]), unit)

    def rows(at):
        matrix = np.stack([np.full(2, at), x], axis=1)[:, None]
        yield Rows("y", ("y",), np.array([[X1, C], [X2, C]]), (1, 1), matrix, miss[:, None])

    problem = SimpleNamespace(
        parameters=[SimpleNamespace(name="c", rotation=False)],
        columns={"c": slice(0, 1)},
        prior_root=np.eye(1),
        processes=(),
        observations=(),
        weights=(),
        noise_factors={},
        gain=0.0,
        chain=SimpleNamespace(interpolates=False, log_determinant=0.0),
        bound=[SimpleNamespace(names={"c"}, observation=SimpleNamespace(label="y"))],
        clock_keys=[],
        key=lambda name: C,
        log_sigma=lambda evaluation: [np.zeros(2)],
        observation_rows=lambda evaluation: rows(c),
        observation_rows_at=lambda evaluation, values: rows(float(values["c"][0])),
    )
    squares = [x[0], x[1] - x[0], c - 2.0, *miss]
    evaluation = SimpleNamespace(
        parameters={"c": np.array([c])}, residuals=(), cost=0.5 * float(np.dot(squares, squares))
    )
    information = eliminated(gaussian, keys.ordering([X1, X2, C]), {X1: 1, X2: 1, C: 1})
    return problem, evaluation, information


@pytest.mark.parametrize("x", [np.array([1.0, 0.0]), np.array([0.3, -2.0])])
def test_a_walk_measured_twice_by_hand(x):
    problem, evaluation, information = by_hand(2.0, x)
    # The variance of y is 1 + c² K with K = [1 1; 1 2], that is [5 4; 4 9].
    found = marginal_objective(problem, evaluation, information)
    assert found == pytest.approx(13 / 29 + np.log(29))
    # det of the information is c⁴ + 3 c² + 1.
    gradient = log_determinant_gradient(problem, evaluation, information)
    assert gradient == pytest.approx([44 / 29], rel=1e-6)
    # That by a clock is left out.
    problem.clock_keys = [C]
    assert not log_determinant_gradient(problem, evaluation, information).any()
    problem.clock_keys = []
    again = log_determinant_gradient(problem, evaluation, information)
    np.testing.assert_allclose(again, gradient, rtol=1e-9)


def test_the_restricted_objective_of_the_walk_by_hand():
    # By c the residuals change by x = 1, 0: its Schur complement is 1 + 9/29.
    found = restricted_objective(*by_hand(2.0, np.array([1.0, 0.0])))
    assert found == pytest.approx(13 / 29 + np.log(38))


def test_what_is_given_must_be_eliminated_last():
    *_, information = by_hand(2.0, np.array([1.0, 0.0]))
    with pytest.raises(ValueError, match="after all others"):
        information.given({X1})


def test_covariances_given_the_constants_are_those_of_the_dense_matrix():
    problem, evaluation, information = system("all constants")
    given = information.given({problem.key(p.name) for p in problem.parameters})
    states, _, _ = dense(problem, evaluation)
    scale = np.linalg.norm(states, axis=0)
    inverse = np.linalg.inv(np.linalg.qr(states / scale, mode="r")) / scale[:, None]
    order, sizes = problem.ordering(), evaluation.values.dims()
    edges = np.cumsum([0, *(sizes[order.at(i)] for i in range(order.size()))])
    place = {order.at(i): slice(edges[i], edges[i + 1]) for i in range(order.size())}
    group = (keys.node(3), keys.bias(0))
    own = np.concatenate([inverse[place[key]] for key in group])
    std = np.linalg.norm(own, axis=1)
    (joint,) = given.joint_covariances([group])
    np.testing.assert_allclose((joint - own @ own.T) / np.outer(std, std), 0.0, atol=1e-6)
    functional = {group[0]: np.eye(9)}
    with_bias = given.covariance_with([functional])[group[1]]
    np.testing.assert_allclose(
        (with_bias - joint[9:, :9]) / np.outer(std[9:], std[:9]), 0.0, atol=1e-6
    )
