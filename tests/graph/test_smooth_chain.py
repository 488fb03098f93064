"""The chain of a trial without IMU: its factors in bulk, and for GTSAM's own optimisers."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from truth import config

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.smooth_motion import SmoothStates
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.levenberg_marquardt import factorized, minimise
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu

# Turns sharp enough that clocks stay where they are between nodes, and as smooth as a ship's.
TURNS = [
    [{"turn_deg_s": rate, "duration_s": 15, "ramp_s": 6}, {"straight_s": 5}]
    for rate in (6.0, -7.0, 8.0)
]
LEGS = [{"straight_s": 4}, *(leg for both in TURNS for leg in both)]


@pytest.fixture(scope="module")
def prepared():
    return prepare_without_imu(simulate(config("ship", manoeuvres=LEGS), seed=3))


@pytest.fixture(scope="module")
def problem(prepared):
    chain, states, values = prepared.first_chain, prepared.states, prepared.values
    processes = prepared.stated_processes(chain, states, values)
    return Problem(
        chain, prepared.observations, prepared.parameters, start=values, processes=processes
    )


@pytest.fixture(scope="module")
def values(prepared, problem):
    rng = np.random.default_rng(1)
    off = rng.normal(0.0, 1e-3, (prepared.states.p_n.shape[0], 12))
    states = prepared.states.retracted(off)
    # The last fix is at a node, beyond which its attitude is that of other nodes.
    chain = problem.chain
    late = {name: prepared.values[name] + 0.02 for name in (chain.clock, chain.attitude_clock)}
    return problem.values(states, problem.prior_values() | prepared.values | late)


def moved(values, key, step):
    delta = gtsam.VectorValues()
    for other, size in values.dims().items():
        delta.insert(other, step if other == key else np.zeros(size))
    return values.retract(delta)


def test_the_gradient_is_that_of_the_cost(problem, values):
    problem.weigh(problem.evaluate(values))
    gradient = problem.linearize(problem.evaluate(values)).gradientAtZero()
    some = [keys.node(7), keys.rate(7), *(problem.key(p.name) for p in problem.parameters)]
    some += [process.key(1) for process in problem.processes]
    clocks = [problem.key(p.name) for p in problem.parameters if "time_offset" in p.name]
    attitude = [o.label for o in problem.observations].index("Attitude")
    for key in some:
        for i in range(values.dims()[key]):
            step = np.zeros(values.dims()[key])
            step[i] = 1e-6
            there = [problem.evaluate(moved(values, key, s * step)) for s in (1.0, -1.0)]
            expected = (there[0].cost - there[1].cost) / 2e-6
            scale = max(1.0, np.abs(gradient.at(key)).max())
            if key in clocks:
                # They move the level axes of attitudes, by 1e-6 rad/s, which rows leave out.
                squares = [0.5 * np.sum(each.residuals[attitude] ** 2) for each in there]
                by_level = (squares[0] - squares[1]) / 2e-6
                assert abs(by_level) < 1.0
                expected -= by_level
            assert gradient.at(key)[i] == pytest.approx(expected, abs=2e-4 * scale)


def test_each_measurement_is_a_factor_of_its_own_and_the_whole_graph_is_the_problem(
    problem, values
):
    problem.weigh(problem.evaluate(values))
    graph, start = problem.nonlinear_graph()
    evaluation = problem.evaluate(start)
    assert graph.error(start) == pytest.approx(evaluation.cost, rel=1e-9)
    assert graph.size() >= sum((w > 0.0).any(axis=1).sum() for w in problem.weights)
    own = problem.linearize(evaluation)
    ordering = problem.ordering()
    expected, _ = own.hessian(ordering)
    found, _ = graph.linearize(start).hessian(ordering)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / scale).max() < 1e-8


def test_the_whole_graph_is_the_problem_also_where_clocks_have_moved(prepared, problem):
    clocks = [name for name in prepared.values if name.endswith("time_offset_s")]
    late = {name: prepared.values[name] + 0.03 for name in clocks if name != problem.chain.clock}
    values = problem.values(prepared.states, problem.prior_values() | prepared.values | late)
    problem.weigh(problem.evaluate(values))
    graph, start = problem.nonlinear_graph()
    evaluation = problem.evaluate(start)
    assert max(np.abs(b.late(evaluation.parameters)).max() for b in problem.bound) > 0.02
    ordering = problem.ordering()
    expected, _ = problem.linearize(evaluation).hessian(ordering)
    found, _ = graph.linearize(start).hessian(ordering)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / scale).max() < 1e-8


def test_gtsams_own_optimiser_and_marginals_agree(prepared, problem):
    values = problem.values(prepared.states, problem.prior_values() | prepared.values)
    near = minimise(problem, values, stage="test", tolerance=1e-8).evaluation
    # Clocks have moved since: measurements are bound anew.
    problem = Problem(
        problem.chain,
        problem.observations,
        problem.all_parameters,
        start=near.parameters,
        processes=problem.processes,
    )
    minimum = minimise(problem, near.values, stage="test", tolerance=1e-10, max_iterations=300)
    assert minimum.converged
    best = minimum.evaluation.values
    graph, _ = problem.nonlinear_graph()
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setRelativeErrorTol(1e-9)
    steps = gtsam.VectorValues()
    for key, size in best.dims().items():
        steps.insert(key, np.full(size, 1e-4))
    start = best.retract(steps)
    assert graph.error(start) > graph.error(best) + 10.0
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()
    marginals = gtsam.Marginals(graph, found)
    information, _ = factorized(problem, minimum.evaluation)
    for p in problem.parameters:
        key = problem.key(p.name)
        sigma = np.sqrt(np.diag(information.marginals([key])[key]))
        theirs = np.sqrt(np.diag(marginals.marginalCovariance(key)))
        np.testing.assert_allclose(theirs, sigma, rtol=0.01)
        if p.rotation:
            off = gtsam.Rot3.Logmap(best.atRot3(key).between(found.atRot3(key)))
        else:
            off = found.atVector(key) - best.atVector(key)
        assert np.abs(off / sigma).max() < 0.01, p.name


def test_steady_motion_along_the_track_costs_nothing(prepared):
    chain = prepared.first_chain
    time = chain.node_time
    angle = 0.05 * (time - time[0])
    nRt = exp_so3(np.column_stack([np.zeros((time.size, 2)), angle]))
    omega = np.tile([0.0, 0.0, 0.05], (time.size, 1))
    v_n = 3.0 * nRt[:, :, 0]
    p_n = 60.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle), 0.0 * angle])
    turning = replace(chain, nRt=nRt)
    states = turning.states(turning.values(SmoothStates(nRt, p_n, v_n, omega)))
    (step,) = turning.steps(states)
    assert np.abs(step.residual).max() < 1e-6
    # Waves turn the body, and with it no velocity.
    rolled = nRt @ exp_so3(np.array([0.1, 0.0, 0.0]))
    body_rate = omega @ exp_so3(np.array([0.1, 0.0, 0.0]))
    states = turning.states(turning.values(SmoothStates(rolled, p_n, v_n, body_rate)))
    (step,) = turning.steps(states)
    assert np.abs(step.residual).max() < 1e-6


def test_a_transposed_attitude_is_no_minimum(prepared, problem):
    values = problem.values(prepared.states, problem.prior_values() | prepared.values)
    problem.weigh(problem.evaluate(values))
    before = minimise(problem, values, stage="test").evaluation
    states, parameters = before.states, before.parameters
    turned = SmoothStates(states.nRb.transpose(0, 2, 1), states.p_n, states.v_n, states.omega_b)
    after = problem.evaluate(problem.values(turned, parameters))
    assert after.cost > 100.0 * before.cost
