"""What gross errors cost, one by one or persisting."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.sensors.gross_errors import gross_errors, steps

# -log of one in a hundred, uniform over 20 m/s.
NEW = np.log(20.0 / 0.01)


def test_what_persists_costs_once():
    error = np.array([[0.0], [3.0], [3.1], [9.0], [0.0]])
    rejected = np.array([[False], [True], [True], [True], [False]])
    cost = gross_errors(error, np.full((5, 1), 0.1), rejected, "m/s")
    spread = 0.1 * np.sqrt(2.0)
    same = 0.5 * (0.1 / spread) ** 2 + np.log(spread * np.sqrt(2.0 * np.pi))
    np.testing.assert_allclose(cost[:, 0], [0.0, NEW, same, NEW, 0.0])


def test_a_good_one_in_between_ends_it():
    error = np.array([[3.0], [0.0], [3.0]])
    rejected = np.array([[True], [False], [True]])
    cost = gross_errors(error, np.full((3, 1), 0.1), rejected, "m/s")
    np.testing.assert_allclose(cost[:, 0], [NEW, 0.0, NEW])


def test_what_was_not_measured_neither_costs_nor_ends_it():
    error = np.array([[3.0, 1.0], [np.nan, 1.0], [3.0, np.nan]])
    cost = gross_errors(error, np.full((3, 2), 0.1), np.ones((3, 1), dtype=bool), "m/s")
    assert cost[1, 0] == cost[2, 1] == 0.0
    # The first is one gross error in two components.
    np.testing.assert_allclose(cost[0].sum(), np.log(20.0**2 / 0.01))
    assert cost[2, 0] < 0.0


def test_steps_are_from_the_last_known():
    error = np.array([[1.0], [np.nan], [4.0]])
    sigma = np.array([[3.0], [1.0], [4.0]])
    step, spread = steps(error, sigma)
    np.testing.assert_allclose(step[:, 0], [np.nan, np.nan, 3.0])
    np.testing.assert_allclose(spread[:, 0], [np.nan, np.nan, 5.0])
