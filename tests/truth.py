"""Scenarios, and the exact motion of one in the tangent frame of the estimator."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.units import DEG_PER_HOUR, MICRO_G
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.simulation import parse_scenario, plan_motion
from factorgraph_dvl.simulation.compass import InsTruth
from factorgraph_dvl.simulation.motion import TrueMotion as ExactMotion
from factorgraph_dvl.simulation.scenario import Scenario

CONFIGS = Path(__file__).parent.parent / "configs"

# Roll and pitch in quadrature at 2 Hz: the coning motion of the calibration scenario.
CONING = {
    "roll": [{"amplitude_deg": 4, "frequency_hz": 2}],
    "pitch": [{"amplitude_deg": 4, "frequency_hz": 2, "phase_deg": 90}],
}
SWELL = {
    "roll": [{"amplitude_deg": 5, "frequency_hz": 0.21}],
    "pitch": [{"amplitude_deg": 3, "frequency_hz": 0.27, "phase_deg": 40}],
    "yaw": [{"amplitude_deg": 2, "frequency_hz": 0.13, "phase_deg": 120}],
    "heave": [{"amplitude_m": 0.3, "frequency_hz": 0.2, "phase_deg": 30}],
}
TURNING = [
    {"straight_s": 10},
    {"turn_deg_s": -6, "duration_s": 20, "ramp_s": 4},
    {"accelerate_m_s2": -0.2, "to_m_s": 2},
    {"turn_deg_s": 8, "duration_s": 20, "ramp_s": 4},
    {"straight_s": 10},
]
# Half the variance of GNSS and DVL persists, and the trial states both halves.
CORRELATED: dict[str, Any] = {
    "gnss": {"correlated_share": 0.5, "velocity_correlated_share": 0.5},
    "dvl": {
        "velocity_std_m_s": 0.008,
        "velocity_std_fraction": 0,
        "correlated_share": 0.5,
        "correlation_time_s": 5,
    },
    "trial": {
        "gnss": {
            "position_std_m": [0.354, 0.354, 0.707],
            "correlated_std_m": [0.354, 0.354, 0.707],
            "correlation_time_s": 100,
            "velocity_std_m_s": [0.0707, 0.0707, 0.0707],
            "correlated_velocity_std_m_s": [0.0707, 0.0707, 0.0707],
            "velocity_correlation_time_s": 2,
        },
        "dvl": {
            "velocity_std_m_s": 0.00566,
            "velocity_std_fraction": 0,
            "correlated_std_m_s": 0.00566,
            "correlation_time_s": 5,
        },
    },
}
_BASE: dict[str, Any] = {
    "name": "test",
    "noise": False,
    "start": {"lat_deg": 36, "lon_deg": 121, "height_m": 10, "heading_deg": 30, "speed_m_s": 4},
    "manoeuvres": TURNING,
    "sway": SWELL,
    "imu": {
        "rate_hz": 100,
        "gyro_noise_deg_sqrt_h": 0.0005,
        "accel_noise_ug_sqrt_hz": 25,
    },
    "gnss": {"rate_hz": 5, "position_std_m": [0.5, 0.5, 1], "velocity_std_m_s": [0.1, 0.1, 0.1]},
    "dvl": {
        "rate_hz": 5,
        "misalignment_deg": [2, 2, 30],
        "scale_error": 0.005,
        "lever_arm_m": [1, 1.2, 1.4],
        "velocity_std_fraction": 0.002,
    },
    "trial": {
        "imu": {"gyro_bias_std_deg_h": 0.05, "accel_bias_std_ug": 100},
        # One clock, an antenna in its place, no bias, unless a test says otherwise.
        "gnss": {"lever_arm_std_m": [0, 0, 0], "time_offset_std_s": 0},
        "dvl": {"velocity_std_m_s": 0.001, "bias_std_m_s": [0, 0, 0], "time_offset_std_s": 0},
    },
}


# Of a ship: the velocity errs with the period of Schuler, the rest is small.
SCHULER = InsTruth(
    rate_hz=1,
    schuler_velocity_rms_m_s=0.05,
    attitude_std_deg=(0.02, 0.02, 0.05),
    white_velocity_std_m_s=0.005,
    white_position_std_m=0.02,
)


# Manoeuvres that determine a calibration within a minute and a half.
TURNS_AND_BRAKING = [
    {"straight_s": 10},
    {"turn_deg_s": -6, "duration_s": 20, "ramp_s": 4},
    {"accelerate_m_s2": -0.2, "to_m_s": 2},
    {"turn_deg_s": 8, "duration_s": 20, "ramp_s": 4},
    {"straight_s": 20},
]
# They with the noise of good sensors, and with a clock of the DVL that is known.
KNOWN_CLOCK = {
    "noise": True,
    "manoeuvres": TURNS_AND_BRAKING,
    "gnss": {"position_std_m": [0.1, 0.1, 0.2], "velocity_std_m_s": [0.03] * 3},
    "dvl": {"velocity_std_fraction": 0.001},
    "trial": {"dvl": {"velocity_std_fraction": 0.001, "time_offset_std_s": 0.0}},
}
# The manoeuvres between straight legs on which errors that persist show.
LONGER_TURNS_AND_BRAKING = [
    {"straight_s": 40},
    *TURNS_AND_BRAKING[1:-1],
    {"straight_s": 60},
]


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return nested `base` with `changes`; a value of None removes a key."""
    out = copy.deepcopy(base)
    for key, value in changes.items():
        if value is None:
            out.pop(key, None)
        elif isinstance(value, dict) and isinstance(out.get(key), dict) and key != "sway":
            out[key] = merged(out[key], value)
        else:
            out[key] = copy.deepcopy(value)
    return out


