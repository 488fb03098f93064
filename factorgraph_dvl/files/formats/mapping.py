"""Mappings: what the columns of a table are, as a YAML file states it."""

from __future__ import annotations

from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec.structs import replace

from factorgraph_dvl.files.formats.format import Clock, HeadingReference, Kind
from factorgraph_dvl.files.formats.velocities import BEAM, EARTH, INSTRUMENT, SHIP
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.units import DEG, DEG_PER_HOUR, KNOT, STANDARD_GRAVITY
from factorgraph_dvl.settings.sections import Section

# Value of each unit in SI.
UNITS = {
    **{"rad": 1.0, "deg": DEG, "arcmin": DEG / 60.0},
    **{"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048},
    **{"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1.0 / 3.6, "kn": KNOT},
    **{"rad/s": 1.0, "deg/s": DEG, "deg/h": DEG_PER_HOUR},
    **{"m/s2": 1.0, "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY},
    **{"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "day": 86400.0},
    **{"1": 1.0},
}
COORDINATES = {"beam": BEAM, "instrument": INSTRUMENT, "ship": SHIP, "earth": EARTH}

_XYZ, _ENU, _RPH = ("x", "y", "z"), ("e", "n", "u"), ("roll", "pitch", "heading")
_FRD = ("forward", "starboard", "down")
_PING_FIELDS = {
    **{f"vel_{axis}": ("velocity", i, "m/s") for i, axis in enumerate(_XYZ)},
    **{f"std_{axis}": ("std", i, "m/s") for i, axis in enumerate(_XYZ)},
    **{f"beam{i + 1}": ("beams", i, "m/s") for i in range(4)},
    **{f"range{i + 1}": ("range", i, "m") for i in range(4)},
    **{name: (name, None, "deg") for name in _RPH},
    "error": ("error", None, "m/s"),
    "number": ("number", None, "1"),
}
_FIX_STDS = {
    **{f"std_{axis}": ("std", i, "m") for i, axis in enumerate(_ENU)},
    **{f"vel_{axis}": ("velocity", i, "m/s") for i, axis in enumerate(_ENU)},
    **{f"vel_std_{axis}": ("velocity_std", i, "m/s") for i, axis in enumerate(_ENU)},
}
_PLACE = {
    "lat": ("lat", None, "deg"),
    "lon": ("lon", None, "deg"),
    "height": ("height", None, "m"),
}
# Fields of each kind: where they stand in its record, and the unit if none is stated.
FIELDS: dict[Kind, dict[str, tuple[str, int | None, str]]] = {
    "dvl": _PING_FIELDS,
    "water": _PING_FIELDS,
    "fix": {
        **_PLACE,
        "altitude": ("altitude", None, "m"),
        "quality": ("quality", None, "1"),
        **_FIX_STDS,
    },
    "course": {"speed": ("speed", None, "m/s"), "course": ("course", None, "deg")},
    "attitude": {
        **{name: (name, None, "deg") for name in _RPH},
        **{f"{name}_std": ("std", i, "deg") for i, name in enumerate(_RPH)},
    },
    "ins": {
        **_PLACE,
        **_FIX_STDS,
        **{name: (name, None, "deg") for name in _RPH},
        **{f"{name}_std": ("attitude_std", i, "deg") for i, name in enumerate(_RPH)},
    },
    "imu": {
        **{f"gyro_{axis}": ("gyro", i, "rad/s") for i, axis in enumerate(_XYZ)},
        **{f"accel_{axis}": ("accel", i, "m/s2") for i, axis in enumerate(_XYZ)},
    },
    "depth": {"depth": ("depth", None, "m")},
    "transponder": {
        **_PLACE,
        "altitude": ("altitude", None, "m"),
        **{f"std_{axis}": ("std", i, "m") for i, axis in enumerate(_ENU)},
    },
    "acoustic": {
        **{name: ("place", i, "m") for i, name in enumerate(_FRD)},
        "std": ("std", None, "m"),
    },
    "transceiver": {
        "range": ("polar", 0, "m"),
        "bearing": ("polar", 1, "deg"),
        "depression": ("polar", 2, "deg"),
        **{name: ("place", i, "m") for i, name in enumerate(_FRD)},
    },
    "topside": {
        **_PLACE,
        "altitude": ("altitude", None, "m"),
        "quality": ("quality", None, "1"),
        **{name: (name, None, "deg") for name in _RPH},
    },
}
_NEEDED: dict[Kind, tuple[tuple[str, ...], ...]] = {
    "dvl": (("vel_x", "vel_y", "vel_z"), ("beam1", "beam2", "beam3", "beam4")),
    "water": (("vel_x", "vel_y", "vel_z"), ("beam1", "beam2", "beam3", "beam4")),
    "fix": (("lat", "lon"),),
    "course": (("speed", "course"),),
    "attitude": (("heading",),),
    "ins": (("lat", "lon", "height", "vel_e", "vel_n", "vel_u", *_RPH),),
    "imu": (tuple(f"{name}_{axis}" for name in ("gyro", "accel") for axis in _XYZ),),
    "depth": (("depth",),),
    "transponder": (("lat", "lon"),),
    "acoustic": (_FRD,),
    "transceiver": (("range", "bearing", "depression"), _FRD),
    "topside": (("lat", "lon"), ("heading",)),
}

TableKind = Literal[
    "dvl",
    "water",
    "fix",
    "course",
    "attitude",
    "ins",
    "imu",
    "depth",
    "transponder",
    "acoustic",
    "transceiver",
    "topside",
]
ColumnName = str | int
Sign = Literal[1, -1]


class Column(Section, frozen=True, kw_only=True):
    """One column: its name or number (from 1), unit and sign.

    `sign: -1` reverses it; `down` and `left` axes become `up` and `right` so.
    """

    column: ColumnName
    unit: str = ""
    sign: Sign = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.unit and self.unit not in UNITS:
            raise ValueError(f"`unit` must be one of {', '.join(UNITS)}; found `{self.unit}`")


class TimeColumn(Section, frozen=True, kw_only=True):
    """The column of time: numbers in a unit, or dates and times as text.

    `columns` names two of text, date and time of day.
    """

    column: ColumnName | None = None
    columns: tuple[ColumnName, ColumnName] | None = None
    unit: Literal["s", "ms", "us", "ns", "min", "h", "day", "iso"] = "s"
    clock: Literal["trial", "utc", "gps", "own", "day", "week"] = "trial"
    offset_s: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.column is None) == (self.columns is None):
            raise ValueError("`time` needs either `column` or `columns`")

    @property
    def names(self) -> tuple[ColumnName, ...]:
        """The columns to read."""
        if self.columns is not None:
            return self.columns
        assert self.column is not None
        return (self.column,)

    @property
    def batch_clock(self) -> Clock:
        """The clock as batches name it."""
        clocks: dict[str, Clock] = {"own": "own", "day": "day", "week": "week"}
        return clocks.get(self.clock, "utc")


class TableMapping(Section, frozen=True, kw_only=True):
    """One kind of record in the tables whose names fit a pattern, or in a topic of bags.

    In a topic columns are fields of its messages, such as `velocity.x`, `beams.0.distance` and
    `header.stamp`. Where the column `valid` is 0 or false, nothing was measured.
    """

    file: str = "*"
    topic: str = ""
    kind: TableKind
    time: TimeColumn
    columns: dict[str, Column | str | int]
    separator: Literal[",", ";", "tab", "space"] | None = None
    header_lines: Annotated[int, msgspec.Meta(ge=0, le=1000)] = 1
    invalid: tuple[float, ...] = ()
    valid: ColumnName | None = None
    # Without: RFU for an IMU; those of a DVL are then not known.
    axes: BodyAxes | Literal[""] = ""
    coordinates: Literal["beam", "instrument", "ship", "earth"] = "instrument"
    beam_angle_deg: Annotated[float, msgspec.Meta(ge=5, le=45)] | None = None
    # YAML reads `true` without quotation marks as a truth value.
    heading: HeadingReference | bool = "unknown"

    @property
    def heading_reference(self) -> HeadingReference:
        """What headings refer to."""
        return "true" if isinstance(self.heading, bool) else self.heading

    def __post_init__(self) -> None:
        super().__post_init__()
        known = FIELDS[self.kind]
        unknown = [name for name in self.columns if name not in known]
        if unknown:
            raise ValueError(
                f"`columns` of {self.kind} has unknown {', '.join(unknown)}; "
                f"there are {', '.join(known)}"
            )
        ways = _NEEDED[self.kind]
        if not any(set(way) <= set(self.columns) for way in ways):
            text = ", or ".join(" ".join(way) for way in ways)
            raise ValueError(f"`columns` of {self.kind} needs {text}")
        if self.heading is False:
            raise ValueError("`heading` must be true, magnetic or unknown; found `false`")
        if self.coordinates == "beam" and self.beam_angle_deg is None:
            raise ValueError("`coordinates: beam` needs `beam_angle_deg`")
        if self.topic and (self.time.columns is not None or self.time.unit == "iso"):
            raise ValueError("`time` of a `topic` needs one `column` of numbers")

    def column(self, field: str) -> Column:
        """Return the column of a field."""
        found = self.columns[field]
        return found if isinstance(found, Column) else Column(column=found)

    def factor(self, field: str) -> float:
        """Return what values of a field are multiplied by."""
        column = self.column(field)
        return UNITS[column.unit or FIELDS[self.kind][field][2]] * column.sign


class MappingSettings(Section, frozen=True, kw_only=True):
    """The whole of a mapping YAML: tables, and what to take over to trial.yaml.

    `sentences` says whose the positions in files are, by patterns of names: `transponder` of the
    vehicle under water, `topside` of its ship, `fix` of its own antenna.
    """

    tables: tuple[TableMapping, ...] = ()
    sentences: dict[str, Literal["transponder", "topside", "fix"]] = msgspec.field(
        default_factory=dict
    )
    trial: dict[str, Any] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.tables or self.sentences):
            raise ValueError("there must be `tables` or `sentences`")

    def of(self, path: Path, *, topics: bool = False) -> tuple[TableMapping, ...]:
        """Return the tables that a file contains, or the topics that a bag does."""
        fits = (table for table in self.tables if fnmatchcase(path.name, table.file))
        return tuple(table for table in fits if bool(table.topic) == topics)

    def source_of(self, table: TableMapping) -> str:
        """Return the name of the source of a table: its kind, with a number from the second on.

        Tables that differ only in their files, as parts of one record do, are of one source.
        """
        sources: list[TableMapping] = []
        for other in self.tables:
            source = replace(other, file="")
            if other.kind == table.kind and source not in sources:
                sources.append(source)
        number = sources.index(replace(table, file="")) + 1
        return table.kind if number == 1 else f"{table.kind} {number}"
