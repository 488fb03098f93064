"""Trials with every sensor and every key."""

from __future__ import annotations

PLANAR = {
    "name": "planar",
    "start": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": -50.0, "speed_m_s": 1.5},
    "manoeuvres": [{"straight_s": 30}],
    "heading": {"rate_hz": 2, "std_deg": 0.5},
    "log": {"rate_hz": 2, "speed_std_m_s": 0.05},
    "depth": {"rate_hz": 2, "std_m": 0.1},
    "beacons": {
        "rate_hz": 1,
        "range_std_m": 0.5,
        "positions": {"B1": {"lat_deg": 25.001, "lon_deg": 135.0, "height_m": -80.0}},
    },
}


EVERYTHING = {
    "name": "everything",
    "epoch": "2022-10-12T02:00:00Z",
    "start": {"lat_deg": 25.0, "lon_deg": 135.0, "speed_m_s": 2.0},
    "manoeuvres": [{"straight_s": 10}, {"turn_deg_s": 5, "duration_s": 10}],
    "imu": {"rate_hz": 20, "gyro_noise_deg_sqrt_h": 0.01, "accel_noise_ug_sqrt_hz": 100},
    "gnss": {"rate_hz": 1, "position_std_m": [1, 1, 2], "velocity_std_m_s": [0.1, 0.1, 0.1]},
    "dvl": {"rate_hz": 1, "velocity_std_m_s": 0.01},
    "star": {"rate_hz": 1, "std_arcsec": 5},
    "depth": {"rate_hz": 1, "std_m": 0.1},
    "dvl_beams": {"rate_hz": 1, "slant_azimuth_deg": [[30, 0], [30, 120], [30, 240]]},
    "turntable": {"rate_hz": 1},
    "beacons": {"rate_hz": 1, "positions": {"B1": PLANAR["beacons"]["positions"]["B1"]}},
    "trial": {"imu": {"gyro_bias_std_deg_h": 1, "accel_bias_std_ug": 1000}},
}
