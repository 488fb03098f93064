"""The simulated sensors: when they measure, and with which errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal, Protocol

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.sensors.depth import DepthSettings
from factorgraph_dvl.sensors.dvl import DvlSettings
from factorgraph_dvl.sensors.dvl_beams import DvlBeamsSettings
from factorgraph_dvl.sensors.gnss import GnssSettings
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.sensors.protocol import SensorSection
from factorgraph_dvl.sensors.star import StarSettings
from factorgraph_dvl.sensors.turntable import TurntableSettings
from factorgraph_dvl.settings.sections import NonNegative, Positive, Section, Sigma3, Vector3

Interval = tuple[float, float]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Draw = Literal["draw"]
# Elements of a matrix by rows: off the diagonal, and all.
_OffDiagonal = tuple[float, float, float, float, float, float]
_Matrix = tuple[Vector3, Vector3, Vector3]


class ScenarioView(Protocol):
    """What the motion and the instruments read of a scenario; sections by their names."""

    @property
    def body_axes(self) -> BodyAxes:
        """Axes of the body quantities."""

    @property
    def noise(self) -> bool:
        """Whether there is noise."""

    @property
    def current_m_s(self) -> Vector3:
        """Current east, north, up, m/s."""

    @property
    def source(self) -> str:
        """Name of the file, for messages."""

    def settings(self, section: str) -> SensorSection:
        """Return a sensor's section of the trial."""

    def __getattr__(self, section: str) -> Any: ...


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


class SimulatedInstrument(Sampled, frozen=True, kw_only=True):
    """A simulated sensor, and the settings of trial.yaml that follow from it by default."""

    section_type: ClassVar[type[SensorSection]]

    def claimed(self) -> dict[str, Any]:
        """Return keys of the sensor's section of trial.yaml, as simulated."""
        raise NotImplementedError


class ClockedInstrument(SimulatedInstrument, frozen=True, kw_only=True):
    """A simulated sensor whose stamps are late by an offset, and run fast by a rate."""

    # Errors that may be drawn, and the keys of the standard deviations that this takes.
    drawn: ClassVar[dict[str, str]] = {"time_offset_s": "time_offset_std_s"}

    time_offset_s: float | Draw = 0.0
    time_offset_std_s: Positive | None = None
    clock_rate_ppm: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, std in self.drawn.items():
            if getattr(self, name) == "draw" and getattr(self, std) is None:
                raise ValueError(f"`{name}: draw` needs `{std}`")


class Outliers(Section, frozen=True, kw_only=True):
    """Gross errors of a share of the measurements, so many stated standard deviations long."""

    share: Share
    sigmas: tuple[NonNegative, NonNegative] = (10.0, 100.0)


class Jumps(Section, frozen=True, kw_only=True):
    """Positions that jump aside for a while, as a receiver's do under a bridge."""

    size_m: Positive = 10.0
    duration_s: Positive = 30.0
    count: Annotated[int, msgspec.Meta(ge=1)] = 3


class MovingWater(Section, frozen=True, kw_only=True):
    """A current that changes with time and place about its mean."""

    std_m_s: Positive
    correlation_time_s: Positive = 3600.0
    correlation_distance_m: Positive = 1e4


class FalseLock(Section, frozen=True, kw_only=True):
    """A lock on something that moves, such as a layer of fish, for a while."""

    speed_m_s: Positive = 0.3
    duration_s: Positive = 60.0


class ImuTruth(ClockedInstrument, frozen=True, kw_only=True):
    """The simulated IMU; `draw` takes an error from N(0, std²), anew for each seed."""

    section_type: ClassVar[type[SensorSection]] = ImuSettings
    # Errors of the samples that grow with rate and force.
    matrices: ClassVar[dict[str, str]] = {
        "gyro_scale_ppm": "gyro_scale_std_ppm",
        "gyro_misalignment_deg": "gyro_misalignment_std_deg",
        "gyro_g_sensitivity_deg_h_g": "gyro_g_sensitivity_std_deg_h_g",
        "accel_scale_ppm": "accel_scale_std_ppm",
        "accel_misalignment_deg": "accel_misalignment_std_deg",
    }
    drawn: ClassVar[dict[str, str]] = {
        **ClockedInstrument.drawn,
        **matrices,
        "gyro_bias_deg_h": "gyro_bias_std_deg_h",
        "accel_bias_ug": "accel_bias_std_ug",
    }

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
    gyro_scale_ppm: Vector3 | Draw = (0.0, 0.0, 0.0)
    gyro_scale_std_ppm: Positive | None = None
    gyro_misalignment_deg: _OffDiagonal | Draw = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    gyro_misalignment_std_deg: Positive | None = None
    gyro_g_sensitivity_deg_h_g: _Matrix | Draw = ((0.0, 0.0, 0.0),) * 3
    gyro_g_sensitivity_std_deg_h_g: Positive | None = None
    accel_scale_ppm: Vector3 | Draw = (0.0, 0.0, 0.0)
    accel_scale_std_ppm: Positive | None = None
    accel_misalignment_deg: Vector3 | Draw = (0.0, 0.0, 0.0)
    accel_misalignment_std_deg: Positive | None = None
    gravity_deflection_std_arcsec: NonNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_intervals("gaps_s", self.gaps_s)

    def claimed(self) -> dict[str, Any]:
        """Return sampling, noise, and standard deviations of errors as simulated."""
        names = (
            "sampling",
            "gyro_noise_deg_sqrt_h",
            "gyro_bias_walk_deg_h_sqrt_h",
            "gyro_bias_std_deg_h",
            "accel_noise_ug_sqrt_hz",
            "accel_bias_walk_ug_sqrt_h",
            "accel_bias_std_ug",
            "gravity_deflection_std_arcsec",
            *self.matrices.values(),
        )
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}


