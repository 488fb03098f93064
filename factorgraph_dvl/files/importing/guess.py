"""A mapping that is proposed for a table, from its header and its data."""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgraph_dvl.errors import DataError, as_text
from factorgraph_dvl.files.formats.format import Kind
from factorgraph_dvl.files.formats.framing import map_file, number
from factorgraph_dvl.files.formats.mapping import FIELDS
from factorgraph_dvl.files.formats.table import header, separator_of
from factorgraph_dvl.geometry.units import STANDARD_GRAVITY
from factorgraph_dvl.geometry.vectors import Array

# Rows that are looked at.
_ROWS = 5000
_BYTES = 1 << 21
# Words in names of columns, in the order of preference, and the field that they mean.
_WORDS = (
    (r"lat(itude)?", "lat"),
    (r"lon(g|gitude)?", "lon"),
    (r"(ellipsoidal )?(height|hgt|h_ell)", "height"),
    (r"(alt|altitude)( msl)?", "altitude"),
    (r"quality|fix quality|q", "quality"),
    (r"roll", "roll"),
    (r"pitch", "pitch"),
    (r"(heading|hdg|yaw|hdt)( true)?", "heading"),
    (r"depth", "depth"),
    (r"(sog|speed|ground speed)", "speed"),
    (r"(cog|course)( true)?", "course"),
    (r"(gyro?s?|omega|angular (rate|velocity)|w|rate) ?([xyz])", "gyro_"),
    (r"(acc|accel|acceleration|specific force|f) ?([xyz])", "accel_"),
    (r"(dvl|bt|vel|velocity|bottom|v|iv) ?([xyz])", "vel_"),
    (r"(v|vel|velocity)( |_)?(n|north)", "vel_n"),
    (r"(v|vel|velocity)( |_)?(e|east)", "vel_e"),
    (r"(v|vel|velocity)( |_)?(u|up)", "vel_u"),
    (r"(v|vel|velocity)( |_)?(d|down)", "vel_down"),
    (r"(beam|bv|b) ?([1234])( vel(ocity)?)?", "beam"),
)
# Words that YAML takes for truth values or for nothing.
_YAML_WORDS = ("y", "n", "yes", "no", "on", "off", "true", "false", "null")
_TIME = re.compile(r"(time|t|stamp|timestamp|utc|gps time|time s|ens t|utc s of day|seconds)")
_UNITS = (
    (r"deg(rees)?[ _/]*(per)?[ _/]*s(ec)?|dps", "deg/s"),
    (r"deg(rees)?[ _/]*(per)?[ _/]*h(our)?", "deg/h"),
    (r"rad(ians)?[ _/]*(per)?[ _/]*s(ec)?", "rad/s"),
    (r"m[ _/]+s(\^|\*\*)?2|m[ _/]+s[ _/]+s|mps2", "m/s2"),
    (r"mm[ _/]+s|mmps", "mm/s"),
    (r"cm[ _/]+s|cmps", "cm/s"),
    (r"m[ _/]+s|mps", "m/s"),
    (r"km[ _/]*h|kph", "km/h"),
    (r"kn|knots?|kts?", "kn"),
    (r"deg(rees)?", "deg"),
    (r"rad(ians)?", "rad"),
    (r"mm", "mm"),
    (r"cm", "cm"),
    (r"mg", "mg"),
    (r"g", "g"),
    (r"m(etres|eters)?", "m"),
    (r"ms|msec", "ms"),
    (r"us|usec", "us"),
    (r"ns|nsec", "ns"),
    (r"s|sec|seconds", "s"),
)
# Marks of instruments for what was not measured.
_INVALID = (-32768.0, -32.768, 88.888, 999.0, 9999.0, 99999.0, -999.0, -9999.0)


@dataclass(frozen=True)
class _Table:
    """A table: the lines of its mapping that all kinds share, and what its columns are.

    Parameters
    ----------
    file, time : str
        Lines of the mapping.
    names : list of str
        Names of its columns.
    columns : ndarray, shape (N, n)
        Their values.
    fields : dict of str to (int, str)
        Columns by field, with the unit that its name states.
    """

    file: str
    time: str
    names: list[str]
    columns: Array
    fields: dict[str, tuple[int, str]]


