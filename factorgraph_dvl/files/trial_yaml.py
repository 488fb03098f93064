"""The settings of a trial: `trial.yaml`, format 1."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import msgspec
from msgspec import UNSET, Meta, UnsetType

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.sensors.catalogue import AIDS, PLANAR, aid_types, load_plug_ins
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.sensors.protocol import Aid, NoiseModel, SensorSection
from factorgraph_dvl.settings.certificate import CertificateSettings
from factorgraph_dvl.settings.sections import Positive, Section, Sigma3, check_epoch
from factorgraph_dvl.settings.yaml_file import dump_yaml, parse_yaml

_Pitch = Annotated[float, Meta(ge=-90, le=90)]
_Speed = Annotated[float, Meta(ge=-200, le=200)]


class PositionSettings(Section, frozen=True, kw_only=True):
    """`initial.position` of trial.yaml."""

    lat_deg: float
    lon_deg: float
    height_m: float
    std_m: Sigma3


class VelocitySettings(Section, frozen=True, kw_only=True):
    """`initial.velocity` of trial.yaml."""

    east_north_up_m_s: tuple[_Speed, _Speed, _Speed]
    std_m_s: Sigma3


class InitialSettings(Section, frozen=True, kw_only=True):
    """Section `initial` of trial.yaml."""

    roll_pitch_heading_deg: tuple[float, _Pitch, float] | UnsetType = UNSET
    std_deg: Sigma3 | UnsetType = UNSET
    position: PositionSettings | UnsetType = UNSET
    velocity: VelocitySettings | UnsetType = UNSET

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.roll_pitch_heading_deg is UNSET) != (self.std_deg is UNSET):
            raise ValueError("`roll_pitch_heading_deg` and `std_deg` are given only together")


class ReferenceSettings(Section, frozen=True, kw_only=True):
    """Section `reference` of trial.yaml."""

    file: str = "reference.csv"


class LimitSettings(Section, frozen=True, kw_only=True):
    """Section `limits` of trial.yaml: standard deviations that are good enough."""

    misalignment_deg: Positive | UnsetType = UNSET
    scale_error: Positive | UnsetType = UNSET
    lever_arm_m: Positive | UnsetType = UNSET
    beam_direction_b: Positive | UnsetType = UNSET
    beam_scale_error: Positive | UnsetType = UNSET

    @property
    def stated(self) -> dict[str, float]:
        """Limits by parameter, without those that are unset."""
        found = msgspec.structs.asdict(self)
        return {name: limit for name, limit in found.items() if limit is not UNSET}


class _Settings(Section, frozen=True, kw_only=True):
    format: Literal[1]
    name: str = ""
    body_axes: BodyAxes = "RFU"
    epoch: str = ""
    noise: NoiseModel | UnsetType = UNSET
    imu: ImuSettings | UnsetType = UNSET
    limits: LimitSettings | UnsetType = UNSET
    certificate: CertificateSettings | UnsetType = UNSET
    initial: InitialSettings | UnsetType = UNSET
    reference: ReferenceSettings | UnsetType = UNSET

    def __post_init__(self) -> None:
        super().__post_init__()
        check_epoch(self.epoch)
        given = set(self.aids)
        missing = [kind.section for kind in PLANAR if kind.section not in given]
        if given & {"heading", "log"} and missing:
            raise ValueError(f"missing key `{missing[0]}`")
        if self.imu is UNSET and not {"attitude", "ins", "heading"} & given:
            motion = "missing key `imu`, or in its place `attitude` (AHRS, gyrocompass) or `ins`"
            if not {"dvl", "dvl_beams"} & given:
                motion += "; and missing key `dvl`: positions alone have nothing to calibrate"
            raise ValueError(motion)

    @property
    def aids(self) -> dict[str, SensorSection]:
        """Sections of the sensors other than the IMU, by name."""
        given = {aid.section: getattr(self, aid.section, UNSET) for aid in aid_types()}
        return {name: section for name, section in given.items() if section is not UNSET}


def _with_sections(kinds: tuple[type[Aid], ...]) -> type[_Settings]:
    """Return the settings of trials that may have these sensors."""
    found = msgspec.defstruct(
        "TrialSettings",
        [(kind.section, kind.section_type | UnsetType, UNSET) for kind in kinds],
        bases=(_Settings,),
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
        namespace={"__doc__": "The whole of trial.yaml; sections that are absent are unset."},
    )
    return cast(type[_Settings], found)


if TYPE_CHECKING:

    class TrialSettings(_Settings, frozen=True, kw_only=True):
        """The whole of trial.yaml; sections that are absent are unset."""

        def __init__(self, **sections: Any) -> None: ...

else:
    TrialSettings = _with_sections(AIDS)


# Keys of trial.yaml that are no sections of sensors beside the IMU.
_KEYS = set(_Settings.__struct_fields__)


def settings_type(keys: Iterable[str]) -> type[TrialSettings]:
    """Return the settings of trials with these keys: plug-ins are searched for unknown ones."""
    load_plug_ins(set(keys) - _KEYS)
    kinds = aid_types()
    found = TrialSettings if kinds == AIDS else _with_sections(kinds)
    return cast("type[TrialSettings]", found)


def parse_trial(text: str, source: str) -> TrialSettings:
    """Return the settings in the text of a trial.yaml.

    Raises
    ------
    ConfigError
        As of `parse_yaml`.
    """
    keys = parse_yaml(text, dict[str, Any], source=source)
    kind = settings_type(keys)
    try:
        return parse_yaml(text, kind, source=source)
    except ConfigError as error:
        unknown = [
            k for k in keys if k not in kind.__struct_fields__ and isinstance(keys[k], dict)
        ]
        if not unknown or error.hint:
            raise
        raise ConfigError(
            error.what,
            where=error.where,
            expected=error.expected,
            hint=f"If `{unknown[0]}` is a sensor of another package, install that package",
        ) from None


def to_yaml(settings: TrialSettings) -> str:
    """Return the text of trial.yaml."""
    return dump_yaml({k: v for k, v in msgspec.to_builtins(settings).items() if v != ""})
