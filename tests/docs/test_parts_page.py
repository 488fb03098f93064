"""The page of parts names everything that a sensor, an observation and a parameter have."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from factorgraph_dvl.sensors.parameters import UNITS, ParameterSpec
from factorgraph_dvl.sensors.protocol import Aid, Observation, SensorSection

PAGE = Path(__file__).resolve().parents[2] / "docs" / "parts.md"
CELLS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.read_text(encoding="utf-8").splitlines()
    if line.startswith("|")
]
NAMED = {name for cells in CELLS for name in re.findall(r"`(\w+)", cells[0])}


def members(protocol: type) -> set[str]:
    """Return the public attributes and methods of a protocol and of those it derives from."""
    return {
        name
        for base in protocol.__mro__[:-1]
        for name in (*vars(base), *getattr(base, "__annotations__", {}))
        if not name.startswith("_")
    }


@pytest.mark.parametrize(
    "names",
    [
        members(Aid),
        members(Observation),
        {field.name for field in dataclasses.fields(ParameterSpec)},
        set(SensorSection.__struct_fields__),
    ],
    ids=["record", "observation", "parameter", "settings"],
)
def test_the_tables_name_every_attribute(names):
    assert names <= NAMED


def test_the_tables_name_every_unit():
    (units,) = (cells[2] for cells in CELLS if cells[0] == "`unit`" and "one of" in cells[2])
    found = re.findall(r'`"?(\w*)"?`', units.split(":")[0])
    assert found == list(UNITS)
