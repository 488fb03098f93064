"""Correlated errors as Gauss-Markov nodes: prior, interpolation, columns in the graph."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from problems import SHORT, problem_of
from problems import walking as walking_biases
from truth import scenario

from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.processes import Process, node_times
from factorgraph_dvl.sensors.protocol import ScaleWalk
from factorgraph_dvl.simulation import simulate

TAU = np.array([4.0, 4.0, 20.0])
SIGMA = np.array([0.5, 0.4, 1.0])


def process(label="GNSS position", index=0, time=None, sigma=SIGMA):
    time = np.array([0.0, 2.0, 5.0, 6.0]) if time is None else time
    return Process(label, index, sigma, TAU, time)


def test_the_prior_is_that_of_a_stationary_process():
    p = process()
    gaussian = gtsam.GaussianFactorGraph()
    p.add_prior(gaussian, p.zero)
    ordering = gtsam.Ordering()
    for j in range(4):
        ordering.push_back(p.key(j))
    information = gaussian.hessian(ordering)[0]
    covariance = np.linalg.inv(information).reshape(4, 3, 4, 3)
    lag = np.abs(p.time[:, None] - p.time)
    for i in range(3):
        np.testing.assert_allclose(covariance[:, i, :, i], np.exp(-lag / TAU[i]), atol=1e-12)


def test_a_process_goes_on_from_what_is_known():
    """The first node has no prior of its own then, and a walk is still that of the whole."""
    p = walking()
    on = p.going_on(np.array([5.0, 6.0, 8.0]), p.walk)
    nodes = np.full((3, 4), 2.0)
    assert not on.prior_residuals(nodes)[0].any()
    gaussian = gtsam.GaussianFactorGraph()
    on.add_prior(gaussian, nodes)
    assert [gaussian.at(i).size() for i in range(gaussian.size())] == [2, 2]
    whole = replace(p, time=np.array([0.0, 2.0, 5.0, 6.0]))
    part = p.going_on(np.array([5.0, 6.0]), p.walk)
    own = np.ones((4, 4))
    np.testing.assert_allclose(
        part.prior_residuals(own[2:])[1], whole.prior_residuals(own)[3], rtol=1e-12
    )
    np.testing.assert_allclose(
        part.error(own[2:], np.array([5.5])), whole.error(own, np.array([5.5])), rtol=1e-12
    )


def test_residuals_by_hand():
    p = process()
    nodes = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0] * 3, [0.0] * 3])
    phi = np.exp(-0.5)
    expected = [1.0, (2.0 - phi) / np.sqrt(1.0 - phi**2)]
    np.testing.assert_allclose(p.prior_residuals(nodes)[:2, 0], expected)
    # Half-way between the first two nodes: 0.5 (1 + 2) / 2.
    one = np.array([1.0])
    np.testing.assert_allclose(p.with_error(np.zeros((1, 3)), nodes, one)[0], [0.75, 0.0, 0.0])


def walking(time=None):
    """A process, and a scale that walks by 0.01 in the square root of a second."""
    seen = np.array([[2.0, 0.0, -1.0], [1.0, 3.0, 0.5], [0.0, 1.0, 2.0]])
    walk = ScaleWalk("scale_error", 0.01, np.array([0.5, 1.0, 4.0]), seen)
    return replace(process(time=time), walk=walk)


def test_a_scale_that_walks_adds_a_share_of_what_is_predicted_by_hand():
    """Over six seconds tau is 18 s, and sigma 0.01 √9 = 0.03."""
    p = walking()
    nodes = p.zero
    assert nodes.shape == (4, 4)
    nodes[:2, 3] = 1.0, 3.0
    residual = np.array([[0.1, 0.2, 0.3]])
    # Half-way, at 1 s: 2 sigma = 0.06, of the 1.1, 3.2 and 0.8 that are predicted.
    out = p.with_error(residual, nodes, np.array([1.0]))
    np.testing.assert_allclose(out, residual + 0.06 * np.array([[1.1, 3.2, 0.8]]), rtol=1e-12)
    np.testing.assert_allclose(p.gain(nodes, np.array([1.0])), [[1.06]])
    # Its mean: 1 and 3 over two seconds, 3 to 0 over three.
    mean, by_key = p.mean_walk(nodes)
    assert mean == pytest.approx(0.03 * (2.0 * 2.0 + 3.0 * 1.5) / 6.0)
    np.testing.assert_allclose(by_key[p.key(1)], [[0.0, 0.0, 0.0, 0.03 * 2.5 / 6.0]])


def test_changes_of_a_scale_are_those_of_a_walk():
    p = walking(np.linspace(0.0, 100.0, 101))
    gaussian = gtsam.GaussianFactorGraph()
    p.add_prior(gaussian, p.zero)
    ordering = gtsam.Ordering()
    for j in range(101):
        ordering.push_back(p.key(j))
    covariance = np.linalg.inv(gaussian.hessian(ordering)[0])[3::4, 3::4]
    sigma = 0.01 * np.sqrt(150.0)
    for lag, most in ((1, 0.01), (10, 0.02), (100, 0.16)):
        change = sigma**2 * 2.0 * (covariance[0, 0] - covariance[0, lag])
        assert change == pytest.approx(0.01**2 * lag, rel=most)


def test_columns_of_an_error_are_its_derivatives():
    p = walking()
    rng = np.random.default_rng(3)
    time, residual, nodes = p.walk.time, rng.normal(size=(3, 3)), rng.normal(size=(4, 4))
    before, _ = p.place(time)
    h = 1e-6
    for part, jacobian in enumerate(p.jacobians(residual, time)):
        for m in range(3):
            for i in range(4):
                moved = nodes.copy()
                moved[before[m] + part, i] += h
                change = p.with_error(residual, moved, time) - p.with_error(residual, nodes, time)
                np.testing.assert_allclose(jacobian[m, :, i], change[m] / h, atol=1e-8)
    change = p.with_error(residual + h, nodes, time) - p.with_error(residual, nodes, time)
    np.testing.assert_allclose(np.broadcast_to(p.gain(nodes, time), (3, 3)), change / h, rtol=1e-8)


def test_the_priors_factors_are_its_residuals():
    p = process()
    nodes = np.random.default_rng(0).normal(size=(4, 3))
    gaussian = gtsam.GaussianFactorGraph()
    p.add_prior(gaussian, nodes)
    step = gtsam.VectorValues()
    moved = nodes.copy()
    for j in range(4):
        h = np.random.default_rng(j).normal(size=3)
        step.insert(p.key(j), h)
        moved[j] += h
    cost = 0.5 * np.sum(p.prior_residuals(moved) ** 2)
    assert gaussian.error(step) == pytest.approx(cost, rel=1e-12)


@pytest.mark.parametrize("labels", [["GNSS position"], ["GNSS position", "DVL velocity"]])
def test_linear_and_evaluated_cost_agree(labels):
    scene = scenario(manoeuvres=SHORT)
    trial = simulate(scene, 1)
    plain, _ = problem_of(scene, trial)
    time = plain.chain.segments.node_time
    nodes = np.linspace(time[0], time[-1], 4)
    sigma = {"GNSS position": SIGMA, "DVL velocity": 0.01 * SIGMA}
    processes = [process(o, i, nodes, sigma[o]) for i, o in enumerate(labels)]
    problem = Problem(plain.chain, plain.observations, plain.all_parameters, processes=processes)
    _, start = problem_of(scene, trial)
    rng = np.random.default_rng(2)
    for p in processes:
        for j in range(4):
            start.insert(p.key(j), rng.normal(size=3))
    problem.weigh(problem.evaluate(start))
    evaluation = problem.evaluate(start)
    gaussian = problem.linearize(evaluation)
    step, still = gtsam.VectorValues(), gtsam.VectorValues()
    for key, size in start.dims().items():
        still.insert(key, np.zeros(size))
        small = 1e-7 if not keys.is_process(key) else 1.0
        step.insert(key, small * rng.normal(size=size))
    before = gaussian.error(still)
    assert before == pytest.approx(evaluation.cost, rel=1e-9)
    after = problem.evaluate(start.retract(step)).cost
    assert gaussian.error(step) - before == pytest.approx(after - evaluation.cost, rel=1e-4)
    # Each measurement depends on two nodes of its process, and the rows of the graph know it.
    for rows in problem.observation_rows(evaluation):
        own = [p for p in processes if p.label == rows.source]
        assert sum(keys.is_process(int(key)) for key in rows.keys[0]) == 2 * len(own)


def test_values_return_the_nodes():
    scene = scenario(manoeuvres=SHORT)
    plain, _ = problem_of(scene)
    time = plain.chain.segments.node_time
    p = process(time=np.linspace(time[0], time[-1], 4))
    problem = Problem(plain.chain, plain.observations, plain.all_parameters, processes=[p])
    nodes = np.random.default_rng(1).normal(size=(4, 3))
    states = plain.evaluate(problem_of(scene)[1]).states
    at = problem.values(states, problem.prior_values() | {p.name: nodes})
    np.testing.assert_allclose(problem.evaluate(at).parameters[p.name], nodes)


def test_nodes_are_close_where_the_process_is_fast():
    sigma, white = np.full(3, 0.42), np.full(3, 0.27)
    time = np.arange(2501) * 0.2
    spacing = np.diff(node_times(time, 100.0, sigma, white))
    # sqrt(6 · 0.27² · 0.2 / (2 · 0.42² / 100)) = 4.98 s, and no more than a third of tau.
    assert spacing.max() == pytest.approx(4.98, abs=0.1)
    slow = np.diff(node_times(time, 100.0, 0.01 * sigma, white))
    assert slow.max() == pytest.approx(500.0 / 16.0)


def test_nodes_leave_out_what_was_not_measured():
    time = np.concatenate([np.arange(100.0), 1e9 + np.arange(100.0)])
    nodes = node_times(time, 10.0, np.ones(1), np.ones(1))
    assert nodes.size < 100
    assert nodes[0] == 0.0
    assert nodes[-1] == 1e9 + 99.0


@pytest.mark.parametrize("walks", [False, True])
@pytest.mark.parametrize("labels", [[], ["GNSS position", "DVL velocity"]])
def test_both_halves_of_a_trial_depend_on_each_other_only_by_what_goes_last(walks, labels):
    scene = walking_biases() if walks else scenario(manoeuvres=SHORT)
    plain, start = problem_of(scene)
    time = plain.chain.segments.node_time
    nodes = np.linspace(time[0], time[-1], time.size // 3)
    processes = [process(o, i, nodes) for i, o in enumerate(labels)]
    problem = Problem(plain.chain, plain.observations, plain.all_parameters, processes=processes)
    for p in processes:
        for j in range(p.time.size):
            start.insert(p.key(j), p.zero[j])
    problem.weigh(problem.evaluate(start))
    ordering = problem.ordering()
    order = [ordering.at(i) for i in range(ordering.size())]
    assert sorted(order) == sorted(start.keys())
    middle = 2 ** int(np.log2(time.size)) - 1
    before = order[: order.index(keys.node(middle))]
    half = {key: keys.index_of(key) < middle for key in before if keys.letter_of(key) in "xb"}
    for p in processes:
        half |= {p.key(j): t < time[middle] for j, t in enumerate(p.time) if p.key(j) in before}
    assert set(half) == set(before)
    assert set(half.values()) == {True, False}
    gaussian = problem.linearize(problem.evaluate(start))
    for i in range(gaussian.size()):
        involved = gaussian.at(i).keys()
        assert len({half[key] for key in involved if key in half}) <= 1


def test_nodes_of_another_layout_start_without_an_error():
    problem, values = problem_of(scenario(manoeuvres=SHORT, noise=True))
    process = Process("GNSS position", 0, np.ones(3), np.full(3, 5.0), np.arange(0.0, 9.0, 4.0))
    problem.processes = (process,)
    states, parameters = problem.chain.states(values), problem.prior_values()
    nodes = np.arange(9.0).reshape(3, 3)
    for given, expected in ((nodes, nodes), (nodes[:2], process.zero)):
        at = problem.values(states, parameters | {process.name: given})
        np.testing.assert_array_equal(problem.arrays(at)[1][process.name], expected)
