"""Estimates in reported units, and the rows of a history."""

from __future__ import annotations

import numpy as np
from kalman_trials import MISALIGNMENT, SCALE, parameter

from factorgraph_dvl.baselines.outcome import (
    Estimated,
    Outcome,
    history_of,
    history_rows,
    prior_of,
)
from factorgraph_dvl.geometry.rotations import exp_so3


def test_a_prior_comes_back_as_it_was_stated():
    turned = parameter("misalignment", [0.1, -0.2, 0.5], [0.01, 0.02, 0.03], kind="rotation")
    values, covariance = prior_of((turned, SCALE)).reported()
    np.testing.assert_allclose(values, [0.1, -0.2, 0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(covariance, np.diag([1e-4, 4e-4, 9e-4, 1e-2]), atol=1e-15)


def test_a_fixed_component_has_no_variance():
    fixed = parameter("misalignment", [0.1, 0.0, 0.3], [0.1, 0.0, 0.1], kind="rotation")
    estimated = Estimated((fixed,), (exp_so3([0.2, 0.0, 0.4]),), 0.01 * np.eye(3))
    _, covariance = estimated.reported()
    assert not covariance[1].any()
    assert not covariance[:, 1].any()


def test_a_history_keeps_its_ends():
    assert history_rows(0).size == 0
    np.testing.assert_array_equal(history_rows(3), [0, 1, 2])
    rows = history_rows(100_000)
    assert rows[0] == 0
    assert rows[-1] == 99_999
    assert rows.size == 2000
    one = prior_of((MISALIGNMENT,))
    assert history_of(Outcome(one, 1)) is None
    np.testing.assert_array_equal(history_of(Outcome(one, 1, ((2.0, one),))).std, [[3.0] * 3])
