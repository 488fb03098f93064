"""The turntable on which IMU and DVL turn together under a ship."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import Message
from factorgraph_dvl.sensors.parameters import Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import Motion, Observation, SensorSection
from factorgraph_dvl.sensors.records import check_finite, check_range, check_times
from factorgraph_dvl.sensors.turntable_motion import TurntableMotion


class TurntableSettings(SensorSection, frozen=True, kw_only=True):
    """Section `turntable` of trial.yaml."""

    file: str = "turntable.csv"


@dataclass(frozen=True)
class Turntable:
    """Record of a turntable: it observes nothing, but gives the place of the antenna.

    Parameters
    ----------
    settings : TurntableSettings
        Section `turntable` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    angle : ndarray, shape (M,)
        Rotation of IMU and DVL relative to the ship, counter-clockwise seen from above, rad; it
        may wrap.
    source : str, optional
        Name of the file, for messages.
    """

    settings: TurntableSettings
    time: Array
    angle: Array
    source: str = "turntable"
    label: str = "Turntable"

    section: ClassVar[str] = "turntable"
    section_type: ClassVar[type[SensorSection]] = TurntableSettings
    required: ClassVar[tuple[str, ...]] = ("time_s", "angle_deg")
    optional: ClassVar[tuple[tuple[str, ...], ...]] = ()
    specs: ClassVar[tuple[ParameterSpec, ...]] = ()

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        angle = {"angle_deg": self.angle / DEG}
        check_finite(angle, self.source)
        check_range(angle, -36e3, 36e3, "deg", self.source)

    @classmethod
    def from_columns(
        cls, settings: TurntableSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table."""
        return cls(settings, columns["time_s"], columns["angle_deg"] * DEG, source)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        return {"time_s": self.time, "angle_deg": self.angle / DEG}

    @property
    def missing(self) -> Array:
        """No row, (M,) bool: none may be empty."""
        return np.zeros(self.time.size, dtype=bool)

    def turning(self, up: Array) -> TurntableMotion:
        """Return how the body turns about its axis `up`, (3,)."""
        return TurntableMotion(self.time, np.unwrap(self.angle), up)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return nothing: the angle is taken as exact."""
        return ()

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return nothing: the turn is a motion of the body, which the IMU sees."""
        return ()

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message | str:
        """Say nothing: there is no parameter."""
        return ""
