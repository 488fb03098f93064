"""The start of a smoother: the last state stands for all records before it."""

from __future__ import annotations

import numpy as np
from exactness import worst_relative

from factorgraph_dvl.message import Message
from factorgraph_dvl.quality.texts import text_of
from factorgraph_dvl.replay.smoother import Smoother
from factorgraph_dvl.replay.start import solve_start
from factorgraph_dvl.solvers.batch import settled_minimum
from factorgraph_dvl.solvers.posterior import posterior


def silent(stage, iteration, cost):
    """Report nothing."""


def test_the_last_state_knows_what_the_batch_knows(started):
    start = started.start
    settled, _ = settled_minimum(started.early, clock_zero=0.0)
    covariances = posterior(settled.problem, settled.minimum)
    gaussian = start.prior.linearize(start.values)
    smoother = Smoother(
        start.prior, start.values, node=start.node, time=start.time,
        parameters=start.parameters, walking=start.walking, lag=None, ranges=start.ranges,
    )  # fmt: skip
    P = smoother.joint_covariance()[:9, :9]
    assert worst_relative(P, covariances.nodes[-1]) < 1e-5
    # Linear where it was solved: no step is left.
    step = gaussian.optimize()
    assert max(np.abs(step.at(key)).max() for key in start.values.dims()) < 1e-4


def test_columns_are_those_of_the_parameters(started):
    start = started.start
    names = [p.name for p in start.parameters]
    sizes = [p.mean.size for p in start.parameters]
    assert start.columns(names).tolist() == list(range(sum(sizes)))
    assert start.columns(names[-1:]).tolist() == list(range(sum(sizes[:-1]), sum(sizes)))
    assert start.columns([]).size == 0


def test_the_trajectory_begins_after_the_time_that_was_known(started):
    time = started.start.trajectory.time
    assert 42.0 < time[0] < 42.2
    assert 44.0 < time[-1] <= started.start.time
    np.testing.assert_allclose(np.diff(time), 0.1, atol=1e-9)


def test_measurements_as_stated_fit(started):
    assert 0.8 < started.start.misfit < 1.2
    assert started.start.sections == ("gnss", "dvl")
    assert not started.start.ranges


def test_a_start_is_refused_with_its_reason(started, monkeypatch):
    monkeypatch.setattr("factorgraph_dvl.replay.start._ATTITUDE", 1e-9)
    said = solve_start(started.early, None, 1.0, 0.0, silent, 0.0)
    assert isinstance(said, Message)
    assert "attitude is known to" in text_of(said)
