"""The sensors that aid the IMU: a new one is known once it stands here."""

from __future__ import annotations

from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.sensors.depth import Depth
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.dvl_beams import DvlBeams
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.star import Star
from factorgraph_dvl.sensors.turntable import Turntable

AIDS: tuple[type[Aid], ...] = (Gnss, Dvl, Star, Depth, DvlBeams, Turntable, Beacons)
