"""The depth sensor: how far it is below the surface of the sea."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from msgspec import UNSET, UnsetType

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array, skew
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.clock import Clock, ClockSection
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    ExpectedCorrelation,
    Linearization,
    Motion,
    Observation,
    PlainObservation,
    SensorSection,
    Values,
    expected_correlation,
)
from factorgraph_dvl.sensors.records import check_range, check_times
from factorgraph_dvl.settings.sections import NonNegative, Positive, Vector3

_SEA_SURFACE = ParameterSpec("sea_surface_height", "m", labels=SCALAR)
SEA_SURFACE_HEIGHT = _SEA_SURFACE.name
# Plausible. Chosen: fresh water for sea water.
_SCALE = ParameterSpec(
    "depth_scale_error",
    labels=SCALAR,
    plausible=0.03,
    of_record=True,
    key="depth: scale_error_std",
)
SCALE_ERROR = _SCALE.name
_CLOCK = Clock.of("depth", prefix="depth_")


class DepthSettings(ClockSection, frozen=True, kw_only=True):
    """Section `depth` of trial.yaml.

    The sea is not the ellipsoid: the geoid leaves it by -107 to 86 m, and tide comes on top. A
    density that is not that of the water makes a scale error; the air pressure and the sensor's
    temperature, an offset that changes slowly.
    """

    file: str = "depth.csv"
    std_m: Positive = 0.1
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    sea_surface_height_m: float = 0.0
    sea_surface_height_std_m: NonNegative = 100.0
    scale_error: float = 0.0
    scale_error_std: NonNegative = 0.0
    correlation_time_s: Positive | UnsetType = UNSET
    correlated_std_m: NonNegative | UnsetType = UNSET


@dataclass(frozen=True)
class Depth:
    """Settings and record of the depth sensor.

    Parameters
    ----------
    settings : DepthSettings
        Section `depth` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    depth : ndarray, shape (M,)
        Depth below the sea surface, positive down, m; nan where not measured.
    source : str, optional
        Name of the file, for messages.
    """

    settings: DepthSettings
    time: Array
    depth: Array
    source: str = "depth"
    label: str = "Depth"

    section: ClassVar[str] = "depth"
    section_type: ClassVar[type[SensorSection]] = DepthSettings
    required: ClassVar[tuple[str, ...]] = ("time_s", "depth_m")
    optional: ClassVar[tuple[tuple[str, ...], ...]] = ()
    specs: ClassVar[tuple[ParameterSpec, ...]] = (_SEA_SURFACE, _SCALE, *_CLOCK.specs)

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        check_range({"depth_m": self.depth}, -100.0, 12e3, "m", self.source)

    @classmethod
    def from_columns(
        cls, settings: DepthSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table."""
        return cls(settings, columns["time_s"], columns["depth_m"], source)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        return {"time_s": self.time, "depth_m": self.depth}

    @property
    def missing(self) -> Array:
        """Rows without a depth, (M,) bool."""
        return np.isnan(self.depth)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the height of the sea surface above the ellipsoid, the scale, and the clock."""
        s = self.settings
        mean, sigma = s.sea_surface_height_m, s.sea_surface_height_std_m
        surface = Parameter(_SEA_SURFACE, np.array([mean]), np.array([sigma]))
        scale = Parameter(_SCALE, np.array([s.scale_error]), np.array([s.scale_error_std]))
        return (surface, scale, *_CLOCK.parameters(s))

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return the depths, where there are any."""
        m = np.logical_not(self.missing)
        if not m.any():
            return ()
        s = self.settings
        arm = np.array(s.lever_arm_m)
        slow = expected_correlation(s.correlation_time_s, s.correlated_std_m, 1)
        return (
            DepthBelowSurface(self.time[m], self.depth[m], s.std_m, arm, frame, correlated=slow),
        )

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why the height of the sea surface or the clock could not be observed."""
        if parameter in _CLOCK.names:
            return message("not_observable.clock_by_depth")
        if parameter == SCALE_ERROR:
            return message("not_observable.depth_scale")
        return message("not_observable.sea_surface")


@dataclass(frozen=True)
class DepthBelowSurface(PlainObservation):
    """Depth of a sensor.

    The error is zero where

        depth = (1 + k) (h_surface - h(p_n + nRb l))

    with h the height above the ellipsoid, of which dh/dp is the upward normal there, and 1 + k
    the ratio of the density of the water to that which the sensor supposes.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the measurements.
    measured : ndarray, shape (M,), m
        Positive down.
    std : float
        Standard deviation, m.
    lever_arm : ndarray, shape (3,)
        IMU to sensor, in body, m.
    frame : LocalFrame
        Frame n.
    correlated : ExpectedCorrelation, optional
        Offset that changes slowly.
    """

    time: Array
    measured: Array
    std: float
    lever_arm: Array
    frame: LocalFrame
    correlated: ExpectedCorrelation | None = None
    label: str = "Depth"
    unit: str = "m"
    components: tuple[str, ...] = ("down",)
    noise_groups: tuple[tuple[int, ...], ...] = ((0,),)
    parameters: tuple[str, ...] = (SEA_SURFACE_HEIGHT, SCALE_ERROR)
    clock: Clock = _CLOCK

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviation, (M, 1), m."""
        return np.full((self.time.size, 1), self.std * factor)

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured, (M, 1), m."""
        return ((1.0 + values[SCALE_ERROR]) * self._depth(motion, values) - self.measured)[:, None]

    def _depth(self, motion: Motion, values: Values) -> Array:
        """Return the depths of the sensor, (M,), m."""
        height = self.frame.geodetic(motion.p_n + motion.nRb @ self.lever_arm)[2]
        return np.asarray(values[SEA_SURFACE_HEIGHT] - height)

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        lat, lon, _ = self.frame.geodetic(motion.p_n + motion.nRb @ self.lever_arm)
        scale = 1.0 + values[SCALE_ERROR]
        up_n = scale * self.frame.level_from_tangent(lat, lon)[:, 2:, :]
        depth = self._depth(motion, values)
        found = {
            SEA_SURFACE_HEIGHT: np.full((self.time.size, 1, 1), scale),
            SCALE_ERROR: depth[:, None, None],
        }
        return Linearization(
            residual=(scale * depth - self.measured)[:, None],
            d_theta=up_n @ motion.nRb @ skew(self.lever_arm),
            d_p=-up_n,
            d_parameters={name: by for name, by in found.items() if name in wanted},
        )
