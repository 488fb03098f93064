"""What a certificate of a calibration states of vessel, place and instruments."""

from __future__ import annotations

from typing import Annotated, Any

from msgspec import UNSET, Meta, Struct, UnsetType

from factorgraph_dvl.settings.sections import Section

# Serial numbers and versions may look like numbers.
_Text = str | int | float


class InstrumentSettings(Section, frozen=True, kw_only=True):
    """An instrument of `certificate`."""

    maker: _Text | UnsetType = UNSET
    model: _Text | UnsetType = UNSET
    serial: _Text | UnsetType = UNSET
    firmware: _Text | UnsetType = UNSET
    settings: _Text | dict[str, Any] | UnsetType = UNSET


# No `Section`: the ranges of `Section` hold for speeds of vessels, not of sound.
class WaterSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Water of `certificate`."""

    temperature_c: Annotated[float, Meta(ge=-5, le=50)] | UnsetType = UNSET
    salinity_psu: Annotated[float, Meta(ge=0, le=350)] | UnsetType = UNSET
    sound_speed_m_s: Annotated[float, Meta(ge=1300, le=1700)] | UnsetType = UNSET


class CertificateSettings(Section, frozen=True, kw_only=True):
    """Section `certificate` of trial.yaml: printed, and never used to solve."""

    vessel: _Text | UnsetType = UNSET
    date: _Text | UnsetType = UNSET
    place: _Text | UnsetType = UNSET
    operator: _Text | UnsetType = UNSET
    client: _Text | UnsetType = UNSET
    project: _Text | UnsetType = UNSET
    dvl: InstrumentSettings | UnsetType = UNSET
    imu: InstrumentSettings | UnsetType = UNSET
    gnss: InstrumentSettings | UnsetType = UNSET
    water: WaterSettings | UnsetType = UNSET
