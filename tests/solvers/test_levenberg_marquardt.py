"""Levenberg-Marquardt: costs that fall, giving up, costs that are no numbers."""

from __future__ import annotations

from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from problems import SHORT, problem_of
from truth import scenario

from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.solvers.levenberg_marquardt import minimise


def test_giving_up_is_reported():
    problem, values = problem_of(scenario(manoeuvres=SHORT))
    minimum = minimise(problem, values, stage="test", max_iterations=1)
    assert not minimum.converged
    assert minimum.iterations == 1
    calls = []
    minimum = minimise(
        problem, values, stage="test", progress=lambda *a: calls.append(a), max_iterations=30
    )
    assert minimum.converged
    assert calls[0][:2] == ("test", 0)
    costs = np.array([c[2] for c in calls])
    assert np.all(np.diff(costs) <= 1e-12 * costs[:-1])
    assert minimum.evaluation.cost == pytest.approx(costs[-1])
    # Once more from there, it stays.
    again = minimise(problem, minimum.evaluation.values, stage="test")
    assert again.iterations == 1
    assert again.evaluation.cost == pytest.approx(minimum.evaluation.cost, abs=1e-5)


def test_a_cost_that_is_not_finite_is_refused():
    problem, values = problem_of(scenario(manoeuvres=SHORT))
    name = problem.parameters[1].name
    values.update(problem.key(name), np.full(problem.parameters[1].mean.size, np.nan))
    with pytest.raises(SolveError, match="not finite"):
        minimise(problem, values, stage="test")


class AtAKink:
    """Lowest cost at 0, where a linear model promises to lower it further."""

    tilt = None
    parameters = ()

    def evaluate(self, values):
        return SimpleNamespace(
            values=values, parameters={}, cost=1.0 + float(np.abs(values.atVector(0)).sum())
        )

    def weighed(self, evaluation):
        return evaluation

    def linearize(self, evaluation):
        graph = gtsam.GaussianFactorGraph()
        unit = gtsam.noiseModel.Unit.Create(1)
        graph.add(0, np.eye(1), np.sqrt([2.0 * evaluation.cost]), unit)
        return graph

    def ordering(self, *, branches=True):
        out = gtsam.Ordering()
        out.push_back(0)
        return out


def test_steps_that_gain_nothing_end_where_larger_ones_fail():
    values = gtsam.Values()
    values.insert(0, np.zeros(1))
    minimum = minimise(AtAKink(), values, stage="test", max_iterations=1000)
    assert not minimum.converged
    assert minimum.evaluation.cost == 1.0
    # One power of ten of damping each, up to steps that are small enough.
    assert minimum.iterations < 20