class GnssTruth(ClockedInstrument, frozen=True, kw_only=True):
    """The simulated receiver; without velocity_std_m_s it measures no velocity.

    Shares are those of the variance of position and velocity that belong to a first-order
    Gauss-Markov process; the rest is white.
    """

    section_type: ClassVar[type[SensorSection]] = GnssSettings
    drawn: ClassVar[dict[str, str]] = {
        **ClockedInstrument.drawn,
        "lever_arm_error_m": "lever_arm_error_std_m",
    }

    position_std_m: Sigma3
    velocity_std_m_s: Sigma3 | None = None
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    lever_arm_error_m: Vector3 | Draw = (0.0, 0.0, 0.0)
    lever_arm_error_std_m: Positive | None = None
    correlated_share: Share = 0.0
    correlation_time_s: float | Vector3 = 100.0
    velocity_correlated_share: Share = 0.0
    velocity_correlation_time_s: float | Vector3 = 2.0
    velocity_delay_s: float = 0.0
    velocity_averaging_s: NonNegative = 0.0
    outliers: Outliers | None = None
    jumps: Jumps | None = None
    outages_s: tuple[Interval, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_intervals("outages_s", self.outages_s)
        for name in ("correlation_time_s", "velocity_correlation_time_s"):
            if np.min(getattr(self, name)) <= 0.0:
                raise ValueError(f"`{name}` must be above 0")

    def claimed(self) -> dict[str, Any]:
        """Return noise and antenna lever arm as simulated; its error comes on top."""
        out: dict[str, Any] = {
            "position_std_m": self.position_std_m,
            "lever_arm_m": self.lever_arm_m,
        }
        if self.velocity_std_m_s is not None:
            out["velocity_std_m_s"] = self.velocity_std_m_s
        return out


class DvlTruth(ClockedInstrument, frozen=True, kw_only=True):
    """The simulated DVL; the noise variance is floor² + (fraction · |v|)²."""

    section_type: ClassVar[type[SensorSection]] = DvlSettings
    drawn: ClassVar[dict[str, str]] = {
        **ClockedInstrument.drawn,
        "bias_m_s": "bias_std_m_s",
    }

    misalignment_deg: Vector3 = (0.0, 0.0, 0.0)
    scale_error: float | Vector3 = 0.0
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    bias_m_s: Vector3 | Draw = (0.0, 0.0, 0.0)
    bias_std_m_s: Positive | None = None
    velocity_std_m_s: NonNegative = 0.0
    velocity_std_fraction: NonNegative = 0.0
    correlated_share: Share = 0.0
    correlation_time_s: Positive = 5.0
    scale_drift: float = 0.0
    scale_walk_sqrt_h: NonNegative = 0.0
    averaging_s: NonNegative = 0.0
    outliers: Outliers | None = None
    false_lock: FalseLock | None = None
    reference: Literal["bottom", "water"] = "bottom"
    moving_water: MovingWater | None = None
    no_lock_s: tuple[Interval, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_intervals("no_lock_s", self.no_lock_s)
        if np.any(np.atleast_1d(self.scale_error) <= -1.0):
            raise ValueError("`scale_error` must be above -1")

    def claimed(self) -> dict[str, Any]:
        """Return noise and the kind of lock as simulated, but not the mounting."""
        names = ("velocity_std_m_s", "velocity_std_fraction", "reference")
        return {name: getattr(self, name) for name in names}


class StarTruth(SimulatedInstrument, frozen=True, kw_only=True):
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
            raise ValueError("`stars` must contain directions, none of them zero")

    def claimed(self) -> dict[str, Any]:
        """Return noise, mounting and UT1 - UTC as simulated."""
        names = ("std_arcsec", "mounting_deg", "ut1_utc_s")
        return {name: getattr(self, name) for name in names}


class DepthTruth(SimulatedInstrument, frozen=True, kw_only=True):
    """The simulated depth sensor; the sea surface is at a height above the ellipsoid."""

    section_type: ClassVar[type[SensorSection]] = DepthSettings

    std_m: NonNegative = 0.0
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    sea_surface_height_m: float = 0.0
    scale_error: float | Draw = 0.0
    scale_error_std: NonNegative = 0.0
    correlated_std_m: NonNegative = 0.0
    correlation_time_s: Positive = 1000.0

    def claimed(self) -> dict[str, Any]:
        """Return noise and lever arm as simulated, but no height of the sea surface or scale."""
        out: dict[str, Any] = {"lever_arm_m": self.lever_arm_m}
        if self.scale_error_std > 0.0:
            out["scale_error_std"] = self.scale_error_std
        if self.correlated_std_m > 0.0:
            out |= {
                "correlated_std_m": self.correlated_std_m,
                "correlation_time_s": self.correlation_time_s,
            }
        return out | ({"std_m": self.std_m} if self.std_m > 0.0 else {})


class LostBeam(Section, frozen=True, kw_only=True):
    """A beam, counted from 1, that is lost for a while."""

    beam: Annotated[int, msgspec.Meta(ge=1)]
    from_s: float
    to_s: float


class DvlBeamsTruth(ClockedInstrument, frozen=True, kw_only=True):
    """The simulated beams; `draw` takes errors anew for each seed, evenly up to a limit.

    The noise variance of a beam is floor² + (fraction · its velocity)².
    """

    section_type: ClassVar[type[SensorSection]] = DvlBeamsSettings

    directions: tuple[Vector3, ...] | UnsetType = UNSET
    slant_azimuth_deg: tuple[tuple[float, float], ...] | UnsetType = UNSET
    alpha_theta_deg: tuple[tuple[float, float], ...] | UnsetType = UNSET
    misalignment_deg: Vector3 = (0.0, 0.0, 0.0)
    direction_error_deg: Literal["draw"] | tuple[tuple[float, float], ...] = ()
    direction_error_up_to_deg: Positive | None = None
    scale_error: Literal["draw"] | tuple[float, ...] = ()
    scale_error_up_to: Positive | None = None
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    velocity_std_m_s: NonNegative = 0.0
    velocity_std_fraction: NonNegative = 0.0
    averaging_s: NonNegative = 0.0
    no_lock_s: tuple[Interval, ...] = ()
    lost: tuple[LostBeam, ...] = ()
    lost_fraction: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_intervals("no_lock_s", self.no_lock_s)
        n = len(self.nominal.nominal_d)
        for name, limit in (
            ("direction_error_deg", "direction_error_up_to_deg"),
            ("scale_error", "scale_error_up_to"),
        ):
            value = getattr(self, name)
            if value == "draw" and getattr(self, limit) is None:
                raise ValueError(f"`{name}: draw` needs `{limit}`")
            if value != "draw" and len(value) not in (0, n):
                raise ValueError(f"`{name}` must have {n} entries, one for each beam")
        if any(item.beam > n for item in self.lost):
            raise ValueError(f"`lost` must name beams from 1 to {n}")

    @property
    def nominal(self) -> DvlBeamsSettings:
        """Nominal directions, as in trial.yaml."""
        return DvlBeamsSettings(
            directions=self.directions,
            slant_azimuth_deg=self.slant_azimuth_deg,
            alpha_theta_deg=self.alpha_theta_deg,
            misalignment_deg=self.misalignment_deg,
        )

    def claimed(self) -> dict[str, Any]:
        """Return nominal directions and misalignment, and noise, as simulated."""
        ways = ("directions", "slant_azimuth_deg", "alpha_theta_deg")
        names = ("misalignment_deg", "velocity_std_m_s", "velocity_std_fraction")
        given = [name for name in ways if getattr(self, name) is not UNSET]
        return {name: getattr(self, name) for name in (*given, *names)}


class TableTurn(Section, frozen=True, kw_only=True):
    """A turn of the turntable, counter-clockwise seen from above where positive."""

    at_s: NonNegative
    turn_deg: float
    duration_s: Positive
    ramp_s: NonNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if 2.0 * self.ramp_s > self.duration_s:
            raise ValueError("`ramp_s` must not exceed half of `duration_s`")


class TurntableTruth(SimulatedInstrument, frozen=True, kw_only=True):
    """The turntable that carries IMU and DVL, and when it turns; it reports without error."""

    section_type: ClassVar[type[SensorSection]] = TurntableSettings

    start_deg: float = 0.0
    turns: tuple[TableTurn, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        ends = [turn.at_s + turn.duration_s for turn in self.turns]
        if any(turn.at_s < end for turn, end in zip(self.turns[1:], ends, strict=False)):
            raise ValueError("`turns` must follow one another")

    def claimed(self) -> dict[str, Any]:
        """Return nothing: the trial contains the angle."""
        return {}


def check_intervals(name: str, intervals: Sequence[Interval]) -> None:
    """Raise ValueError unless all intervals begin before they end."""
    for start, end in intervals:
        if not start <= end:
            raise ValueError(f"`{name}` must contain pairs [start, end] with start <= end")
