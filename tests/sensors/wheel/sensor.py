"""A paddle wheel: the speed ahead, over ground."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    Linearization,
    Motion,
    Observation,
    PlainObservation,
    SensorSection,
    Values,
)
from factorgraph_dvl.settings.sections import NonNegative, Positive, Vector3

SCALE = ParameterSpec("wheel_scale_error", labels=SCALAR)


class WheelSettings(SensorSection, frozen=True, kw_only=True):
    """Section `wheel` of trial.yaml."""

    file: str = "wheel.csv"
    speed_std_m_s: Positive = 0.05
    ahead: Vector3 = (0.0, 1.0, 0.0)
    scale_error_std: NonNegative = 0.2


@dataclass(frozen=True)
class Wheel:
    """Settings and record of the wheel."""

    settings: WheelSettings
    time: Array
    speed: Array
    source: str = "wheel"
    label: str = "Wheel"

    section: ClassVar[str] = "wheel"
    section_type: ClassVar[type[SensorSection]] = WheelSettings
    required: ClassVar[tuple[str, ...]] = ("time_s", "speed_m_s")
    optional: ClassVar[tuple[tuple[str, ...], ...]] = ()
    specs: ClassVar[tuple[ParameterSpec, ...]] = (SCALE,)

    @classmethod
    def from_columns(
        cls, settings: WheelSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record that a table holds."""
        return cls(settings, columns["time_s"], columns["speed_m_s"], source)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        return {"time_s": self.time, "speed_m_s": self.speed}

    @property
    def missing(self) -> Array:
        """Rows without a speed."""
        return np.isnan(self.speed)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the scale error."""
        return (Parameter(SCALE, np.zeros(1), np.array([self.settings.scale_error_std])),)

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return the speeds."""
        s = self.settings
        return (WheelSpeed(self.time, self.speed, s.speed_std_m_s, np.array(s.ahead)),)

    def explain(self, parameter: str, component: int, motion: Motion | None) -> str:
        """Say why the scale error could not be observed."""
        return "the wheel stands still"


@dataclass(frozen=True)
class WheelSpeed(PlainObservation):
    """Speed ahead: zero error where measured = (1 + k) aheadᵀ nRbᵀ v_n."""

    time: Array
    measured: Array
    std: float
    ahead: Array
    label: str = "Wheel speed"
    unit: str = "m/s"
    components: tuple[str, ...] = ("ahead",)
    parameters: tuple[str, ...] = (SCALE.name,)
    clock: None = None

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviations, (M, 1)."""
        return np.full((self.time.size, 1), self.std)

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured, (M, 1)."""
        ahead = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n) @ self.ahead
        return ((1.0 + values[SCALE.name]) * ahead - self.measured)[:, None]

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        scale = 1.0 + float(values[SCALE.name][0])
        v_b = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n)
        return Linearization(
            residual=self.residual(motion, values),
            d_theta=scale * self.ahead @ skew(v_b)[:, None],
            d_v=scale * (motion.nRb @ self.ahead)[:, None],
            d_parameters={SCALE.name: (v_b @ self.ahead)[:, None, None]},
        )
