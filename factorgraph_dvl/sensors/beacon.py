"""Acoustic beacons: settings, record, and the range and range rate to each of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.units import GEODETIC_SI
from factorgraph_dvl.geometry.vectors import Array, cross, rotate, skew
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.clock import Clock, ClockSection
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    Linearization,
    Motion,
    Observation,
    PlainObservation,
    SensorSection,
    Values,
    lever_arm_sigma,
)
from factorgraph_dvl.sensors.records import at_row, check_range, check_times
from factorgraph_dvl.settings.sections import NonNegative, Positive, Section, Vector3

RANGE = "range_m"
RANGE_RATE = "range_rate_m_s"
NAME = "beacon"

_SCALE = ParameterSpec("sound_speed_error", labels=SCALAR)
SOUND_SPEED_ERROR = _SCALE.name
_CLOCK = Clock.of("beacon", prefix="beacon_", section="beacons")

# Standard deviations from which on a measurement is an echo. Chosen: by chance one in 2000 is.
GATE = 3.5

_NAMES = re.compile(r"[A-Za-z0-9_-]+")
# Stands for the name of any beacon in the names of parameters.
ANY_BEACON = "NAME"
# Speed of sound by which a range becomes a travel time, m/s. Chosen: 1 % of it is 1 ms at 150 m.
_SOUND_SPEED = 1500.0


def _offset_spec(beacon: str) -> ParameterSpec:
    """Return what the error of a beacon's stated place is."""
    return ParameterSpec(f"beacon_{beacon}_offset", "m", labels=("e", "n", "u"), frame="n")


def offset_name(beacon: str) -> str:
    """Return the name of the parameter that says how far a beacon is off its stated place."""
    return _offset_spec(beacon).name


def _bias_spec(beacon: str) -> ParameterSpec:
    """Return by how much the ranges to a beacon are too long, as by its delay."""
    return ParameterSpec(f"beacon_{beacon}_range_bias", "m", labels=SCALAR)


def bias_name(beacon: str) -> str:
    """Return the name of the parameter that says how much the ranges to a beacon are too long."""
    return _bias_spec(beacon).name


class BeaconPosition(Section, frozen=True, kw_only=True):
    """One of `beacons.positions` of trial.yaml."""

    lat_deg: float
    lon_deg: float
    height_m: float
    std_m: NonNegative = 0.0

    @property
    def geodetic(self) -> Array:
        """Latitude, longitude (rad), ellipsoidal height (m), (3,)."""
        return np.array([self.lat_deg, self.lon_deg, self.height_m]) * GEODETIC_SI


class BeaconSettings(ClockSection, frozen=True, kw_only=True):
    """Section `beacons` of trial.yaml."""

    file: str = "beacon.csv"
    range_std_m: Positive = 0.5
    range_rate_std_m_s: Positive = 0.05
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    sound_speed_error_std: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.0
    range_bias_std_m: NonNegative = 0.0
    stamp: Literal["middle", "reception"] = "middle"
    turn_around_s: NonNegative = 0.0
    positions: dict[str, BeaconPosition]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.positions:
            raise ValueError("`positions` must contain at least one beacon")
        for name in self.positions:
            if not _NAMES.fullmatch(name):
                raise ValueError(f"`positions`: a name has letters, digits, _ and -, not {name!r}")


