"""Descent of the objective: it never rises, and what does not lower it is not kept."""

from __future__ import annotations

import importlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from findings import of_code
from problems import SHORT
from truth import CONFIGS, scenario

from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers import rounds
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.model import least_objective
from factorgraph_dvl.solvers.preparation import prepare
from factorgraph_dvl.solvers.rounds import settle
from factorgraph_dvl.solvers.steps import Noise


def silent(stage, iteration, cost):
    """Report nothing."""


@pytest.fixture(scope="module")
def noisy():
    """A trial whose DVL is three times as noisy as stated, with gross errors."""
    trial = simulate(scenario(noise=True), seed=1)
    settings = trial.dvl.settings
    rng = np.random.default_rng(1)
    velocity = trial.dvl.velocity + rng.normal(0.0, 0.01, trial.dvl.velocity.shape)
    velocity[::40] += 1.0
    return replace(trial, dvl=replace(trial.dvl, settings=settings, velocity=velocity))


@pytest.fixture(scope="module")
def settled(noisy):
    prepared = prepare(noisy, 1.0, silent)
    return settle(prepared, prepared.start_positions.states[0], silent)


def test_the_objective_never_rises(settled):
    objective = [step.objective for step in settled.steps]
    assert len(objective) > 2
    assert np.all(np.diff(objective) < 0.0)
    changes = [step.change for step in settled.steps]
    assert {"gross errors", "noise"} <= set(changes)
    falls = [step.fall for step in settled.steps[1:]]
    np.testing.assert_allclose(falls, -np.diff(objective))


def test_another_problem_and_another_order_have_the_same_objective(settled, monkeypatch):
    monkeypatch.syspath_prepend(CONFIGS.parent / "benchmarks")
    again = importlib.import_module("common").objective_again
    found = again(settled.problem, settled.minimum.evaluation)
    assert found == pytest.approx(settled.steps[-1].objective, abs=1e-2)


def test_what_does_not_lower_the_objective_is_dropped(noisy, monkeypatch):
    """Steps that ask for the opposite of what the last one did lead in no circle."""
    asked = []

    def opposite(self, at):
        asked.append(len(asked))
        factor = 100.0 if len(asked) % 2 else 0.01
        factors = {label: f * factor for label, f in at.model.noise_factors.items()}
        yield rounds.Proposal(replace(at.model, noise_factors=factors), at.states, at.values)

    monkeypatch.setattr(Noise, "proposals", opposite)
    prepared = prepare(noisy, 1.0, silent)
    found = settle(prepared, prepared.start_positions.states[0], silent)
    assert found.settled
    assert len(asked) < 10
    assert np.all(np.diff([step.objective for step in found.steps]) < 0.0)


def test_the_steps_are_part_of_the_solution(noisy):
    solution = solve(noisy, rate_hz=1.0)
    assert solution.steps[0].change == "start"
    assert solution.steps[-1].largest_move_sigma < 5.0


def test_steps_without_end_are_named(monkeypatch):
    monkeypatch.setattr(rounds, "_MOST_STEPS", 1)
    solution = solve(simulate(scenario(manoeuvres=SHORT, noise=True), seed=1), rate_hz=1.0)
    assert not solution.converged
    assert np.isfinite(solution.covariance).all()
    assert of_code(solution.findings, Code.NOT_CONVERGED)


def test_a_solver_that_tries_much_in_vain_ends_and_says_so(monkeypatch):
    left = []

    def in_vain(step, at, report, most):
        left.append(most)
        return None, 150

    monkeypatch.setattr(rounds, "_kept", in_vain)
    solution = solve(simulate(scenario(manoeuvres=SHORT, noise=True), seed=1), rate_hz=1.0)
    assert left[:3] == [100, -50, -200]
    assert solution.verdict.grade == "do not use"
    (finding,) = of_code(solution.findings, Code.NOT_CONVERGED)
    assert f"in {solution.iterations} iterations" in str(finding)


def first_minimum(trial):
    prepared = prepare(trial, 1.0, silent)
    start, _ = rounds._start(
        prepared, prepared.start_positions.states[0], silent, None, None, None
    )
    return rounds._first(start, silent)


def test_noise_that_no_fit_makes_up_for_is_not_tried():
    at = first_minimum(simulate(scenario(manoeuvres=SHORT, noise=True), seed=1))
    model = replace(at.model, parameters=(*at.model.parameters[1:], at.model.parameters[0]))
    wider = {label: 1e3 * f for label, f in model.noise_factors.items()}
    other = replace(model, noise_factors=wider)
    assert rounds._is_hopeless(rounds.Proposal(other, at.states, at.values), at)
    assert not rounds._is_hopeless(rounds.Proposal(model, at.states, at.values), at)
    least = least_objective(model, at.states, at.values)
    # What it leaves out: the squares of all residuals.
    assert least + 2.0 * at.minimum.evaluation.cost == pytest.approx(at.objective, abs=1.0)


def test_nothing_is_tried_beyond_the_most_in_vain():
    class Costly:
        name = "costly"

        def proposals(self, at):
            raise AssertionError

    assert rounds._kept(Costly(), None, silent, 0) == (None, 0)


def test_less_of_what_makes_it_worse_is_not_tried(monkeypatch):
    tried = []

    def objective(model, *_, **__):
        tried.append(model.share)
        minimum = SimpleNamespace(iterations=1, converged=True)
        return SimpleNamespace(objective=worse[model.share], minimum=minimum, rough=False)

    def model(share):
        same = {"parameters": (), "robust_weights": {}, "processes": ()}
        chain = SimpleNamespace(interpolates=True)
        return SimpleNamespace(share=share, chain=chain, is_applied=lambda _: True, **same)

    class Halved:
        name = "halved"

        def proposals(self, at):
            for share in (1.0, 0.5, 0.25, 0.125):
                yield rounds.Proposal(model(share), None, {}, nearer=share < 1.0)

    monkeypatch.setattr(rounds, "estimated", objective)
    at = SimpleNamespace(objective=0.0, rough=False, model=model(0.0), problem=None)
    worse = {1.0: 2.0, 0.5: 4.0, 0.25: 6.0, 0.125: 7.0}
    assert rounds._kept(Halved(), at, silent) == (None, 2)
    assert tried == [1.0, 0.5]
    worse = {1.0: 9.0, 0.5: 4.0, 0.25: 1.0, 0.125: -1.0}
    found, iterations = rounds._kept(Halved(), at, silent)
    assert (found.objective, iterations) == (-1.0, 4)


@pytest.mark.parametrize(
    ("converged", "misfit", "lost"),
    [(False, 1.0, False), (True, 1e4, False), (False, 99.0, False), (False, 101.0, True)],
)
def test_what_has_no_minimum_and_does_not_fit_by_far_is_lost(converged, misfit, lost):
    """Residuals ten times as large as stated are no noise: a stuck gyro took 10,000 steps."""
    at = first_minimum(simulate(scenario(manoeuvres=SHORT, noise=True), seed=1))
    count = sum(np.count_nonzero(weight) for weight in at.problem.weights)
    evaluation = replace(at.minimum.evaluation, cost=0.5 * misfit * count)
    minimum = replace(at.minimum, evaluation=evaluation, converged=converged)
    assert rounds._is_lost(replace(at, minimum=minimum)) == lost
