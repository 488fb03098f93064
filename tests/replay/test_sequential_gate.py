"""Measurements against the prediction of a window, one after another."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.replay import sequential_gate
from factorgraph_dvl.replay.sequential_gate import _one_after_another


@pytest.fixture
def shared():
    """Covariance of five predictions of one component that share an error of 3 sigma."""
    return np.full((5, 5), 9.0)


def test_innovations_are_white(shared):
    rng = np.random.default_rng(1)
    root = np.linalg.cholesky(shared + np.eye(5))
    found, spread = zip(
        *(_one_after_another(root @ rng.normal(size=5), shared, (5, 1)) for _ in range(4000)),
        strict=True,
    )
    normalised = np.array(found)[..., 0] / np.array(spread)[..., 0]
    np.testing.assert_allclose(np.cov(normalised.T), np.eye(5), atol=0.08)
    # The first is predicted worst.
    assert np.all(np.diff(spread[0][:, 0]) < 0.0)


def test_an_outlier_does_not_change_what_is_predicted_next(shared):
    residual = np.array([0.5, 40.0, 0.2, -0.1, 0.3])
    found, spread = _one_after_another(residual, shared, (5, 1))
    without, _ = _one_after_another(residual[[0, 2, 3, 4]], shared[1:, 1:], (4, 1))
    assert abs(found[1, 0]) > sequential_gate._LIMIT * spread[1, 0]
    np.testing.assert_allclose(found[[0, 2, 3, 4]], without)


def test_what_was_not_measured_changes_nothing():
    """Its rows are zero."""
    covariance = np.zeros((4, 4))
    covariance[:1, :1] = covariance[2:3, 2:3] = covariance[0, 2] = covariance[2, 0] = 4.0
    found, spread = _one_after_another(np.array([1.0, 0.0, 1.0, 0.0]), covariance, (2, 2))
    np.testing.assert_allclose(found[:, 1], 0.0)
    np.testing.assert_allclose(spread[:, 1], 1.0)
    # 4/5 of the first is in the second too.
    np.testing.assert_allclose(found[1, 0], 1.0 - 0.8)
