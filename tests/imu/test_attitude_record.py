"""Attitude from a record alone: how much its noise is smoothed, and its motion is not."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from truth import CONFIGS

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.simulation import load_scenario, plan_motion, simulate


def ship(white_deg):
    scenario = load_scenario(CONFIGS / "ship.yaml")
    legs = scenario.manoeuvres[0]["manoeuvres"]
    attitude = msgspec.structs.replace(
        scenario.attitude,
        std_deg=(0.0, 0.0, 0.0),
        white_std_deg=(white_deg,) * 3,
        schuler_rms_deg=0.0,
    )
    return msgspec.structs.replace(scenario, manoeuvres=legs, attitude=attitude)


@pytest.mark.parametrize("white_deg", [0.001, 0.02, 0.2])
def test_noise_of_attitudes_and_rates_is_as_large_as_said(white_deg):
    scenario = ship(white_deg)
    trial = simulate(scenario, 1)
    record = AttitudeRecord(trial.attitude, trial.body_axes, estimated=True)
    time = np.arange(20.05, 700.0, 0.2)
    level = np.broadcast_to(np.eye(3), (time.size, 3, 3))
    found = record.at(time, np.zeros((time.size, 3)), level)
    truth = plan_motion(scenario).at(time)
    off = np.angle(np.exp(1j * (found.rph - truth.rph)))
    for measured, said in (
        (off, record.white),
        (found.omega_eb_b - truth.omega_eb_b, found.omega_sigma),
    ):
        ratio = np.sqrt(np.mean(np.square(measured), axis=0) / np.mean(np.square(said), axis=0))
        np.testing.assert_allclose(ratio, 1.0, atol=0.25)
    assert np.all(record.white < 1.2 * white_deg * DEG)


def test_more_noise_is_smoothed_more():
    gains = []
    for white_deg in (0.001, 0.02, 0.2):
        trial = simulate(ship(white_deg), 1)
        record = AttitudeRecord(trial.attitude, trial.body_axes, estimated=True)
        gains.append(record.white[0] / (white_deg * DEG))
    assert gains[0] > gains[1] >= gains[2]
    assert gains[1] < 0.6
