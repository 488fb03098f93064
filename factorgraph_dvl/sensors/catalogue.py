"""The sensors that aid the IMU: those of the package, and those of other packages."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.sensors.attitude import Attitude
from factorgraph_dvl.sensors.beacon import ANY_BEACON, Beacons, bias_name, offset_name
from factorgraph_dvl.sensors.depth import Depth
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.dvl_beams import DvlBeams
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.sensors.parameters import ParameterSpec
from factorgraph_dvl.sensors.protocol import Aid, SensorRecord
from factorgraph_dvl.sensors.speed_log import Heading, SpeedLog
from factorgraph_dvl.sensors.star import Star
from factorgraph_dvl.sensors.turntable import Turntable
from factorgraph_dvl.sensors.usbl import Usbl

AIDS: tuple[type[Aid], ...] = (
    *(Gnss, Dvl, Ins, Attitude, Heading, SpeedLog, Star, Depth),
    *(DvlBeams, Turntable, Beacons, Usbl),
)


# Group of entry points by which other packages offer sensors; each has the name of its section.
GROUP = "factorgraph_dvl.sensors"
# Attributes that a sensor must have before its section can be read; the protocol `Aid` has all.
_DECLARED = ("section", "section_type", "required", "optional", "specs", "from_columns")

# Sensors of other packages that a trial has named so far, by section.
_PLUG_INS: dict[str, type[Aid]] = {}


def aid_types() -> tuple[type[Aid], ...]:
    """Return the sensors that are known: the package's own, and plug-ins that a trial named."""
    return (*AIDS, *_PLUG_INS.values())


def load_plug_ins(sections: Iterable[str]) -> None:
    """Look for sensors of other packages that have these sections; ones without are left out.

    Entry points are searched only if a section is not known yet.

    Raises
    ------
    ConfigError
        If a package that offers a section cannot be imported, or offers something else.
    """
    unknown = set(sections) - {kind.section for kind in aid_types()}
    if not unknown:
        return
    for entry in entry_points(group=GROUP):
        if entry.name in unknown:
            add_plug_in(_loaded(entry))


def add_plug_in(kind: type[Aid]) -> None:
    """Make a sensor known to files, reports and comparisons; one of the package's is already."""
    if kind not in AIDS:
        _PLUG_INS[kind.section] = kind


def _loaded(entry: EntryPoint) -> type[Aid]:
    where = f"entry point {entry.name} = {entry.value}"
    try:
        kind = entry.load()
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"the sensor cannot be imported ({error})", where=where, expected="a class"
        ) from error
    missing = [name for name in _DECLARED if not hasattr(kind, name)]
    if missing or kind.section != entry.name:
        what = f"lacks {', '.join(missing)}" if missing else f"has section {kind.section!r}"
        raise ConfigError(
            f"the sensor {what}",
            where=where,
            expected=f"a class with section {entry.name!r} and the rest of `Aid`",
        )
    return kind


# The sensors of a planar trial, which has no IMU.
PLANAR: tuple[type[Aid], ...] = (Heading, SpeedLog, Depth, Beacons)


# Offsets and biases of beacons, whose names are the user's, from any text around them.
_ANY_NAME = r"([^\s\"':,{}]+?)"
BEACON_OFFSET = re.compile(offset_name(_ANY_NAME) + r"\b")
_OF_BEACONS = {offset_name: BEACON_OFFSET, bias_name: re.compile(bias_name(_ANY_NAME))}


def every_spec() -> tuple[ParameterSpec, ...]:
    """Return the parameters of all sensors, with each number of components."""
    kinds: tuple[type[SensorRecord], ...] = (Imu, *aid_types())
    return tuple(dict.fromkeys(spec for kind in kinds for spec in kind.specs))


def specs_of(name: str) -> dict[int, ParameterSpec]:
    """Return what a parameter may be, by its number of components; empty if none knows it."""
    found = {spec.size: spec for spec in every_spec() if spec.name == name}
    if found:
        return found
    for named, pattern in _OF_BEACONS.items():
        if beacon := pattern.fullmatch(name):
            return {
                n: replace(spec, stem=spec.stem.replace(ANY_BEACON, beacon[1]))
                for n, spec in specs_of(named(ANY_BEACON)).items()
            }
    return {}
