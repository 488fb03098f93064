"""WinRiver measurement files (`.mmt`): what was set for the PD0 files that they name.

Source: the elements that public readers of these XML files use: transects with their files and
configurations, of which the last that was checked is in force.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from factorgraph_dvl.files.formats.format import Batch, Format, empty, left_out
from factorgraph_dvl.files.formats.framing import map_file, number
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.geometry.units import DEG

_ROOT = b"<WinRiver"
# Characters that are in some of these files, and in no XML.
_NO_XML = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
_FIELDS = {
    "declination": "Offsets/Magnetic_Variation",
    "transducer_depth": "Offsets/ADCP_Transducer_Depth",
    "heading_offset": "Ext_Heading/Offset",
    "delay": "GPS/Time_Delay",
}
_NOTE = (
    "{}: magnetic variation {:g}°, transducer {:g} m below the surface, offset of an external "
    "heading {:g}°, delay of GNSS {:g} s were set"
)
_UNITS = {"declination": DEG, "heading_offset": DEG}


def share(path: Path, sample: bytes) -> float:
    """Return whether a sample is XML of WinRiver."""
    return float(_ROOT in sample[:4096])


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    content = _NO_XML.sub(b"", map_file(path)[:])
    losses = Losses()
    for transect in _transects(content, losses):
        yield from _transect(transect)
    yield left_out(losses)


def _transects(content: bytes, losses: Losses) -> Iterator[ElementTree.Element]:
    """Yield the transects before damage."""
    try:
        for _, element in ElementTree.iterparse(BytesIO(content), events=("end",)):
            if element.tag == "Transect":
                yield element
                element.clear()
    except (ElementTree.ParseError, LookupError, ValueError):
        # The others are for an encoding that does not exist.
        losses.add("file that is cut or no XML", 0)


def _transect(transect: ElementTree.Element) -> Iterator[Batch]:
    configurations = transect.findall("Configuration")
    checked = [c for c in configurations if c.get("Checked") == "1"] or configurations
    if not checked:
        return
    out = empty("settings", 1)
    for name, place in _FIELDS.items():
        out[name] = number((checked[-1].findtext(place) or "").strip()) * _UNITS.get(name, 1.0)
    if np.isnan(out["declination"]).all():
        return
    shown = [float(out[name][0]) / _UNITS.get(name, 1.0) for name in _FIELDS]
    for file in transect.findall("File"):
        if name := re.split(r"[/\\]", (file.text or "").strip())[-1]:
            yield Batch("settings", out, "utc", name, notes=(_NOTE.format(name, *shown),))


FORMAT = Format(
    name="winriver",
    family="dvl",
    title="WinRiver measurement file `.mmt`",
    share=share,
    read=read,
    verified="by public readers of it only",
    endings=(".mmt",),
)
