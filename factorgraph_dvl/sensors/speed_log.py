"""Heading and speed log: what a vehicle without a usable IMU reckons its way with."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.dvl_water import CURRENT_SPEC
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    Linearization,
    Motion,
    Observation,
    ObservationByRows,
    SensorSection,
    Values,
)
from factorgraph_dvl.sensors.records import check_range, check_times
from factorgraph_dvl.settings.sections import NonNegative, Positive

HEADING_BIAS = "heading_bias_deg"
SCALE_ERROR = "log_scale_error"
CURRENT = "current_m_s"

# Standard deviation of a velocity to starboard that nobody measures, m/s. Chosen: no leeway, and
# no weight without bounds.
_NO_LEEWAY = 1e-3

HEADING_BIAS_SPEC = ParameterSpec("heading_bias", "deg", labels=SCALAR, kind="angle")
LOG_SCALE_SPEC = ParameterSpec("log_scale_error", labels=SCALAR, above=-1.0)


class HeadingSettings(SensorSection, frozen=True, kw_only=True):
    """Section `heading` of trial.yaml."""

    file: str = "heading.csv"
    std_deg: Positive = 0.5
    bias_std_deg: NonNegative = 0.0

    @property
    def std_rad(self) -> float:
        """Standard deviation of the noise, rad."""
        return self.std_deg * DEG


class LogSettings(SensorSection, frozen=True, kw_only=True):
    """Section `log` of trial.yaml."""

    file: str = "log.csv"
    speed_std_m_s: Positive = 0.05
    scale_error_std: NonNegative = 0.0
    reference: Literal["water", "bottom"] = "water"
    current_std_m_s: tuple[NonNegative, NonNegative] = (0.5, 0.5)


@dataclass(frozen=True)
class Heading:
    """Settings and record of a compass or gyrocompass.

    Parameters
    ----------
    settings : HeadingSettings
        Section `heading` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    heading : ndarray, shape (M,)
        Clockwise from true north, rad; nan where not measured.
    source : str, optional
        Name of the file, for messages.
    """

    settings: HeadingSettings
    time: Array
    heading: Array
    source: str = "heading"
    label: str = "Heading"

    section: ClassVar[str] = "heading"
    section_type: ClassVar[type[SensorSection]] = HeadingSettings
    required: ClassVar[tuple[str, ...]] = ("time_s", "heading_deg")
    optional: ClassVar[tuple[tuple[str, ...], ...]] = ()
    specs: ClassVar[tuple[ParameterSpec, ...]] = (HEADING_BIAS_SPEC,)

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        check_range({"heading_deg": self.heading / DEG}, -360.0, 360.0, "deg", self.source)

    @classmethod
    def from_columns(
        cls, settings: HeadingSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table."""
        return cls(settings, columns["time_s"], columns["heading_deg"] * DEG, source)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        return {"time_s": self.time, "heading_deg": self.heading / DEG}

    @property
    def missing(self) -> Array:
        """Rows without a heading, (M,) bool."""
        return np.isnan(self.heading)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the constant error of the heading."""
        sigma = np.array([self.settings.bias_std_deg]) * DEG
        return (Parameter(HEADING_BIAS_SPEC, np.zeros(1), sigma),)

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return nothing: the chain of a planar trial has its attitude from the record."""
        return ()

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why the error of the heading could not be observed."""
        return message("not_observable.heading_by_one_beacon")


@dataclass(frozen=True)
class SpeedLog:
    """Settings and record of a log: speed through the water or over ground.

    Parameters
    ----------
    settings : LogSettings
        Section `log` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    speed : ndarray, shape (M,)
        Ahead, m/s; nan where not measured.
    starboard : ndarray, shape (M,)
        Speed to starboard, m/s; nan where not measured, which stands for none.
    source : str, optional
        Name of the file, for messages.
    """

    settings: LogSettings
    time: Array
    speed: Array
    starboard: Array
    source: str = "log"
    label: str = "Log"

    section: ClassVar[str] = "log"
    section_type: ClassVar[type[SensorSection]] = LogSettings
    required: ClassVar[tuple[str, ...]] = ("time_s", "speed_m_s")
    optional: ClassVar[tuple[tuple[str, ...], ...]] = (("starboard_m_s",),)
    specs: ClassVar[tuple[ParameterSpec, ...]] = (LOG_SCALE_SPEC, CURRENT_SPEC)

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        speeds = {"speed_m_s": self.speed, "starboard_m_s": self.starboard}
        check_range(speeds, -50.0, 50.0, "m/s", self.source)

    @classmethod
    def from_columns(
        cls, settings: LogSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table."""
        return cls(
            settings, columns["time_s"], columns["speed_m_s"], columns["starboard_m_s"], source
        )

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        table = {"time_s": self.time, "speed_m_s": self.speed}
        if not np.isnan(self.starboard).all():
            table["starboard_m_s"] = self.starboard
        return table

    @property
    def missing(self) -> Array:
        """Rows without a speed, (M,) bool."""
        return np.isnan(self.speed)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return scale error and, through the water, the current."""
        s = self.settings
        through_water = s.reference == "water"
        current = np.array(s.current_std_m_s) if through_water else np.zeros(2)
        scale = np.array([s.scale_error_std])
        return (
            Parameter(LOG_SCALE_SPEC, np.zeros(1), scale),
            Parameter(CURRENT_SPEC, np.zeros(2), current),
        )

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return the velocity along the axes of the body."""
        own = ~np.isnan(self.speed)
        if not own.any():
            return ()
        starboard = self.starboard[own]
        measured = np.stack([self.speed[own], np.nan_to_num(starboard)], axis=1)
        std = np.full(measured.shape, self.settings.speed_std_m_s)
        std[np.isnan(starboard), 1] = _NO_LEEWAY
        return (LogVelocity(self.time[own], measured, std, body_axes),)

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why current or scale error could not be observed."""
        if parameter == CURRENT:
            return message("not_observable.current_by_ranges")
        return message("not_observable.log_scale")


@dataclass(frozen=True, eq=False)
class LogVelocity(ObservationByRows):
    """Velocity ahead and to starboard, through the water or over ground.

    The error is zero where

        w = (1 + k) Rz(b) F nRbᵀ (v_n - c)

    with the scale error k, the current c, the rows F forward and right of the body's axes, and
    the rotation Rz(b) about down by what the heading is too large in the motion.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the measurements.
    measured : ndarray, shape (M, 2), m/s
        Ahead and to starboard.
    std : ndarray, shape (M, 2), m/s
        Standard deviation of each component.
    body_axes : BodyAxes
        Axes of the body.
    """

    time: Array
    measured: Array
    std: Array
    body_axes: BodyAxes

    label: str = "Log velocity"
    unit: str = "m/s"
    components: tuple[str, ...] = ("ahead", "starboard")
    parameters: tuple[str, ...] = (SCALE_ERROR, HEADING_BIAS, CURRENT)
    clock: ClassVar[None] = None
    noise_groups = ((0,), (1,))
    independent = True

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviations."""
        return self.std * factor

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured, (M, 2), m/s."""
        return self._gain(values) * self._turned(motion, values)[0] - self.measured

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        gain = self._gain(values)
        velocity, rows, through_b = self._turned(motion, values)
        d_v = gain * rows @ motion.nRb.transpose(0, 2, 1)
        across = np.stack([-velocity[:, 1], velocity[:, 0]], axis=1)
        derivatives: dict[str, Callable[[], Array]] = {
            SCALE_ERROR: lambda: velocity[:, :, None],
            HEADING_BIAS: lambda: gain * across[:, :, None],
            CURRENT: lambda: -d_v[:, :, :2],
        }
        return Linearization(
            residual=gain * velocity - self.measured,
            d_theta=gain * rows @ skew(through_b),
            d_v=d_v,
            d_parameters={name: make() for name, make in derivatives.items() if name in wanted},
        )

    @staticmethod
    def _gain(values: Values) -> float:
        return 1.0 + float(values[SCALE_ERROR][0])

    def _turned(self, motion: Motion, values: Values) -> tuple[Array, Array, Array]:
        """Return the velocity along the log's axes, these axes (2, 3), and it in body axes."""
        current_n = np.array([*values[CURRENT], 0.0])
        through_b = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n - current_n)
        b = float(values[HEADING_BIAS][0])
        turn = np.array([[np.cos(b), -np.sin(b)], [np.sin(b), np.cos(b)]])
        rows = turn @ frd_from_body(self.body_axes)[:2]
        return through_b @ rows.T, rows, through_b