def guess(path: Path) -> str:
    """Propose a mapping of one table.

    Parameters
    ----------
    path : path-like
        A text file with a line of names above the data.

    Returns
    -------
    str
        Entries of `tables` in a mapping YAML; comments say what came from the data.

    Raises
    ------
    DataError
        If the file is no table, or no column is recognised.
    """
    names, columns, iso = _sample(path)
    fields = {}
    for index, name in enumerate(names):
        field, unit = _meaning(name)
        if field and field not in fields and not np.isnan(columns[:, index]).all():
            fields[field] = (index, unit)
    time = next((i for i, name in enumerate(names) if _TIME.fullmatch(_plain(name)[0])), None)
    kind = _kind(set(fields))
    if kind is None or time is None:
        missing = "no column of time" if time is None else "no kind of record in its columns"
        raise DataError(
            f"{missing} is recognised",
            where=path.name,
            expected="a line of names, such as `time_s,vel_x_m_s,vel_y_m_s,vel_z_m_s`",
            hint=f"Found {', '.join(names[:20])}; write the mapping by hand",
        )
    table = _Table(
        f"  - file: {_quoted(glob.escape(as_text(path.name)))}",
        f"    time: {_time(names, columns, time, iso)}",
        names,
        columns,
        fields,
    )
    text = _entry(table, kind)
    # A log of velocities may have a compass and tilt sensors of its own.
    return text + _entry(table, "attitude") if kind == "dvl" and "heading" in fields else text


def _entry(table: _Table, kind: Kind) -> str:
    """Return the entry of the records of a kind in a table."""
    names, columns, fields = table.names, table.columns, dict(table.fields)
    lines = [table.file, f"    kind: {kind}", table.time]
    if kind == "imu":
        lines.append(f"    axes: {_axes(columns[:, fields['accel_z'][0]])}")
    if kind == "dvl":
        lines.append("    # axes: FRD  # forward, right, down; or RFU, FLU: not in the table")
    if kind == "ins" and "height" not in fields:
        fields["height"] = fields["altitude"]
    if kind == "attitude":
        if "true" in names[fields["heading"][0]].lower():
            lines.append('    heading: "true"  # by its name; else magnetic, or unknown')
        if "roll" in fields and _is_turned_over(columns[:, fields["roll"][0]], fields["roll"][1]):
            lines.append("    # roll is near 180°, of a sensor that is upside down: left out")
            del fields["roll"]
            fields.pop("pitch", None)
    if kind == "dvl" and "beam1" in fields:
        lines.append("    coordinates: beam")
        lines.append("    beam_angle_deg: 30  # from the vertical: not in the table")
    invalid = [x for x in _INVALID if np.isclose(columns, x, atol=1e-6).any()]
    if invalid:
        shown = ", ".join(f"{x:g}" for x in invalid)
        lines.append(f"    invalid: [{shown}]  # found in the data")
    lines.append("    columns:")
    for field in FIELDS[kind]:
        if field in fields:
            index, unit = fields[field]
            lines.append(_column(field, names[index], unit, columns[:, index], kind))
    if "vel_down" in fields and kind in ("fix", "ins"):
        index, unit = fields["vel_down"]
        lines.append(f"      vel_u: {{column: {_quoted(names[index])}, unit: {unit}, sign: -1}}")
    return "\n".join(lines) + "\n"


def _is_turned_over(roll: Array, unit: str) -> bool:
    """Return whether most rolls are those of a sensor upside down."""
    upright = 0.75 * np.pi if unit == "rad" else 135.0
    return bool(np.nanmedian(np.abs(roll)) > upright)


def guess_all(paths: Sequence[Path]) -> str:
    """Return the mapping YAML that is proposed for several tables."""
    return "tables:\n" + "".join(guess(path) for path in paths)


def _sample(path: Path) -> tuple[list[str], Array, bool]:
    """Return names, columns (N, n) of numbers, and whether times are dates as text."""
    source = map_file(path)
    separator = separator_of(source)
    names, start = header(source, separator, 1)
    text = source[start : start + _BYTES].splitlines()[:_ROWS]
    split = (line.split() if separator == b" " else line.split(separator) for line in text)
    rows = [cells for cells in split if len(cells) == len(names)]
    columns = np.array([[number(cell.strip()) for cell in row] for row in rows])
    iso = any(re.match(rb"\s*\"?\d{4}[-/]\d\d[-/]\d\d", cell) for row in rows[:1] for cell in row)
    if len(names) < 2 or not len(rows):
        raise DataError("is no table", where=path.name, expected="names, then rows of numbers")
    return names, columns, iso


