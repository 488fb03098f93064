"""Scenarios of simulated trials, as typed settings read from YAML.

```yaml
name: harbour
body_axes: RFU                     # or FRD, FLU
epoch: 2018-12-01T05:30:00Z        # UTC of time zero, needed for stars
noise: true                        # false: exact measurements, constant biases only
reference_rate_hz: 10
start: {lat_deg: 36, lon_deg: 121, height_m: 0, heading_deg: 0, speed_m_s: 0}
manoeuvres:                        # one after the other
  - {accelerate_m_s2: 1, to_m_s: 4}
  - {straight_s: 100}
  - {turn_deg_s: -2, duration_s: 45, ramp_s: 3}   # positive to starboard
  - {figure_eight_deg_s: 6}        # a full circle to starboard, then one to port
  - {stop_s: 30, acceleration_m_s2: 0.2}          # to rest, stay, and back to the speed before
  - {climb_m_s: -0.5, to_height_m: -40, ramp_s: 10}   # sink, with heading and speed as they are
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
depth: {...}                       # DepthTruth, optional
star: {...}                        # StarTruth, optional
beacons: {...}                     # BeaconTruth, optional
usbl: {...}                        # UsblTruth, optional, with the ship above the vehicle
dvl_beams: {...}                   # DvlBeamsTruth, optional
attitude: {...}                    # AttitudeTruth, optional, beside or in place of imu
ins: {...}                         # InsTruth, optional, likewise
turntable: {...}                   # TurntableTruth, optional: turns IMU and DVL on the ship
heading: {...}                     # without imu: HeadingTruth, LogTruth, DepthTruth, and
log: {...}                         # beacons make a planar trial
depth: {...}
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

from collections.abc import Mapping
from datetime import date
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from factorgraph_dvl.errors import ConfigError, printable
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.sensors.protocol import NoiseModel, SensorSection
from factorgraph_dvl.settings.convert import convert
from factorgraph_dvl.settings.sections import Positive, Section, Vector3, check_epoch
from factorgraph_dvl.settings.yaml_file import read_yaml
from factorgraph_dvl.simulation.catalogue import INSTRUMENTS, PLANAR_INSTRUMENTS
from factorgraph_dvl.simulation.course import StartSettings, SwaySettings
from factorgraph_dvl.simulation.instruments import ImuTruth, SimulatedInstrument
from factorgraph_dvl.simulation.manoeuvres import Manoeuvre, flatten


class InitialClaim(Section, frozen=True, kw_only=True):
    """Priors at the first IMU sample: the truth plus an error. No std = no such prior."""

    attitude_error_deg: Vector3 = (0.0, 0.0, 0.0)
    attitude_std_deg: tuple[Positive, Positive, Positive] | None = None
    position_error_m: Vector3 = (0.0, 0.0, 0.0)
    position_std_m: tuple[Positive, Positive, Positive] | None = None
    velocity_error_m_s: Vector3 = (0.0, 0.0, 0.0)
    velocity_std_m_s: tuple[Positive, Positive, Positive] | None = None


class _Claims(Section, frozen=True, kw_only=True):
    """Settings of the written trial.yaml; sensor sections as there."""

    noise: NoiseModel = "estimated"
    initial: InitialClaim | None = None


if TYPE_CHECKING:

    class Claims(_Claims, frozen=True, kw_only=True):
        """Settings of the written trial.yaml; sensor sections as there."""

else:
    Claims = msgspec.defstruct(
        "Claims",
        [(name, dict[str, Any], msgspec.field(default_factory=dict)) for name in INSTRUMENTS],
        bases=(_Claims,),
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
        module=__name__,
        namespace={"__doc__": "Settings of the written trial.yaml; sensor sections as there."},
    )


class _Scenario(Section, frozen=True, kw_only=True):
    """A simulated trial; see the module's docstring for the file."""

    name: str
    body_axes: BodyAxes = "RFU"
    epoch: str = ""
    noise: bool = True
    reference_rate_hz: Positive = 10.0
    start: StartSettings
    manoeuvres: list[dict[str, Any]]
    sway: SwaySettings = SwaySettings()
    current_m_s: Vector3 = (0.0, 0.0, 0.0)
    imu: ImuTruth | None = None
    trial: Claims = Claims()
    # A mapping of Any: a number, or a list of them, is checked below in one sentence.
    required: dict[str, Any] = msgspec.field(default_factory=dict)
    source: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_epoch(self.epoch)
        for name, given in self.required.items():
            numbers = given if isinstance(given, list) else [given]
            if not numbers or not all(_is_sigma(number) for number in numbers):
                raise ValueError(
                    f"`required` must have a number above 0 for each name, or a list of them; "
                    f"{name} is {given}"
                )

    def plan(self) -> list[Manoeuvre]:
        """Return the manoeuvres with repetitions written out.

        Raises
        ------
        ConfigError
            If one is not valid.
        """
        return flatten(self.manoeuvres, "manoeuvres", self.source)

    @property
    def planar(self) -> bool:
        """Whether the trial is planar: with heading and log, and without an IMU."""
        return "heading" in self.aids

    @property
    def aids(self) -> dict[str, SimulatedInstrument]:
        """The simulated sensors other than the IMU, by section."""
        given = {name: getattr(self, name) for name in INSTRUMENTS if name != "imu"}
        return {name: truth for name, truth in given.items() if truth is not None}

    def settings(self, section: str) -> SensorSection:
        """Return a sensor's section of the trial: as simulated, except for its claims.

        Raises
        ------
        ConfigError
            If a claim is not valid.
        """
        truth: SimulatedInstrument = getattr(self, section)
        claims = getattr(self.trial, section)
        return convert(
            truth.claimed() | claims, truth.section_type, f"trial.{section}", self.source
        )


