"""The motion that instruments report, in place of SINS/GNSS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_dvl.baselines.recorded_navigation import recorded_navigation
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.sensors.attitude import Attitude, AttitudeSettings
from factorgraph_dvl.sensors.gnss import Gnss, GnssSettings
from factorgraph_dvl.sensors.ins import Ins, InsSettings
from factorgraph_dvl.trial import Trial

# A circle of 100 m radius at 5 m/s, about 45 deg north; metres per radian there.
TIME = np.arange(0.0, 120.0, 0.5)
TURN = 5.0 / 100.0
NORTH, EAST = 6367381.8, 6388838.3 * np.cos(45.0 * DEG)
ARM = np.array([10.0, 0.0, 0.0])


def circle(time):
    heading = TURN * time
    east, north = 100.0 * (1.0 - np.cos(heading)), 100.0 * np.sin(heading)
    velocity = 5.0 * np.stack([np.sin(heading), np.cos(heading), 0.0 * time], axis=1)
    return heading, np.stack([east, north, 0.0 * time], axis=1), velocity


def geodetic(metres):
    return np.stack([45.0 * DEG + metres[:, 1] / NORTH, metres[:, 0] / EAST, metres[:, 2]], axis=1)


def reported(arm):
    """Return what a point of the bow at `arm` m ahead does."""
    heading, metres, velocity = circle(TIME)
    ahead = np.stack([np.sin(heading), np.cos(heading), 0.0 * heading], axis=1)
    aside = np.stack([np.cos(heading), -np.sin(heading), 0.0 * heading], axis=1)
    rph = np.stack([0.0 * heading, 0.0 * heading, heading], axis=1)
    return rph, geodetic(metres + arm * ahead), velocity + arm * TURN * aside


def check(trial, tolerance):
    at = np.array([40.25, 61.1])
    motion = recorded_navigation(trial).at(at)
    _, metres, velocity = circle(at)
    assert motion.covered.all()
    np.testing.assert_allclose(motion.velocity, velocity, atol=tolerance)
    np.testing.assert_allclose(motion.v_b, [[5.0, 0.0, 0.0]] * 2, atol=tolerance)
    np.testing.assert_allclose(motion.omega_b, [[0.0, 0.0, TURN]] * 2, atol=1e-4)
    off = (motion.geodetic - geodetic(metres)) * [NORTH, EAST, 1.0]
    np.testing.assert_allclose(off, 0.0, atol=0.05)


def ins_trial(late=0.0):
    rph, place, velocity = reported(ARM[0])
    settings = InsSettings(lever_arm_m=tuple(ARM), time_offset_s=late)
    ins = Ins(settings, TIME + late, place, velocity, rph, np.full((TIME.size, 9), np.nan))
    return Trial("circle", None, others=(ins,), body_axes="FRD")


@pytest.mark.parametrize("late", [0.0, 2.5])
def test_an_ins_gives_the_motion_of_the_body(late):
    check(ins_trial(late), 2e-3)


def test_gnss_with_a_compass_gives_velocities_by_differences():
    rph, place, velocity = reported(ARM[0])
    unknown = np.full(velocity.shape, np.nan)
    rph[:, :2] = np.nan
    settings = GnssSettings(lever_arm_m=tuple(ARM))
    gnss = Gnss(settings, TIME, place, unknown, unknown.copy(), unknown.copy())
    compass = Attitude(AttitudeSettings(), TIME, rph)
    # Over five seconds a chord is shorter than the arc by 0.26 %.
    check(Trial("circle", None, gnss=gnss, others=(compass,), body_axes="FRD"), 0.02)
    with pytest.raises(ConfigError, match="position and attitude"):
        recorded_navigation(Trial("circle", None, others=(compass,), body_axes="FRD"))


def test_nothing_is_known_in_a_gap_and_beyond_the_ends():
    trial = ins_trial()
    (ins,) = trial.others
    kept = (TIME < 50.0) | (TIME > 70.0)
    part = Ins(ins.settings, TIME[kept], *(getattr(ins, n)[kept] for n in
                                           ("geodetic", "velocity", "rph", "std")))  # fmt: skip
    motion = recorded_navigation(replace(trial, others=(part,))).at(np.array([-1.0, 40.0, 60.0]))
    np.testing.assert_array_equal(motion.covered, [False, True, False])