@dataclass(frozen=True)
class Beacons:
    """Settings and record of the ranging to beacons of known place.

    Parameters
    ----------
    settings : BeaconSettings
        Section `beacons` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    name : ndarray of np.str_, shape (M,)
        Beacon of each row.
    range : ndarray, shape (M,)
        Slant range, m; nan where not measured.
    range_rate : ndarray, shape (M,), m/s
        Positive when the range grows; nan where not measured.
    source : str, optional
        Name of the file, for messages.
    """

    settings: BeaconSettings
    time: Array
    name: NDArray[np.str_]
    range: Array
    range_rate: Array
    source: str = "beacons"
    label: str = "Beacon"

    section: ClassVar[str] = "beacons"
    section_type: ClassVar[type[SensorSection]] = BeaconSettings
    required: ClassVar[tuple[str, ...]] = ("time_s", NAME)
    optional: ClassVar[tuple[tuple[str, ...], ...]] = ((RANGE,), (RANGE_RATE,))
    specs: ClassVar[tuple[ParameterSpec, ...]] = (
        *(_SCALE, _offset_spec(ANY_BEACON), _bias_spec(ANY_BEACON)),
        *_CLOCK.specs,
    )

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        known = list(self.settings.positions)
        bad = np.flatnonzero(~np.isin(self.name, known))
        if bad.size:
            raise DataError(
                f"the beacon is '{self.name[bad[0]]}'",
                where=at_row(self.source, bad[0]),
                expected=f"one of beacons.positions: {', '.join(known)}",
            )
        check_range({RANGE: self.range}, 0.0, 1e6, "m", self.source)
        check_range({RANGE_RATE: self.range_rate}, -100.0, 100.0, "m/s", self.source)

    @classmethod
    def from_columns(
        cls, settings: BeaconSettings, columns: Mapping[str, Any], source: str
    ) -> Self:
        """Return the record in a table."""
        return cls(
            settings,
            columns["time_s"],
            columns[NAME],
            columns[RANGE],
            columns[RANGE_RATE],
            source,
        )

    def columns(self) -> dict[str, Any]:
        """Return the record as a table."""
        table: dict[str, Any] = {"time_s": self.time, NAME: self.name, RANGE: self.range}
        if not np.isnan(self.range_rate).all():
            table[RANGE_RATE] = self.range_rate
        return table

    @property
    def places(self) -> Array:
        """Stated places of the beacons, (B, 3): latitude, longitude (rad), height (m)."""
        return np.array([place.geodetic for place in self.settings.positions.values()])

    @property
    def missing(self) -> NDArray[Any]:
        """Rows with neither range nor range rate, (M,) bool."""
        return np.asarray(np.isnan(self.range) & np.isnan(self.range_rate))

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the errors of sound speed, places and clock."""
        s = self.settings
        return (
            Parameter(_SCALE, np.zeros(1), np.array([s.sound_speed_error_std])),
            *(
                Parameter(_offset_spec(name), np.zeros(3), np.full(3, position.std_m))
                for name, position in s.positions.items()
            ),
            *(
                Parameter(_bias_spec(name), np.zeros(1), np.array([s.range_bias_std_m]))
                for name in s.positions
            ),
            *_CLOCK.parameters(s),
        )

    def _middle(self) -> Array:
        """Return the stamps of the middles of the sound's ways, (M,), s.

        A way there and back is twice the range from there; the beacon waits before it replies.
        """
        s = self.settings
        if s.stamp == "middle":
            return self.time
        way = np.nan_to_num(self.range) / _SOUND_SPEED
        return np.asarray(self.time - way - 0.5 * s.turn_around_s)

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return ranges and range rates, beacon by beacon."""
        s, time = self.settings, self._middle()
        out: list[Observation] = []
        for name, position in s.positions.items():
            place_n = frame.position(*position.geodetic)
            nRl = frame.level_from_tangent(*position.geodetic[:2]).T
            for kind, values, std in (
                (BeaconRange, self.range, s.range_std_m),
                (BeaconRangeRate, self.range_rate, s.range_rate_std_m_s),
            ):
                m = (self.name == name) & ~np.isnan(values)
                if m.any():
                    arm = np.array(s.lever_arm_m)
                    out.append(kind(time[m], values[m], std, place_n, nRl, arm, name))
        return tuple(out)

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why a component could not be observed, given the motion of the trial."""
        if motion is None or motion.v_n.shape[0] < 2:
            return message("not_observable.no_ranges")
        travelled = float(np.linalg.norm(np.ptp(motion.p_n[:, :2], axis=0)))
        if parameter in _CLOCK.names:
            return message("not_observable.clock_by_ranges")
        if parameter == SOUND_SPEED_ERROR:
            return message("not_observable.sound_speed")
        return message("not_observable.beacon_position", travelled=travelled)


@dataclass(frozen=True)
class _ToBeacon(PlainObservation):
    """What range and range rate to one beacon share.

    Parameters
    ----------
    time : ndarray, shape (M,), s
    measured : ndarray, shape (M,)
        M or m/s.
    std : float
        Standard deviation of each depth, in the same unit.
    place_n : ndarray, shape (3,), m
        Stated position of the beacon.
    nRl : ndarray, shape (3, 3)
        East, north, up at the beacon to n.
    arm_b : ndarray, shape (3,)
        Lever arm of the vehicle's transponder, in body, m.
    beacon : str
        Its name.
    """

    time: Array
    measured: Array
    std: float
    place_n: Array
    nRl: Array
    arm_b: Array
    beacon: str

    # Echoes come one by one, and the gate goes by the standard deviation that is stated.
    gate = GATE

    @property
    def offset(self) -> str:
        """Name of the parameter of the beacon's own place."""
        return offset_name(self.beacon)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the calibration parameters that the measurement depends on."""
        return (SOUND_SPEED_ERROR, self.offset)

    @property
    def clock(self) -> Clock:
        """Clock of the instrument."""
        return _CLOCK

    def _geometry(self, motion: Motion, values: Values) -> tuple[Array, Array]:
        """Return distance (M,) and unit vector (M, 3) from the beacon to the transponder."""
        place_n = self.place_n + self.nRl @ values[self.offset]
        separation = motion.p_n + motion.nRb @ self.arm_b - place_n
        distance = np.maximum(np.linalg.norm(separation, axis=1), 1e-3)
        return distance, separation / distance[:, None]


@dataclass(frozen=True)
class BeaconRange(_ToBeacon):
    """Slant range to a beacon.

    The error is zero where

        r = (1 + e) |p_n + nRb l - b_n| + b

    with the beacon at b_n, 1 + e the ratio of the sound speed that the instrument supposes to
    the effective one, and b the range that the beacon's delay is off by.
    """

    unit: str = "m"
    components: tuple[str, ...] = ("range",)

    @property
    def bias(self) -> str:
        """Name of the parameter of what the ranges are too long by."""
        return bias_name(self.beacon)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the calibration parameters that the measurement depends on."""
        return (*super().parameters, self.bias)

    @property
    def label(self) -> str:
        """Name of the measurement, for people."""
        return f"Beacon {self.beacon} range"

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviations."""
        return np.full((self.time.size, 1), self.std * factor)

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured, (M, 1), m."""
        distance, _ = self._geometry(motion, values)
        predicted = (1.0 + values[SOUND_SPEED_ERROR]) * distance + values[self.bias]
        return (predicted - self.measured)[:, None]

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        distance, direction = self._geometry(motion, values)
        scale = 1.0 + values[SOUND_SPEED_ERROR]
        d_p = scale * direction[:, None, :]
        derivatives: dict[str, Callable[[], Array]] = {
            SOUND_SPEED_ERROR: lambda: distance[:, None, None],
            self.offset: lambda: -d_p @ self.nRl,
            self.bias: lambda: np.ones((distance.size, 1, 1)),
        }
        return Linearization(
            residual=(scale * distance + values[self.bias] - self.measured)[:, None],
            d_theta=-d_p @ motion.nRb @ skew(self.arm_b),
            d_p=d_p,
            d_parameters={name: make() for name, make in derivatives.items() if name in wanted},
        )


