"""The simulated sensors: when they measure, and with which errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from factorgraph_dvl.sensors.depth import DepthSettings
from factorgraph_dvl.sensors.dvl import DvlSettings
from factorgraph_dvl.sensors.gnss import GnssSettings
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.sensors.protocol import (
    NonNegative,
    Positive,
    Section,
    SensorSection,
    Sigma3,
    Vector3,
)
from factorgraph_dvl.sensors.star import StarSettings

Interval = tuple[float, float]


class Sampled(Section, frozen=True, kw_only=True):
    """When a sensor measures: at phase_s + k / rate_hz, each shifted by at most jitter_s."""

    rate_hz: Positive
    phase_s: NonNegative = 0.0
    jitter_s: NonNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.phase_s >= 1.0 / self.rate_hz:
            raise ValueError("`phase_s` must be below one period, 1 / rate_hz")
        if self.jitter_s >= 0.5 / self.rate_hz:
            raise ValueError("`jitter_s` must be below half a period, 0.5 / rate_hz")


class Instrument(Sampled, frozen=True, kw_only=True):
    """A simulated sensor, and what trial.yaml claims of it unless told otherwise."""

    section_type: ClassVar[type[SensorSection]]

    def claimed(self) -> dict[str, Any]:
        """Return keys of the sensor's section of trial.yaml, as simulated."""
        raise NotImplementedError


class ImuTruth(Instrument, frozen=True, kw_only=True):
    """The simulated IMU; `draw` takes a bias from N(0, std²), anew for each seed."""

    section_type: ClassVar[type[SensorSection]] = ImuSettings

    sampling: Literal["mean", "instantaneous"] = "mean"
    gaps_s: tuple[Interval, ...] = ()
    gyro_bias_deg_h: Vector3 | Literal["draw"] = (0.0, 0.0, 0.0)
    gyro_bias_std_deg_h: Positive | None = None
    gyro_bias_walk_deg_h_sqrt_h: NonNegative = 0.0
    gyro_noise_deg_sqrt_h: NonNegative = 0.0
    accel_bias_ug: Vector3 | Literal["draw"] = (0.0, 0.0, 0.0)
    accel_bias_std_ug: Positive | None = None
    accel_bias_walk_ug_sqrt_h: NonNegative = 0.0
    accel_noise_ug_sqrt_hz: NonNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_intervals("gaps_s", self.gaps_s)
        if self.gyro_bias_deg_h == "draw" and self.gyro_bias_std_deg_h is None:
            raise ValueError("`gyro_bias_deg_h: draw` needs `gyro_bias_std_deg_h`")
        if self.accel_bias_ug == "draw" and self.accel_bias_std_ug is None:
            raise ValueError("`accel_bias_ug: draw` needs `accel_bias_std_ug`")

    def claimed(self) -> dict[str, Any]:
        """Return sampling, noise and bias as simulated."""
        names = (
            "sampling",
            "gyro_noise_deg_sqrt_h",
            "gyro_bias_walk_deg_h_sqrt_h",
            "gyro_bias_std_deg_h",
            "accel_noise_ug_sqrt_hz",
            "accel_bias_walk_ug_sqrt_h",
            "accel_bias_std_ug",
        )
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}


class GnssTruth(Instrument, frozen=True, kw_only=True):
    """The simulated receiver; without velocity_std_m_s it measures no velocity."""

    section_type: ClassVar[type[SensorSection]] = GnssSettings

    position_std_m: Sigma3
    velocity_std_m_s: Sigma3 | None = None
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    outages_s: tuple[Interval, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_intervals("outages_s", self.outages_s)

    def claimed(self) -> dict[str, Any]:
        """Return noise and antenna lever arm as simulated."""
        out: dict[str, Any] = {
            "position_std_m": self.position_std_m,
            "lever_arm_m": self.lever_arm_m,
        }
        if self.velocity_std_m_s is not None:
            out["velocity_std_m_s"] = self.velocity_std_m_s
        return out


class DvlTruth(Instrument, frozen=True, kw_only=True):
    """The simulated DVL; the noise variance is floor² + (fraction · |v|)²."""

    section_type: ClassVar[type[SensorSection]] = DvlSettings

    misalignment_deg: Vector3 = (0.0, 0.0, 0.0)
    scale_error: float | Vector3 = 0.0
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    bias_m_s: Vector3 = (0.0, 0.0, 0.0)
    time_offset_s: float = 0.0
    velocity_std_m_s: NonNegative = 0.0
    velocity_std_fraction: NonNegative = 0.0
    reference: Literal["bottom", "water"] = "bottom"
    no_lock_s: tuple[Interval, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_intervals("no_lock_s", self.no_lock_s)
        if np.any(np.atleast_1d(self.scale_error) <= -1.0):
            raise ValueError("`scale_error` must be above -1")

    def claimed(self) -> dict[str, Any]:
        """Return noise and the kind of lock as simulated; the mounting is to be found."""
        names = ("velocity_std_m_s", "velocity_std_fraction", "reference")
        return {name: getattr(self, name) for name in names}


class StarTruth(Instrument, frozen=True, kw_only=True):
    """The simulated star tracker; with `stars` it reports their directions."""

    section_type: ClassVar[type[SensorSection]] = StarSettings

    std_arcsec: float | Vector3
    mounting_deg: Vector3 = (0.0, 0.0, 0.0)
    ut1_utc_s: Annotated[float, msgspec.Meta(ge=-1, le=1)] = 0.0
    stars: tuple[Vector3, ...] = ()
    outages_s: tuple[Interval, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_intervals("outages_s", self.outages_s)
        if np.min(self.std_arcsec) <= 0.0:
            raise ValueError("`std_arcsec` must be above 0")
        if self.stars and np.ndim(self.std_arcsec) != 0:
            raise ValueError("`std_arcsec` must be one number where there are `stars`")
        if any(not any(star) for star in self.stars):
            raise ValueError("`stars` must hold directions, none of them zero")

    def claimed(self) -> dict[str, Any]:
        """Return noise, mounting and UT1 - UTC as simulated."""
        names = ("std_arcsec", "mounting_deg", "ut1_utc_s")
        return {name: getattr(self, name) for name in names}


class DepthTruth(Instrument, frozen=True, kw_only=True):
    """The simulated depth sensor; the sea surface is at a height above the ellipsoid."""

    section_type: ClassVar[type[SensorSection]] = DepthSettings

    std_m: NonNegative = 0.0
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    sea_surface_height_m: float = 0.0

    def claimed(self) -> dict[str, Any]:
        """Return noise and lever arm as simulated; the height of the sea is to be found."""
        out: dict[str, Any] = {"lever_arm_m": self.lever_arm_m}
        return out | ({"std_m": self.std_m} if self.std_m > 0.0 else {})


def check_intervals(name: str, intervals: Sequence[Interval]) -> None:
    """Raise ValueError unless all intervals begin before they end."""
    for start, end in intervals:
        if not start <= end:
            raise ValueError(f"`{name}` must hold pairs [start, end] with start <= end")
