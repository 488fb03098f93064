"""Typical errors of IMUs by grade, for the keys that a trial does not state."""

from __future__ import annotations

from typing import Literal

Grade = Literal["navigation", "tactical", "industrial", "mems"]

# Chosen: round figures (1 σ) of what data sheets of the class say, docs/format.md names them.
# Biases are those from one start to the next, walks what in-run instability amounts to in an
# hour. A bias prior that is too wide costs little, one that is too narrow falsifies the rest.
TYPICAL: dict[Grade, dict[str, float]] = {
    "navigation": {
        "gyro_noise_deg_sqrt_h": 0.002,
        "gyro_bias_std_deg_h": 0.01,
        "gyro_bias_walk_deg_h_sqrt_h": 0.0,
        "accel_noise_ug_sqrt_hz": 25.0,
        "accel_bias_std_ug": 50.0,
        "accel_bias_walk_ug_sqrt_h": 0.0,
        "gyro_scale_std_ppm": 5.0,
        "gyro_misalignment_std_deg": 0.0015,
        "gyro_g_sensitivity_std_deg_h_g": 0.005,
        "accel_scale_std_ppm": 100.0,
        "accel_misalignment_std_deg": 0.003,
    },
    "tactical": {
        "gyro_noise_deg_sqrt_h": 0.1,
        "gyro_bias_std_deg_h": 2.0,
        "gyro_bias_walk_deg_h_sqrt_h": 0.3,
        "accel_noise_ug_sqrt_hz": 80.0,
        "accel_bias_std_ug": 1000.0,
        "accel_bias_walk_ug_sqrt_h": 30.0,
        "gyro_scale_std_ppm": 300.0,
        "gyro_misalignment_std_deg": 0.03,
        "gyro_g_sensitivity_std_deg_h_g": 1.0,
        "accel_scale_std_ppm": 300.0,
        "accel_misalignment_std_deg": 0.03,
    },
    "industrial": {
        "gyro_noise_deg_sqrt_h": 0.1,
        "gyro_bias_std_deg_h": 200.0,
        "gyro_bias_walk_deg_h_sqrt_h": 2.0,
        "accel_noise_ug_sqrt_hz": 40.0,
        "accel_bias_std_ug": 3000.0,
        "accel_bias_walk_ug_sqrt_h": 30.0,
        "gyro_scale_std_ppm": 1000.0,
        "gyro_misalignment_std_deg": 0.05,
        "gyro_g_sensitivity_std_deg_h_g": 10.0,
        "accel_scale_std_ppm": 1000.0,
        "accel_misalignment_std_deg": 0.04,
    },
    "mems": {
        "gyro_noise_deg_sqrt_h": 0.4,
        "gyro_bias_std_deg_h": 600.0,
        "gyro_bias_walk_deg_h_sqrt_h": 10.0,
        "accel_noise_ug_sqrt_hz": 150.0,
        "accel_bias_std_ug": 5000.0,
        "accel_bias_walk_ug_sqrt_h": 100.0,
        "gyro_scale_std_ppm": 3000.0,
        "gyro_misalignment_std_deg": 0.1,
        "gyro_g_sensitivity_std_deg_h_g": 20.0,
        "accel_scale_std_ppm": 3000.0,
        "accel_misalignment_std_deg": 0.1,
    },
}
# Without a grade these are taken as zero, and the other keys must be stated.
ZERO_WITHOUT_GRADE = frozenset(
    (
        "gyro_bias_walk_deg_h_sqrt_h",
        "accel_bias_walk_ug_sqrt_h",
        "gyro_scale_std_ppm",
        "gyro_misalignment_std_deg",
        "gyro_g_sensitivity_std_deg_h_g",
        "accel_scale_std_ppm",
        "accel_misalignment_std_deg",
    )
)
