"""Directions that the data do not determine: found, fixed at the prior, with its covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import solved

from factorgraph_dvl.solvers.calibration import calibration
from factorgraph_dvl.solvers.fixed_directions import undetermined_there, with_covariances


def column(found, name, component):
    return found.problem.columns[name].start + component


def test_a_solved_problem_prints_in_a_line():
    _, found = solved.turning()
    states = found.problem.chain.node_time.size
    assert repr(found).startswith(f"<SolvedProblem of {states} states and ")
    assert len(repr(found)) < 80


def test_turns_leave_no_direction_undetermined():
    _, found = solved.turning()
    assert found.fixed.shape[1] == 0


def test_a_straight_run_leaves_the_lever_arm_and_the_roll_about_its_course():
    _, found = solved.straight()
    fixed = found.fixed
    np.testing.assert_allclose(fixed.T @ fixed, np.eye(fixed.shape[1]), atol=1e-9)
    share = np.sum(fixed**2, axis=1)
    expected = [column(found, "lever_arm_m", i) for i in range(3)]
    # The vessel goes along y.
    expected.append(column(found, "misalignment_deg", 1))
    assert share[expected].min() > 0.98
    assert np.delete(share, expected).max() < 0.05


def test_along_fixed_directions_value_and_covariance_are_the_priors():
    trial, found = solved.straight()
    estimates, covariance = calibration(found)
    (arm,) = [e for e in estimates if e.name == "lever_arm_m"]
    np.testing.assert_allclose(arm.value, trial.dvl.settings.lever_arm_m, atol=0.02)
    np.testing.assert_allclose(arm.std, trial.dvl.settings.lever_arm_std_m, rtol=0.01)
    assert not arm.observable.any()
    assert np.linalg.eigvalsh(covariance).min() > -1e-12


@pytest.fixture
def free():
    """The minimum of the straight run before its directions are fixed."""
    return solved.before_fixing(solved.straight()[0])


def test_at_the_truth_parameters_stay(free):
    before = free.minimum.evaluation.parameters
    starts = []

    def stay(start):
        starts.append(free.problem.evaluate(start).parameters)
        return free.minimum

    found = with_covariances(free.problem, free.minimum, stay, at_truth=True)
    assert found.fixed.shape[1] == solved.straight()[1].fixed.shape[1]
    (start,) = starts
    for name, value in before.items():
        np.testing.assert_allclose(start[name], value, atol=1e-12)


def test_what_is_fixed_is_undetermined_at_the_minimum(free):
    _, found = solved.straight()
    assert undetermined_there(found, free.problem)
    # One direction less is not the same.
    assert not undetermined_there(replace(found, fixed=found.fixed[:, 1:]), free.problem)
