"""Scenarios for tests of the simulator."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np

from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.simulation import parse_scenario, plan_motion, simulate

CONFIGS = Path(__file__).resolve().parents[1] / "configs"

SWELL = {
    "roll": [{"amplitude_deg": 3, "frequency_hz": 0.12}],
    "pitch": [{"amplitude_deg": 1.5, "frequency_hz": 0.15, "phase_deg": 40}],
    "yaw": [{"amplitude_deg": 0.8, "frequency_hz": 0.1, "phase_deg": 120}],
    "heave": [{"amplitude_m": 0.3, "frequency_hz": 0.12, "phase_deg": 30}],
}

MANOEUVRES = [
    {"straight_s": 5},
    {"accelerate_m_s2": 0.5, "to_m_s": 4},
    {"turn_deg_s": -6, "duration_s": 15, "ramp_s": 3},
    {"accelerate_m_s2": -1, "to_m_s": 2},
    {"turn_deg_s": 9, "duration_s": 10},
    {"straight_s": 5},
]


def scenario_dict(**changes):
    data = {
        "name": "test",
        "noise": False,
        "start": {"lat_deg": 36, "lon_deg": 121, "height_m": 10, "heading_deg": 30},
        "manoeuvres": MANOEUVRES,
        "imu": {"rate_hz": 100},
        "gnss": {"rate_hz": 5, "position_std_m": [1, 1, 2], "velocity_std_m_s": [0.1, 0.1, 0.1]},
        "dvl": {"rate_hz": 5, "velocity_std_fraction": 0.002},
        "trial": {
            "imu": {"gyro_bias_std_deg_h": 1, "accel_bias_std_ug": 100},
            "gnss": {"lever_arm_std_m": [0, 0, 0], "time_offset_std_s": 0},
            "dvl": {"bias_std_m_s": [0, 0, 0], "time_offset_std_s": 0},
        },
    }
    for key, value in changes.items():
        if key in ("start", "imu", "gnss", "dvl", "trial") and value is not None:
            data[key] = data[key] | value
        else:
            data[key] = value
    out = copy.deepcopy({k: v for k, v in data.items() if v is not None})
    for sensor in ("gnss", "dvl"):
        if sensor not in out:
            out.get("trial", {}).pop(sensor, None)
    return out


def run(seed=0, **changes):
    return simulate(parse_scenario(scenario_dict(**changes)), seed)


def motion_of(**changes):
    return plan_motion(parse_scenario(scenario_dict(**changes)))


def constant(degrees):
    """Return a sway that is constant for all practical purposes."""
    return [{"amplitude_deg": degrees, "frequency_hz": 1e-12, "phase_deg": 90}]


def tangent_states(motion, frame, t):
    """Return attitude, position, velocity in the tangent frame, (M, 15)."""
    state = motion.at(t)
    level = frame.level_from_tangent(state.geodetic[:, 0], state.geodetic[:, 1])
    nRb = np.swapaxes(level, 1, 2) @ rotation_from_rph(state.rph, motion.body_axes)
    v_n = np.einsum("mji,mj->mi", level, state.v_n)
    p_n = frame.position(*state.geodetic.T)
    return np.hstack([nRb.reshape(-1, 9), p_n, v_n])
