"""The depth sensor: its equation, and what a trial gains from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exactness import assert_exact
from jacobians import differentiate
from offsets import OFFSET_RAD
from truth import config, exact_motion, scenario

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.depth import Depth, DepthBelowSurface, DepthSettings
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.simulation import plan_motion, simulate
from factorgraph_dvl.solvers.batch import solve

ARM = [2.0, -3.0, 1.5]
SINKING = [{"straight_s": 10}, {"climb_m_s": -0.5, "to_height_m": -5}, {"straight_s": 10}]


def scene(**changes):
    depth = {"rate_hz": 3, "phase_s": 0.1, "lever_arm_m": ARM, "sea_surface_height_m": 17.3}
    depth |= {"scale_error": 0.01}
    return scenario(manoeuvres=SINKING, depth=depth, **changes)


def observed(scn):
    """Return exact motion, an observation, and its values; 60 km from the origin."""
    trial = simulate(scn)
    fix = trial.gnss.geodetic[0]
    frame = LocalFrame(fix[0] - OFFSET_RAD, fix[1] + OFFSET_RAD, 0.0)
    (depth,) = trial.others
    (o,) = depth.observations(frame, "RFU")
    values = {"sea_surface_height_m": np.array([17.3]), "depth_scale_error": np.array([0.01])}
    return exact_motion(plan_motion(scn), frame, o.time), o, values, depth


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
def test_zero_error_at_the_truth(body_axes):
    motion, o, values, _ = observed(scene(body_axes=body_axes))
    assert np.abs(o.residual(motion, values)).max() < 1e-6
    # A rotation the wrong way round shows: the arm is 4 m long and the vessel rolls.
    turned = replace(motion, nRb=motion.nRb.transpose(0, 2, 1))
    assert np.abs(o.residual(turned, values)).max() > 0.1


def test_jacobians():
    # Geodetic heights have nine digits after the comma, so the steps must be long.
    motion, o, values, _ = observed(scene())
    lin = o.linearize(motion, values, o.parameters)

    def residual(**changes):
        return o.residual(replace(motion, **changes), values)

    for stated, numerical in (
        (lin.d_theta, differentiate(
            lambda h: residual(nRb=motion.nRb @ exp_so3(h)), 3, step=1e-3)),
        (lin.d_p, differentiate(lambda h: residual(p_n=motion.p_n + h), 3, step=1.0)),
        (lin.d_parameters["sea_surface_height_m"], differentiate(
            lambda h: o.residual(motion, values | {"sea_surface_height_m": np.array([17.3]) + h}),
            1)),
        (lin.d_parameters["depth_scale_error"], differentiate(
            lambda h: o.residual(motion, values | {"depth_scale_error": np.array([0.01]) + h}),
            1)),
    ):  # fmt: skip
        np.testing.assert_allclose(stated, numerical, atol=2e-6)
    assert np.abs(lin.d_theta).max() > 1.0
    assert lin.d_v is None


def test_depth_by_hand():
    # At the origin of n, rolled by 90 deg about north: body x points down, so a sensor 2 m
    # along x is 2 m lower, and one at a height of 10 m is 7 m below a surface at 15 m.
    frame = LocalFrame(0.6, 2.1, 10.0)
    down = np.array([[[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]])
    zero = np.zeros((1, 3))
    motion = Motion(down, zero, zero, zero, zero, zero, zero)
    measured = np.array([6.5])
    o = DepthBelowSurface(np.zeros(1), measured, 0.1, np.array([2.0, 0.0, 0.0]), frame)
    values = {"sea_surface_height_m": np.array([15.0]), "depth_scale_error": np.array([-0.02])}
    # 7 m of water that is lighter than supposed look like 6.86 m.
    np.testing.assert_allclose(o.residual(motion, values), [[0.36]], atol=1e-8)


def test_noiseless_dive_is_exact():
    unbiased = {"gyro_bias_deg_h": [0, 0, 0], "accel_bias_ug": [0, 0, 0]}
    short = config(
        "dive",
        noise=False,
        manoeuvres=SINKING + SINKING[:1],
        imu=unbiased,
        gnss={"outages_s": [[15, 1000]]},
        dvl={"no_lock_s": []},
    )
    trial = simulate(short, 0)
    solution = solve(trial)
    assert solution.estimate("sea_surface_height_m").observable.all()
    assert_exact(trial, solution, limit=0.1, trajectory=0.6)


@pytest.mark.slow
def test_scale_and_surface_of_a_slow_pressure_sensor_are_as_good_as_they_say():
    """With fixes at the surface, and 30 m down: density off by 2 %, an offset over minutes."""
    down = [{"climb_m_s": -0.5, "to_height_m": -30}, {"straight_s": 60}]
    up = [{"climb_m_s": 0.5, "to_height_m": 10}, {"straight_s": 60}]
    slow = {"scale_error_std": 0.02, "correlated_std_m": 0.2, "correlation_time_s": 200}
    depth = {"rate_hz": 1, "std_m": 0.02, "sea_surface_height_m": 11.0, "scale_error": "draw"}
    squares = []
    for seed in range(4):
        trial = simulate(
            scenario(
                noise=True,
                manoeuvres=[{"straight_s": 60}, *down, *up],
                start={"lat_deg": 36, "lon_deg": 121, "height_m": 10, "speed_m_s": 1.5},
                gnss={"outages_s": [[60, 300]], "position_std_m": [0.1, 0.1, 0.1]},
                dvl={"rate_hz": 2},
                depth=depth | slow,
            ),
            seed,
        )
        solution = solve(trial, rate_hz=1.0)
        e = solution.estimate("depth_scale_error")
        assert e.std[0] < 0.01
        for name in ("depth_scale_error", "sea_surface_height_m"):
            e = solution.estimate(name)
            squares.append((e.value - trial.calibration_truth[name])[0] ** 2 / e.std[0] ** 2)
    assert np.max(squares) < 4.0**2
    # The mean of eight, in 99 % of such tests.
    assert 0.1 < np.mean(squares) < 2.8


def test_without_gnss_the_sea_surface_is_not_observable():
    initial = {"attitude_std_deg": [1, 1, 1], "position_std_m": [5, 5, 200]}
    trial = simulate(scene(gnss=None, trial={"initial": initial}), 0)
    solution = solve(trial)
    assert not solution.estimate("sea_surface_height_m").observable.any()
    unseen = {f.parameter for f in solution.findings if f.code == Code.NOT_OBSERVABLE}
    assert "sea_surface_height_m" in unseen


def test_a_depth_out_of_range_names_its_row():
    with pytest.raises(DataError, match=r"depth line 3: depth_m = 20000 is out of range"):
        Depth(DepthSettings(), np.array([0.0, 1.0]), np.array([1.0, 2e4]))
