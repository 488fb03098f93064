"""Heading and speed log: what a vehicle without a usable IMU reckons its way with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.dvl import CURRENT_SPEC
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import Motion, Observation, SensorSection
from factorgraph_dvl.sensors.records import check_range, check_times
from factorgraph_dvl.settings.sections import NonNegative, Positive

HEADING_BIAS = "heading_bias_deg"
SCALE_ERROR = "log_scale_error"
CURRENT = "current_m_s"

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
        """Return the record that a table holds."""
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
        """Return nothing: the record is integrated, as that of an IMU is."""
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
        To starboard, m/s; nan where not measured, which stands for none.
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
        """Return the record that a table holds."""
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
        """Return nothing: the record is integrated, as that of an IMU is."""
        return ()

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why current or scale error could not be observed."""
        if parameter == CURRENT:
            return message("not_observable.current_by_ranges")
        return message("not_observable.log_scale")