@dataclass(frozen=True)
class BeaconRangeRate(_ToBeacon):
    """Range rate to a beacon, positive when the range grows.

    The error is zero where

        dr/dt = (1 + e) uᵀ (v_n + nRb (omega_eb_b x l))

    with the unit vector u from the beacon to the transponder. A Doppler shift, and the
    difference of two ranges, both scale with the supposed sound speed as the range does:
    so e is the same.
    """

    unit: str = "m/s"
    components: tuple[str, ...] = ("range rate",)

    @property
    def label(self) -> str:
        """Name of the measurement, for people."""
        return f"Beacon {self.beacon} range rate"

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviations, the gyro's share through the lever arm included."""
        return np.hypot(self.std * factor, lever_arm_sigma(motion, self.arm_b)[:, None])

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured, (M, 1), m/s."""
        _, direction = self._geometry(motion, values)
        speed = np.sum(direction * self._velocity(motion), axis=1)
        return ((1.0 + values[SOUND_SPEED_ERROR]) * speed - self.measured)[:, None]

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        distance, direction = self._geometry(motion, values)
        velocity_n = self._velocity(motion)
        speed = np.sum(direction * velocity_n, axis=1)
        scale = 1.0 + values[SOUND_SPEED_ERROR]
        across = velocity_n - speed[:, None] * direction
        d_p = (scale * across / distance[:, None])[:, None, :]
        d_v = scale * direction[:, None, :]
        d_arm = d_v @ motion.nRb
        turning_b = cross(motion.omega_eb_b, self.arm_b)
        derivatives: dict[str, Callable[[], Array]] = {
            SOUND_SPEED_ERROR: lambda: speed[:, None, None],
            self.offset: lambda: -d_p @ self.nRl,
        }
        return Linearization(
            residual=(scale * speed - self.measured)[:, None],
            d_theta=-d_p @ motion.nRb @ skew(self.arm_b) - d_arm @ skew(turning_b),
            d_p=d_p,
            d_v=d_v,
            d_omega=-d_arm @ skew(self.arm_b),
            d_parameters={name: make() for name, make in derivatives.items() if name in wanted},
        )

    def _velocity(self, motion: Motion) -> Array:
        """Return the velocity of the transponder in n, (M, 3), m/s."""
        return motion.v_n + rotate(motion.nRb, cross(motion.omega_eb_b, self.arm_b))
