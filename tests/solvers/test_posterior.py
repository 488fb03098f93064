"""Covariances against dense algebra."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from exactness import worst_relative
from problems import SHORT, dense_covariance, problem_of, walking
from truth import scenario

from factorgraph_dvl.graph import keys
from factorgraph_dvl.statistics import elimination
from factorgraph_dvl.statistics.elimination import eliminated


@pytest.fixture(scope="module", params=["constant", "walking"])
def system(request):
    """A linearised trial with navigation-grade gyros, and its dense Jacobian."""
    scene = scenario(manoeuvres=SHORT) if request.param == "constant" else walking()
    problem, values = problem_of(scene)
    problem.weigh(problem.evaluate(values))
    gaussian = problem.linearize(problem.evaluate(values))
    ordering = problem.ordering()
    sizes = values.dims()
    information = eliminated(gaussian, ordering, sizes)
    order = sorted(sizes)
    place, at = {}, 0
    for key in order:
        place[key] = slice(at, at + sizes[key])
        at += sizes[key]
    rows = []
    for i in range(gaussian.size()):
        factor = gaussian.at(i)
        A, _ = factor.jacobian()
        wide, column = np.zeros((A.shape[0], at)), 0
        for key in list(factor.keys()):
            wide[:, place[key]] = A[:, column : column + sizes[key]]
            column += sizes[key]
        rows.append(wide)
    return problem, information, place, np.concatenate(rows), gaussian, sizes


def test_elimination_in_parts_and_in_time_gives_the_same(system, monkeypatch):
    problem, whole, _, _, gaussian, sizes = system
    monkeypatch.setattr(elimination, "_MANY", 0)
    in_parts = eliminated(gaussian, problem.ordering(), sizes)
    every = [{problem.key(p.name): np.eye(p.mean.size)} for p in problem.parameters]
    np.testing.assert_allclose(
        in_parts.covariance_of(every), whole.covariance_of(every), rtol=1e-6
    )
    wanted = list(sizes)
    found, expected = in_parts.marginals(wanted), whole.marginals(wanted)
    step, exact = in_parts.solution(), whole.solution()
    for key in wanted:
        assert worst_relative(found[key], expected[key]) < 1e-6
        sigma = np.sqrt(np.diag(expected[key]))
        np.testing.assert_allclose(step.at(key) / sigma, exact.at(key) / sigma, atol=1e-6)


def test_the_solution_is_that_of_gtsam(system):
    problem, whole, _, _, gaussian, sizes = system
    tree = gaussian.eliminateMultifrontal(problem.ordering(), gtsam.EliminateQR)
    exact, step = tree.optimize(), whole.solution()
    sigma = {key: np.sqrt(np.diag(P)) for key, P in whole.marginals(list(sizes)).items()}
    for key, each in sigma.items():
        np.testing.assert_allclose(step.at(key) / each, exact.at(key) / each, atol=1e-6)


def test_marginals_equal_the_dense_inverse(system):
    _, information, place, A, *_ = system
    P = dense_covariance(A)
    found = information.marginals(list(place))
    assert set(found) == set(place)
    for key, where in place.items():
        assert worst_relative(found[key], P[where, where]) < 1e-6


def test_joint_covariance_of_functionals_equals_the_dense_inverse(system):
    problem, information, place, A, *_ = system
    P = dense_covariance(A)
    rng = np.random.default_rng(0)
    n = problem.chain.segments.node_time.size
    functionals = [{problem.key(p.name): np.eye(p.mean.size)} for p in problem.parameters]
    functionals.append({keys.node(k): rng.normal(size=(2, 9)) for k in range(0, n, 2)})
    functionals.append({problem.chain.bias_key(k): rng.normal(size=(6, 6)) / n for k in range(n)})
    W = np.zeros((sum(next(iter(f.values())).shape[0] for f in functionals), A.shape[1]))
    row = 0
    for functional in functionals:
        height = next(iter(functional.values())).shape[0]
        for key, matrix in functional.items():
            W[row : row + height, place[key]] += matrix
        row += height
    assert worst_relative(information.covariance_of(functionals), W @ P @ W.T) < 1e-6


def test_the_normal_equations_would_have_few_digits_left(system):
    _, _, _, A, *_ = system
    information = A.T @ A
    # Why everything stays with the square root: 1 / epsilon is 4.5e15, and this is a trial
    # of eight seconds.
    assert np.linalg.cond(information) > 1e13


def test_a_conflicting_pair_of_measurements_by_hand():
    # x1 and x2 of one component, sigma 1 and 2, and x2 - x1 known to 1: information
    # [[1 + 1, -1], [-1, 1/4 + 1]], determinant 3/2, inverse [[5/6, 2/3], [2/3, 4/3]].
    graph = gtsam.GaussianFactorGraph()
    unit, one, zero = gtsam.noiseModel.Unit.Create(1), np.eye(1), np.zeros(1)
    graph.add(1, one, zero, unit)
    graph.add(2, one / 2.0, zero, unit)
    graph.add(1, -one, 2, one, zero, unit)
    ordering = gtsam.Ordering()
    ordering.push_back(1)
    ordering.push_back(2)
    information = eliminated(graph, ordering, {1: 1, 2: 1})
    joint = information.covariance_of([{1: one}, {2: one}])
    np.testing.assert_allclose(joint, [[5 / 6, 2 / 3], [2 / 3, 4 / 3]])
    np.testing.assert_allclose(information.marginals([1])[1], [[5 / 6]])
    np.testing.assert_allclose(information.covariance_of([{1: one, 2: one}]), [[21 / 6]])
