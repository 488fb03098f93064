"""Tests of what the wrong sampling of an IMU looks like."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.imu.sampling import apparent_gyro_scale
from factorgraph_dvl.sensors.imu import Imu, ImuSettings


@pytest.mark.parametrize(("sampling", "sign"), [("instantaneous", -1.0), ("mean", 1.0)])
def test_means_of_a_sine_are_smaller_by_a_sixth_of_the_squared_angle(sampling, sign):
    time = np.arange(0.0, 100.0, 0.02)
    noise = np.random.default_rng(1).normal(scale=1e-3, size=(time.size, 3))
    gyro = 0.3 * np.sin(2.0 * np.pi * time[:, None] * np.array([0.5, 1.0, 2.0])) + noise
    settings = ImuSettings(grade="mems", sampling=sampling)
    imu = Imu(time=time, gyro=gyro, accel=np.zeros_like(gyro) + 9.8, settings=settings)
    x = np.pi * 0.02 * np.array([0.5, 1.0, 2.0])
    np.testing.assert_allclose(apparent_gyro_scale(imu), sign * x**2 / 6.0, rtol=0.05)
