"""USBL: positions of a transponder under water, or range and direction to it from a ship."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
from msgspec import UNSET, UnsetType
from scipy.ndimage import median_filter

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, frd_from_body
from factorgraph_dvl.geometry.units import DEG, GEODETIC_SI
from factorgraph_dvl.geometry.vectors import Array, BoolArray, cross, rotate, skew
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.carried_point import PointPosition
from factorgraph_dvl.sensors.clock import Clock, ClockSection
from factorgraph_dvl.sensors.gnss import (
    HORIZONTAL_AND_UP,
    POSITION_COLUMNS,
    POSITION_STD_COLUMNS,
    Gnss,
    GnssSettings,
)
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    Linearization,
    Motion,
    Observation,
    ObservationByRows,
    SensorRecord,
    SensorSection,
    Values,
)
from factorgraph_dvl.sensors.records import (
    check_all_or_none,
    check_possible,
    check_range,
    check_times,
    named_columns,
    stack,
)
from factorgraph_dvl.sensors.ship import Ship, ShipMotion, ShipSettings
from factorgraph_dvl.settings.sections import NonNegative, Positive, Sigma3, Vector3

POLAR_COLUMNS = ("range_m", "bearing_deg", "depression_deg")
CARTESIAN_COLUMNS = ("forward_m", "starboard_m", "down_m")
AGE = "age_s"

# Speed of sound by which a range becomes a travel time, m/s. Chosen: 1 % of it is 1 ms at 150 m.
_SOUND_SPEED = 1500.0
_POLAR_SI = np.array([1.0, DEG, DEG])
# Least standard deviation of a direction, m: straight down, a bearing moves nothing.
_LEAST_STD = 1e-3

# Fixes of which a median is taken, and standard deviations from it that are far. Chosen: a start
# loses nothing by a few good ones that are left out.
_NEIGHBOURS, _STRAY = 9, 5.0
_CLOCK = Clock.of("usbl", prefix="usbl_")
TIME_OFFSET = _CLOCK.offset.name
_MISALIGNMENT = ParameterSpec("usbl_misalignment", "deg", kind="rotation", frame="b")
_SCALE = ParameterSpec("usbl_sound_speed_error", labels=SCALAR)
# Plausible sizes, m. Chosen: a ship's half breadth and draught, and a vehicle's length.
_TRANSCEIVER = ParameterSpec(
    "usbl_transceiver_lever_arm", "m", frame="b", nuisance=True, plausible=5.0
)
_TRANSPONDER = ParameterSpec(
    "usbl_transponder_lever_arm",
    "m",
    frame="b",
    nuisance=True,
    plausible=2.0,
    key="usbl: transponder_lever_arm_std_m",
)
MISALIGNMENT, SOUND_SPEED_ERROR = _MISALIGNMENT.name, _SCALE.name
TRANSCEIVER_LEVER_ARM, TRANSPONDER_LEVER_ARM = _TRANSCEIVER.name, _TRANSPONDER.name


class UsblSettings(ClockSection, frozen=True, kw_only=True):
    """Section `usbl` of trial.yaml."""

    file: str = "usbl.csv"
    position_std_m: tuple[Positive, Positive, Positive] = (0.5, 0.5, 0.5)
    std_fraction: NonNegative = 0.003
    range_std_m: Positive = 0.2
    angle_std_deg: Positive = 0.15
    transponder_lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    transponder_lever_arm_std_m: Sigma3 = (0.0, 0.0, 0.0)
    time_offset_std_s: NonNegative = 0.5
    ship: ShipSettings | UnsetType = UNSET


@dataclass(frozen=True)
class Usbl:
    """Settings and record of a USBL.

    A row has a position, or what the transceiver measured: range, bearing and depression, or
    forward, starboard and down.

    Parameters
    ----------
    settings : UsblSettings
        Section `usbl` of trial.yaml.
    time : ndarray, shape (M,), s
        Times of reception; strictly increasing.
    geodetic : ndarray, shape (M, 3)
        Latitude, longitude (rad), ellipsoidal height (m) of the transponder; nan where not given.
    position_std : ndarray, shape (M, 3), m
        Standard deviations, east, north, up; nan where the settings have them.
    polar : ndarray, shape (M, 3)
        Range (m), bearing clockwise from forward and depression (rad); nan where not given.
    cartesian : ndarray, shape (M, 3), m
        Forward, starboard, down of the transceiver; nan where not given.
    age : ndarray, shape (M,), s
        How long before `time` it was so.
    ship : Ship, optional
        The ship of the transceiver.
    source : str, optional
        Name of the file, for messages.

    Raises
    ------
    ConfigError
        If there are measurements of a transceiver, and no ship.
    """

    settings: UsblSettings
    time: Array
    geodetic: Array
    position_std: Array
    polar: Array
    cartesian: Array
    age: Array
    ship: Ship | None = None
    source: str = "usbl"
    label: str = "USBL"

    section: ClassVar[str] = "usbl"
    section_type: ClassVar[type[SensorSection]] = UsblSettings
    parts: ClassVar[Mapping[str, type[SensorRecord]]] = {"ship": Ship}
    required: ClassVar[tuple[str, ...]] = ("time_s",)
    optional: ClassVar[tuple[tuple[str, ...], ...]] = (
        *(POSITION_COLUMNS, POSITION_STD_COLUMNS, POLAR_COLUMNS, CARTESIAN_COLUMNS),
        (AGE,),
    )
    specs: ClassVar[tuple[ParameterSpec, ...]] = (
        *(_MISALIGNMENT, _SCALE, _TRANSCEIVER, _TRANSPONDER),
        *_CLOCK.specs,
    )

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        groups = (POSITION_COLUMNS, POLAR_COLUMNS, CARTESIAN_COLUMNS)
        for names, values in zip(groups, self._measured, strict=True):
            columns = named_columns(names, values)
            check_all_or_none(columns, self.source)
            check_possible(columns, self.source)
        check_range(
            named_columns(POSITION_STD_COLUMNS, self.position_std), 1e-6, 1e6, "m", self.source
        )
        check_range({"range_m": self.polar[:, 0]}, 0.0, 2e4, "m", self.source)
        check_range({AGE: self.age}, 0.0, 600.0, "s", self.source)
        if self.raw.any() and self.ship is None:
            raise ConfigError(
                "measurements of a transceiver need the ship that it is on",
                where="trial.yaml key usbl",
                expected="a section `usbl.ship` with the position and attitude of the ship",
            )

    @classmethod
    def from_columns(
        cls,
        settings: UsblSettings,
        columns: Mapping[str, Array],
        source: str,
        ship: Ship | None = None,
    ) -> Self:
        """Return the record in a table."""
        geodetic, std, polar, cartesian = (stack(columns, group) for group in cls.optional[:-1])
        age = np.nan_to_num(columns[AGE])
        return cls(
            settings,
            columns["time_s"],
            geodetic * GEODETIC_SI,
            std,
            polar * _POLAR_SI,
            cartesian,
            age,
            ship,
            source,
        )

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        groups = {
            POSITION_COLUMNS: self.geodetic / GEODETIC_SI,
            POSITION_STD_COLUMNS: self.position_std,
            POLAR_COLUMNS: self.polar / _POLAR_SI,
            CARTESIAN_COLUMNS: self.cartesian,
        }
        table = {"time_s": self.time}
        for names, values in groups.items():
            if not np.isnan(values).all():
                table |= named_columns(names, values)
        return table | ({AGE: self.age} if self.age.any() else {})

    @property
    def _measured(self) -> tuple[Array, Array, Array]:
        """What rows may have, degrees where columns have them, (M, 3) each."""
        return self.geodetic / GEODETIC_SI, self.polar / _POLAR_SI, self.cartesian

    @property
    def raw(self) -> BoolArray:
        """Rows with a measurement of the transceiver, (M,)."""
        return np.asarray(np.isfinite(self.polar[:, 0]) | np.isfinite(self.cartesian[:, 0]))

    @property
    def missing(self) -> Array:
        """Rows without a measurement, (M,) bool."""
        return np.asarray(np.isnan(self.geodetic[:, 0]) & ~self.raw)

    @cached_property
    def in_transceiver(self) -> Array:
        """What the transceiver measured as forward, starboard, down, (M, 3), m."""
        distance, bearing, depression = self.polar.T
        level = distance * np.cos(depression)
        found = [level * np.cos(bearing), level * np.sin(bearing), distance * np.sin(depression)]
        return np.where(np.isnan(self.cartesian), np.stack(found, axis=1), self.cartesian)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return lever arms and clock; with a ship, misalignment and sound speed."""
        s = self.settings
        out = [
            Parameter(
                _TRANSPONDER,
                np.array(s.transponder_lever_arm_m),
                np.array(s.transponder_lever_arm_std_m),
            )
        ]
        if self.raw.any() and not isinstance(s.ship, UnsetType):
            ship = s.ship
            rotation = np.array([ship.misalignment_deg, ship.misalignment_std_deg]) * DEG
            arm = np.array([ship.transceiver_lever_arm_m, ship.transceiver_lever_arm_std_m])
            scale = np.array([ship.sound_speed_error_std])
            out += [
                Parameter(_MISALIGNMENT, *rotation),
                Parameter(_SCALE, np.zeros(1), scale),
                Parameter(_TRANSCEIVER, *arm),
            ]
        return (*out, *_CLOCK.parameters(s))

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return positions, and measurements of the transceiver while the ship is known."""
        found = (self._positions(frame, body_axes), self._from_ship(frame, body_axes))
        return tuple(o for o in found if o is not None)

    def fixes(self, frame: LocalFrame, body_axes: BodyAxes) -> Gnss | None:
        """Return positions of the transponder by stated mountings, as fixes; None if none."""
        s = self.settings
        parts = []
        positions = self._positions(frame, body_axes)
        if positions is not None:
            parts.append((positions.time, positions.measured_n, positions.std))
        from_ship = self._from_ship(frame, body_axes)
        if from_ship is not None:
            stated = {p.name: p.internal(p.reported_prior[0]) for p in self.parameters()}
            std = np.linalg.norm(from_ship.std, axis=1)[:, None]
            parts.append((from_ship.time, from_ship.place_n(stated), np.tile(std, 3)))
        if not parts:
            return None
        stamps, p_n, std = (np.concatenate(each) for each in zip(*parts, strict=True))
        time, rows = np.unique(stamps, return_index=True)
        none = np.full((time.size, 3), np.nan)
        geodetic = np.stack(frame.geodetic(p_n[rows]), axis=1)
        settings = GnssSettings(
            lever_arm_m=s.transponder_lever_arm_m,
            time_offset_s=s.time_offset_s,
            time_offset_std_s=s.time_offset_std_s,
        )
        return Gnss(settings, time, geodetic, none, std[rows], none, self.source, self.label)

    def place(self) -> Array:
        """Return a place near the first measurement, (3,): latitude, longitude (rad), height (m).

        Raises
        ------
        DataError
            If there is no measurement.
        """
        known = self.geodetic[np.isfinite(self.geodetic[:, 0])]
        if known.size:
            return known[0]
        if self.ship is None:
            raise DataError("no measurement", where=self.source, expected="at least one")
        return self.ship.geodetic[0]

    @property
    def _received(self) -> Array:
        """Stamps of the receptions that the measurements are of, (M,), s."""
        return self.time - self.age

    def _positions(self, frame: LocalFrame, body_axes: BodyAxes) -> PointPosition | None:
        """Return the positions; of a known ship, the slant range adds to the noise."""
        rows = np.flatnonzero(np.isfinite(self.geodetic[:, 0]))
        if not rows.size:
            return None
        s = self.settings
        time, place_n = self._received[rows], frame.position(*self.geodetic[rows].T)
        slant = np.zeros(rows.size)
        if self.ship is not None:
            known = self.ship.covers(time)
            ship = self.ship.at(time[known], frame, body_axes)
            transceiver = ship.p_n + rotate(
                ship.nRs, np.array(self.ship.settings.transceiver_lever_arm_m)
            )
            slant[known] = np.linalg.norm(place_n[known] - transceiver, axis=1)
        std = np.hypot(s.position_std_m, s.std_fraction * slant[:, None])
        stated = self.position_std[rows]
        time = time - slant / _SOUND_SPEED
        order = np.argsort(time, kind="stable")
        return PointPosition(
            time=time[order],
            measured_n=place_n[order],
            lRn=frame.level_from_tangent(*self.geodetic[rows[order], :2].T),
            std=np.where(np.isnan(stated), std, stated)[order],
            label="USBL position",
            clock=_CLOCK,
            lever_arm=TRANSPONDER_LEVER_ARM,
            noise_groups=HORIZONTAL_AND_UP,
        )

    def _from_ship(self, frame: LocalFrame, body_axes: BodyAxes) -> FromShip | None:
        """Return what the transceiver measured, where the ship is known."""
        if self.ship is None:
            return None
        s = self.settings
        received = self._received
        measured = self.in_transceiver
        distance = np.linalg.norm(measured, axis=1)
        known = self.raw & self.ship.covers(received - s.time_offset_s)
        rows = np.flatnonzero(known & (distance > 0.0))
        if not rows.size:
            return None
        travel = distance / _SOUND_SPEED
        rows = rows[np.argsort(received[rows] - travel[rows], kind="stable")]
        level = np.hypot(measured[:, 0], measured[:, 1])
        # Bearing and depression err by an angle each, forward, starboard and down all around.
        across = np.where(np.isnan(self.polar[:, 0]), distance, level)
        angle = s.angle_std_deg * DEG
        along = np.full_like(distance, s.range_std_m)
        std = np.stack([along, angle * across, angle * distance], axis=1)
        at_stated = self.ship.at(received[rows] - s.time_offset_s, frame, body_axes)
        arm = np.array(self.ship.settings.transceiver_lever_arm_m)
        moving_s = at_stated.v_s + cross(at_stated.omega_s, arm)
        return FromShip(
            time=(received - travel)[rows],
            received=received[rows],
            measured=measured[rows],
            std=np.maximum(std[rows], _LEAST_STD),
            travelled_s=travel[rows, None] * moving_s,
            ship=self.ship,
            frame=frame,
            body_axes=body_axes,
        )

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why a component could not be observed."""
        if parameter in _CLOCK.names:
            return message("not_observable.clock")
        if parameter == TRANSPONDER_LEVER_ARM:
            return message("not_observable.transponder")
        if parameter == SOUND_SPEED_ERROR:
            return message("not_observable.usbl_sound_speed")
        return message("not_observable.transceiver")


