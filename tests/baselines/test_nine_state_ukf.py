"""The unscented nine-state filter: exact without noise, better than a linear one at 30 degrees."""

from __future__ import annotations

import numpy as np
import pytest
from kalman_trials import MISALIGNMENT, SCALE, exact_points, parameter

from factorgraph_dvl.baselines.nine_state import nine_state, unscented, with_bias
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3

ROUGHLY = parameter("misalignment", np.zeros(3), np.full(3, 0.5), kind="rotation")
BIAS = parameter("dvl_bias", np.zeros(3), np.full(3, 0.2))
NO_ARM = np.zeros(3)


def error(outcome, turn):
    return float(np.linalg.norm(log_so3(exp_so3(turn).T @ outcome.estimated.values[0])))


@pytest.mark.parametrize("turn", [[0.02, -0.01, 0.03], [0.2, -0.1, 0.5]], ids=["small", "large"])
def test_it_finds_angles_that_a_linear_filter_does_not(turn):
    scale, bias = np.array([0.01, -0.02, 0.03]), np.array([0.05, 0.02, -0.1])
    points = exact_points(misalignment=turn, scale=scale, bias=bias)
    three, findings = with_bias(ROUGHLY, SCALE, BIAS)
    outcome = unscented(points, three, NO_ARM, findings)
    linear = nine_state(points, ROUGHLY, SCALE, BIAS, NO_ARM, iterated=False)
    assert error(outcome, turn) < 5e-3
    assert error(outcome, turn) < 0.5 * error(linear, turn)
    np.testing.assert_allclose(outcome.estimated.values[2], bias, atol=0.02)
    assert np.linalg.eigvalsh(outcome.estimated.covariance)[0] > 0.0


def test_a_misalignment_that_may_be_anything_is_refused():
    three, findings = with_bias(MISALIGNMENT, SCALE, BIAS)
    with pytest.raises(ConfigError, match="approximate misalignment"):
        unscented(exact_points(), three, NO_ARM, findings)
