"""The GNSS receiver: position and velocity of its antenna."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.units import DEG, GEODETIC_SI
from factorgraph_dvl.geometry.vectors import IDENTITY, Array
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.averaging import averaging_spec, usual_parameter, usual_spec
from factorgraph_dvl.sensors.carried_point import PointPosition, PointVelocity
from factorgraph_dvl.sensors.clock import Clock, ClockSection, LateClock
from factorgraph_dvl.sensors.parameters import Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    USUAL_CORRELATION_TIME,
    Motion,
    Observation,
    SensorSection,
    expected_correlation,
)
from factorgraph_dvl.sensors.records import (
    check_all_or_none,
    check_possible,
    check_range,
    check_times,
    named_columns,
    rows_of,
    stack,
)
from factorgraph_dvl.sensors.turntable_motion import TurntableMotion
from factorgraph_dvl.settings.sections import NonNegative, Positive, Sigma3, Vector3

POSITION_COLUMNS = ("lat_deg", "lon_deg", "height_m")
VELOCITY_COLUMNS = ("vel_e_m_s", "vel_n_m_s", "vel_u_m_s")
POSITION_STD_COLUMNS = ("std_e_m", "std_n_m", "std_u_m")
VELOCITY_STD_COLUMNS = ("vel_std_e_m_s", "vel_std_n_m_s", "vel_std_u_m_s")

LEVER_ARM = "gnss_lever_arm_m"

# Components whose noise is alike: a fix is as good to the east as to the north, on the whole.
HORIZONTAL_AND_UP = ((0, 1), (2,))

# Plausible size, m. Chosen: a vessel's length, for an antenna that was not measured.
_LEVER_ARM = ParameterSpec(
    "gnss_lever_arm",
    "m",
    frame="b",
    nuisance=True,
    plausible=5.0,
    key="gnss: lever_arm_std_m",
)
# Correlation time of velocities where none is stated, s. Chosen: that of filters in receivers.
_VELOCITY_TIME = 2.0
# Rate of the body relative to itself.
_AT_REST = np.zeros(3)
_AT_REST.setflags(write=False)
_CLOCK = Clock.of("gnss", prefix="gnss_")
# Plausible lengths, s, of windows of velocities, and delays. Chosen: differences of positions over
# one second, with their stamps at the end.
_DELAY = usual_spec("gnss_velocity_delay", 0.5)
_AVERAGING = averaging_spec("gnss_velocity_", 1.0)
_VELOCITY_CLOCK = LateClock(_CLOCK.offset, _CLOCK.rate, _CLOCK.sawtooth, _CLOCK.period, _DELAY)
TIME_OFFSET = _CLOCK.offset.name


class GnssSettings(ClockSection, frozen=True, kw_only=True):
    """Section `gnss` of trial.yaml.

    Examples
    --------
    >>> from factorgraph_dvl import GnssSettings
    >>> GnssSettings(lever_arm_m=(1.2, 0.0, -3.5)).lever_arm_std_m
    (0.02, 0.02, 0.02)
    """

    file: str = "gnss.csv"
    position_std_m: tuple[Positive, Positive, Positive] = (1.0, 1.0, 2.0)
    velocity_std_m_s: tuple[Positive, Positive, Positive] = (0.1, 0.1, 0.1)
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    lever_arm_std_m: Sigma3 = (0.02, 0.02, 0.02)
    time_offset_std_s: NonNegative = 0.5
    correlation_time_s: Positive | UnsetType = UNSET
    correlated_std_m: Sigma3 | UnsetType = UNSET
    velocity_correlation_time_s: Positive | UnsetType = UNSET
    correlated_velocity_std_m_s: Sigma3 | UnsetType = UNSET
    velocity_delay_s: float = 0.0
    velocity_delay_std_s: NonNegative | UnsetType = UNSET
    velocity_averaging_s: NonNegative = 0.0
    velocity_averaging_std_s: NonNegative | UnsetType = UNSET

    @property
    def left_out(self) -> tuple[str, ...]:
        """The window of velocities, where there is one."""
        return ("velocity_averaging_s",) if self.velocity_averaging_s > 0.0 else ()

    @property
    def velocity_lag_s(self) -> tuple[float, float]:
        """What stamps of velocities are late by, and its standard deviation, s."""
        std = self.velocity_delay_std_s
        total = math.hypot(self.time_offset_std_s, 0.0 if isinstance(std, UnsetType) else std)
        return self.time_offset_s + self.velocity_delay_s, total


@dataclass(frozen=True)
class Gnss:
    """Settings and record of the GNSS receiver.

    Parameters
    ----------
    settings : GnssSettings
        Section `gnss` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    geodetic : ndarray, shape (M, 3)
        Latitude, longitude (rad), ellipsoidal height (m) of the antenna; nan where not measured.
    velocity : ndarray, shape (M, 3)
        East, north, up, m/s; nan where not measured. Up alone may be nan, as where course and
        speed over ground are known: it is then 0, with an infinite standard deviation.
    position_std, velocity_std : ndarray, shape (M, 3)
        Standard deviations, east, north, up; the settings' where the record has none (nan).
    source : str, optional
        Name of the file, for messages.
    turning : TurntableMotion, optional
        Rotation of the body relative to the ship that carries the antenna; None = the antenna is
        fixed to the body.

    Examples
    --------
    >>> import numpy as np
    >>> from factorgraph_dvl import Gnss, GnssSettings
    >>> geodetic = np.array([[np.radians(36.0), np.radians(121.0), 10.0]])
    >>> absent = np.full((1, 3), np.nan)
    >>> Gnss(GnssSettings(), np.zeros(1), geodetic, absent, absent, absent).missing
    array([False])
    """

    settings: GnssSettings
    time: Array
    geodetic: Array
    velocity: Array
    position_std: Array
    velocity_std: Array
    source: str = "gnss"
    label: str = "GNSS"
    turning: TurntableMotion | None = None

    section: ClassVar[str] = "gnss"
    section_type: ClassVar[type[SensorSection]] = GnssSettings
    required: ClassVar[tuple[str, ...]] = ("time_s", *POSITION_COLUMNS)
    optional: ClassVar[tuple[tuple[str, ...], ...]] = (
        VELOCITY_COLUMNS,
        POSITION_STD_COLUMNS,
        VELOCITY_STD_COLUMNS,
    )
    specs: ClassVar[tuple[ParameterSpec, ...]] = (_LEVER_ARM, *_CLOCK.specs, _DELAY, _AVERAGING)

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        position = named_columns(POSITION_COLUMNS, self.geodetic)
        check_all_or_none(position, self.source)
        velocity = named_columns(VELOCITY_COLUMNS, self.velocity)
        check_all_or_none(dict(list(velocity.items())[:2]), self.source)
        level = np.isfinite(self.velocity[:, 0])
        no_up = level & (np.isnan(self.velocity[:, 2]) | np.isinf(self.velocity_std[:, 2]))
        check_all_or_none(named_columns(VELOCITY_COLUMNS, self.velocity[~no_up]), self.source)
        degrees = {k: position[k] / DEG for k in POSITION_COLUMNS[:2]}
        check_possible(degrees | {"height_m": position["height_m"]}, self.source)
        check_range(velocity, -200.0, 200.0, "m/s", self.source)
        for names, std in (
            (POSITION_STD_COLUMNS, self.position_std),
            (VELOCITY_STD_COLUMNS, self.velocity_std),
        ):
            stated = np.where(np.isinf(std), np.nan, std)
            check_range(named_columns(names, stated), 1e-6, 1e6, "above 0", self.source)
        for name, default in (
            ("position_std", self.settings.position_std_m),
            ("velocity_std", self.settings.velocity_std_m_s),
        ):
            std = getattr(self, name)
            # A new array: the one that was given is the caller's.
            object.__setattr__(self, name, np.where(np.isnan(std), default, std))
        if no_up.any():
            up = np.array([False, False, True])
            self.velocity_std[no_up, 2] = np.inf
            measured = np.where(no_up[:, None] & up, 0.0, self.velocity)
            object.__setattr__(self, "velocity", measured)

    @classmethod
    def from_columns(
        cls, settings: GnssSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table."""
        geodetic = stack(columns, POSITION_COLUMNS) * GEODETIC_SI
        velocity, position_std, velocity_std = (stack(columns, group) for group in cls.optional)
        return cls(
            settings, columns["time_s"], geodetic, velocity, position_std, velocity_std, source
        )

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        table = {
            "time_s": self.time,
            **named_columns(POSITION_COLUMNS, self.geodetic / GEODETIC_SI),
            **named_columns(POSITION_STD_COLUMNS, self.position_std),
        }
        if not np.isnan(self.velocity).all():
            known = np.isfinite(self.velocity_std)
            table |= named_columns(VELOCITY_COLUMNS, np.where(known, self.velocity, np.nan))
            table |= named_columns(
                VELOCITY_STD_COLUMNS, np.where(known, self.velocity_std, np.nan)
            )
        return table

    @property
    def missing(self) -> Array:
        """Epochs with neither position nor velocity, (M,) bool."""
        return np.asarray(np.isnan(self.geodetic[:, 0]) & np.isnan(self.velocity[:, 0]))

    @property
    def mean_velocity_std(self) -> Array:
        """Root mean square of the standard deviations of measured components, (M,), m/s."""
        known = np.isfinite(self.velocity_std)
        total = np.sum(np.where(known, self.velocity_std, 0.0) ** 2, axis=1)
        return np.asarray(np.sqrt(total / known.sum(axis=1)))

    def on_trial_clock(self) -> Self:
        """Return this record with stamps less the stated time offset."""
        offset = self.settings.time_offset_s
        if offset == 0.0:
            return self
        settings = msgspec.structs.replace(self.settings, time_offset_s=0.0)
        return replace(self, settings=settings, time=self.time - offset)

    def of_one_clock(self) -> tuple[Self, ...]:
        """Return positions and velocities apart where these are late beside them, else itself."""
        s = self.settings
        if s.velocity_delay_s == 0.0 and s.velocity_delay_std_s in {0.0, UNSET}:
            return (self,)
        absent = np.full_like(self.geodetic, np.nan)
        parts = replace(self, velocity=absent), replace(self, geodetic=absent)
        measured = [np.logical_not(part.missing) for part in parts]
        return tuple(rows_of(p, m) for p, m in zip(parts, measured, strict=True) if m.any())

    def carrier(self, time: Array) -> tuple[Array, Array]:
        """Return bRc (M, 3, 3), axes of what carries the antenna to body, and omega_cb_b (M, 3).

        The lever arm keeps its components in c, and c turns at omega_eb_b - omega_cb_b.
        """
        bRc, omega_cb_b = self._carrier(time)
        return np.broadcast_to(bRc, (time.size, 3, 3)), np.broadcast_to(omega_cb_b, (time.size, 3))

    def _carrier(self, time: Array) -> tuple[Array, Array]:
        """Return the same, once for all times where the body carries the antenna itself."""
        return (IDENTITY, _AT_REST) if self.turning is None else self.turning.at(time)

    def lever_arm(self, time: Array) -> tuple[Array, Array]:
        """Return the nominal lever arm in body, (M, 3), m, and omega_cb_b of `carrier`."""
        bRc, omega_cb_b = self.carrier(time)
        return bRc @ np.array(self.settings.lever_arm_m), omega_cb_b

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the antenna's lever arm, the receiver's clock, delay and window of velocities."""
        s = self.settings
        lever_arm = Parameter(_LEVER_ARM, np.array(s.lever_arm_m), np.array(s.lever_arm_std_m))
        of_velocity = (
            (_DELAY, s.velocity_delay_s, s.velocity_delay_std_s),
            (_AVERAGING, s.velocity_averaging_s, s.velocity_averaging_std_s),
        )
        return (
            lever_arm,
            *_CLOCK.parameters(s),
            *(usual_parameter(*each) for each in of_velocity),
        )

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return position and velocity measurements, where there are any."""
        out: list[Observation] = []
        has_position = ~np.isnan(self.geodetic[:, 0])
        has_velocity = ~np.isnan(self.velocity[:, 0])
        # A receiver that loses its position keeps the axes of the last one: the
        # vertical turns by a degree in 111 km.
        lat, lon = self.geodetic[:, 0], self.geodetic[:, 1]
        if not has_position.any():
            lat, lon = np.full_like(lat, frame.lat), np.full_like(lon, frame.lon)
        elif not has_position.all():
            known = np.maximum.accumulate(np.where(has_position, np.arange(self.time.size), -1))
            known = np.where(known < 0, np.argmax(has_position), known)
            lat, lon = lat[known], lon[known]
        lRn = frame.level_from_tangent(lat, lon)
        s = self.settings
        if has_position.any():
            m = slice(None) if has_position.all() else has_position
            p_n = frame.position(*self.geodetic[m].T)
            bRc, _ = self._carrier(self.time[m])
            out.append(
                PointPosition(
                    time=self.time[m],
                    measured_n=p_n,
                    lRn=lRn[m],
                    std=self.position_std[m],
                    label="GNSS position",
                    clock=_CLOCK,
                    lever_arm=LEVER_ARM,
                    bRc=bRc,
                    noise_groups=HORIZONTAL_AND_UP,
                    correlated=expected_correlation(
                        s.correlation_time_s, s.correlated_std_m, 3, USUAL_CORRELATION_TIME
                    ),
                )
            )
        if has_velocity.any():
            m = slice(None) if has_velocity.all() else has_velocity
            bRc, omega_cb_b = self._carrier(self.time[m])
            out.append(
                PointVelocity(
                    time=self.time[m],
                    measured_l=self.velocity[m],
                    lRn=lRn[m],
                    std=self.velocity_std[m],
                    label="GNSS velocity",
                    clock=_VELOCITY_CLOCK,
                    lever_arm=LEVER_ARM,
                    bRc=bRc,
                    omega_cb_b=omega_cb_b,
                    noise_groups=HORIZONTAL_AND_UP,
                    averaging=_AVERAGING.name,
                    averages_in_body=False,
                    correlated=expected_correlation(
                        s.velocity_correlation_time_s,
                        s.correlated_velocity_std_m_s,
                        3,
                        _VELOCITY_TIME,
                    ),
                )
            )
        return tuple(out)

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why a component of the lever arm or the clock could not be observed."""
        if parameter in {*_VELOCITY_CLOCK.names, _AVERAGING.name}:
            return message("not_observable.clock")
        return message("not_observable.antenna")
