"""Inertial navigation systems: position, velocity and attitude that an instrument worked out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.units import DEG, GEODETIC_SI
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.attitude import COLUMNS as ATTITUDE_COLUMNS
from factorgraph_dvl.sensors.attitude import (
    LEAST_STD,
    SCHULER_PERIOD,
    AttitudeAngles,
    AttitudeError,
    Share,
    check_angles,
    dense_angles,
    spaced,
)
from factorgraph_dvl.sensors.carried_point import PointPosition, PointVelocity
from factorgraph_dvl.sensors.clock import Clock, ClockSection
from factorgraph_dvl.sensors.gnss import POSITION_COLUMNS, VELOCITY_COLUMNS
from factorgraph_dvl.sensors.parameters import Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    ExpectedCorrelation,
    Motion,
    Observation,
    SensorSection,
)
from factorgraph_dvl.sensors.records import (
    check_all_or_none,
    check_possible,
    check_range,
    check_times,
    named_columns,
    stack,
    white_noise,
)
from factorgraph_dvl.settings.sections import NonNegative, Positive, Sigma3, Vector3

STD_COLUMNS = (
    *("std_e_m", "std_n_m", "std_u_m"),
    *("vel_std_e_m_s", "vel_std_n_m_s", "vel_std_u_m_s"),
    *("roll_std_deg", "pitch_std_deg", "heading_std_deg"),
)
_CLOCK = Clock.of("ins", prefix="ins_")
SCHULER_SPEC = ParameterSpec(
    "ins_schuler",
    "m_s",
    labels=("cos_east", "cos_north", "sin_east", "sin_north"),
    nuisance=True,
)
# Times the correlation time after which an error counts as another one beside an IMU.
_APART = 2.0
# Share of a total standard deviation that is new in each sample, whatever is stated. Chosen: it
# keeps the weights of samples finite, and is lost beside the rest.
_LEAST_SHARE = 0.02
# Fewest samples whose white noise is measured. Chosen: it is then known to a third.
_FEWEST = 12


class InsSettings(ClockSection, frozen=True, kw_only=True):
    """Section `ins` of trial.yaml.

    Standard deviations are totals; `correlated_share` of their squares is a Gauss-Markov process.
    An oscillation of 84.4 minutes comes on top, with a root mean square of the velocity east and
    north.
    """

    file: str = "ins.csv"
    position_std_m: Sigma3 = (1.0, 1.0, 2.0)
    velocity_std_m_s: Sigma3 = (0.05, 0.05, 0.05)
    attitude_std_deg: Sigma3 = (0.02, 0.02, 0.05)
    correlation_time_s: Positive = 300.0
    correlated_share: Share = 1.0
    schuler_std_m_s: NonNegative = 0.0
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    time_offset_std_s: NonNegative = 5.0


@dataclass(frozen=True)
class Ins:
    """Settings and record of an inertial navigation system.

    Parameters
    ----------
    settings : InsSettings
        Section `ins` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    geodetic : ndarray, shape (M, 3)
        Latitude, longitude (rad), ellipsoidal height (m); nan where not known.
    velocity : ndarray, shape (M, 3)
        East, north, up, m/s; nan where not known.
    rph : ndarray, shape (M, 3)
        Roll, pitch, heading, rad; nan where not known.
    std : ndarray, shape (M, 9)
        Standard deviations of the three, m, m/s and rad; nan = as the settings state.
    source : str, optional
        Name of the file, for messages.
    """

    settings: InsSettings
    time: Array
    geodetic: Array
    velocity: Array
    rph: Array
    std: Array
    source: str = "ins"
    label: str = "INS"

    section: ClassVar[str] = "ins"
    section_type: ClassVar[type[SensorSection]] = InsSettings
    required: ClassVar[tuple[str, ...]] = (
        "time_s",
        *POSITION_COLUMNS,
        *VELOCITY_COLUMNS,
        *ATTITUDE_COLUMNS,
    )
    optional: ClassVar[tuple[tuple[str, ...], ...]] = (STD_COLUMNS,)
    specs: ClassVar[tuple[ParameterSpec, ...]] = (SCHULER_SPEC, *_CLOCK.specs)
    clock: ClassVar[Clock] = _CLOCK

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        position = named_columns(POSITION_COLUMNS, self.geodetic)
        check_all_or_none(position, self.source)
        degrees = {k: position[k] / DEG for k in POSITION_COLUMNS[:2]}
        check_possible(degrees | {"height_m": position["height_m"]}, self.source)
        velocity = named_columns(VELOCITY_COLUMNS, self.velocity)
        check_all_or_none(velocity, self.source)
        check_range(velocity, -200.0, 200.0, "m/s", self.source)
        check_all_or_none(named_columns(ATTITUDE_COLUMNS, self.rph), self.source)
        check_angles(self.rph, self.source)
        check_range(named_columns(STD_COLUMNS, self.std), 1e-9, 1e6, "above 0", self.source)

    @classmethod
    def from_columns(
        cls, settings: InsSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table."""
        return cls(
            settings,
            columns["time_s"],
            stack(columns, POSITION_COLUMNS) * GEODETIC_SI,
            stack(columns, VELOCITY_COLUMNS),
            stack(columns, ATTITUDE_COLUMNS) * DEG,
            stack(columns, STD_COLUMNS) * np.repeat([1.0, 1.0, DEG], 3),
            source,
        )

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        table = {
            "time_s": self.time,
            **named_columns(POSITION_COLUMNS, self.geodetic / GEODETIC_SI),
            **named_columns(VELOCITY_COLUMNS, self.velocity),
            **named_columns(ATTITUDE_COLUMNS, self.rph / DEG),
        }
        if not np.isnan(self.std).all():
            table |= named_columns(STD_COLUMNS, self.std / np.repeat([1.0, 1.0, DEG], 3))
        return table

    @property
    def missing(self) -> Array:
        """Rows without a position, (M,) bool."""
        return np.isnan(self.geodetic[:, 0])

    @property
    def total_std(self) -> Array:
        """Total standard deviations of position, velocity, attitude, (M, 9), m, m/s, rad."""
        s = self.settings
        stated = np.array(
            [*s.position_std_m, *s.velocity_std_m_s, *np.array(s.attitude_std_deg) * DEG]
        )
        return np.maximum(np.where(np.isnan(self.std), stated, self.std), LEAST_STD)

    @property
    def error(self) -> AttitudeError:
        """What is stated of the errors of its attitude."""
        sigma = np.median(self.total_std[:, 6:], axis=0)
        s = self.settings
        share = s.correlated_share
        return AttitudeError(
            np.sqrt(share) * sigma, s.correlation_time_s, np.sqrt(1 - share) * sigma
        )

    def parameters(self) -> tuple[Parameter, ...]:
        """Return Schuler oscillation, offset and rate of the clock."""
        std = np.full(SCHULER_SPEC.size, self.settings.schuler_std_m_s)
        schuler = Parameter(SCHULER_SPEC, np.zeros(SCHULER_SPEC.size), std)
        return (schuler, *_CLOCK.parameters(self.settings))

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return what is far enough apart to have errors of its own, with total deviations."""
        apart = _APART * self.settings.correlation_time_s * (self.settings.correlated_share > 0.0)
        rows = spaced(self.time, ~np.isnan(self.rph[:, 0]), apart)
        kept = (
            *self.motion_observations(frame, apart),
            AttitudeAngles(
                self.time[rows],
                self.rph[rows],
                self.total_std[rows, 6:],
                frame,
                body_axes,
                _CLOCK,
                label="INS attitude",
                parameters=(),
            ),
        )
        return tuple(o for o in kept if o.time.size)

    def dense_observations(
        self, frame: LocalFrame, body_axes: BodyAxes
    ) -> tuple[Observation, ...]:
        """Return all of its record: lasting errors are processes beside the noise of each."""
        s = self.settings
        lasting = np.sqrt(s.correlated_share) * np.median(self.total_std, axis=0)
        position, velocity = (
            replace(
                o,
                noise_groups=((0, 1), (2,)),
                correlated=ExpectedCorrelation(s.correlation_time_s, own) if own.any() else None,
            )
            for o, own in zip(
                self.motion_observations(frame), (lasting[:3], lasting[3:6]), strict=True
            )
        )
        rows = np.flatnonzero(~np.isnan(self.rph[:, 0]))
        angles = dense_angles(
            self.time[rows],
            self.rph[rows],
            self.error,
            frame,
            body_axes,
            _CLOCK,
            "INS attitude",
            parameters=(),
        )
        return position, velocity, angles

    def motion_observations(
        self, frame: LocalFrame, apart: float = 0.0
    ) -> tuple[PointPosition | PointVelocity, ...]:
        """Return positions and velocities at least so many seconds apart.

        All of them have the part of the standard deviation that is new in each, at least the white
        noise of the record; those that are apart, the total. Without that noise the motion would
        follow it, and a clock would move to where the interpolation has less of it: by 0.2 s, with
        0.02 m in positions once a second.
        """
        share = 1.0 if apart > 0.0 else max(1.0 - self.settings.correlated_share, _LEAST_SHARE**2)
        std = np.sqrt(share) * self.total_std
        place_n = frame.position(*self.geodetic.T)
        if not apart:
            for i, measured in ((0, place_n), (3, self.velocity)):
                known = measured[~np.isnan(measured[:, 0])]
                if len(known) >= _FEWEST:
                    std[:, i : i + 3] = np.maximum(std[:, i : i + 3], white_noise(known))
        arm = np.array(self.settings.lever_arm_m)
        at_position = spaced(self.time, ~np.isnan(self.geodetic[:, 0]), apart)
        at_velocity = spaced(
            self.time, ~np.isnan(self.velocity[:, 0]) & ~np.isnan(self.geodetic[:, 0]), apart
        )
        p, v = at_position, at_velocity
        by_position, by_velocity = self._by_schuler()
        return (
            PointPosition(
                time=self.time[p],
                measured_n=place_n[p],
                lRn=frame.level_from_tangent(*self.geodetic[p, :2].T),
                std=std[p, :3],
                label="INS position",
                clock=_CLOCK,
                lever_arm=arm,
                errors={SCHULER_SPEC.name: by_position[p]},
            ),
            PointVelocity(
                time=self.time[v],
                measured_l=self.velocity[v],
                lRn=frame.level_from_tangent(*self.geodetic[v, :2].T),
                std=std[v, 3:6],
                label="INS velocity",
                clock=_CLOCK,
                lever_arm=arm,
                errors={SCHULER_SPEC.name: by_velocity[v]},
            ),
        )

    def _by_schuler(self) -> tuple[Array, Array]:
        """Return the derivatives of errors of position and velocity by the oscillation, (M, 3, 4).

        The velocity errs by c cos w t + s sin w t east and north, and the position by its integral
        about a mean of zero. Time is that of the trial: a part of the record has the same c and s.
        """
        rate = 2.0 * np.pi / SCHULER_PERIOD
        phase = rate * self.time
        level = np.eye(3)[:, :2]
        cos, sin = (f(phase)[:, None, None] * level for f in (np.cos, np.sin))
        return (
            np.concatenate([sin, -cos], axis=2) / rate,
            np.concatenate([cos, sin], axis=2),
        )

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why the clock could not be observed."""
        return message("not_observable.clock")
