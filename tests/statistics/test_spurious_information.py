"""Spurious information, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
import solved
from dense_rows import dense, place_of, width_of
from problems import dense_covariance

from factorgraph_dvl.statistics.rows import rows_by_source
from factorgraph_dvl.statistics.spurious_information import left_of_noise, spurious_information


@pytest.fixture(scope="module")
def found():
    return solved.turning()[1]


def test_what_the_variables_leave_of_noise_is_what_the_dense_projection_leaves(found):
    problem, evaluation = found.problem, found.minimum.evaluation
    place, rows = place_of(evaluation), list(rows_by_source(problem, evaluation))
    matrices = [dense(each, place) for each in rows]
    P = dense_covariance(np.concatenate([J.reshape(-1, width_of(place)) for J in matrices]))
    left = left_of_noise(problem, evaluation, found.covariances.information)
    for observation in problem.observations:
        J = np.concatenate(
            [m for m, r in zip(matrices, rows, strict=True) if r.source == observation.label]
        )
        exact = np.eye(J.shape[1]) - J @ P @ J.transpose(0, 2, 1)
        np.testing.assert_allclose(left[observation.label], exact, atol=1e-6)


def test_a_sensor_that_states_follow_adds_little_spurious_information(found):
    """Of noise of the Jacobian, states take up the share that they follow the residuals by."""
    problem, evaluation, covariances = found.problem, found.minimum.evaluation, found.covariances
    every = spurious_information(problem, evaluation, covariances.given).sum(axis=0)
    left = spurious_information(
        problem, evaluation, covariances.given, covariances.information
    ).sum(axis=0)
    place = problem.columns["lever_arm_m"]
    share = np.trace(left[place, place]) / np.trace(every[place, place])
    blocks = left_of_noise(problem, evaluation, covariances.information)["DVL velocity"]
    shares = np.linalg.eigvalsh(blocks)
    assert shares.min() < share < shares.max()
    assert np.linalg.eigvalsh(every - left).min() > -1e-9 * np.trace(every)
