"""Errors of the IMU: what they move, forward and back."""

from __future__ import annotations

import numpy as np
import pytest
from problems import IMU_ERRORS, SHORT, problem_of
from truth import scenario

from factorgraph_dvl.geometry.rotations import log_so3
from factorgraph_dvl.imu.sensitivity import carried_back_by, corrected_two_way, sensitivities
from factorgraph_dvl.imu.two_way import attach_two_way
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.solvers.levenberg_marquardt import minimise


@pytest.fixture(scope="module")
def bound():
    """Return segments, the Earth's rate, elements, and times inside segments bound to them."""
    scene = scenario(manoeuvres=SHORT, trial={"imu": IMU_ERRORS})
    problem, _ = problem_of(scene)
    elements = [e for errors in ERRORS.values() for e in errors]
    seg, rate = problem.chain.segments, problem.chain.frame.earth_rate
    return seg, rate, elements, seg.node_time[1:-2] + 0.03


def test_what_is_integrated_back_moves_as_what_is_corrected(bound):
    seg, rate, elements, time = bound
    at = attach_two_way(seg, time + 0.4, rate)
    ends, (by,) = sensitivities(seg, elements, [at.forward])
    size = 1e-5 * np.random.default_rng(3).normal(size=len(elements))
    back = carried_back_by(at, by, ends)

    def corrected(factor):
        return corrected_two_way(at, by, ends, seg, elements, factor * size).backward

    ahead, behind = corrected(1.0), corrected(-1.0)
    turned = log_so3(ahead.dR @ behind.dR.transpose(0, 2, 1)) / 2.0
    for found, name in (
        (turned, "theta"),
        ((ahead.dV - behind.dV) / 2.0, "v"),
        ((ahead.dP - behind.dP) / 2.0, "p"),
    ):
        expected = getattr(back, name) @ size
        np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())
    # Transposed, a rotation over half a second of a turn of 8 deg/s shows.
    wrong = by.theta - ends.theta[at.segment]
    assert np.abs((wrong - back.theta) @ size).max() > 1e-3 * np.abs(turned).max()


def test_the_cost_does_not_jump_where_measurements_cross_a_node():
    scene = scenario(
        manoeuvres=SHORT,
        imu={"gyro_scale_ppm": [5000] * 3, "accel_scale_ppm": [5000] * 3},
        trial={
            "imu": {"gyro_scale_std_ppm": 5000, "accel_scale_std_ppm": 5000},
            "dvl": {"velocity_std_m_s": 0.001, "time_offset_std_s": 0.1},
        },
    )
    problem, values = problem_of(scene)
    # Pings are where nodes are: with an earlier clock they belong to the segment before.
    (pings,) = (o.time for o in problem.observations if o.label == "DVL velocity")
    assert np.isin(problem.chain.segments.node_time[1:-1].round(6), pings.round(6)).all()
    at = minimise(problem, values, stage="test").evaluation
    late = at.parameters["time_offset_s"] + np.linspace(-0.003, 0.003, 13)[:, None]
    costs = [
        problem.evaluate(problem.values(at.states, at.parameters | {"time_offset_s": x})).cost
        for x in late
    ]
    assert np.abs(np.diff(costs, 2)).max() < 0.3 * np.abs(np.diff(costs)).max()
