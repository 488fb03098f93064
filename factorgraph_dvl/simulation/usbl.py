"""The simulated USBL: a ship above the vehicle, sound that goes there and back, and its record."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, cast

import msgspec
import numpy as np
import pymap3d
from scipy.spatial.transform import Rotation

from factorgraph_dvl.geometry.rotations import frd_from_body, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.protocol import SensorSection
from factorgraph_dvl.sensors.ship import Ship, ShipSettings
from factorgraph_dvl.sensors.usbl import Usbl, UsblSettings
from factorgraph_dvl.settings.sections import NonNegative, Positive, Section, Sigma3, Vector3
from factorgraph_dvl.simulation.course import StartSettings, SwaySettings
from factorgraph_dvl.simulation.instruments import (
    ClockedInstrument,
    Draw,
    Interval,
    Outliers,
    ScenarioView,
    check_intervals,
)
from factorgraph_dvl.simulation.measurements import apply, displaced, sample_times, within
from factorgraph_dvl.simulation.motion import TrueMotion, plan_motion

# Speed of sound that the instrument supposes, m/s.
_SUPPOSED = 1500.0
# Rounds in which the ways of the sound are found: each leaves a thousandth, the ratio of speeds.
_ROUNDS = 4


class ShipTruth(Section, frozen=True, kw_only=True):
    """The ship of the transceiver; after its manoeuvres it keeps speed and heading."""

    start: StartSettings
    manoeuvres: list[dict[str, Any]] = msgspec.field(default_factory=list)
    sway: SwaySettings = SwaySettings()
    rate_hz: Positive = 10.0
    position_std_m: NonNegative = 0.0
    attitude_std_deg: NonNegative = 0.0
    transceiver_lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    misalignment_deg: Vector3 | Draw = (0.0, 0.0, 0.0)
    misalignment_std_deg: Sigma3 = (2.0, 2.0, 2.0)
    sound_speed_error: float | Draw = 0.0
    sound_speed_error_std: NonNegative = 0.005


class UsblTruth(ClockedInstrument, frozen=True, kw_only=True):
    """The simulated USBL; `draw` takes an error of the ship's from N(0, std²) for each seed.

    It measures positions, with a variance of floor² + (fraction · slant range)², or polar or
    Cartesian components of the transceiver, whose directions err by `angle_std_deg`.
    """

    section_type: ClassVar[type[SensorSection]] = UsblSettings

    ship: ShipTruth
    measures: Literal["position", "polar", "cartesian"] = "polar"
    position_std_m: Sigma3 = (0.0, 0.0, 0.0)
    std_fraction: NonNegative = 0.0
    range_std_m: NonNegative = 0.0
    angle_std_deg: NonNegative = 0.0
    transponder_lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    age_s: NonNegative = 0.0
    outliers: Outliers | None = None
    outages_s: tuple[Interval, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_intervals("outages_s", self.outages_s)

    def claimed(self) -> dict[str, Any]:
        """Return noise, lever arms and priors as simulated, but not the mounting."""
        names = ("position_std_m", "range_std_m", "angle_std_deg", "std_fraction")
        out = {name: getattr(self, name) for name in names if np.any(getattr(self, name))}
        keys = ("transceiver_lever_arm_m", "misalignment_std_deg", "sound_speed_error_std")
        ship = {name: getattr(self.ship, name) for name in keys}
        return {**out, "transponder_lever_arm_m": self.transponder_lever_arm_m, "ship": ship}


def simulate_usbl(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Usbl, dict[str, Array]]:
    """Return the record of the USBL with that of its ship, and its calibration.

    The ship asks, the transponder replies at once, and the ship receives: each where it is then.
    """
    truth: UsblTruth = scenario.usbl
    jitter_rng, error_rng, noise_rng, gross_rng, ship_rng = rng.spawn(5)
    above = _ship_motion(scenario, motion.duration)
    turn, error = _errors(truth.ship, error_rng)
    time = sample_times(truth, motion.duration, jitter_rng)
    time = time[~within(time, truth.outages_s) & (time > 1.0)]
    place, distance = _heard(scenario, motion, above, time, _SUPPOSED / (1.0 + error))
    state = above.at(time)
    transceiver = _carried(state, truth.ship.transceiver_lever_arm_m, scenario)
    to = pymap3d.geodetic2enu(*place.T, *transceiver.T, deg=False)
    nRs = rotation_from_rph(state.rph, scenario.body_axes)
    in_ship = apply(np.swapaxes(nRs, 1, 2), np.stack(to, axis=1))
    seen = turn.apply(in_ship) @ frd_from_body(scenario.body_axes).T
    seen /= np.linalg.norm(seen, axis=1)[:, None]
    slant = (1.0 + error) * distance
    white = noise_rng.standard_normal((time.size, 3)) * float(scenario.noise)
    gross = _gross(truth.outliers, time.size, gross_rng) if scenario.noise else np.ones((1, 1))
    nothing = np.full((time.size, 3), np.nan)
    geodetic, polar, cartesian = nothing, nothing, nothing
    if truth.measures == "position":
        std = np.hypot(truth.position_std_m, truth.std_fraction * distance[:, None])
        geodetic = displaced(place, gross * white * std)
    elif truth.measures == "polar":
        polar = np.stack(_angles(seen, slant), axis=1)
        angle = truth.angle_std_deg * DEG
        polar += gross * white * [truth.range_std_m, angle, angle]
        polar[:, 1] %= 2.0 * np.pi
    else:
        off = np.cross(seen, gross * white * truth.angle_std_deg * DEG)
        along = gross[:, 0] * white[:, 0] * truth.range_std_m
        cartesian = slant[:, None] * (seen + off) + along[:, None] * seen
    record = Usbl(
        settings=cast("UsblSettings", scenario.settings("usbl")),
        time=time + truth.age_s,
        geodetic=geodetic,
        position_std=nothing.copy(),
        polar=polar,
        cartesian=cartesian,
        age=np.full(time.size, truth.age_s),
        ship=_record(scenario, above, motion.duration, ship_rng),
    )
    return record, {
        "usbl_misalignment_deg": turn.as_rotvec() / DEG,
        "usbl_sound_speed_error": np.array([error]),
        "usbl_transceiver_lever_arm_m": np.array(truth.ship.transceiver_lever_arm_m),
        "usbl_transponder_lever_arm_m": np.array(truth.transponder_lever_arm_m),
        "usbl_time_offset_s": np.zeros(1),
    }


def _ship_motion(scenario: ScenarioView, duration: float) -> TrueMotion:
    """Return the motion of the ship, planned as that of a vehicle of its own."""
    ship: ShipTruth = scenario.usbl.ship
    plan = [*ship.manoeuvres, {"straight_s": duration + 1.0}]
    changes = {"start": ship.start, "manoeuvres": plan, "sway": ship.sway}
    alone = {"current_m_s": (0.0, 0.0, 0.0), "turntable": None}
    return plan_motion(msgspec.structs.replace(cast(Any, scenario), **changes, **alone))


def _errors(ship: ShipTruth, rng: np.random.Generator) -> tuple[Rotation, float]:
    """Return the misalignment, body to transceiver, and the error of the sound speed."""
    drawn = rng.standard_normal(4)
    stated, error = ship.misalignment_deg, ship.sound_speed_error
    turn = drawn[:3] * ship.misalignment_std_deg if stated == "draw" else np.array(stated)
    return (
        Rotation.from_rotvec(turn * DEG),
        float(drawn[3] * ship.sound_speed_error_std if error == "draw" else error),
    )


def _heard(
    scenario: ScenarioView, motion: TrueMotion, above: TrueMotion, time: Array, sound: float
) -> tuple[Array, Array]:
    """Return where the transponder replied, (M, 3), and half of the sound's way, (M,), m."""
    truth: UsblTruth = scenario.usbl
    arm = truth.ship.transceiver_lever_arm_m
    here = _ecef(_carried(above.at(time), arm, scenario))
    back = there = np.zeros(time.size)
    for _ in range(_ROUNDS):
        replied = time - back / sound
        place = _carried(motion.at(replied), truth.transponder_lever_arm_m, scenario)
        asked = _ecef(_carried(above.at(replied - there / sound), arm, scenario))
        back = np.linalg.norm(_ecef(place) - here, axis=1)
        there = np.linalg.norm(_ecef(place) - asked, axis=1)
    return place, 0.5 * (there + back)


