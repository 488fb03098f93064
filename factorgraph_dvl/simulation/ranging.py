"""The simulated sensors of navigation by beacons: beacons, compass, log and ranging."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, cast

import msgspec
import numpy as np
import pymap3d

from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.beacon import BeaconPosition, Beacons, BeaconSettings
from factorgraph_dvl.sensors.protocol import SensorSection
from factorgraph_dvl.sensors.speed_log import Heading, HeadingSettings, LogSettings, SpeedLog
from factorgraph_dvl.settings.sections import NonNegative, Vector3
from factorgraph_dvl.simulation.instruments import (
    Interval,
    ScenarioView,
    SimulatedInstrument,
    check_intervals,
)
from factorgraph_dvl.simulation.measurements import displaced, sample_times, within
from factorgraph_dvl.simulation.motion import TrueMotion

# Speed of sound that the instrument supposes, m/s.
_SUPPOSED = 1500.0


def simulate_beacons(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Beacons, dict[str, Array]]:
    """Return ranges and range rates to the beacons, asked in turn, and their truth.

    Distances are straight lines in Earth-centred coordinates, times 1 + e.
    """
    truth: BeaconTruth = scenario.beacons
    jitter_rng, place_rng, noise_rng, fault_rng, bias_rng = rng.spawn(5)
    time = sample_times(truth, motion.duration, jitter_rng)
    names = list(truth.positions)
    asked = np.arange(time.size) % len(names)
    drawn = place_rng.standard_normal((len(names) + 1, 3))
    stated = np.array([place.geodetic for place in truth.positions.values()])
    offset = drawn[1:] * np.array([[place.std_m] for place in truth.positions.values()])
    place = displaced(stated, offset)
    error = truth.sound_speed_error
    scale = 1.0 + (drawn[0, 0] * truth.sound_speed_error_std if error == "draw" else error)
    bias = truth.range_bias_std_m * bias_rng.standard_normal(len(names))

    state = motion.at(time)
    nRb = rotation_from_rph(state.rph, scenario.body_axes)
    arm = np.array(truth.lever_arm_m)
    transponder = displaced(state.geodetic, nRb @ arm)
    velocity = state.v_n + np.einsum("mij,mj->mi", nRb, np.cross(state.omega_eb_b, arm))
    here = np.stack(pymap3d.geodetic2ecef(*transponder.T, deg=False), axis=1)
    there = np.stack(pymap3d.geodetic2ecef(*place[asked].T, deg=False), axis=1)
    separation = here - there
    distance = np.linalg.norm(separation, axis=1)
    lat, lon = state.geodetic[:, :2].T
    direction = np.stack(pymap3d.ecef2enuv(*separation.T, lat, lon, deg=False), axis=1)
    ranges = scale * distance + bias[asked]
    stamps = time
    if truth.stamp == "reception":
        stamps = time + scale * distance / _SUPPOSED + 0.5 * truth.turn_around_s
    rates = scale * np.sum(direction * velocity, axis=1) / distance
    draws = noise_rng.standard_normal((time.size, 2))
    lost, longer, length = fault_rng.uniform(size=(3, time.size))
    if scenario.noise:
        ranges = ranges + draws[:, 0] * truth.range_std_m
        rates = rates + draws[:, 1] * (truth.range_rate_std_m_s or 0.0)
        low, high = truth.multipath_m
        ranges = ranges + (longer < truth.multipath) * (low + (high - low) * length)
        ranges[lost < truth.missed] = np.nan
    if truth.range_rate_std_m_s is None:
        rates = np.full_like(rates, np.nan)
    keep = ~within(time, truth.outages_s)
    calibration = {"sound_speed_error": np.array([scale - 1.0])}
    calibration |= {f"beacon_{n}_offset_m": offset[i] for i, n in enumerate(names)}
    calibration |= {f"beacon_{n}_range_bias_m": bias[i : i + 1] for i, n in enumerate(names)}
    record = Beacons(
        settings=cast("BeaconSettings", scenario.settings("beacons")),
        time=stamps[keep],
        name=np.array(names)[asked[keep]],
        range=ranges[keep],
        range_rate=rates[keep],
    )
    return record, calibration


def simulate_heading(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Heading, dict[str, Array]]:
    """Return the compass's record and its bias."""
    truth: HeadingTruth = scenario.heading
    jitter_rng, noise_rng = rng.spawn(2)
    time = sample_times(truth, motion.duration, jitter_rng, first=0)
    drawn, *white = noise_rng.standard_normal(1 + time.size)
    bias = drawn * truth.bias_std_deg if truth.bias_deg == "draw" else truth.bias_deg
    heading = motion.at(time).rph[:, 2] + bias * DEG
    if scenario.noise:
        heading = heading + np.array(white) * truth.std_deg * DEG
    settings = cast("HeadingSettings", scenario.settings("heading"))
    record = Heading(settings, time, heading % (2.0 * np.pi))
    return record, {"heading_bias_deg": np.array([bias])}


