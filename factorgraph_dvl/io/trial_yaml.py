"""The settings of a trial: `trial.yaml`, format 1."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

from factorgraph_dvl.conventions import BodyAxes
from factorgraph_dvl.sensors.dvl import DvlSettings
from factorgraph_dvl.sensors.gnss import GnssSettings
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.sensors.protocol import Section, Sigma3

UNUSED_SECTIONS = ("depth", "star", "dvl_beams", "turntable", "beacons")

_Latitude = Annotated[float, Meta(ge=-90, le=90)]
_Longitude = Annotated[float, Meta(ge=-360, le=360)]
_Height = Annotated[float, Meta(ge=-12e3, le=20e3)]
_Turn = Annotated[float, Meta(ge=-360, le=360)]
_Pitch = Annotated[float, Meta(ge=-90, le=90)]


class PositionSettings(Section, frozen=True, kw_only=True):
    """`initial.position` of trial.yaml."""

    lat_deg: _Latitude
    lon_deg: _Longitude
    height_m: _Height
    std_m: Sigma3


class InitialSettings(Section, frozen=True, kw_only=True):
    """Section `initial` of trial.yaml."""

    roll_pitch_heading_deg: tuple[_Turn, _Pitch, _Turn] | UnsetType = UNSET
    std_deg: Sigma3 | UnsetType = UNSET
    position: PositionSettings | UnsetType = UNSET

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.roll_pitch_heading_deg is UNSET) != (self.std_deg is UNSET):
            raise ValueError("`roll_pitch_heading_deg` and `std_deg` are given only together")


class ReferenceSettings(Section, frozen=True, kw_only=True):
    """Section `reference` of trial.yaml."""

    file: str = "reference.csv"


class TrialSettings(Section, frozen=True, kw_only=True):
    """The whole of trial.yaml; sections that are absent are unset."""

    format: Literal[1]
    name: str = ""
    body_axes: BodyAxes = "RFU"
    epoch: str = ""
    imu: ImuSettings
    gnss: GnssSettings | UnsetType = UNSET
    dvl: DvlSettings | UnsetType = UNSET
    depth: dict[str, Any] | UnsetType = UNSET
    star: dict[str, Any] | UnsetType = UNSET
    dvl_beams: dict[str, Any] | UnsetType = UNSET
    turntable: dict[str, Any] | UnsetType = UNSET
    beacons: dict[str, Any] | UnsetType = UNSET
    initial: InitialSettings | UnsetType = UNSET
    reference: ReferenceSettings | UnsetType = UNSET

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.epoch:
            try:
                datetime.fromisoformat(self.epoch)
            except ValueError:
                raise ValueError(
                    "`epoch` must be a date and time such as 2022-10-12T02:00:00Z"
                ) from None

    @property
    def unused(self) -> tuple[str, ...]:
        """Sections that are given, but that this version does not use."""
        return tuple(name for name in UNUSED_SECTIONS if getattr(self, name) is not UNSET)


def to_yaml(settings: TrialSettings) -> str:
    """Return the text of trial.yaml."""
    import yaml

    plain = {k: v for k, v in msgspec.to_builtins(settings).items() if v != ""}
    return yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, default_flow_style=None)
