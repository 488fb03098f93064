"""Spurious information of a replay, accumulated."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.graph.priors import prior_mean
from factorgraph_dvl.graph.sensor_factor import NodeMeasurements, bind, states_of
from factorgraph_dvl.replay.navigator import LocalGravity
from factorgraph_dvl.replay.smoother import Smoother
from factorgraph_dvl.replay.spurious import SpuriousInformation


@pytest.fixture(scope="module")
def second(started):
    """Measurements of a second, the motion at them, the state's covariance, and the values."""
    start = started.start
    smoother = Smoother(
        start.prior, start.values, node=start.node, time=start.time,
        parameters=start.parameters, walking=start.walking, lag=None, ranges=start.ranges,
    )  # fmt: skip
    values = {**start.fixed, **smoother.calibration()}
    seg = started.segment(0)
    state, bias = smoother.state(start.node), smoother.bias(start.node)
    gravity = LocalGravity(start.frame).at(state.position()[None])
    chain = start.chain.following(seg, gravity, start.node)
    after = chain.graph.at(0).preintegratedMeasurements().predict(state, bias)
    states = states_of([state, after], [bias])
    observations = [
        o for aid in started.aids(seg) for o in aid.observations(start.frame, start.body_axes)
    ]
    bound, _ = bind(chain, observations, start.parameters, {}, start.clock_zero)
    measured = NodeMeasurements.of(bound, start.parameters, start.fixed)
    _, _, motions, _ = measured.linearize(states, values)
    P = smoother.joint_covariance()[:9, :9]
    weights = [b.weight for b in measured.bound]
    return measured, motions, weights, values, P


def test_it_is_evaluated_once_a_second_and_scaled_to_all_that_were_used(started, second):
    measured, motions, weights, values, P = second
    time = started.start.time
    once, twice = SpuriousInformation(started.start), SpuriousInformation(started.start)
    before = once.information
    assert not once.add(measured, motions, weights, values, P, time + 0.5)
    assert once.information is before
    assert once.add(measured, motions, weights, values, P, time + 1.5)
    assert twice.add(measured, motions, weights, values, P, time + 1.5)
    # The first stands for both.
    np.testing.assert_allclose(
        once.information - before, 2.0 * (twice.information - before), rtol=1e-9, atol=1e-15
    )
    assert np.trace(once.information) > np.trace(before)


def test_what_was_not_used_adds_nothing(started, second):
    measured, motions, weights, values, P = second
    found = SpuriousInformation(started.start)
    none = [0.0 * w for w in weights]
    assert not found.add(measured, motions, none, values, P, started.start.time + 10.0)


def test_what_is_known_no_better_than_before_is_undetermined(started):
    found = SpuriousInformation(started.start)
    parameters = started.start.parameters
    prior = np.diag(np.concatenate([p.sigma for p in parameters]) ** 2)
    count = len(prior)
    assert found.undetermined(prior).shape == (count, count)
    assert found.undetermined(1e-12 * prior).shape == (count, 0)
    assert all(np.isfinite(prior_mean(p)).all() for p in parameters)
