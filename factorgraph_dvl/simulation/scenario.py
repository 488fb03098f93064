"""Scenarios: what a simulated trial is, as typed settings read from YAML.

```yaml
name: harbour
body_axes: RFU                     # or FRD, FLU
noise: true                        # false: exact measurements, constant biases only
reference_rate_hz: 10
start: {lat_deg: 36, lon_deg: 121, height_m: 0, heading_deg: 0, speed_m_s: 0}
manoeuvres:                        # one after the other
  - {accelerate_m_s2: 1, to_m_s: 4}
  - {straight_s: 100}
  - {turn_deg_s: -2, duration_s: 45, ramp_s: 3}   # positive to starboard
  - {repeat: 2, manoeuvres: [{straight_s: 10}, {turn_deg_s: 9, duration_s: 20}]}
sway:                              # amplitude · sin(2 pi frequency · t + phase), summed
  roll: [{amplitude_deg: 4, frequency_hz: 2, phase_deg: 0}]
  pitch: []
  yaw: []                          # of the bow about the course
  heave: [{amplitude_m: 0.3, frequency_hz: 0.12, phase_deg: 0}]
current_m_s: [0.1, 0.1, 0]         # east, north, up
imu: {...}                         # ImuTruth: rate, errors
gnss: {...}                        # GnssTruth, optional
dvl: {...}                         # DvlTruth, optional
trial:                             # what trial.yaml will claim
  imu: {gyro_bias_std_deg_h: 0.05, accel_bias_std_ug: 100}
  gnss: {}
  dvl: {velocity_std_m_s: 0.001}
  initial: {attitude_error_deg: [0.5, 0.5, 2], attitude_std_deg: [0.5, 0.5, 2]}
```

A turn with a ramp builds its rate up over `ramp_s` and down again; it turns by
turn_deg_s · duration_s all the same, and takes duration_s + ramp_s. The `trial` sections
take every key that trial.yaml knows; what they leave out about noise, antenna lever arm
and sampling is claimed as simulated.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
import yaml

from factorgraph_dvl.conventions import BodyAxes
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.sensors.dvl import DvlSettings
from factorgraph_dvl.sensors.gnss import GnssSettings
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.sensors.protocol import NonNegative, Positive, Section, Sigma3, Vector3

Latitude = Annotated[float, msgspec.Meta(ge=-89, le=89)]
Longitude = Annotated[float, msgspec.Meta(ge=-360, le=360)]
Interval = tuple[float, float]
_T = TypeVar("_T")
# More than any trial has, far fewer than would exhaust memory.
_MAX_MANOEUVRES = 100_000


class Start(Section, frozen=True, kw_only=True):
    """Where and how the vehicle is at time zero."""

    lat_deg: Latitude
    lon_deg: Longitude
    height_m: float = 0.0
    heading_deg: float = 0.0
    speed_m_s: NonNegative = 0.0


class Accelerate(Section, frozen=True, kw_only=True):
    """Change the speed through the water at a constant rate."""

    accelerate_m_s2: float
    to_m_s: NonNegative


class Straight(Section, frozen=True, kw_only=True):
    """Keep speed and heading."""

    straight_s: Positive


class Turn(Section, frozen=True, kw_only=True):
    """Turn by turn_deg_s · duration_s, to starboard where positive."""

    turn_deg_s: float
    duration_s: Positive
    ramp_s: NonNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ramp_s > self.duration_s:
            raise ValueError("`ramp_s` must not exceed `duration_s`")


class Repeat(Section, frozen=True, kw_only=True):
    """Run a list of manoeuvres several times."""

    repeat: Annotated[int, msgspec.Meta(ge=1)]
    manoeuvres: list[dict[str, Any]]


Manoeuvre = Accelerate | Straight | Turn
_MANOEUVRES: dict[str, type[Accelerate | Straight | Turn | Repeat]] = {
    "accelerate_m_s2": Accelerate,
    "straight_s": Straight,
    "turn_deg_s": Turn,
    "repeat": Repeat,
}


class AngularSway(Section, frozen=True, kw_only=True):
    """A sinusoid of an angle."""

    amplitude_deg: float
    frequency_hz: Positive
    phase_deg: float = 0.0


class Heave(Section, frozen=True, kw_only=True):
    """A sinusoid of the height."""

    amplitude_m: float
    frequency_hz: Positive
    phase_deg: float = 0.0


class SwaySettings(Section, frozen=True, kw_only=True):
    """What the sea does to the vehicle."""

    roll: tuple[AngularSway, ...] = ()
    pitch: tuple[AngularSway, ...] = ()
    yaw: tuple[AngularSway, ...] = ()
    heave: tuple[Heave, ...] = ()


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


class ImuTruth(Sampled, frozen=True, kw_only=True):
    """The simulated IMU; `draw` takes a bias from N(0, std²), anew for each seed."""

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
        _check_intervals("gaps_s", self.gaps_s)
        if self.gyro_bias_deg_h == "draw" and self.gyro_bias_std_deg_h is None:
            raise ValueError("`gyro_bias_deg_h: draw` needs `gyro_bias_std_deg_h`")
        if self.accel_bias_ug == "draw" and self.accel_bias_std_ug is None:
            raise ValueError("`accel_bias_ug: draw` needs `accel_bias_std_ug`")


class GnssTruth(Sampled, frozen=True, kw_only=True):
    """The simulated receiver; without velocity_std_m_s it measures no velocity."""

    position_std_m: Sigma3
    velocity_std_m_s: Sigma3 | None = None
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    outages_s: tuple[Interval, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_intervals("outages_s", self.outages_s)


class DvlTruth(Sampled, frozen=True, kw_only=True):
    """The simulated DVL; the noise variance is floor² + (fraction · |v|)²."""

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
        _check_intervals("no_lock_s", self.no_lock_s)
        if np.any(np.atleast_1d(self.scale_error) <= -1.0):
            raise ValueError("`scale_error` must be above -1")


class InitialClaim(Section, frozen=True, kw_only=True):
    """Priors at the first IMU sample: the truth plus an error. No std = no such prior."""

    attitude_error_deg: Vector3 = (0.0, 0.0, 0.0)
    attitude_std_deg: tuple[Positive, Positive, Positive] | None = None
    position_error_m: Vector3 = (0.0, 0.0, 0.0)
    position_std_m: tuple[Positive, Positive, Positive] | None = None


class Claims(Section, frozen=True, kw_only=True):
    """What trial.yaml will say; sensor sections as in trial.yaml."""

    imu: dict[str, Any] = msgspec.field(default_factory=dict)
    gnss: dict[str, Any] = msgspec.field(default_factory=dict)
    dvl: dict[str, Any] = msgspec.field(default_factory=dict)
    initial: InitialClaim | None = None


class Scenario(Section, frozen=True, kw_only=True):
    """A simulated trial; see the module's docstring for the file."""

    name: str
    body_axes: BodyAxes = "RFU"
    noise: bool = True
    reference_rate_hz: Positive = 10.0
    start: Start
    manoeuvres: list[dict[str, Any]]
    sway: SwaySettings = SwaySettings()
    current_m_s: Vector3 = (0.0, 0.0, 0.0)
    imu: ImuTruth
    gnss: GnssTruth | None = None
    dvl: DvlTruth | None = None
    trial: Claims = Claims()
    source: str = "scenario"

    def plan(self) -> list[Manoeuvre]:
        """Return the manoeuvres with repetitions written out.

        Raises
        ------
        ConfigError
            If one is not valid.
        """
        return _flatten(self.manoeuvres, "manoeuvres", self.source)

    def imu_settings(self) -> ImuSettings:
        """Return section `imu` of the trial."""
        simulated: dict[str, Any] = {
            name: getattr(self.imu, name)
            for name in (
                "sampling",
                "gyro_noise_deg_sqrt_h",
                "gyro_bias_walk_deg_h_sqrt_h",
                "gyro_bias_std_deg_h",
                "accel_noise_ug_sqrt_hz",
                "accel_bias_walk_ug_sqrt_h",
                "accel_bias_std_ug",
            )
            if getattr(self.imu, name) is not None
        }
        return _convert(simulated | self.trial.imu, ImuSettings, "trial.imu", self.source)

    def gnss_settings(self) -> GnssSettings | None:
        """Return section `gnss` of the trial, None if there is no receiver."""
        if self.gnss is None:
            return None
        simulated: dict[str, Any] = {
            "position_std_m": self.gnss.position_std_m,
            "lever_arm_m": self.gnss.lever_arm_m,
        }
        if self.gnss.velocity_std_m_s is not None:
            simulated["velocity_std_m_s"] = self.gnss.velocity_std_m_s
        return _convert(simulated | self.trial.gnss, GnssSettings, "trial.gnss", self.source)

    def dvl_settings(self) -> DvlSettings | None:
        """Return section `dvl` of the trial, None if there is no DVL."""
        if self.dvl is None:
            return None
        simulated: dict[str, Any] = {
            "velocity_std_m_s": self.dvl.velocity_std_m_s,
            "velocity_std_fraction": self.dvl.velocity_std_fraction,
            "reference": self.dvl.reference,
        }
        return _convert(simulated | self.trial.dvl, DvlSettings, "trial.dvl", self.source)


