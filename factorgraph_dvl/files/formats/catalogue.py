"""The formats of raw files: a new one is known once it stands here."""

from __future__ import annotations

from factorgraph_dvl.files.formats import (
    ad2cp,
    dvl_sentences,
    nmea,
    pd0,
    pd4,
    pd6,
    pd6_table,
    pixse,
    rowe,
    rtklib,
    sbet,
    underwater_gps,
    usbl_sentences,
    water_linked,
    water_linked_table,
    winriver,
)
from factorgraph_dvl.files.formats.format import Format
from factorgraph_dvl.files.formats.table import FORMAT as TABLE
from factorgraph_dvl.files.formats.vehicles import ardupilot, bags, nucleus, telemetry, ulog

FORMATS: tuple[Format, ...] = (
    *pd0.FORMATS,
    winriver.FORMAT,
    *ad2cp.FORMATS,
    *pd4.FORMATS,
    *pd6.FORMATS,
    pd6_table.FORMAT,
    *dvl_sentences.FORMATS,
    *water_linked.FORMATS,
    *water_linked_table.FORMATS,
    underwater_gps.FORMAT,
    usbl_sentences.FORMAT,
    *rowe.FORMATS,
    *rtklib.FORMATS,
    *sbet.FORMATS,
    *nmea.FORMATS,
    *pixse.FORMATS,
    nucleus.FORMAT,
    bags.FORMAT,
    ardupilot.FORMAT,
    telemetry.FORMAT,
    ulog.FORMAT,
    TABLE,
)
