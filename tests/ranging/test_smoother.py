"""The smoother: when it has converged."""

from __future__ import annotations

import numpy as np
import pytest
from planar import trial, true_state

from factorgraph_dvl.ranging.model import GATE
from factorgraph_dvl.ranging.problem import planar_setup
from factorgraph_dvl.ranging.smoother import fit, truncation_weights


def test_a_fit_that_was_cut_short_has_not_converged():
    setup = planar_setup(trial())
    start = true_state(trial(), setup.problem)
    away = start[0] + np.array([30.0, -20.0, 0.0, 0.0])
    assert not fit(setup.problem, away, start[1], iterations=1).converged
    whole = fit(setup.problem, away, start[1])
    assert whole.converged
    again = fit(setup.problem, whole.x, whole.theta, iterations=2)
    assert again.converged
    assert again.cost == pytest.approx(whole.cost, abs=1e-5)


def test_weights_go_from_the_convex_surrogate_to_the_gate():
    squares = np.array([0.0, 0.9 * GATE**2, 1.1 * GATE**2, 100.0 * GATE**2])
    np.testing.assert_array_equal(truncation_weights(squares, np.inf), [1, 1, 0, 0])
    # Yang et al., eq. 14, by hand at mu = 1: gate / |r| sqrt(2) - 1 between mu / (mu + 1) of the
    # gate and (mu + 1) / mu of it.
    expected = [1.0, np.sqrt(2.0 / 0.9) - 1.0, np.sqrt(2.0 / 1.1) - 1.0, 0.0]
    np.testing.assert_allclose(truncation_weights(squares, 1.0), expected)
    close = truncation_weights(np.array([0.99, 1.01]) * GATE**2, 1e6)
    np.testing.assert_array_equal(close, [1.0, 0.0])