def simulate_log(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[SpeedLog, dict[str, Array]]:
    """Return the log's record, its scale error, and the current that it does not measure."""
    truth: LogTruth = scenario.log
    jitter_rng, noise_rng = rng.spawn(2)
    time = sample_times(truth, motion.duration, jitter_rng, first=0)
    drawn = noise_rng.standard_normal()
    white = noise_rng.standard_normal((2, time.size))
    scale = drawn * truth.scale_error_std if truth.scale_error == "draw" else truth.scale_error
    state = motion.at(time)
    over_ground = truth.reference == "bottom"
    current = np.zeros(3) if over_ground else np.array(scenario.current_m_s)
    east, north, _ = (state.v_n - current).T
    sine, cosine = np.sin(state.rph[:, 2]), np.cos(state.rph[:, 2])
    speed = (1.0 + scale) * np.stack([east * sine + north * cosine, east * cosine - north * sine])
    if scenario.noise:
        speed = speed + white * truth.speed_std_m_s
    starboard = speed[1] if over_ground else np.full(time.size, np.nan)
    settings = cast("LogSettings", scenario.settings("log"))
    calibration = {"log_scale_error": np.array([scale])}
    if not over_ground:
        calibration["current_m_s"] = np.array(scenario.current_m_s[:2])
    return SpeedLog(settings, time, speed[0], starboard), calibration


class HeadingTruth(SimulatedInstrument, frozen=True, kw_only=True):
    """The simulated compass; `draw` takes its bias from N(0, std²), anew for each seed."""

    section_type: ClassVar[type[SensorSection]] = HeadingSettings

    std_deg: NonNegative = 0.0
    bias_deg: float | Literal["draw"] = 0.0
    bias_std_deg: NonNegative = 0.0

    def claimed(self) -> dict[str, Any]:
        """Return noise and bias as simulated."""
        out: dict[str, Any] = {"bias_std_deg": self.bias_std_deg}
        return out | ({"std_deg": self.std_deg} if self.std_deg > 0.0 else {})


class LogTruth(SimulatedInstrument, frozen=True, kw_only=True):
    """The simulated log; `draw` takes its scale error from N(0, std²), anew for each seed."""

    section_type: ClassVar[type[SensorSection]] = LogSettings

    speed_std_m_s: NonNegative = 0.0
    scale_error: float | Literal["draw"] = 0.0
    scale_error_std: NonNegative = 0.0
    reference: Literal["water", "bottom"] = "water"

    def claimed(self) -> dict[str, Any]:
        """Return noise, scale error and reference as simulated."""
        out = {"scale_error_std": self.scale_error_std, "reference": self.reference}
        return out | ({"speed_std_m_s": self.speed_std_m_s} if self.speed_std_m_s > 0.0 else {})


class BeaconTruth(SimulatedInstrument, frozen=True, kw_only=True):
    """The simulated ranging; beacons are asked in turn.

    `positions` are the true places but for `std_m`: each seed draws a place around the
    stated one. A range is lost with probability `missed`, and longer by a uniform draw from
    `multipath_m` with probability `multipath`. `sound_speed_error: draw` takes it from
    N(0, std²). Each beacon's ranges are too long by a draw from N(0, range_bias_std_m²).
    """

    section_type: ClassVar[type[SensorSection]] = BeaconSettings

    positions: dict[str, BeaconPosition]
    range_std_m: NonNegative = 0.0
    range_rate_std_m_s: NonNegative | None = None
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    sound_speed_error: float | Literal["draw"] = 0.0
    sound_speed_error_std: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.0
    missed: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    multipath: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    multipath_m: tuple[float, float] = (10.0, 50.0)
    range_bias_std_m: NonNegative = 0.0
    stamp: Literal["middle", "reception"] = "middle"
    turn_around_s: NonNegative = 0.0
    outages_s: tuple[Interval, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_intervals("outages_s", self.outages_s)
        check_intervals("multipath_m", (self.multipath_m,))

    def claimed(self) -> dict[str, Any]:
        """Return noise, places and lever arm as simulated."""
        out: dict[str, Any] = {
            "positions": msgspec.to_builtins(self.positions),
            "lever_arm_m": self.lever_arm_m,
            "sound_speed_error_std": self.sound_speed_error_std,
            "range_bias_std_m": self.range_bias_std_m,
            "stamp": self.stamp,
            "turn_around_s": self.turn_around_s,
        }
        if self.range_std_m > 0.0:
            out["range_std_m"] = self.range_std_m
        if self.range_rate_std_m_s:
            out["range_rate_std_m_s"] = self.range_rate_std_m_s
        return out