def _plain(name: str) -> tuple[str, str]:
    """Return a name of a column without its unit, and the unit as text."""
    bracket = re.search(r"[\[(]([^\])]*)[\])]", name)
    text = re.sub(r"[\[(][^\])]*[\])]", " ", name)
    text = re.sub(r"([a-z])([A-Z])", r"\1 \2", text).replace("_", " ").replace("-", " ")
    text = " ".join(text.lower().split())
    if bracket:
        return text, bracket[1].lower().strip()
    for pattern, _ in _UNITS:
        found = re.fullmatch(rf"(.+?) ({pattern})", text)
        if found:
            return found[1], found[2]
    return text, ""


def _meaning(name: str) -> tuple[str, str]:
    """Return the field that a name means, empty if none, and its unit, empty if not stated."""
    text, stated = _plain(name)
    unit = next((u for pattern, u in _UNITS if re.fullmatch(pattern, stated)), "")
    for pattern, field in _WORDS:
        found = re.fullmatch(pattern, text)
        if found:
            last = text[-1] if field.endswith("_") else ""
            if field == "beam":
                last = found[2]
            return field + last, unit
    return "", unit


def _kind(fields: set[str]) -> Kind | None:
    place, tilt = {"lat", "lon"} <= fields, {"roll", "pitch", "heading"} <= fields
    if {"gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"} <= fields:
        return "imu"
    if place and tilt and {"vel_n", "vel_e"} <= fields and fields & {"height", "altitude"}:
        return "ins"
    if place:
        return "fix"
    if {"vel_x", "vel_y", "vel_z"} <= fields or {"beam1", "beam2", "beam3", "beam4"} <= fields:
        return "dvl"
    if {"speed", "course"} <= fields:
        return "course"
    if "heading" in fields:
        return "attitude"
    return "depth" if "depth" in fields else None


def _time(names: Sequence[str], columns: Array, index: int, iso: bool) -> str:
    column = f"column: {_quoted(names[index])}"
    if iso and np.isnan(columns[:, index]).all():
        return f"{{{column}, unit: iso, clock: utc}}  # dates as text, taken as UTC"
    values = columns[:, index][np.isfinite(columns[:, index])]
    size = float(np.median(values)) if len(values) else 0.0
    for unit, scale in (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if 1e8 <= size / scale < 1e10:
            return f"{{{column}, unit: {unit}, clock: utc}}  # counts from 1970, by its size"
    if "day" in _plain(names[index])[0]:
        return f"{{{column}, unit: s, clock: day}}"
    unit = next((u for p, u in _UNITS if re.fullmatch(p, _plain(names[index])[1])), "s")
    unit = unit if unit in ("s", "ms", "us", "ns") else "s"
    return f"{{{column}, unit: {unit}, clock: trial}}  # one clock for all tables; else `own`"


def _axes(accel_z: Array) -> str:
    """Return axes by the sign of gravity along z, which is all that it shows."""
    if np.nanmedian(accel_z) < 0.0:
        return "FRD  # forward, right, down: z points down by the data"
    return "RFU  # right, forward, up: z points up by the data; or FLU"


def _column(
    field: str,
    name: str,
    unit: str,
    values: Array,
    kind: Kind,
) -> str:
    comment = ""
    if not unit:
        usual = FIELDS[kind][field][2]
        if usual == "1":
            return f"      {field}: {_quoted(name)}"
        unit, comment = _unit_by_size(field, values, usual)
    return f"      {field}: {{column: {_quoted(name)}, unit: {unit}}}{comment}"


def _unit_by_size(field: str, values: Array, usual: str) -> tuple[str, str]:
    """Return a unit in which values are of a possible size, and a comment."""
    known = values[np.isfinite(values)]
    size = float(np.median(np.abs(known))) if len(known) else 0.0
    largest = float(np.max(np.abs(known))) if len(known) else 0.0
    by_size = "  # unit by the size of the values"
    if field in ("lat", "lon", "roll", "pitch", "heading", "course") and largest <= 2.0 * np.pi:
        return "rad", by_size
    if field.startswith("gyro") and largest > np.pi:
        return "deg/s", by_size
    if field == "accel_z" and 0.5 < size < 2.0:
        return "g", by_size
    if field == "accel_z" and size > 50.0 * STANDARD_GRAVITY:
        return "mg", by_size
    if field.startswith(("vel", "beam")) and largest > 100.0:
        return "mm/s", by_size
    return usual, "  # unit not in the table: the usual one"


def _quoted(name: str) -> str:
    plain = re.fullmatch(r"[A-Za-z][\w .]*", name) and name.lower() not in _YAML_WORDS
    return name if plain else json.dumps(name, ensure_ascii=False)
