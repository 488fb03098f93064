"""Directions of the parameters that the data do not determine."""

from __future__ import annotations

import numpy as np
import pytest
import solved

from factorgraph_dvl.statistics.undetermined_directions import (
    at_prior_along,
    largest_spurious_share,
    parameter_information,
    undetermined_directions,
)

RNG = np.random.default_rng(0)
Q, _ = np.linalg.qr(RNG.normal(size=(4, 4)))


def along(*information):
    """Return a matrix of information along four directions."""
    return Q * np.array(information) @ Q.T


def test_a_direction_whose_information_is_spurious_is_undetermined():
    data = along(1e6, 1e4, 200.0, 50.0)
    spurious = along(1.0, 1.0, 10.0, 49.8)
    found = undetermined_directions(data, spurious)
    assert found.shape == (4, 1)
    assert abs(found[:, 0] @ Q[:, 3]) == pytest.approx(1.0, abs=1e-6)


def test_little_information_that_is_genuine_determines_little_and_is_left():
    data = along(1e6, 1e4, 200.0, 0.05)
    assert undetermined_directions(data, 0.0 * data).shape == (4, 0)
    # Once any is spurious, what leaves the prior nearly as it was goes with it.
    spurious = along(0.0, 0.0, 180.0, 0.0)
    found = undetermined_directions(data, spurious)
    assert found.shape == (4, 1)
    assert abs(found[:, 0] @ Q[:, 3]) == pytest.approx(1.0, abs=1e-3)


def test_the_largest_share_is_that_of_the_worst_direction():
    data, spurious = along(1e6, 1e4, 200.0, 50.0), along(1.0, 1.0, 10.0, 25.0)
    share = largest_spurious_share(np.stack([data, 2.0 * data]), np.stack([spurious, spurious]))
    np.testing.assert_allclose(share, [0.5, 0.25], rtol=0.01)
    assert undetermined_directions(np.zeros((0, 0)), np.zeros((0, 0))).shape == (0, 0)


def test_parameters_return_to_the_prior_along_directions_and_nowhere_else():
    _, found = solved.turning()
    problem, values = found.problem, found.minimum.evaluation.parameters
    directions = np.eye(len(problem.prior_root))[:, problem.columns["lever_arm_m"]]
    moved = at_prior_along(problem, values, directions)
    np.testing.assert_allclose(moved["lever_arm_m"], problem.prior_values()["lever_arm_m"])
    np.testing.assert_allclose(moved["misalignment_deg"], values["misalignment_deg"], atol=1e-9)
    np.testing.assert_allclose(moved["scale_error"], values["scale_error"], atol=1e-12)


def test_with_all_else_exact_parameters_are_known_better_than_beside_it():
    _, found = solved.turning()
    exact = parameter_information(found.problem, found.minimum.evaluation)
    # In units of the priors, whose information is the identity.
    beside = np.linalg.inv(found.covariances.parameters) - np.eye(len(exact))
    assert np.linalg.eigvalsh(exact - beside).min() > -1e-6 * np.linalg.eigvalsh(exact).max()