if TYPE_CHECKING:

    class Scenario(_Scenario, frozen=True, kw_only=True):
        """A simulated trial; see the module's docstring for the file."""

        def __getattr__(self, section: str) -> Any: ...

else:
    Scenario = msgspec.defstruct(
        "Scenario",
        [(name, each.truth | None, None) for name, each in INSTRUMENTS.items() if name != "imu"],
        bases=(_Scenario,),
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
        module=__name__,
        namespace={"__doc__": "A simulated trial; see the module's docstring for the file."},
    )


def _is_sigma(value: Any) -> bool:
    is_number = isinstance(value, float | int) and not isinstance(value, bool)
    return is_number and 0.0 < value < float("inf")


def load_scenario(path: str | PathLike[str]) -> Scenario:
    """Read a scenario from its YAML file.

    Raises
    ------
    ConfigError
        If the file is missing, is not YAML, or contains an unknown key, a wrong type or a
        value out of range; the message names file, line and key.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> fd.load_scenario("examples/short.yaml").name
    'short run'
    """
    path = Path(path)
    scenario = read_yaml(path, Scenario, source=str(path))
    if scenario.source:
        raise ConfigError("unknown key `source`", where=str(path))
    return _checked(msgspec.structs.replace(scenario, source=str(path)))


def parse_scenario(data: Mapping[str, Any], source: str = "scenario") -> Scenario:
    """Turn plain data, as read from YAML, into a scenario.

    Parameters
    ----------
    data : mapping of str to object
        Keys and values as in the file.
    source : str, default 'scenario'
        Name of the origin of the data, for messages.

    Raises
    ------
    ConfigError
        As `load_scenario`.
    """
    if isinstance(data.get("epoch"), date):
        # A type of YAML 1.1, which this format has as text.
        data = {**data, "epoch": data["epoch"].isoformat()}
    scenario = convert({**data, "source": source}, Scenario, "", source)
    return _checked(msgspec.structs.replace(scenario, name=printable(scenario.name)))


def _checked(scenario: Scenario) -> Scenario:
    source = scenario.source
    scenario.plan()
    _check_sections(scenario)
    for name in INSTRUMENTS:
        if getattr(scenario, name) is not None:
            scenario.settings(name)
        elif getattr(scenario.trial, name):
            raise ConfigError(
                f"the trial claims a {name} that is not simulated",
                where=f"{source} key trial.{name}",
                expected=f"a section `{name}` beside it",
            )
    return scenario


def _check_sections(scenario: Scenario) -> None:
    """Raise ConfigError unless the sensors make a trial, with an IMU or planar."""
    given = {name for name in INSTRUMENTS if getattr(scenario, name) is not None}
    reckoned = sorted(given & {"heading", "log"})
    if not reckoned:
        if given & {"imu", "attitude", "ins"}:
            return
        raise ConfigError(
            "missing key `imu`",
            where=scenario.source,
            expected="this key; or, for a planar trial, heading, log, depth and beacons",
        )
    if "imu" in given:
        raise ConfigError(
            f"`{reckoned[0]}` belongs to a planar trial, which has no imu",
            where=f"{scenario.source} key {reckoned[0]}",
            expected="`imu`, or heading and log",
        )
    missing = [name for name in PLANAR_INSTRUMENTS if name not in given]
    wrong = sorted(given - PLANAR_INSTRUMENTS.keys())
    if missing or wrong:
        raise ConfigError(
            f"missing key `{missing[0]}`" if missing else f"`{wrong[0]}` needs an imu",
            where=scenario.source,
            expected="heading, log, depth and beacons for a planar trial, or an imu",
        )
