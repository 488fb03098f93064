"""Shares of the information on a parameter."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.analysis.information.manoeuvres import Segment
from factorgraph_dvl.analysis.information.observability import information_shares
from factorgraph_dvl.statistics.information_history import InformationHistory

PARTS = [Segment(0.0, 10.0, "first"), Segment(10.0, 20.0, "second")]


def history(*information):
    """Information at 0, 10 and 20 s, as square roots of covariances."""
    root = np.stack([np.linalg.cholesky(np.linalg.inv(L)) for L in information])
    names = tuple("abc"[: root.shape[1]])
    return InformationHistory(np.array([0.0, 10.0, 20.0]), names, root)


def test_of_one_parameter_the_shares_are_those_of_its_information():
    shares = information_shares(history(*np.array([1.0, 4.0, 8.0]).reshape(3, 1, 1)), PARTS)
    np.testing.assert_allclose(shares.prior, [1 / 8])
    np.testing.assert_allclose(shares.segments, [[3 / 8], [4 / 8]])


def test_a_part_that_separates_two_parameters_counts_for_both():
    # The first part measures a + b with unit variance, the second a alone.
    prior = 0.01 * np.eye(2)
    both = prior + np.ones((2, 2))
    shares = information_shares(history(prior, both, both + np.diag([1.0, 0.0])), PARTS)
    np.testing.assert_allclose(shares.prior + shares.segments.sum(axis=0), 1.0)
    a, b = shares.segments.T
    assert a[1] > 0.9
    # b = (a + b) - a: each of the two errors is half of its own.
    np.testing.assert_allclose(b, 0.5, atol=0.02)
