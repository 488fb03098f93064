"""From a minimum to a solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import solved

from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.dvl import SCALE_SPEC
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solvers import change_along_trial
from factorgraph_dvl.solvers.change_along_trial import ComponentChange
from factorgraph_dvl.solvers.summary import summarise
from factorgraph_dvl.statistics.constancy import Change


@pytest.fixture(scope="module")
def turning():
    trial, found = solved.turning()
    return found, summarise(trial, found, rate_hz=2.0)


def test_the_trajectory_comes_at_the_rate_that_was_asked_for(turning):
    _, solution = turning
    np.testing.assert_allclose(np.diff(solution.trajectory.time), 0.5, atol=1e-9)
    assert solution.converged
    assert solution.verdict.grade == "good"


def test_residuals_are_predicted_less_measured_in_their_unit(turning):
    found, solution = turning
    problem, evaluation = found.problem, found.minimum.evaluation
    for residuals, whitened, o in zip(
        solution.residuals, evaluation.residuals, problem.observations, strict=True
    ):
        assert residuals.label == o.label
        assert residuals.time.size == o.time.size
        np.testing.assert_allclose(residuals.residual / residuals.sigma, whitened, rtol=1e-9)
    assert 0.5 * sum(np.sum(r**2) for r in evaluation.residuals) <= solution.cost


def test_what_was_found_before_is_kept_and_an_end_without_a_minimum_is_an_error():
    trial, found = solved.turning()
    note = Finding(Code.UNUSED, "a note", severity="note")
    minimum = replace(found.minimum, converged=False)
    solution = summarise(trial, replace(found, minimum=minimum, findings=(note,)), rate_hz=1.0)
    assert note in solution.findings
    (error,) = [f for f in solution.findings if f.code == Code.NOT_CONVERGED]
    assert error.severity == "error"
    assert solution.verdict.grade == "do not use"


def test_what_the_data_do_not_determine_is_named_with_its_reason():
    trial, found = solved.straight()
    solution = summarise(trial, found, rate_hz=1.0)
    texts = [f.text for f in solution.findings if f.code == Code.NOT_OBSERVABLE]
    for component in ("lever_arm_x_m", "lever_arm_z_m", "misalignment_y_deg"):
        assert any(component in text for text in texts), component
    assert solution.verdict.grade == "doubtful"


@pytest.mark.parametrize(("size", "grade"), [(-9e-4, "doubtful"), (1.1e-3, "do not use")])
def test_a_change_below_the_limit_of_its_parameter_is_a_drift(monkeypatch, size, grade):
    scale = Parameter(SCALE_SPEC, np.zeros(1), np.ones(1))
    change = ComponentChange(scale.name, scale, Change(40.0, 40.0, 50.0, size, 1e-4, np.zeros(1)))
    monkeypatch.setattr(change_along_trial, "changes_at", lambda *_: [change])
    trial, found = solved.turning()
    verdict = summarise(trial, found, rate_hz=2.0).verdict
    assert verdict.grade == grade
    assert [r.code for r in verdict.reasons] == [Code.CHANGED_ALONG_TRIAL]


@pytest.mark.parametrize(("shift", "grade"), [(-9e-4, "doubtful"), (1.1e-3, "do not use")])
def test_a_change_beside_the_calibration_counts_as_it_moves_it(monkeypatch, shift, grade):
    scale = Parameter(SCALE_SPEC, np.zeros(1), np.ones(1))
    bias = Parameter(Imu.specs[0], np.zeros(3), np.ones(3))
    beside = Change(9.0, 9.0, 50.0, 0.1, 1e-4, np.zeros(2))
    change = Change(40.0, 40.0, 50.0, 0.5, 0.1, np.array([shift, 0.5]))
    tests = [ComponentChange(p.name, p, c) for p, c in ((scale, beside), (bias, change))]
    monkeypatch.setattr(change_along_trial, "changes_at", lambda *_: tests)
    trial, found = solved.turning()
    verdict = summarise(trial, found, rate_hz=2.0).verdict
    assert verdict.grade == grade
    (reason,) = verdict.reasons
    assert bias.name in reason.text
