"""The simulated sensors of navigation by beacons: compass, log and ranging."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import msgspec

from factorgraph_dvl.sensors.beacon import BeaconPosition, BeaconSettings
from factorgraph_dvl.sensors.protocol import SensorSection
from factorgraph_dvl.sensors.speed_log import HeadingSettings, LogSettings
from factorgraph_dvl.settings.sections import NonNegative, Vector3
from factorgraph_dvl.simulation.instruments import Interval, SimulatedInstrument, check_intervals


class HeadingTruth(SimulatedInstrument, frozen=True, kw_only=True):
    """The simulated compass; `draw` takes its bias from N(0, std²), anew for each seed."""

    section_type: ClassVar[type[SensorSection]] = HeadingSettings

    std_deg: NonNegative = 0.0
    bias_deg: float | Literal["draw"] = 0.0
    bias_std_deg: NonNegative = 0.0

    def claimed(self) -> dict[str, Any]:
        """Return noise and bias as simulated."""
        out: dict[str, Any] = {"bias_std_deg": self.bias_std_deg}
        return out | ({"std_deg": self.std_deg} if self.std_deg > 0.0 else {})


class LogTruth(SimulatedInstrument, frozen=True, kw_only=True):
    """The simulated log; `draw` takes its scale error from N(0, std²), anew for each seed."""

    section_type: ClassVar[type[SensorSection]] = LogSettings

    speed_std_m_s: NonNegative = 0.0
    scale_error: float | Literal["draw"] = 0.0
    scale_error_std: NonNegative = 0.0
    reference: Literal["water", "bottom"] = "water"

    def claimed(self) -> dict[str, Any]:
        """Return noise, scale error and reference as simulated."""
        out = {"scale_error_std": self.scale_error_std, "reference": self.reference}
        return out | ({"speed_std_m_s": self.speed_std_m_s} if self.speed_std_m_s > 0.0 else {})


class BeaconTruth(SimulatedInstrument, frozen=True, kw_only=True):
    """The simulated ranging; beacons are asked in turn.

    `positions` are the true places but for `std_m`: each seed draws a place around the
    stated one. A range is lost with probability `missed`, and longer by a uniform draw from
    `multipath_m` with probability `multipath`. `sound_speed_error: draw` takes it from
    N(0, std²).
    """

    section_type: ClassVar[type[SensorSection]] = BeaconSettings

    positions: dict[str, BeaconPosition]
    range_std_m: NonNegative = 0.0
    range_rate_std_m_s: NonNegative | None = None
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    sound_speed_error: float | Literal["draw"] = 0.0
    sound_speed_error_std: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.0
    missed: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    multipath: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    multipath_m: tuple[float, float] = (10.0, 50.0)
    outages_s: tuple[Interval, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_intervals("outages_s", self.outages_s)
        check_intervals("multipath_m", (self.multipath_m,))

    def claimed(self) -> dict[str, Any]:
        """Return noise, places and lever arm as simulated."""
        out: dict[str, Any] = {
            "positions": msgspec.to_builtins(self.positions),
            "lever_arm_m": self.lever_arm_m,
            "sound_speed_error_std": self.sound_speed_error_std,
        }
        if self.range_std_m > 0.0:
            out["range_std_m"] = self.range_std_m
        if self.range_rate_std_m_s:
            out["range_rate_std_m_s"] = self.range_rate_std_m_s
        return out
