"""Elimination of Gaussian graphs: in parts as at once, and what remains of it against a matrix."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.elimination_order import Spans, elimination_order
from factorgraph_dvl.statistics import elimination
from factorgraph_dvl.statistics.elimination import (
    cholesky,
    eliminated,
    error_of_variance,
)
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

NODES, SIZE, SHARED = 21, 3, 100
UNIT = gtsam.noiseModel.Unit.Create(SIZE)


@pytest.fixture(scope="module")
def chain():
    """Return the graph of nodes in a row that share a constant, its order, sizes and matrix."""
    rng = np.random.default_rng(4)
    graph = gtsam.GaussianFactorGraph()

    def some():
        return rng.standard_normal((SIZE, SIZE))

    for k in range(NODES):
        graph.add(k, some(), SHARED, some(), rng.random(SIZE), UNIT)
        if k:
            graph.add(k - 1, some(), k, some(), rng.random(SIZE), UNIT)
    time = np.arange(float(NODES))
    order = [*elimination_order(time, [Spans([[k] for k in range(NODES)], time)]), SHARED]
    every = [*range(NODES), SHARED]
    matrix, right = graph.jacobian(keys.ordering(every))
    P = np.linalg.inv(matrix.T @ matrix)
    place = {key: slice(SIZE * i, SIZE * (i + 1)) for i, key in enumerate(every)}
    return graph, order, dict.fromkeys(every, SIZE), P, P @ matrix.T @ right, place


@pytest.mark.parametrize("many", [0, 500])
def test_covariances_and_minimum_are_those_of_the_matrix(chain, many, monkeypatch):
    monkeypatch.setattr(elimination, "_MANY", many)
    graph, order, sizes, P, x, place = chain
    found = eliminated(graph, keys.ordering(order), sizes)
    for key, own in place.items():
        np.testing.assert_allclose(found.solution().at(key), x[own], atol=1e-9)
        np.testing.assert_allclose(found.marginals([key])[key], P[own, own], atol=1e-9)
    rng = np.random.default_rng(0)
    W = rng.standard_normal((4, len(P)))
    functionals = [{key: W[i : i + 2, own] for key, own in place.items()} for i in (0, 2)]
    np.testing.assert_allclose(found.covariance_of(functionals), W @ P @ W.T, atol=1e-9)
    with_every = found.covariance_with(functionals)
    for key, own in place.items():
        np.testing.assert_allclose(with_every[key], P[own] @ W.T, atol=1e-9)
    several = with_every.stacked(np.array([7, SHARED]), SIZE)
    np.testing.assert_array_equal(several, [with_every[7], with_every[SHARED]])
    groups = [(3, 4, SHARED), (11,), (12, 11)]
    for group, joint in zip(groups, found.joint_covariances(groups), strict=True):
        rows = np.concatenate([np.arange(len(P))[place[key]] for key in group])
        np.testing.assert_allclose(joint, P[np.ix_(rows, rows)], atol=1e-9)
    _, log_determinant = np.linalg.slogdet(P)
    assert found.log_determinant == pytest.approx(-log_determinant)


def test_what_is_known_leaves_the_covariance_of_the_others(chain):
    graph, order, sizes, P, _, place = chain
    given = eliminated(graph, keys.ordering(order), sizes).given({SHARED})
    states = slice(0, SIZE * NODES)
    expected = np.linalg.inv(np.linalg.inv(P)[states, states])
    pairs = [(5, 6), (20, 19)]
    for pair, joint in zip(pairs, given.joint_covariances(pairs), strict=True):
        rows = np.concatenate([np.arange(len(P))[place[key]] for key in pair])
        np.testing.assert_allclose(joint, expected[np.ix_(rows, rows)], atol=1e-9)
    with pytest.raises(ValueError, match="after all others"):
        eliminated(graph, keys.ordering(order), sizes).given({4})


def test_a_variable_that_is_not_there_is_named_and_no_other_taken(chain):
    graph, order, sizes, *_ = chain
    found = eliminated(graph, keys.ordering(order), sizes)
    with pytest.raises(KeyError):
        found.joint_covariances([(NODES + 3,)])
    with_shared = found.covariance_with([{SHARED: np.eye(SIZE)}])
    for key in (NODES + 3, SHARED + 1):
        assert key not in with_shared
        with pytest.raises(KeyError):
            with_shared.stacked(np.array([SHARED, key]), SIZE)


def test_cholesky_has_the_digits_of_what_is_well_conditioned_and_says_where_it_has_none(chain):
    graph, order, sizes, _, x, place = chain
    tree = cholesky(graph, keys.ordering(order))
    found = SquareRootInformation([tree], sizes)
    np.testing.assert_allclose(found.solution().at(4), x[place[4]], atol=1e-8)
    assert error_of_variance(graph, found, {SHARED: np.ones((1, SIZE))}) < 1e-8
    singular = gtsam.GaussianFactorGraph()
    singular.add(0, np.ones((SIZE, SIZE)), np.zeros(SIZE), UNIT)
    assert cholesky(singular, keys.ordering([0])) is None
