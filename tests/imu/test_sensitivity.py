"""Errors of the IMU: what they move, and what they move where a clock has moved."""

from __future__ import annotations

import numpy as np
import pytest
from problems import IMU_ERRORS, SHORT, problem_of
from truth import scenario

from factorgraph_dvl.imu.propagation import attach
from factorgraph_dvl.imu.sensitivity import moved, sensitivities
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


def at(bound, late):
    seg, rate, elements, time = bound
    here, there = attach(seg, time, rate), attach(seg, time + late, rate)
    ends, (by, exact) = sensitivities(seg, elements, [here, there])
    return moved(seg, there, here, by, ends), exact, ends


# What errors of the rate do to the position grows with the cube of time, from which a line between
# its ends differs by at most 0.385 of the end.
@pytest.mark.parametrize(
    ("late", "share"), [(0.0, 1e-12), (0.001, 0.002), (0.02, 0.03), (-0.02, 0.03), (0.4, 0.385)]
)
def test_the_sensitivity_where_a_clock_moved_is_nearly_the_exact_one(bound, late, share):
    found, exact, ends = at(bound, late)
    for name in ("theta", "v", "p"):
        mine, true = getattr(found, name), getattr(exact, name)
        assert np.abs(mine - true).max() <= share * np.abs(getattr(ends, name)).max()
    np.testing.assert_allclose(found.gyro, exact.gyro)
    np.testing.assert_allclose(found.force, exact.force)


def test_the_sensitivity_does_not_jump_from_segment_to_segment(bound):
    seg, rate, elements, time = bound
    here = attach(seg, time, rate)
    before = attach(seg, time - 0.03 - 1e-5, rate)
    assert np.all(before.segment == here.segment - 1)
    ends, (by,) = sensitivities(seg, elements, [here])
    found = moved(seg, before, here, by, ends)
    # The node after takes over what the segment before has added.
    whole = ends.theta[before.segment]
    np.testing.assert_allclose(found.theta, whole, atol=2e-5 * np.abs(whole).max())
    after = moved(seg, attach(seg, time - 0.03 + 1e-5, rate), here, by, ends)
    assert np.abs(after.theta).max() < 1e-3 * np.abs(whole).max()


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
    # Pings are bound where nodes are: with an earlier clock they belong to the segment before.
    (pings,) = (o.time for o in problem.observations if o.label == "DVL velocity")
    assert np.isin(problem.chain.segments.node_time[1:-1].round(6), pings.round(6)).all()
    at = minimise(problem, values, stage="test").evaluation
    late = at.parameters["time_offset_s"] + np.linspace(-0.003, 0.003, 13)[:, None]
    costs = [
        problem.evaluate(problem.values(at.states, at.parameters | {"time_offset_s": x})).cost
        for x in late
    ]
    assert np.abs(np.diff(costs, 2)).max() < 0.3 * np.abs(np.diff(costs)).max()
