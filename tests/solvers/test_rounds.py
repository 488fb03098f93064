"""Rounds of minimisation: what never settles, and measurements at their gate."""

from __future__ import annotations

import numpy as np
from findings import of_code
from problems import SHORT
from truth import scenario

from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve


def unsettled(monkeypatch, name, answer):
    monkeypatch.setattr(Problem, name, answer)
    return solve(simulate(scenario(manoeuvres=SHORT, noise=True), seed=1), rate_hz=1.0)


def test_what_never_settles_is_named(monkeypatch):
    solution = unsettled(monkeypatch, "needs_reweighting", lambda *_: True)
    assert not solution.converged
    text, *_ = of_code(solution.findings, Code.NOT_CONVERGED)
    assert "the weights of measurements still changed" in text


def test_clocks_that_never_settle_leave_a_result_that_is_not_converged(monkeypatch):
    solution = unsettled(monkeypatch, "needs_rebinding", lambda *_: True)
    assert not solution.converged
    assert np.isfinite(solution.covariance).all()
    text, *_ = of_code(solution.findings, Code.NOT_CONVERGED)
    assert "the times of measurements still changed" in text


def test_a_measurement_at_its_gate_is_used_and_named(monkeypatch):
    def outliers(problem, _):
        return {} if problem.rejected else {"DVL velocity": np.array([1.0])}

    solution = unsettled(monkeypatch, "outliers", outliers)
    assert solution.converged
    (text,) = of_code(solution.findings, Code.AT_THE_GATE)
    assert text.startswith("DVL velocity: 1 ")
    assert not solution.rejected


def test_outliers_that_never_repeat_do_not_settle(monkeypatch):
    def outliers(problem, _):
        times = problem.rejected.get("DVL velocity", np.zeros(0))
        return {"DVL velocity": np.append(times, 1.0 + times.size)}

    solution = unsettled(monkeypatch, "outliers", outliers)
    assert not solution.converged
    text, *_ = of_code(solution.findings, Code.NOT_CONVERGED)
    assert "which measurements are echoes still changed" in text
