"""Correlated errors of a replay against their definition."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.replay.correlated_errors import CorrelatedErrors
from factorgraph_dvl.sensors.protocol import ScaleWalk

PROCESSES = (
    Process("slow", 0, np.array([0.5, 2.0]), np.array([100.0, 50.0]), np.array([0.0, 10.0, 18.0])),
    Process("none", 1, np.zeros(1), np.ones(1), np.array([0.0, 20.0])),
    Process("fast", 2, np.array([0.1]), np.array([2.0]), np.array([0.0, 19.5])),
)
TAU = np.array([100.0, 50.0, 2.0])


WALK = ScaleWalk("scale_error", 0.01, np.array([0.0, 20.0]), np.ones((2, 1)))


@pytest.fixture
def errors():
    return CorrelatedErrors.of(PROCESSES)


def test_processes_without_an_error_of_their_own_have_no_components(errors):
    assert errors.size == 3
    assert errors.places == {"slow": slice(0, 2), "fast": slice(2, 3)}
    assert CorrelatedErrors.of(()).size == 0


def test_the_covariance_of_two_states_is_that_of_the_process(errors):
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    first, second = keys.correlated(4), keys.correlated(5)
    unit = gtsam.noiseModel.Unit.Create(3)
    graph.addPriorVector(first, np.zeros(3), unit)
    graph.add(errors.transition(4, 0.7))
    for key in (first, second):
        values.insert(key, np.ones(3))
    joint = gtsam.Marginals(graph, values).jointMarginalCovariance([first, second])
    np.testing.assert_allclose(joint.at(second, second), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(joint.at(second, first), np.diag(np.exp(-0.7 / TAU)), atol=1e-12)


def test_the_variance_of_a_scale_that_walks_grows_with_time():
    alone = replace(PROCESSES[1], walk=WALK)
    errors = CorrelatedErrors.of([alone])
    assert (errors.places, errors.walks) == ({}, {"none": ("scale_error", 0)})
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    first, second = keys.correlated(0), keys.correlated(1)
    graph.addPriorVector(first, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 1e-3))
    graph.add(errors.transition(0, 5.0))
    for key in (first, second):
        values.insert(key, np.zeros(1))
    found = gtsam.Marginals(graph, values).marginalCovariance(second) * errors.sigma**2
    np.testing.assert_allclose(found, [[WALK.rate**2 * 5.0]], rtol=1e-4)


def test_the_start_follows_from_the_last_nodes(errors):
    gaussian = gtsam.GaussianFactorGraph()
    nodes = {p.name: np.ones((p.time.size, p.size)) for p in PROCESSES}
    found = errors.add_start(gaussian, PROCESSES, nodes, 7, 20.0)
    left = np.exp(-np.array([2.0, 2.0, 0.5]) / TAU)
    np.testing.assert_allclose(found, left)
    last = [(p, p.key(p.time.size - 1)) for p in PROCESSES if p.sigma.any()]
    for p, key in last:
        gaussian.add(key, np.eye(p.size), np.zeros(p.size), gtsam.noiseModel.Unit.Create(p.size))
    key = keys.correlated(7)
    P = gaussian.marginal([key]).hessian()[0]
    np.testing.assert_allclose(np.linalg.inv(P), np.eye(3), atol=1e-9)


def test_an_error_is_interpolated_between_the_states(errors):
    observation = SimpleNamespace(label="fast", components=("x",), scale_walk=None)
    other = SimpleNamespace(label="other", components=("x", "y"), scale_walk=None)
    bound = [
        SimpleNamespace(
            observation=o,
            weight=np.ones((len(tau), len(o.components))),
            attachment=SimpleNamespace(forward=SimpleNamespace(tau=np.array(tau))),
        )
        for o, tau in ((observation, [0.0, 0.15]), (other, [0.1]))
    ]
    before, after = errors.gains(SimpleNamespace(bound=bound), 0.2)
    np.testing.assert_allclose(before[:, 2], [0.1, 0.025, 0.0, 0.0])
    np.testing.assert_allclose(after[:, 2], [0.0, 0.075, 0.0, 0.0])
    assert not before[:, :2].any()
