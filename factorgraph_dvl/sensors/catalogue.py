"""The sensors that aid the IMU: a new one is known once it stands here."""

from __future__ import annotations

from typing import Any

import numpy as np

from factorgraph_dvl.sensors.beacon import BeaconPosition, Beacons, BeaconSettings
from factorgraph_dvl.sensors.depth import Depth, DepthSettings
from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings
from factorgraph_dvl.sensors.dvl_beams import DvlBeams, DvlBeamsSettings
from factorgraph_dvl.sensors.gnss import Gnss, GnssSettings
from factorgraph_dvl.sensors.imu import Imu, ImuSettings
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.speed_log import Heading, HeadingSettings, LogSettings, SpeedLog
from factorgraph_dvl.sensors.star import Star, StarSettings
from factorgraph_dvl.sensors.turntable import Turntable

AIDS: tuple[type[Aid], ...] = (Gnss, Dvl, Star, Depth, DvlBeams, Turntable, Beacons)


def every_parameter(beams: int, beacon: str) -> tuple[Parameter, ...]:
    """Return the parameters that sensors may have, with each number of components.

    Parameters
    ----------
    beams : int
        The most that a DVL may have.
    beacon : str
        Name of the one whose parameters are returned.
    """
    imu = ImuSettings(
        gyro_noise_deg_sqrt_h=1.0,
        gyro_bias_std_deg_h=1.0,
        accel_noise_ug_sqrt_hz=1.0,
        accel_bias_std_ug=1.0,
    )
    place = BeaconPosition(lat_deg=0.0, lon_deg=0.0, height_m=0.0)
    common = DvlBeamsSettings(directions=_fan(3), parametrisation="common")
    sensors = [
        _bare(Dvl, DvlSettings(scale_error_std=0.1)),
        _bare(Dvl, DvlSettings(scale_error_std=(0.1, 0.1, 0.1))),
        _bare(Gnss, GnssSettings()),
        _bare(DvlBeams, common, prefix="beam_"),
        *(
            _bare(DvlBeams, DvlBeamsSettings(directions=_fan(n)), prefix="beam_")
            for n in range(3, beams + 1)
        ),
        _bare(Star, StarSettings()),
        _bare(Depth, DepthSettings()),
        _bare(Beacons, BeaconSettings(positions={beacon: place})),
        _bare(Heading, HeadingSettings()),
        _bare(SpeedLog, LogSettings()),
    ]
    aided = (p for sensor in sensors for p in sensor.parameters())
    return (*_bare(Imu, imu).parameters(0.0), *aided)


def _bare(kind: type, settings: Any, **more: Any) -> Any:
    """Return a sensor without a record: its parameters are those of its settings."""
    out: Any = object.__new__(kind)
    for name, value in {"settings": settings, **more}.items():
        object.__setattr__(out, name, value)
    return out


def _fan(n: int) -> tuple[tuple[float, float, float], ...]:
    """Return n directions on a cone."""
    angle = np.arange(n) * 2.0 * np.pi / n
    return tuple((0.6 * float(np.cos(a)), 0.6 * float(np.sin(a)), -0.8) for a in angle)
