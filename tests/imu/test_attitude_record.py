"""Attitude from a record alone: how large the noise of its rates is."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.sensors.attitude import Attitude, AttitudeSettings

WHITE = np.array([0.01, 0.01, 0.02]) * DEG


def rolling(time):
    """Return angles (M, 3) and their rates in a seaway."""
    rate = 2.0 * np.pi * np.array([0.09, 0.12, 0.07])
    amplitude = np.array([3.0, 1.0, 0.5]) * DEG
    phase = rate * time[:, None]
    return amplitude * np.sin(phase), rate * amplitude * np.cos(phase)


def record_of(interval, *, noise=1.0, estimated=True):
    time = np.arange(0.0, 20000.0 * interval, interval)
    rph = rolling(time)[0]
    rph += noise * WHITE * np.random.default_rng(1).standard_normal(rph.shape)
    sensor = Attitude(AttitudeSettings(), time, rph)
    return AttitudeRecord(sensor, "FRD", estimated=estimated)


@pytest.mark.parametrize("interval", [0.2, 0.1, 0.05])
def test_rates_have_the_noise_that_is_said(interval):
    record = record_of(interval)
    time = (np.arange(40, 19960) + 0.25) * interval
    body = record.at(time, np.zeros((time.size, 3)), np.broadcast_to(np.eye(3), (time.size, 3, 3)))
    truth = (body.theta_by_rph @ rolling(time)[1][:, :, None])[:, :, 0]
    measured = np.mean((body.omega_eb_b - truth) ** 2, axis=0)
    said = np.mean(body.omega_sigma**2, axis=0)
    np.testing.assert_allclose(said, measured, rtol=0.1)