def scenario(**changes: Any) -> Scenario:
    """Return a vessel that sways and turns for 70 s, noise-free, with changes."""
    return _parsed(merged(_BASE, changes))


def _parsed(data: dict[str, Any]) -> Scenario:
    """Return a scenario without claims on sensors that a test has taken away."""
    for sensor in ("gnss", "dvl"):
        if sensor not in data:
            data.get("trial", {}).pop(sensor, None)
    return parse_scenario(data)


def config(name: str, **changes: Any) -> Scenario:
    """Return a scenario of configs/, with changes."""
    data = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8"))
    return _parsed(merged(data, changes))


def with_ins(made: Scenario, ins: InsTruth) -> Scenario:
    """Return a scenario with an INS in place of compass and GNSS."""
    claims = msgspec.structs.replace(made.trial, gnss={}, attitude={})
    return msgspec.structs.replace(made, gnss=None, attitude=None, ins=ins, trial=claims)


def exact_motion(exact: ExactMotion, frame: LocalFrame, time: Array) -> Motion:
    """Return the simulated motion at times away from its kinks, in the tangent frame."""
    step = 1e-5
    nRb, p_n, v_n, omega = _tangent(exact, frame, time)
    before, after = (_tangent(exact, frame, time + h) for h in (-step, step))
    return Motion(
        nRb=nRb,
        p_n=p_n,
        v_n=v_n,
        omega_eb_b=omega,
        a_n=(after[2] - before[2]) / (2.0 * step),
        alpha_b=(after[3] - before[3]) / (2.0 * step),
        omega_sigma=np.zeros_like(omega),
    )


def exact_states(scene: Scenario, frame: LocalFrame, time: Array) -> States:
    """Return the simulated states and biases at times."""
    nRb, p_n, v_n, _ = _tangent(plan_motion(scene), frame, time)
    shape = np.zeros((time.size, 3))
    return States(
        nRb,
        p_n,
        v_n,
        shape + np.array(scene.imu.gyro_bias_deg_h) * DEG_PER_HOUR,
        shape + np.array(scene.imu.accel_bias_ug) * MICRO_G,
    )


def _tangent(
    exact: ExactMotion, frame: LocalFrame, time: Array
) -> tuple[Array, Array, Array, Array]:
    state = exact.at(np.asarray(time, dtype=float))
    nRl = frame.level_from_tangent(state.geodetic[:, 0], state.geodetic[:, 1]).transpose(0, 2, 1)
    return (
        nRl @ rotation_from_rph(state.rph, exact.body_axes),
        frame.position(*state.geodetic.T),
        rotate(nRl, state.v_n),
        state.omega_eb_b,
    )