def load_scenario(path: str | PathLike[str]) -> Scenario:
    """Read a scenario from its YAML file.

    Raises
    ------
    ConfigError
        If the file is missing, is not YAML, or holds an unknown key, a wrong type or a
        value out of range; the message names file and key.
    """
    path = Path(path)
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(
            f"cannot read the scenario ({error.strerror})",
            where=str(path),
            expected="a YAML file",
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{path} line {mark.line + 1}" if mark else str(path)
        problem = getattr(error, "problem", None) or "not text in UTF-8"
        raise ConfigError(f"not valid YAML ({problem})", where=where) from error
    return parse_scenario(data, str(path))


def parse_scenario(data: Mapping[str, Any], source: str = "scenario") -> Scenario:
    """Turn plain data, as read from YAML, into a scenario.

    Parameters
    ----------
    data : keys and values as in the file.
    source : name of the file, for messages.

    Raises
    ------
    ConfigError
        As `load_scenario`.
    """
    if not isinstance(data, Mapping):
        raise ConfigError(
            "this is not a scenario",
            where=source,
            expected="keys such as `name`, `start`, `manoeuvres` and `imu`",
        )
    if "source" in data:
        raise ConfigError("object contains unknown field `source`", where=source)
    scenario = _convert({**data, "source": source}, Scenario, "", source)
    scenario.plan()
    scenario.imu_settings()
    scenario.gnss_settings()
    scenario.dvl_settings()
    for name in ("gnss", "dvl"):
        if getattr(scenario, name) is None and getattr(scenario.trial, name):
            raise ConfigError(
                f"the trial claims a {name} that is not simulated",
                where=f"{source} key trial.{name}",
                expected=f"a section `{name}` beside it",
            )
    return scenario


def _convert(data: Any, kind: type[_T], key: str, source: str) -> _T:
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        what, _, path = str(error).partition(" - at ")
        inner = path.strip("`").removeprefix("$").removeprefix(".")
        full = re.sub(r"\.(?=\[)", "", ".".join(part for part in (key, inner) if part))
        where = f"{source} key {full}" if full else source
        raise ConfigError(what[:1].lower() + what[1:], where=where) from error


def _flatten(items: Sequence[Mapping[str, Any]], key: str, source: str) -> list[Manoeuvre]:
    out: list[Manoeuvre] = []
    for i, item in enumerate(items):
        kinds = [kind for name, kind in _MANOEUVRES.items() if name in item]
        if len(kinds) != 1:
            raise ConfigError(
                f"{sorted(item)} is not a manoeuvre",
                where=f"{source} key {key}[{i}]",
                expected=f"exactly one of {', '.join(_MANOEUVRES)}",
            )
        manoeuvre = _convert(dict(item), kinds[0], f"{key}[{i}]", source)
        if isinstance(manoeuvre, Repeat):
            inner = _flatten(manoeuvre.manoeuvres, f"{key}[{i}].manoeuvres", source)
            if len(out) + len(inner) * manoeuvre.repeat > _MAX_MANOEUVRES:
                raise ConfigError(
                    "the repetitions add up to too many manoeuvres",
                    where=f"{source} key {key}[{i}].repeat",
                    expected=f"at most {_MAX_MANOEUVRES} in all",
                )
            out += inner * manoeuvre.repeat
        else:
            out.append(manoeuvre)
    if not out:
        raise ConfigError(
            "there is no manoeuvre", where=f"{source} key {key}", expected="at least one"
        )
    return out


def _check_intervals(name: str, intervals: Sequence[Interval]) -> None:
    for start, end in intervals:
        if not start <= end:
            raise ValueError(f"`{name}` must hold pairs [start, end] with start <= end")
