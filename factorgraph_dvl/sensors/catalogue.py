"""The sensors that aid the IMU: a new one is known once it stands here."""

from __future__ import annotations

import re
from dataclasses import replace

from factorgraph_dvl.sensors.attitude import Attitude
from factorgraph_dvl.sensors.beacon import ANY_BEACON, Beacons, offset_name
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

AIDS: tuple[type[Aid], ...] = (
    *(Gnss, Dvl, Ins, Attitude, Star, Depth),
    *(DvlBeams, Turntable, Beacons),
)


# Records of a planar trial, which has no IMU.
PLANAR: tuple[type[SensorRecord], ...] = (Heading, SpeedLog, Depth, Beacons)


# Offsets of beacons, whose names are the user's, from any text around them.
BEACON_OFFSET = re.compile(offset_name(r"([^\s\"':,{}]+)") + r"\b")


def every_spec() -> tuple[ParameterSpec, ...]:
    """Return the parameters of all sensors, with each number of components."""
    kinds: tuple[type[SensorRecord], ...] = (Imu, *AIDS, *PLANAR)
    return tuple(dict.fromkeys(spec for kind in kinds for spec in kind.specs))


def specs_of(name: str) -> dict[int, ParameterSpec]:
    """Return what a parameter may be, by its number of components; empty if none knows it."""
    found = {spec.size: spec for spec in every_spec() if spec.name == name}
    beacon = BEACON_OFFSET.fullmatch(name)
    if found or beacon is None:
        return found
    offsets = specs_of(offset_name(ANY_BEACON))
    return {
        n: replace(spec, stem=spec.stem.replace(ANY_BEACON, beacon[1]))
        for n, spec in offsets.items()
    }