def _carried(state: Any, arm: Vector3, scenario: ScenarioView) -> Array:
    """Return where a lever arm's end is, geodetic, (M, 3)."""
    nRb = rotation_from_rph(state.rph, scenario.body_axes)
    return displaced(state.geodetic, apply(nRb, np.array(arm)))


def _ecef(geodetic: Array) -> Array:
    return np.stack(pymap3d.geodetic2ecef(*geodetic.T, deg=False), axis=1)


def _angles(seen: Array, slant: Array) -> tuple[Array, Array, Array]:
    """Return range, bearing and depression of unit vectors forward, starboard, down."""
    bearing = np.arctan2(seen[:, 1], seen[:, 0])
    return slant, bearing, np.arcsin(np.clip(seen[:, 2], -1.0, 1.0))


def _gross(outliers: Outliers | None, count: int, rng: np.random.Generator) -> Array:
    """Return by how much noise is longer than usual, (M, 1)."""
    if outliers is None:
        return np.ones((count, 1))
    wrong = rng.random(count) < outliers.share
    return np.where(wrong, rng.uniform(*outliers.sigmas, count), 1.0)[:, None]


def _record(
    scenario: ScenarioView, above: TrueMotion, duration: float, rng: np.random.Generator
) -> Ship:
    """Return the record of the ship's reference point, a little longer than the dive."""
    truth: ShipTruth = scenario.usbl.ship
    time = np.arange(int((duration + 1.0) * truth.rate_hz) + 1) / truth.rate_hz
    state = above.at(time)
    noise = rng.standard_normal((2, time.size, 3)) * float(scenario.noise)
    rph = state.rph + noise[1] * truth.attitude_std_deg * DEG
    rph[:, 2] %= 2.0 * np.pi
    settings = cast("UsblSettings", scenario.settings("usbl")).ship
    return Ship(
        cast("ShipSettings", settings),
        time,
        displaced(state.geodetic, noise[0] * truth.position_std_m),
        rph,
    )
