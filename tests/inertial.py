"""Records of an IMU whose rate and force never change."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import Segments, segments
from factorgraph_dvl.sensors.imu import Imu, ImuSettings

SETTINGS = ImuSettings(
    gyro_noise_deg_sqrt_h=0.001,
    gyro_bias_std_deg_h=0.1,
    accel_noise_ug_sqrt_hz=20,
    accel_bias_std_ug=100,
)


def constant_imu(seconds: float, gyro=(0.0, 0.0, 0.0), accel=(0.0, 0.0, 9.8)) -> Imu:
    """Return samples at 100 Hz."""
    time = np.arange(1, round(100 * seconds) + 1) / 100.0
    return Imu(SETTINGS, time, np.tile(gyro, (time.size, 1)), np.tile(accel, (time.size, 1)))


def constant_segments(seconds: float, interval: float = 1.0, **signals) -> Segments:
    """Return the segments of such a record."""
    return segments(increments(constant_imu(seconds, **signals))[0], interval)
