"""Simulated instruments of ships without a raw IMU: gyrocompass or AHRS, and INS."""

from __future__ import annotations

from typing import Any, ClassVar, cast

import numpy as np

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.attitude import Attitude, AttitudeSettings
from factorgraph_dvl.sensors.ins import Ins, InsSettings
from factorgraph_dvl.sensors.protocol import SensorSection
from factorgraph_dvl.settings.sections import NonNegative, Positive, Sigma3
from factorgraph_dvl.simulation.instruments import ScenarioView, SimulatedInstrument
from factorgraph_dvl.simulation.measurements import displaced, sample_times
from factorgraph_dvl.simulation.motion import TrueMotion

# Period of an undamped gyrocompass and of an INS, s: 84.4 minutes.
_SCHULER_S = 5064.0


class AttitudeTruth(SimulatedInstrument, frozen=True, kw_only=True):
    """The simulated AHRS or gyrocompass.

    Its heading is off by an offset, an oscillation of 84.4 minutes with a root mean square and a
    random phase, and roll, pitch and heading by first-order processes and white noise.
    """

    section_type: ClassVar[type[SensorSection]] = AttitudeSettings

    std_deg: Sigma3 = (0.0, 0.0, 0.0)
    white_std_deg: Sigma3 = (0.0, 0.0, 0.0)
    correlation_time_s: Positive = 300.0
    heading_offset_deg: float = 0.0
    schuler_rms_deg: NonNegative = 0.0
    tilt: bool = True
    time_offset_s: float = 0.0

    def claimed(self) -> dict[str, Any]:
        """Return standard deviations and times as simulated, but not the offsets."""
        total = np.hypot(self.std_deg, self.white_std_deg)
        share = float(np.sum(np.square(self.std_deg)) / max(np.sum(total**2), 1e-30))
        return {
            "std_deg": tuple(total.tolist()),
            "correlated_share": min(share, 1.0),
            "correlation_time_s": self.correlation_time_s,
            "schuler_std_deg": self.schuler_rms_deg,
        }


class InsTruth(SimulatedInstrument, frozen=True, kw_only=True):
    """The simulated INS: its velocity oscillates in 84.4 minutes, its position with it.

    Velocity east and north have a root mean square and random phases each; attitude has
    first-order processes; all have white noise besides.
    """

    section_type: ClassVar[type[SensorSection]] = InsSettings

    schuler_velocity_rms_m_s: NonNegative = 0.0
    attitude_std_deg: Sigma3 = (0.0, 0.0, 0.0)
    correlation_time_s: Positive = 800.0
    white_velocity_std_m_s: NonNegative = 0.0
    white_position_std_m: NonNegative = 0.0
    time_offset_s: float = 0.0

    def claimed(self) -> dict[str, Any]:
        """Return standard deviations and times as simulated."""
        return {
            "velocity_std_m_s": (self.white_velocity_std_m_s,) * 3,
            "position_std_m": (self.white_position_std_m,) * 3,
            "schuler_std_m_s": self.schuler_velocity_rms_m_s,
            "attitude_std_deg": self.attitude_std_deg,
            "correlation_time_s": self.correlation_time_s,
        }


def simulate_attitude(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Attitude, dict[str, Array]]:
    """Return the record of the compass, and its offsets by reported name."""
    truth: AttitudeTruth = scenario.attitude
    jitter_rng, slow_rng, white_rng, phase_rng = rng.spawn(4)
    time = sample_times(truth, motion.duration, jitter_rng)
    rph = motion.at(time).rph.copy()
    rph[:, 2] += truth.heading_offset_deg * DEG
    if scenario.noise:
        rph += first_order(time, truth.correlation_time_s, slow_rng) * truth.std_deg * DEG
        rph += white_rng.standard_normal(rph.shape) * truth.white_std_deg * DEG
        phase = 2.0 * np.pi * (time / _SCHULER_S + phase_rng.random())
        rph[:, 2] += np.sqrt(2.0) * truth.schuler_rms_deg * DEG * np.sin(phase)
    rph[:, 2] %= 2.0 * np.pi
    if not truth.tilt:
        rph[:, :2] = np.nan
    record = Attitude(
        settings=cast("AttitudeSettings", scenario.settings("attitude")),
        time=time + truth.time_offset_s,
        rph=rph,
    )
    return record, {
        "heading_offset_deg": np.array([truth.heading_offset_deg]),
        "attitude_time_offset_s": np.array([truth.time_offset_s]),
    }


def simulate_ins(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Ins, dict[str, Array]]:
    """Return the record of the INS, and its time offset."""
    truth: InsTruth = scenario.ins
    jitter_rng, slow_rng, white_rng, phase_rng = rng.spawn(4)
    time = sample_times(truth, motion.duration, jitter_rng)
    state = motion.at(time)
    rph, velocity = state.rph.copy(), state.v_n.copy()
    error_p = np.zeros_like(velocity)
    if scenario.noise:
        rph += first_order(time, truth.correlation_time_s, slow_rng) * truth.attitude_std_deg * DEG
        angle = 2.0 * np.pi * (time[:, None] / _SCHULER_S + phase_rng.random(2))
        size = np.sqrt(2.0) * truth.schuler_velocity_rms_m_s
        velocity[:, :2] += size * np.cos(angle)
        error_p[:, :2] += size * _SCHULER_S / (2.0 * np.pi) * np.sin(angle)
        velocity += truth.white_velocity_std_m_s * white_rng.standard_normal(velocity.shape)
        error_p += truth.white_position_std_m * white_rng.standard_normal(velocity.shape)
    rph[:, 2] %= 2.0 * np.pi
    record = Ins(
        settings=cast("InsSettings", scenario.settings("ins")),
        time=time + truth.time_offset_s,
        geodetic=displaced(state.geodetic, error_p),
        velocity=velocity,
        rph=rph,
        std=np.full((time.size, 9), np.nan),
    )
    return record, {"ins_time_offset_s": np.array([truth.time_offset_s])}


def first_order(time: Array, tau: float, rng: np.random.Generator) -> Array:
    """Return three first-order processes of unit variance at times (M,), (M, 3)."""
    draws = rng.standard_normal((time.size, 3))
    keep = np.exp(-np.diff(time) / tau)
    out = np.empty_like(draws)
    out[0] = draws[0]
    for k in range(1, time.size):
        out[k] = keep[k - 1] * out[k - 1] + np.sqrt(1.0 - keep[k - 1] ** 2) * draws[k]
    return out