@dataclass(frozen=True, kw_only=True)
class FromShip(ObservationByRows):
    """Where the transceiver of a ship sees a transponder on the vehicle.

    The error is zero where

        m = (1 + e) F C (sRn (p_n + nRb l - p_s) - l_s)

    with the ship at p_s, its transceiver at l_s in its body s, C the misalignment, body to
    transceiver, F body axes to forward, starboard, down, and 1 + e the ratio of the sound speed
    that the instrument supposes to the effective one. The vehicle is where it replied, and the
    ship where it received; a range is half of the way there and back, so it refers to where the
    ship was in between. The residual has the axes of the measured direction: along it, to
    starboard of it, and down across it.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Stamps of the replies.
    received : ndarray, shape (M,), s
        Stamps of the receptions.
    measured : ndarray, shape (M, 3), m
        Forward, starboard, down of the transceiver.
    std : ndarray, shape (M, 3), m
        Along and across, as the residual.
    travelled_s : ndarray, shape (M, 3), m
        How far the transceiver went from the middle of a range to its end, in the ship's body.
    ship : Ship
        Record of the ship.
    frame : LocalFrame
        Frame n.
    body_axes : {'RFU', 'FRD', 'FLU'}
        Axes of both bodies.
    """

    time: Array
    received: Array
    measured: Array
    std: Array
    travelled_s: Array
    ship: Ship
    frame: LocalFrame
    body_axes: BodyAxes
    label: str = "USBL"
    unit: str = "m"
    components: tuple[str, ...] = ("range", "bearing", "depression")
    noise_groups: tuple[tuple[int, ...], ...] = ((0,), (1, 2))
    parameters: tuple[str, ...] = (
        *(TRANSPONDER_LEVER_ARM, MISALIGNMENT, SOUND_SPEED_ERROR, TRANSCEIVER_LEVER_ARM),
    )
    clock: Clock = _CLOCK

    @cached_property
    def _axes(self) -> Array:
        """Rows along, to starboard of and down across the measured directions, (M, 3, 3)."""
        forward, starboard, down = (self.measured / _length(self.measured)).T
        level = np.hypot(forward, starboard)
        straight = level < 1e-9
        # Straight down every bearing is as good.
        c = np.where(straight, 1.0, forward) / np.where(straight, 1.0, level)
        s = np.where(straight, 0.0, starboard) / np.where(straight, 1.0, level)
        zero = np.zeros_like(c)
        along = np.stack([forward, starboard, down], axis=1)
        return np.stack(
            [along, np.stack([-s, c, zero], 1), np.stack([-c * down, -s * down, level], 1)], axis=1
        )

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviations, (M, 3), m."""
        return self.std * factor

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured, (M, 3), m."""
        return self._predicted(self._seen(motion, values)[1], values) - self._along_measured

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians; that by the clock is of the ship's motion."""
        ship, seen_s = self._seen(motion, values)
        scale = 1.0 + values[SOUND_SPEED_ERROR]
        by_seen = scale * self._axes @ self._to_transceiver(values)
        by_p = by_seen @ np.swapaxes(ship.nRs, 1, 2)
        by_arm = by_p @ motion.nRb
        arm_s = values[TRANSCEIVER_LEVER_ARM]
        from_middle = np.zeros_like(by_seen)
        from_middle[:, 0] = (by_seen[:, 0, None] @ skew(self.travelled_s))[:, 0]
        later = cross(ship.omega_s, seen_s + arm_s) + ship.v_s
        predicted = self._predicted(seen_s, values)
        found = {
            TRANSPONDER_LEVER_ARM: by_arm,
            MISALIGNMENT: -by_seen @ skew(seen_s) - from_middle,
            SOUND_SPEED_ERROR: (predicted / scale)[:, :, None],
            TRANSCEIVER_LEVER_ARM: -by_seen,
            TIME_OFFSET: by_seen @ later[:, :, None],
        }
        return Linearization(
            residual=predicted - self._along_measured,
            d_theta=-by_arm @ skew(values[TRANSPONDER_LEVER_ARM]),
            d_p=by_p,
            d_parameters={name: by for name, by in found.items() if name in wanted},
        )

    def place_n(self, values: Values) -> Array:
        """Return where the measurements put the transponder, (M, 3), m."""
        ship = self._ship(values)
        unscaled = self.measured / (1.0 + values[SOUND_SPEED_ERROR])
        seen_s = unscaled @ self._to_transceiver(values)
        return ship.p_n + rotate(ship.nRs, seen_s + values[TRANSCEIVER_LEVER_ARM])

    @cached_property
    def _along_measured(self) -> Array:
        return rotate(self._axes, self.measured)

    def _to_transceiver(self, values: Values) -> Array:
        """Return F C, the ship's body to forward, starboard, down of the transceiver, (3, 3)."""
        return np.asarray(frd_from_body(self.body_axes) @ values[MISALIGNMENT])

    def _ship(self, values: Values) -> ShipMotion:
        """Return the motion of the ship at the receptions."""
        return self.ship.at(self.received - values[TIME_OFFSET][0], self.frame, self.body_axes)

    def _seen(self, motion: Motion, values: Values) -> tuple[ShipMotion, Array]:
        """Return the ship, and the transponder from its transceiver in its body, (M, 3), m."""
        ship = self._ship(values)
        from_ship = motion.p_n + motion.nRb @ values[TRANSPONDER_LEVER_ARM] - ship.p_n
        seen_s = rotate(np.swapaxes(ship.nRs, 1, 2), from_ship) - values[TRANSCEIVER_LEVER_ARM]
        return ship, seen_s

    def _predicted(self, seen_s: Array, values: Values) -> Array:
        """Return what is predicted, in the axes of the measured direction, (M, 3), m."""
        to_axes = self._axes @ self._to_transceiver(values)
        out = rotate(to_axes, seen_s)
        out[:, 0] += np.sum(to_axes[:, 0] * self.travelled_s, axis=1)
        return np.asarray((1.0 + values[SOUND_SPEED_ERROR]) * out)


def _length(vectors: Array) -> Array:
    """Return the lengths of vectors (M, 3), (M, 1)."""
    return np.linalg.norm(vectors, axis=1)[:, None]


def near_their_neighbours(fixes: Gnss, frame: LocalFrame) -> BoolArray:
    """Return which fixes (M,) are near the median of those around them.

    A single one that is wrong is in no median of nine, and the vehicle goes on little meanwhile.

    Parameters
    ----------
    fixes : Gnss
        Positions in the order of time.
    frame : LocalFrame
        Navigation frame.
    """
    known = np.isfinite(fixes.geodetic[:, 0])
    p_n = frame.position(*fixes.geodetic[known].T)
    middle = median_filter(p_n, size=(_NEIGHBOURS, 1), mode="nearest")
    off = np.linalg.norm(p_n - middle, axis=1)
    noise = np.hypot(np.linalg.norm(fixes.position_std[known], axis=1), np.median(off))
    # Velocities without a position stay.
    out = ~known
    out[known] = off < _STRAY * noise
    return out
