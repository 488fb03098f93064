"""What every format of raw files offers: how it is recognised, and its records in common terms.

To add a format, write a module in this package that has

- a function `share(path, sample)`: the share of the sample's bytes, 0 to 1, that stand in whole
  records of the format (a container with a magic number: 1 or 0);
- a generator `read(path, mapping)` that yields a `Batch` for every few thousand records,
  in SI units and radians, with values that are absent as nan, and in bounded memory.
  It keeps what is whole in a damaged file, and raises only `DataError`;
- `FORMAT = Format(...)`, or `FORMATS` where a module has several;

and put it into the table of `catalogue.py`. From there `import` knows it. What a reader decides
(a sign, an axis, a unit) it says in `Batch.notes`, one sentence each: they go to `import.log`.
No record is lost in silence. What a reader leaves out it counts in `Losses`, which its last batch
has: damage, whole records by type with the reason, and types that it does not read. Records that
the instrument's own status calls invalid stay in the batch, which says so in `valid`: only the
whole file shows whether the instrument ever sets that status. Records of a batch without a time
or a value are counted for all readers alike (`faults`).
A third-party library is imported inside `read`, and named with its extra in `Format`.

Records of all kinds have `at`, their position in the file; `time`, on the clock that the batch
names; and `received`, on the recording clock of the file: that of a logging computer, of a
bag, or of the instrument in whose file they stand. A file in which some records have UTC as
`time` and all have `received` so relates its clocks by itself; nan where there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.files.formats.losses import NO_FIX, NO_LOCK, NO_TIME, NO_VALUE, Losses
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array

Family = Literal["dvl", "ins", "gnss", "vehicle", "table"]
Kind = Literal[
    "dvl",
    "water",
    "fix",
    "course",
    "attitude",
    "ins",
    "ins_std",
    "imu",
    "depth",
    "clock",
    "transponder",
    "acoustic",
    "transceiver",
    "topside",
    "settings",
]
# `utc`: seconds since 1970. `own`: the recording clock of the file, seconds since 1970 (perhaps of
# local time) or since its start. `day`: seconds of the UTC day. `week`: of the GPS week.
Clock = Literal["utc", "own", "day", "week"]
HeadingReference = Literal["true", "magnetic", "unknown"]

_HEAD = [("at", "i8"), ("time", "f8"), ("received", "f8")]
_RPH = [("roll", "f8"), ("pitch", "f8"), ("heading", "f8")]
_PING = np.dtype(
    [
        *_HEAD,
        ("number", "i8"),
        ("axes", "u1"),
        ("velocity", "f8", (3,)),
        ("error", "f8"),
        ("std", "f8", (3,)),
        ("beams", "f8", (4,)),
        ("range", "f8", (4,)),
        *_RPH,
        ("alignment", "f8"),
        ("tilts_used", "?"),
        ("up", "?"),
        ("beam_angle", "f8"),
        ("convex", "?"),
        ("sound_speed", "f8"),
        ("temperature", "f8"),
        ("delay", "f8"),
        ("window", "f8"),
    ]
)
_FIX = np.dtype(
    [
        *_HEAD,
        *((name, "f8") for name in ("lat", "lon", "height", "altitude", "quality")),
        *((name, "f8", (3,)) for name in ("std", "velocity", "velocity_std")),
    ]
)
# Kinds of records of positions: of an antenna, and of a transponder under water.
FIXES: tuple[Kind, ...] = ("fix", "transponder")

# Records by kind. Angles rad: roll starboard down, pitch bow up, heading clockwise from north.
#
# dvl       one ping: `velocity` m/s of the instrument over the bottom (never of the bottom), in
#           `axes` (`velocities.BEAM`, `INSTRUMENT`, `SHIP` starboard-forward-up, `EARTH`
#           east-north-up); `error` velocity; `std` m/s, where the instrument states it;
#           `beams` m/s of the transducer along each outward beam; `range` m; roll, pitch, heading
#           of the sensors that the instrument itself used; `alignment`: EA, beam 3 clockwise from
#           the bow; `tilts_used`, `up`, `beam_angle`, `convex` as `janus` takes them; `delay`:
#           from the stamp to the middle of the measurement, s; `window` over which it is a mean,
#           s.
# water     the same through the water.
# fix       `lat`, `lon`; `height` above the ellipsoid, `altitude` above the geoid, m; `quality`
#           as in GGA; `std` of position and `velocity` m/s, `velocity_std`: east, north, up.
# course    `speed` m/s and `course` over ground.
# attitude  roll, pitch, heading and their `std`; roll and pitch nan for a compass.
# ins       a navigation solution; stds as in fix and attitude.
# ins_std   standard deviations of a navigation solution that has a file of its own.
# imu       `gyro` rad/s and `accel` m/s² (specific force), in `Batch.axes`.
# depth     `depth` m below the surface.
# transponder
#           the same of a transponder under water.
# acoustic  `place` of the vehicle, forward, starboard, down of a vessel at the surface; `std`; m.
# transceiver
#           what the transceiver of a USBL measured in its own axes: `polar`, range m, bearing
#           clockwise from forward and depression, or `place` forward, starboard, down, m.
# topside   `lat`, `lon`, `height`, `altitude` of that vessel, `quality` as in GGA; roll, pitch and
#           true heading.
# settings  what was set for the file that `Batch.stream` names, without a time: magnetic
#           `declination`; `transducer_depth` m; `heading_offset` of an external compass; `delay`
#           of GNSS, s.
# clock     `time` is UTC at `received`; `number` of the ping that it belongs to, or -1.
KINDS: dict[Kind, np.dtype[Any]] = {
    "dvl": _PING,
    "water": _PING,
    "fix": _FIX,
    "transponder": _FIX,
    "course": np.dtype([*_HEAD, ("speed", "f8"), ("course", "f8")]),
    "attitude": np.dtype([*_HEAD, *_RPH, ("std", "f8", (3,))]),
    "ins": np.dtype(
        [
            *_HEAD,
            *((name, "f8") for name in ("lat", "lon", "height")),
            ("velocity", "f8", (3,)),
            *_RPH,
            *((name, "f8", (3,)) for name in ("std", "velocity_std", "attitude_std")),
        ]
    ),
    "ins_std": np.dtype(
        [*_HEAD, *((name, "f8", (3,)) for name in ("std", "velocity_std", "attitude_std"))]
    ),
    "imu": np.dtype([*_HEAD, ("gyro", "f8", (3,)), ("accel", "f8", (3,))]),
    "depth": np.dtype([*_HEAD, ("depth", "f8")]),
    "clock": np.dtype([*_HEAD, ("number", "i8")]),
    "acoustic": np.dtype([*_HEAD, ("place", "f8", (3,)), ("std", "f8")]),
    "transceiver": np.dtype([*_HEAD, ("polar", "f8", (3,)), ("place", "f8", (3,))]),
    "topside": np.dtype(
        [
            *_HEAD,
            *((name, "f8") for name in ("lat", "lon", "height", "altitude", "quality")),
            *_RPH,
        ]
    ),
    "settings": np.dtype(
        [
            *_HEAD,
            *((name, "f8") for name in ("declination", "transducer_depth")),
            *((name, "f8") for name in ("heading_offset", "delay")),
        ]
    ),
}


# The fields without one of which a record of a kind says nothing.
_VALUES: dict[Kind, tuple[str, ...]] = {
    **dict.fromkeys(("fix", "transponder", "ins"), ("lat", "lon")),
    "course": ("speed", "course"),
    "depth": ("depth",),
}


@dataclass(frozen=True)
class Batch:
    """Consecutive records of one kind.

    Parameters
    ----------
    kind : Kind
        What they are.
    records : Records
        (N,) of `KINDS[kind]`.
    clock : {'utc', 'own', 'day', 'week'}, optional
        Clock of `time`.
    stream : str, optional
        Which of several sources in the file: sentence, topic, message.
    axes : {'', 'RFU', 'FRD', 'FLU'}, optional
        Axes of the IMU or of the DVL's instrument axes; empty if they are not known.
    heading : {'true', 'magnetic', 'unknown'}, optional
        What headings refer to.
    notes : tuple of str, optional
        What the reader decided, and why; the same sentence again is logged once.
    losses : Losses, optional
        What was left out of the file since the batch before that has some.
    directions : tuple of tuple of float, optional
        Outward directions of the beams (4, 3) in instrument axes, where the file has them and
        `beam_angle` does not say them.
    valid : ndarray of bool, shape (N,), optional
        What the status of the instrument says of each record.
    """

    kind: Kind
    records: Records
    clock: Clock = "utc"
    stream: str = ""
    axes: BodyAxes | Literal[""] = ""
    heading: HeadingReference = "unknown"
    notes: tuple[str, ...] = ()
    losses: Losses | None = None
    directions: tuple[tuple[float, ...], ...] = ()
    valid: NDArray[np.bool_] | None = None

    @property
    def type(self) -> str:
        """Name of the type of its records, as `Losses` has it."""
        return type_name(self.kind, self.stream)


def type_name(kind: Kind, stream: str = "") -> str:
    """Return the name of a type of records for people."""
    return f"{stream} ({kind})" if stream else kind


Reader = Callable[[Path, Mapping[str, Any] | None], Iterator[Batch]]


@dataclass(frozen=True)
class Format:
    """One format of raw files.

    Parameters
    ----------
    name : str
        Name as `import --format` takes it: lower case, short.
    family : {'dvl', 'ins', 'gnss', 'vehicle', 'table'}
        Family of the instruments or programs that write it.
    title : str
        Title for people: maker and name.
    share : callable
        Given the path and a sample (its first bytes, and as many from its middle), returns
        the share of the sample that the format explains, 0 to 1. The path may be a folder; its
        sample is empty.
    read : callable
        Given the path and a mapping (plain content of the YAML, None without), yields batches.
        Raises ConfigError if `module` is not installed, and DataError if nothing can be read.
    verified : str
        What the reader was compared with; `not verified` where nothing could be had.
    endings : tuple of str, optional
        Usual endings of names, lower case with dot; they decide between equal shares only.
    in_text : bool, optional
        Whether its records may stand in one text file with those of other such formats.
    addresses : bytes, optional
        Regular expression of the addresses of sentences that it reads.
    module, extra : str, optional
        Third-party module that reading needs, and the extra that installs it.
    limit : str, optional
        What it needs beyond bounded memory, said before it reads.
    """

    name: str
    family: Family
    title: str
    share: Callable[[Path, bytes], float]
    read: Reader
    verified: str
    endings: tuple[str, ...] = ()
    in_text: bool = False
    addresses: bytes = b""
    module: str = ""
    extra: str = ""
    limit: str = ""


def positive(values: Array) -> Array:
    """Return values above 0, and nan in place of others, which stand for what is not known."""
    return np.where(values > 0.0, values, np.nan)


def faults(batch: Batch) -> dict[str, NDArray[np.bool_]]:
    """Return which records (N,) of a batch cannot be used, by the reason, each for one reason."""
    records = batch.records
    timeless = np.isnan(records["time"]) & np.isnan(records["received"])
    if batch.kind == "settings":
        timeless[:] = False
    valueless, reason = np.zeros(len(records), bool), NO_VALUE
    if batch.kind in ("dvl", "water"):
        along = np.isfinite(records["beams"]).any(axis=1) & (records["axes"] == 0)
        valueless, reason = ~np.isfinite(records["velocity"]).all(axis=1) & ~along, NO_LOCK
    elif batch.kind == "imu":
        valueless = ~(np.isfinite(records["gyro"]) & np.isfinite(records["accel"])).all(axis=1)
    elif batch.kind == "acoustic":
        valueless = ~np.isfinite(records["place"]).all(axis=1)
    elif batch.kind == "transceiver":
        polar, place = records["polar"], records["place"]
        valueless = ~(np.isfinite(polar).all(axis=1) | np.isfinite(place).all(axis=1))
    elif batch.kind == "topside":
        valueless = ~has_place(records) & np.isnan(records["heading"])
    elif batch.kind == "attitude":
        valueless = np.isnan(records["roll"]) & np.isnan(records["heading"])
    elif batch.kind in _VALUES:
        valueless = np.any([np.isnan(records[name]) for name in _VALUES[batch.kind]], axis=0)
        reason = NO_FIX if batch.kind in FIXES else NO_VALUE
    return {NO_TIME: timeless, reason: valueless & ~timeless}


def has_place(records: Records) -> NDArray[np.bool_]:
    """Return which records (N,) have a latitude and a longitude."""
    return np.asarray(np.isfinite(records["lat"]) & np.isfinite(records["lon"]))


def left_out(losses: Losses) -> Batch:
    """Return a batch without records, for what was left out of a file."""
    return Batch("clock", empty("clock", 0), losses=losses)


def empty(kind: Kind, count: int) -> Records:
    """Return records (count,) in which numbers are nan, numbers of pings -1, and flags unset."""
    out = np.zeros(count, KINDS[kind])
    for name, (part, *_) in (KINDS[kind].fields or {}).items():
        if part.base.kind == "f":
            out[name] = np.nan
    names = out.dtype.names or ()
    if "number" in names:
        out["number"] = -1
    if "convex" in names:
        out["convex"] = True
    return out
