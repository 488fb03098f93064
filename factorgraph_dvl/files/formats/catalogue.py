"""The formats of raw files: a new one is known once it stands here."""

from __future__ import annotations

from factorgraph_dvl.files.formats.format import Format
from factorgraph_dvl.files.formats.normalised import (
    ad2cp,
    nmea,
    pd0,
    pixse,
    trajectories,
    velocity_logs,
)
from factorgraph_dvl.files.formats.table import FORMAT as TABLE
from factorgraph_dvl.files.formats.vehicles import ardupilot, bags, nucleus, ulog

FORMATS: tuple[Format, ...] = (
    *pd0.FORMATS,
    *ad2cp.FORMATS,
    *velocity_logs.FORMATS,
    *trajectories.FORMATS,
    *nmea.FORMATS,
    *pixse.FORMATS,
    nucleus.FORMAT,
    bags.FORMAT,
    ardupilot.FORMAT,
    ulog.FORMAT,
    TABLE,
)
