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
    clock_keys = ()

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

    def ordering(self):
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


class Curved:
    """A cost of two constants, the second a clock by which its slope may jump.

    Its linear model has another curvature by the first than the cost.
    """

    tilt = None

    def __init__(self, curvature, jump=0.0):
        self.parameters = tuple(SimpleNamespace(name=name) for name in ("scale", "clock"))
        self.clock_keys = [1]
        self._curvature, self._jump = curvature, jump

    def key(self, name):
        return ("scale", "clock").index(name)

    def evaluate(self, values):
        x, t = values.atVector(0)[0] - 2.0, values.atVector(1)[0]
        cost = 10.0 + 0.5 * self._curvature * x**2 + self._jump * abs(t) + 0.5 * (t - 0.1) ** 2
        return SimpleNamespace(values=values, parameters={}, cost=cost)

    def weighed(self, evaluation):
        return evaluation

    def linearize(self, evaluation):
        graph = gtsam.GaussianFactorGraph()
        x = evaluation.values.atVector(0)[0] - 2.0
        t = evaluation.values.atVector(1)[0]
        slopes = self._curvature * x, (t - 0.1) + self._jump * (1.0 if t > 0.0 else -1.0)
        unit = gtsam.noiseModel.Unit.Create(1)
        for key, slope in enumerate(slopes):
            graph.add(key, np.eye(1), np.full(1, -slope), unit)
        rest = 2.0 * evaluation.cost - sum(slope**2 for slope in slopes)
        graph.add(0, np.zeros((1, 1)), np.sqrt([rest]), unit)
        return graph

    def ordering(self):
        out = gtsam.Ordering()
        for key in (0, 1):
            out.push_back(key)
        return out


def start():
    values = gtsam.Values()
    for key in (0, 1):
        values.insert(key, np.zeros(1))
    return values


@pytest.mark.parametrize("curvature", [1.9, 0.1])
def test_steps_go_on_as_they_changed_where_the_linear_model_has_another_curvature(curvature):
    # By itself it would go to and fro, a tenth nearer each time, or by a tenth of the way.
    problem = Curved(curvature)
    minimum = minimise(problem, start(), stage="test", proven=False)
    assert minimum.converged
    assert minimum.iterations < 8
    values = minimum.evaluation.values
    assert values.atVector(0)[0] == pytest.approx(2.0, abs=0.02)
    assert values.atVector(1)[0] == pytest.approx(0.1, abs=0.01)


def test_a_clock_stays_where_the_slope_jumps_and_the_rest_goes_on():
    minimum = minimise(Curved(1.0, jump=0.6), start(), stage="test", proven=False)
    assert minimum.converged
    values = minimum.evaluation.values
    # In standard deviations, which are 1.
    assert values.atVector(0)[0] == pytest.approx(2.0, abs=0.01)
    assert values.atVector(1)[0] == pytest.approx(0.0, abs=0.01)
