"""A problem as a native graph: the same cost, the same Jacobians, the same minimum."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from problems import ALL_FREE, IMU_ERRORS, SHORT, problem_of, walking
from truth import scenario

from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.sensors.protocol import ScaleWalk
from factorgraph_dvl.solvers.levenberg_marquardt import minimise

# Times of the nodes of correlated errors, s; a measurement lies between any two.
NODES = np.array([0.0, 1.3, 2.9, 4.0, 6.5, 8.1])

STRICT = gtsam.LevenbergMarquardtParams()
STRICT.setRelativeErrorTol(1e-12)
STRICT.setAbsoluteErrorTol(1e-9)
STRICT.setMaxIterations(30)
# Cholesky's factorisation squares the condition of a problem at navigation grade.
STRICT.setLinearSolverType("MULTIFRONTAL_QR")


def weighed(kind):
    more = {"imu": IMU_ERRORS} if kind == "IMU errors" else {}
    scene = walking() if kind == "walking" else scenario(manoeuvres=SHORT, trial=ALL_FREE | more)
    problem, values = problem_of(scene)
    if kind == "correlated":
        labels = ("GNSS position", "DVL velocity")
        processes = [
            Process(label, i, np.array([0.1, 0.2, 0.3]), np.array([3.0, 4.0, 5.0]), NODES)
            for i, label in enumerate(labels)
        ]
        (dvl,) = (o for o in problem.observations if o.label == "DVL velocity")
        walk = ScaleWalk("scale_error", 0.01, dvl.time, dvl.measured_d)
        processes[1] = replace(processes[1], walk=walk)
        evaluation = problem.evaluate(values)
        problem = Problem(
            problem.chain,
            problem.observations,
            problem.all_parameters,
            start=evaluation.parameters,
            processes=processes,
        )
        rng = np.random.default_rng(2)
        errors = {p.name: rng.normal(0.0, 1.0, p.zero.shape) for p in processes}
        values = problem.values(evaluation.states, evaluation.parameters | errors)
    problem.weigh(problem.evaluate(values))
    return problem, values


@pytest.mark.parametrize("kind", ["constant", "walking", "IMU errors", "correlated"])
def test_cost_and_jacobians_are_those_of_the_problem(kind):
    problem, values = weighed(kind)
    graph, start = problem.nonlinear_graph()
    assert start.equals(values, 0.0)
    evaluation = problem.evaluate(values)
    assert graph.error(values) == pytest.approx(evaluation.cost, rel=1e-12)
    own = problem.linearize(evaluation)
    ordering = problem.ordering()
    expected, _ = own.hessian(ordering)
    found, _ = graph.linearize(values).hessian(ordering)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / scale).max() < 1e-9


def test_a_problem_without_weights_is_refused():
    problem, _ = problem_of(scenario(manoeuvres=SHORT))
    with pytest.raises(ValueError, match="weigh"):
        problem.nonlinear_graph()


def test_gtsams_own_optimisers_find_the_same_minimum():
    problem, values = weighed("constant")
    near = minimise(problem, values, stage="test").evaluation
    # A factor keeps its nodes: pings that a clock moves from node to node would change them.
    values = problem.values(problem.evaluate(values).states, near.parameters)
    problem.weigh(problem.evaluate(values))
    graph, start = problem.nonlinear_graph()
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, STRICT).optimize()
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.setRelinearizeThreshold(1e-9)
    parameters.relinearizeSkip = 1
    isam = gtsam.ISAM2(parameters)
    isam.update(graph, start)
    for _ in range(8):
        isam.update()
    minimum = minimise(problem, start, stage="test", tolerance=1e-9)
    best = minimum.evaluation.values
    assert graph.error(best) == pytest.approx(minimum.evaluation.cost, rel=1e-9)
    for p in problem.parameters:
        key = problem.key(p.name)
        sigma = np.sqrt(np.diag(isam.marginalCovariance(key)))
        for other in (found, isam.calculateEstimate()):
            if p.rotation:
                off = gtsam.Rot3.Logmap(best.atRot3(key).between(other.atRot3(key)))
            else:
                off = other.atVector(key) - best.atVector(key)
            assert np.abs(off / sigma).max() < 0.01, p.name


def test_a_transposed_attitude_is_no_minimum():
    problem, values = weighed("constant")
    graph, _ = problem.nonlinear_graph()
    states = problem.evaluate(values).states
    turned = problem.values(states, problem.evaluate(values).parameters)
    for key in turned.keys():  # noqa: SIM118
        if turned.dims()[key] == 9:
            state = turned.atNavState(key)
            back = gtsam.NavState(state.attitude().inverse(), state.position(), state.velocity())
            turned.update(key, back)
    assert graph.error(turned) > 100.0 * graph.error(values)
