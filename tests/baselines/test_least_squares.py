"""Nonlinear least squares, with a time offset."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kalman_trials import LEVER_ARM, MISALIGNMENT, exact_points, parameter
from truth import scenario

from factorgraph_dvl.baselines import kalman
from factorgraph_dvl.baselines.least_squares import least_squares
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import simulate


def test_least_squares_finds_a_time_offset():
    scene = scenario(
        noise=True, dvl={"time_offset_s": 0.08}, trial={"dvl": {"time_offset_std_s": 0.5}}
    )
    solution = kalman(simulate(scene, 1), "least-squares")
    offset = solution.estimate("time_offset_s")
    assert offset.observable[0]
    np.testing.assert_allclose(offset.value, 0.08, atol=max(5.0 * offset.std[0], 1e-3))
    neglected = [f for f in kalman(simulate(scene, 1)).findings if f.code == Code.METHOD_LIMITS]
    assert "time_offset_s" in {f.parameter for f in neglected}


# A wide prior starts from the rotations of a cube, a narrow one from its mean.
@pytest.mark.parametrize(("turn", "wide"), [([0.1, 0.2, -0.3], 0.3), ([0.0, 3.0, 0.0], 3.0)])
def test_without_noise_it_is_exact(turn, wide):
    arm, scale, bias = np.array([1.0, -0.5, 2.0]), np.array([0.01, -0.02, 0.03]), 0.05
    points = exact_points(40, misalignment=turn, scale=scale, arm=arm, bias=bias)
    parameters = (
        replace(MISALIGNMENT, sigma=np.full(3, wide)),
        parameter("scale_error", np.zeros(3), np.full(3, 0.5)),
        LEVER_ARM,
        parameter("dvl_bias", np.zeros(3), np.full(3, 1.0)),
        parameter("time_offset", [0.0], [0.0], labels=("",)),
    )
    outcome = least_squares(lambda offset: points, parameters)
    assert outcome.converged
    found = outcome.estimated
    assert [p.stem for p in found.parameters][-1] == "dvl_bias"
    np.testing.assert_allclose(found.values[0], exp_so3(turn), atol=1e-4)
    for value, true in zip(found.values[1:], (scale, arm, bias), strict=True):
        np.testing.assert_allclose(value, np.broadcast_to(true, 3), atol=1e-3)
