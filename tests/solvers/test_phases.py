"""Where a vessel begins or ends to turn or to climb, from its attitude and its DVL."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import scenario

from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.phases import BEGINS, CLIMBS, STAYS, TURNS, each_phase, phases

# Turns from 60 to 120 s; a climb by 0.2 m/s from 180 to 240 s, with ramps of ten seconds.
MANOEUVRES = [
    {"straight_s": 60},
    {"turn_deg_s": 3, "duration_s": 60, "ramp_s": 5},
    {"straight_s": 60},
    {"climb_m_s": 0.2, "to_height_m": 20},
    {"straight_s": 60},
]
TIME = np.array([20.0, 60.0, 90.0, 150.0, 185.0, 210.0, 235.0, 280.0])


@pytest.fixture(scope="module")
def dive():
    trial = simulate(
        scenario(
            noise=True,
            start={"speed_m_s": 1.0},
            manoeuvres=MANOEUVRES,
            sway={},
            imu=None,
            attitude={"rate_hz": 5, "white_std_deg": [0.05, 0.05, 0.1]},
            dvl={"rate_hz": 2, "misalignment_deg": [0, 0, 0], "velocity_std_m_s": 0.004},
            trial={"imu": None},
        ),
        1,
    )
    return trial, AttitudeRecord(trial.attitude, trial.body_axes, estimated=False)


def test_turns_and_climbs_are_phases_of_their_own(dive):
    trial, record = dive
    found = phases(record, TIME, trial, np.eye(3), 0.0)
    of_heading = [STAYS, BEGINS, TURNS, STAYS, STAYS, STAYS, STAYS, STAYS]
    np.testing.assert_array_equal(found[:, :5], np.tile(of_heading, (5, 1)).T)
    vertical = [STAYS, BEGINS, TURNS, STAYS, CLIMBS, STAYS, CLIMBS, STAYS]
    np.testing.assert_array_equal(found[:, 5], vertical)


def test_without_a_log_no_climb_is_known(dive):
    trial, record = dive
    found = phases(record, TIME, replace(trial, dvl=None), np.eye(3), 0.0)
    assert not np.any(found == CLIMBS)


def test_every_step_has_one_phase_of_each_component(dive):
    trial, record = dive
    found = phases(record, TIME, trial, np.eye(3), 0.0)
    count = np.zeros_like(found)
    for kind, i, where in each_phase(found):
        assert np.all(found[where, i] == kind)
        count[where, i] += 1
    assert np.all(count == 1)
