"""Information along a trial: against the smoother, against dense algebra, and its limits."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from problems import SHORT, dense_covariance, problem_of, walking
from truth import config, scenario

from factorgraph_dvl.analysis.comparison.halves import halves_of
from factorgraph_dvl.analysis.information.manoeuvres import Segment
from factorgraph_dvl.analysis.information.observability import information_shares
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.priors import Tilt
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve, solved_problems
from factorgraph_dvl.solvers.information_along_trial import (
    as_history,
    information_history,
    run_filter,
    solve_with_history,
)
from factorgraph_dvl.solvers.levenberg_marquardt import factorized
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu
from factorgraph_dvl.statistics.information_history import InformationHistory

CALM = {"sway": {}, "current_m_s": [0.3, -0.1, 0]}


def history_of(scene, seed=1):
    found = solved_problems(simulate(scene, seed))[0]
    history = information_history(found)
    return found, history


def system(scene):
    """A problem, and its dense Jacobian with the node that each row belongs to."""
    problem, values = problem_of(scene)
    problem.weigh(problem.evaluate(values))
    evaluation = problem.evaluate(values)
    gaussian = problem.linearize(evaluation)
    sizes = values.dims()
    place, at = {}, 0
    for key in sorted(sizes):
        place[key] = slice(at, at + sizes[key])
        at += sizes[key]
    nodes = problem.chain.segments.node_time.size
    node = {keys.node(k): k for k in range(nodes)}
    if problem.chain.walking:
        node |= {keys.bias(k): k for k in range(nodes)}
    rows, first = [], []
    for i in range(gaussian.size()):
        factor = gaussian.at(i)
        A, column = factor.jacobian()[0], 0
        wide = np.zeros((A.shape[0], at))
        for key in list(factor.keys()):
            wide[:, place[key]] = A[:, column : column + sizes[key]]
            column += sizes[key]
        own = [node[key] for key in list(factor.keys()) if key in node]
        # A prior is there before all.
        is_prior = i < problem.graph.size() and max(own, default=0) == 0
        rows.append(wide)
        first += [-1 if is_prior else min(own)] * A.shape[0]
    return problem, evaluation, place, np.concatenate(rows), np.array(first)


@pytest.mark.parametrize("walks", [False, True], ids=["constant", "walking"])
def test_every_entry_equals_dense_algebra(walks):
    scene = walking() if walks else scenario(manoeuvres=SHORT)
    problem, evaluation, place, A, first = system(scene)
    found = run_filter(problem, evaluation)
    triangles, frontier = found.triangles, found.frontier
    constants = [] if walks else [keys.bias(0)]
    constants += [problem.key(p.name) for p in problem.parameters]
    columns = np.concatenate([np.arange(place[k].start, place[k].stop) for k in constants])
    for k in (0, 1, 4, len(triangles) - 1):
        # Entry k has the measurements after the nodes before it.
        upto = A[first < k]
        used = np.flatnonzero(np.abs(upto).max(axis=0) > 0.0)
        P = dense_covariance(upto[:, used])
        own = np.searchsorted(used, columns)
        expected = P[np.ix_(own, own)]
        S = np.linalg.inv(triangles[k])
        std = np.sqrt(np.diag(expected))
        assert np.abs((S @ S.T - expected) / np.outer(std, std)).max() < 1e-6, k
    assert frontier.root.shape[0] == 9 + 6 * walks + columns.size


@pytest.mark.parametrize("name", ["navigation", "walking"])
def test_the_last_entry_is_the_solution(name):
    turning = [{"straight_s": 20}, {"turn_deg_s": 6, "duration_s": 30}, {"straight_s": 10}]
    walk = {"gyro_bias_walk_deg_h_sqrt_h": 1.0, "accel_bias_walk_ug_sqrt_h": 50.0}
    imu = walk | {"gyro_noise_deg_sqrt_h": 0.1} if name == "walking" else {}
    scene = scenario(noise=True, manoeuvres=turning, imu=imu)
    solution, history = solve_with_history(simulate(scene, 1))
    index = [solution.order.index(n) for n in history.names]
    P = solution.covariance[np.ix_(index, index)]
    std = np.sqrt(np.diag(P))
    # The solver's last linearisation is one small step before.
    assert np.abs((history.covariance(-1) - P) / np.outer(std, std)).max() < 1e-4
    np.testing.assert_allclose(history.std[-1], std, rtol=1e-4)
    # Constants only: biases that walk are not.
    assert ("gyro_bias_x_deg_h" in history.names) == (name != "walking")
    # Before any data there is the prior.
    prior = np.concatenate([e.prior_std for e in solution.estimates])[index]
    np.testing.assert_allclose(history.std[0][3:], prior[3:], rtol=1e-6)
    assert history.time[0] == pytest.approx(0.0, abs=1e-6)


def test_halfway_it_is_what_the_first_half_says():
    """A step from the whole trial, against a solution of the first half alone."""
    turns = [
        each
        for rate in (6, -6, 6, -6)
        for each in ({"straight_s": 25}, {"turn_deg_s": rate, "duration_s": 25})
    ]
    trial = simulate(scenario(noise=True, manoeuvres=turns), 3)
    whole, history = solve_with_history(trial)
    first = solve(halves_of(trial)[0], anyway=True)
    moved = []
    for name in ("misalignment_deg", "scale_error", "lever_arm_m"):
        own = first.estimate(name)
        assert np.all(np.abs(history.halfway[name] - own.value) < 0.3 * own.std), name
        moved += [*(np.abs(whole.estimate(name).value - own.value) / own.std)]
    assert max(moved) > 1.0


def test_halfway_directions_that_are_not_determined_yet_stay_at_their_prior():
    """Sailing straight on, nothing shows the lever arm along the course."""
    late = [{"straight_s": 60}, {"turn_deg_s": 6, "duration_s": 30}, {"straight_s": 20}]
    trial = simulate(scenario(noise=True, manoeuvres=late, **CALM), 1)
    whole, history = solve_with_history(trial)
    stated = trial.dvl.settings.lever_arm_m[0]
    assert history.halfway["lever_arm_m"][0] == pytest.approx(stated, abs=1e-3)
    assert abs(whole.estimate("lever_arm_m").value[0] - stated) > 0.1


def test_information_only_grows():
    _, history = history_of(scenario(noise=True))
    step = np.diff(history.std, axis=0) / history.std[:-1]
    assert step.max() < 1e-9
    for a, b in ((0, 10), (10, 40), (40, -1)):
        gain = np.linalg.inv(history.covariance(b)) - np.linalg.inv(history.covariance(a))
        scale = history.std[b]
        eigenvalues = np.linalg.eigvalsh(gain * np.outer(scale, scale))
        assert eigenvalues.min() > -1e-6


def along_velocity(found, history, k):
    """Standard deviation, rad, of the rotation of the DVL about the velocity."""
    evaluation = found.minimum.evaluation
    D = evaluation.parameters["misalignment_deg"]
    v_b = evaluation.motions[-1].nRb[0].T @ evaluation.motions[-1].v_n[0]
    axis = v_b / np.linalg.norm(v_b)
    # A turn about the velocity moves the rotation vector by this much.
    step = (log_so3(D @ exp_so3(1e-6 * axis)) - log_so3(D)) / 1e-6
    weight = np.zeros(len(history.names))
    weight[:3] = step / (step @ step) * DEG
    return float(np.linalg.norm(weight @ history.root[k]))


def test_a_straight_run_gives_no_confident_number_at_any_time():
    straight = {"manoeuvres": [{"straight_s": 100}], "noise": True, **CALM}
    found, history = history_of(scenario(**straight))
    assert found.fixed.shape[1] == 4
    for k in range(len(history.time)):
        assert along_velocity(found, history, k) > 0.95 * np.pi
        assert np.all(history.std[k, 4:7] > 9.9)
    # What a straight run does show falls.
    scale = history.names.index("scale_error")
    assert history.std[-1, scale] < 0.01 * history.std[0, scale]


def test_noise_feigns_nothing_before_the_turn_that_shows_it():
    parts = [{"straight_s": 80}, {"turn_deg_s": 6, "duration_s": 30}, {"straight_s": 10}]
    found, history = history_of(scenario(manoeuvres=parts, noise=True, **CALM))
    assert found.fixed.shape[1] == 0
    before = int(np.searchsorted(history.time, 79.0))
    assert along_velocity(found, history, before) > 0.9 * np.pi
    assert np.all(history.std[before, 4:7] > 9.9)
    assert along_velocity(found, history, -1) < 1.0 * DEG
    assert np.all(history.std[-1, 4:6] < 0.1)
    # The turn gets the credit for the lever arm, but not all: l_x and the scale look alike in
    # it, and the straight run knows the scale.
    segments = [Segment(0.0, 80.0, "steady"), Segment(80.0, 110.0, "turning")]
    segments.append(Segment(110.0, 120.0, "steady"))
    shares = information_shares(history, segments)
    lever_arm = shares.names.index("lever_arm_x_m")
    assert shares.segments[1, lever_arm] > 0.5
    assert 0.02 < shares.segments[0, lever_arm] < 0.2


def test_shares_add_up():
    _, history = history_of(scenario(noise=True))
    edges = [0.0, 10.0, 33.3, 50.0, 78.0]
    segments = [Segment(a, b, "") for a, b in pairwise(edges)]
    shares = information_shares(history, segments)
    np.testing.assert_allclose(shares.prior + shares.segments.sum(axis=0), 1.0, atol=1e-9)
    assert shares.prior.min() > 0.0
    assert shares.segments.min() > -1e-9


def test_shares_of_independent_measurements_by_hand():
    # One number of prior information 1, then 3 and 6: shares 1/10, 3/10, 6/10. A second
    # one that is measured in the last part only, with 1 beside a prior of 1: 1/2, 0, 1/2.
    information = [np.diag([1.0, 1.0]), np.diag([4.0, 1.0]), np.diag([10.0, 2.0])]
    root = np.stack([np.linalg.inv(np.sqrt(L)) for L in information])
    history = InformationHistory(np.array([0.0, 1.0, 2.0]), ("a", "b"), root)
    shares = information_shares(history, [Segment(0.0, 1.0, ""), Segment(1.0, 2.0, "")])
    np.testing.assert_allclose(shares.prior, [0.1, 0.5])
    np.testing.assert_allclose(shares.segments, [[0.3, 0.0], [0.6, 0.5]], atol=1e-12)
    # As a derivative: one per cent more of the last part.
    more = np.linalg.inv(information[1] + 1.01 * (information[2] - information[1]))
    last = np.linalg.inv(information[2])
    change = -np.log(np.diag(more) / np.diag(last)) / 0.01
    np.testing.assert_allclose(change, shares.segments[1], rtol=0.01)


def test_gaps_and_outages_do_no_harm():
    gaps = {"imu": {"gaps_s": [[30.0, 33.0]]}, "gnss": {"outages_s": [[20, 60]]}}
    solution, history = solve_with_history(simulate(scenario(noise=True, **gaps), 1))
    std = np.sqrt(np.diag(solution.covariance))
    np.testing.assert_allclose(history.std[-1], std, rtol=1e-3)


def test_a_trial_without_a_dvl_has_the_biases():
    trial = replace(simulate(scenario(noise=True), 1), dvl=None)
    found = solved_problems(trial)[0]
    history = information_history(found)
    assert len(history.names) == 6
    assert all("_bias_" in name for name in history.names)
    assert history.std[-1, history.names.index("accel_bias_z_ug")] < 50.0


@pytest.fixture(scope="module", params=["ship", "ship-water"])
def without_imu(request):
    """A problem without IMU near its minimum, with a tilt, as linearised there."""
    lines = [{"straight_s": 40}, {"turn_deg_s": 3, "duration_s": 30}, {"straight_s": 20}]
    prepared = prepare_without_imu(simulate(config(request.param, manoeuvres=lines), 1))
    chain = prepared.chain(prepared.states)
    parameters = prepared.parameters
    free = [p for p in parameters if p.estimated]
    sigma = np.concatenate([1e-3 * p.sigma for p in free])
    tilt = Tilt(1.0 / sigma, sigma, {p.name: prepared.values[p.name] for p in free})
    problem = Problem(
        chain,
        prepared.observations,
        parameters,
        start=prepared.values,
        processes=prepared.stated_processes(chain, prepared.states, prepared.values),
        tilt=tilt,
    )
    values = problem.values(prepared.states, problem.prior_values() | prepared.values)
    return problem, problem.weighed(problem.evaluate(values))


def test_without_imu_it_ends_with_the_information_of_the_whole(without_imu):
    problem, evaluation = without_imu
    found = run_filter(problem, evaluation)
    triangles, frontier = found.triangles, found.frontier
    information, _ = factorized(problem, evaluation)
    every = {
        problem.key(name): np.eye(len(problem.prior_root))[:, own]
        for name, own in problem.columns.items()
    }
    expected = information.covariance_of([every])
    S = np.linalg.inv(triangles[-1])
    std = np.sqrt(np.diag(expected))
    assert np.abs((S @ S.T - expected) / np.outer(std, std)).max() < 1e-6
    # A state and its rates, and the constants.
    assert frontier.root.shape[0] == 12 + std.size


def test_without_imu_it_begins_with_the_priors_and_grows(without_imu):
    problem, evaluation = without_imu
    triangles = run_filter(problem, evaluation).triangles
    fixed = np.zeros((len(problem.prior_root), 0))
    history = as_history(problem, evaluation, fixed, triangles, {})
    np.testing.assert_allclose(history.time, problem.chain.node_time)
    prior = {
        name: sigma
        for p in problem.parameters
        for name, sigma in zip(p.component_names, p.sigma / p.si, strict=True)
    }
    np.testing.assert_allclose(history.std[0], [prior[name] for name in history.names], rtol=1e-6)
    assert (np.diff(history.std, axis=0) / history.std[:-1]).max() < 1e-9
