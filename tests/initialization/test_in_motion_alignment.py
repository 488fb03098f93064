"""States to start from: any heading, any body axes, whatever aids there are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import CONING, exact_states, scenario

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import segments
from factorgraph_dvl.initialization.in_motion_alignment import initial_states
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import simulate

INITIAL = {"initial": {"attitude_std_deg": [0.5, 0.5, 2.0], "position_std_m": [1, 1, 1]}}


def start_of(scene, **changes):
    """Return start, and largest errors of tilt, heading (deg), position, velocity."""
    trial = replace(simulate(scene, seed=3), **changes)
    frame = trial.frame()
    inc, _ = increments(trial.imu)
    seg = segments(inc, 1.0)
    start = initial_states(trial, frame, seg)
    true = exact_states(scene, frame, seg.node_time)
    turned = log_so3(start.states.nRb @ true.nRb.transpose(0, 2, 1)) / DEG
    return (
        start,
        np.abs(turned[:, :2]).max(),
        np.abs(turned[:, 2]).max(),
        np.abs(start.states.p_n - true.p_n).max(),
        np.abs(start.states.v_n - true.v_n).max(),
    )


@pytest.mark.parametrize("heading", [0, 137, 250])
@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
def test_any_heading_and_body_axes(heading, body_axes):
    scene = scenario(noise=True, start={"heading_deg": heading}, body_axes=body_axes)
    start, tilt, yaw, position, velocity = start_of(scene)
    assert start.findings == ()
    # Velocities of 0.1 m/s, 390 of them over changes of a few m/s: 0.02 deg of tilt, 0.3
    # of heading.
    assert tilt < 0.1
    assert yaw < 1.0
    # Fixes of 0.5 and 1 m, interpolated.
    assert position < 5.0
    assert velocity < 0.7


def test_noise_free_alignment_is_limited_by_interpolation_only():
    start, tilt, yaw, position, velocity = start_of(scenario())
    assert start.findings == ()
    assert tilt < 1e-3
    assert yaw < 1e-3
    # Straight lines between the 5 Hz epochs of a swell.
    assert position < 0.08
    assert velocity < 0.08


def test_violent_sway_with_an_antenna_up_a_mast():
    scene = scenario(noise=True, sway=CONING, gnss={"lever_arm_m": [0.3, -1.5, 5.0]})
    start, tilt, yaw, _, velocity = start_of(scene)
    assert start.findings == ()
    # The antenna swings by 4.4 m/s at 2 Hz, and the first state is older than the first fix.
    assert tilt < 0.1
    assert yaw < 1.0
    assert velocity < 7.0


@pytest.mark.parametrize("heading", [0, 250])
def test_from_positions_alone(heading):
    scene = scenario(
        noise=True,
        start={"heading_deg": heading},
        gnss={"velocity_std_m_s": None, "lever_arm_m": [0.3, -1.5, 4.0]},
    )
    start, tilt, yaw, position, _ = start_of(scene)
    assert start.findings == ()
    assert tilt < 0.3
    assert yaw < 3.0
    assert position < 5.0


@pytest.mark.parametrize("heading", [0, 137, 250])
def test_tilt_from_the_dvl_alone(heading):
    # Nothing tells where north is: the mounting is known, the heading is free.
    claims = {"misalignment_deg": [2, 2, 30], "lever_arm_m": [1, 1.2, 1.4], "scale_error": 0.005}
    scene = scenario(
        noise=True,
        start={"heading_deg": heading},
        trial={"dvl": claims, "initial": {"position_std_m": [1, 1, 1]}},
    )
    start, tilt, _, _, _ = start_of(scene, gnss=None)
    assert tilt < 0.1
    assert start.states.nRb.shape[0] == 79


def test_a_straight_run_takes_the_heading_from_the_course():
    scene = scenario(
        noise=True, manoeuvres=[{"straight_s": 60}], sway={}, start={"heading_deg": 250}
    )
    start, tilt, yaw, _, _ = start_of(scene)
    assert [f.code for f in start.findings] == [Code.HEADING_UNKNOWN]
    assert tilt < 0.2
    # The course of one epoch: 0.1 m/s across 4 m/s.
    assert yaw < 5.0


def test_at_rest_the_start_is_level_and_north_and_says_so():
    scene = scenario(
        manoeuvres=[{"straight_s": 30}], sway={}, start={"heading_deg": 250, "speed_m_s": 0}
    )
    start, tilt, _, _, velocity = start_of(scene)
    assert len(start.findings) == 1
    # What the Earth turns in half a minute about an axis that is taken for another: 0.2 deg.
    assert tilt < 0.25
    assert velocity < 1e-6


def test_an_initial_attitude_is_taken_as_it_is():
    error = [0.3, -0.2, 5.0]
    claims = {"initial": INITIAL["initial"] | {"attitude_error_deg": error}}
    start, _, yaw, _, _ = start_of(scenario(trial=claims))
    # Heading is clockwise, the rotation about up counter-clockwise.
    assert yaw == pytest.approx(5.0, abs=0.4)
    assert start.findings == ()


@pytest.mark.parametrize("initial", [None, INITIAL])
def test_every_arc_is_aligned(initial):
    scene = scenario(noise=True, imu={"gaps_s": [[25.0, 28.0], [50.0, 51.0]]}, trial=initial or {})
    start, tilt, yaw, position, _ = start_of(scene)
    assert start.findings == ()
    assert tilt < 0.3
    assert yaw < 2.0
    assert position < 5.0


def test_gyros_that_drift_are_aligned_in_windows():
    scene = scenario(
        noise=True,
        manoeuvres=[
            {"repeat": 6, "manoeuvres": [{"straight_s": 30}, {"turn_deg_s": 3, "duration_s": 30}]}
        ],
        imu={
            "gyro_bias_deg_h": [30, -20, 25],
            "gyro_noise_deg_sqrt_h": 0.2,
            "accel_noise_ug_sqrt_hz": 150,
            "accel_bias_ug": [1000, -1000, 500],
        },
        trial={"imu": {"gyro_bias_std_deg_h": 30, "accel_bias_std_ug": 1000}},
    )
    start, tilt, yaw, _, _ = start_of(scene)
    assert start.findings == ()
    # A heading is believed from a standard deviation of 5 deg on; 15 deg at worst here.
    assert tilt < 1.5
    assert yaw < 20.0


def test_gaps_of_gnss_are_bridged_by_the_dvl():
    claims = {"misalignment_deg": [2, 2, 30], "lever_arm_m": [1, 1.2, 1.4]}
    scene = scenario(gnss={"outages_s": [[15.0, 60.0]]}, trial={"dvl": claims})
    _, tilt, yaw, position, velocity = start_of(scene)
    assert tilt < 0.01
    assert yaw < 0.5
    # Up to ten seconds from a fix its velocity is taken, turn or not.
    assert velocity < 4.0
    assert position < 20.0


def test_nothing_to_align_with():
    scene = scenario(trial={"initial": {"position_std_m": [1, 1, 1]}})
    with pytest.raises(DataError, match=r"no data to find the attitude from 0\.0 s on"):
        start_of(scene, gnss=None, dvl=None)
    # With an initial attitude, the arc after a gap starts from the end of the one before.
    scene = scenario(imu={"gaps_s": [[30.0, 35.0]]}, trial=INITIAL)
    start = start_of(scene, gnss=None, dvl=None)[0]
    a, b = (int(k) for k in (30, 31))
    np.testing.assert_allclose(start.states.nRb[b], start.states.nRb[a], atol=1e-3)
