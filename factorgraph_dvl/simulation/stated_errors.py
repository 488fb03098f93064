"""The errors that a scenario states beside white noise, each from a random stream of its own."""

from __future__ import annotations

from dataclasses import replace
from zlib import crc32

import numpy as np

from factorgraph_dvl.geometry.units import DEG, DEG_PER_HOUR, PPM, STANDARD_GRAVITY
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.simulation import faults
from factorgraph_dvl.simulation.faults import Fault
from factorgraph_dvl.simulation.instruments import DvlTruth, GnssTruth, ImuTruth, ScenarioView
from factorgraph_dvl.trial import Trial

_PER_G = DEG_PER_HOUR / STANDARD_GRAVITY
_OFF_DIAGONAL = ~np.eye(3, dtype=bool)
_BELOW_DIAGONAL = np.tri(3, k=-1, dtype=bool)


def with_stated_errors(trial: Trial, scenario: ScenarioView, seed: int) -> Trial:
    """Return a simulated trial with the errors that its scenario states.

    Parameters
    ----------
    trial : Trial
        Trial with white noise, beams and biases of the IMU as simulated, and no other error.
    scenario : Scenario
        What it was simulated from; without `noise`, only errors that are constant are added.
    seed : int
        Random seed. The stream of an error depends on the seed and on its own name alone.
    """
    for name, fault in _stated(scenario, seed).items():
        trial = fault(trial, _stream(seed, name))
    if scenario.imu is None:
        return trial
    drawn = {name: _value(scenario, "imu", name, seed) for name in ImuTruth.matrices}
    truth = {name: value.ravel() for name, value in drawn.items() if np.any(value)}
    return replace(trial, calibration_truth=trial.calibration_truth | truth)


def _stated(scenario: ScenarioView, seed: int) -> dict[str, Fault]:
    """Return the errors of a scenario by name, in the order in which they are added."""
    out: dict[str, Fault] = {}
    if scenario.gnss is not None:
        error = _value(scenario, "gnss", "lever_arm_error_m", seed)
        if np.any(error):
            out["gnss lever arm"] = faults.wrong_antenna(error.tolist())
        if scenario.noise:
            out |= _varying_gnss(scenario.gnss)
    if scenario.dvl is not None:
        bias = _value(scenario, "dvl", "bias_m_s", seed)
        if scenario.noise:
            out |= _varying_dvl(scenario.dvl)
        if np.any(bias):
            out["dvl bias"] = faults.dvl_bias(bias.tolist())
    if scenario.imu is not None:
        out |= _imu_errors(scenario, seed)
    for section in ("gnss", "dvl", "dvl_beams", "usbl", "imu"):
        truth = getattr(scenario, section)
        if truth is None:
            continue
        if truth.clock_rate_ppm:
            out[f"{section} clock rate"] = faults.clock_rate(section, truth.clock_rate_ppm)
        offset = float(_value(scenario, section, "time_offset_s", seed))
        if offset:
            out[f"{section} time offset"] = faults.late(section, offset)
    return out


def _varying_gnss(truth: GnssTruth) -> dict[str, Fault]:
    position = np.sqrt(truth.correlated_share) * np.array(truth.position_std_m)
    velocity = np.sqrt(truth.velocity_correlated_share) * np.array(truth.velocity_std_m_s or 0.0)
    out: dict[str, Fault] = {}
    if position.any():
        out["gnss position"] = faults.correlated_gnss(
            position_std_m=position.tolist(), position_tau_s=truth.correlation_time_s
        )
    if velocity.any():
        out["gnss velocity"] = faults.correlated_gnss(
            velocity_std_m_s=velocity.tolist(), velocity_tau_s=truth.velocity_correlation_time_s
        )
    if truth.outliers is not None:
        out["gnss outliers"] = faults.gnss_outliers(truth.outliers.share, truth.outliers.sigmas)
    if truth.jumps is not None:
        j = truth.jumps
        out["gnss jumps"] = faults.gnss_jumps(j.size_m, j.duration_s, j.count)
    return out


def _varying_dvl(truth: DvlTruth) -> dict[str, Fault]:
    part = float(np.sqrt(truth.correlated_share))
    out: dict[str, Fault] = {}
    if truth.scale_drift:
        out["dvl scale drift"] = faults.dvl_scale_drift(truth.scale_drift)
    if truth.scale_walk_sqrt_h:
        out["dvl scale walk"] = faults.dvl_scale_walk(truth.scale_walk_sqrt_h)
    if part:
        out["dvl noise"] = faults.correlated_dvl(
            part * truth.velocity_std_m_s,
            truth.correlation_time_s,
            part * truth.velocity_std_fraction,
        )
    if truth.outliers is not None:
        out["dvl outliers"] = faults.dvl_outliers(truth.outliers.share, truth.outliers.sigmas)
    if truth.false_lock is not None:
        lock = truth.false_lock
        out["dvl false lock"] = faults.dvl_false_lock(lock.speed_m_s, lock.duration_s)
    return out


def _imu_errors(scenario: ScenarioView, seed: int) -> dict[str, Fault]:
    elements = {name: _value(scenario, "imu", name, seed) for name in ImuTruth.matrices}
    if not any(value.any() for value in elements.values()):
        return {}
    gyro = np.diag(elements["gyro_scale_ppm"] * PPM)
    gyro[_OFF_DIAGONAL] = elements["gyro_misalignment_deg"] * DEG
    accel = np.diag(elements["accel_scale_ppm"] * PPM)
    accel[_BELOW_DIAGONAL] = elements["accel_misalignment_deg"] * DEG
    sensitivity = elements["gyro_g_sensitivity_deg_h_g"] * _PER_G
    return {"imu": faults.imu_errors(gyro.tolist(), sensitivity.tolist(), accel.tolist())}


# Shapes of the errors that may be drawn.
_SHAPES: dict[str, tuple[int, ...]] = {
    "time_offset_s": (),
    "lever_arm_error_m": (3,),
    "bias_m_s": (3,),
    "gyro_scale_ppm": (3,),
    "gyro_misalignment_deg": (6,),
    "gyro_g_sensitivity_deg_h_g": (3, 3),
    "accel_scale_ppm": (3,),
    "accel_misalignment_deg": (3,),
}


def _value(scenario: ScenarioView, section: str, name: str, seed: int) -> Array:
    """Return the value of a constant error, drawn if the scenario says so."""
    truth = getattr(scenario, section)
    value = getattr(truth, name)
    if value != "draw":
        return np.asarray(value, dtype=float)
    drawn = _stream(seed, f"{section} {name}").standard_normal(_SHAPES[name])
    return np.asarray(drawn * getattr(truth, truth.drawn[name]))


def _stream(seed: int, name: str) -> np.random.Generator:
    return np.random.default_rng([seed, crc32(name.encode())])
