"""The global search: both mirror images of a straight run, from nothing."""

from __future__ import annotations

import numpy as np
from planar import STRAIGHT, setup_of, trial, true_state

from factorgraph_dvl.ranging.search import GATE, _truncation_weights
from factorgraph_dvl.solvers.hypotheses import _searched, same_track


def test_a_straight_run_has_two_mirror_images_one_of_which_is_the_truth():
    t = trial(1, **STRAIGHT)
    setup = setup_of(t)
    x, values = true_state(t, setup)
    found = _searched(setup, 60)
    assert len(found) == 2
    truth = setup.fitted(x[:60], values, {})
    assert sum(same_track(setup, truth, f) for f in found) == 1
    assert not same_track(setup, *found)
    ranges = [np.hypot(*(f.x[-1, :2] - setup.rows.place[0])) for f in found]
    np.testing.assert_allclose(ranges[0], ranges[1], atol=5.0)


def test_few_rows_give_no_start():
    assert _searched(setup_of(trial(1, **STRAIGHT)), 5) == []


def test_weights_go_from_the_convex_surrogate_to_the_gate():
    squares = np.array([0.0, 0.9 * GATE**2, 1.1 * GATE**2, 100.0 * GATE**2])
    hard = _truncation_weights(squares, np.full(4, np.inf))
    np.testing.assert_array_equal(hard, [1, 1, 0, 0])
    # Yang et al., eq. 14, by hand at mu = 1: gate / |r| sqrt(2) - 1 between mu / (mu + 1) of the
    # gate and (mu + 1) / mu of it.
    expected = [1.0, np.sqrt(2.0 / 0.9) - 1.0, np.sqrt(2.0 / 1.1) - 1.0, 0.0]
    np.testing.assert_allclose(_truncation_weights(squares, np.ones(4)), expected)
    close = _truncation_weights(np.array([0.99, 1.01]) * GATE**2, np.full(2, 1e6))
    np.testing.assert_array_equal(close, [1.0, 0.0])
