"""NMEA 0183 and the usual proprietary sentences of attitude sensors.

Sources: GGA, RMC, VTG, ZDA, GST, HDT as in gpsd's published description of NMEA 0183;
`$PASHR` as receivers of several makers document it (time, heading, T, roll, pitch, heave,
three standard deviations, two flags); `$PRDID` (pitch, roll, heading) and `$PADCP`
(ensemble, PC date and time, PC clock minus UTC) as Teledyne's VmDas writes them; `$PIXSE` as in
Exail's interface library. Signs of roll and pitch are kept as sent: roll positive
starboard down, pitch positive bow up, but in `$PIXSE,ATITUD` pitch positive bow down
(that one statement is not verified against a document).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.clocks import in_order, nearest_day, posix
from factorgraph_dvl.files.formats.format import (
    Batch,
    Clock,
    Format,
    HeadingReference,
    empty,
    left_out,
    type_name,
)
from factorgraph_dvl.files.formats.framing import BLOCK_OF_LINES, Records, Source, map_file, number
from factorgraph_dvl.files.formats.losses import NO_FIX, NO_VALUE, UNKNOWN_TYPE, Losses
from factorgraph_dvl.files.formats.sentences import NOT_USABLE, Sentence, sentences
from factorgraph_dvl.geometry.units import DEG, KNOT
from factorgraph_dvl.geometry.vectors import Array

_HEAD = [("at", "i8"), ("received", "f8"), ("checked", "?"), ("talker", "S2")]
Row = tuple[float, ...]


def _kind(fields: str) -> np.dtype[np.void]:
    return np.dtype([*_HEAD, *((name, "f8") for name in fields.split())])


# Angles in rad, lengths in m, speeds in m/s; `second`: of the UTC day; `date`: seconds
# since 1970 of its start. Altitudes are above the geoid, heights above the ellipsoid.
KINDS = {
    "GGA": _kind("second lat lon quality satellites hdop altitude separation height age"),
    "RMC": _kind("second date valid lat lon speed course"),
    "VTG": _kind("course speed"),
    "ZDA": _kind("second date"),
    "GST": _kind("second rms std_lat std_lon std_height"),
    "HDT": _kind("heading"),
    "PASHR": _kind("second heading roll pitch heave std_roll std_pitch std_heading gnss ins"),
    "PRDID": _kind("pitch roll heading"),
    "PADCP": _kind("ensemble pc pc_minus_utc"),
    "ATITUD": _kind("roll pitch"),
    "POSITI": _kind("lat lon altitude"),
    "SPEED_": _kind("vel_e vel_n vel_u"),
    "STDHRP": _kind("std_heading std_roll std_pitch"),
    "STDPOS": _kind("std_lat std_lon std_height"),
    # Public readers disagree on which of the first two is north.
    "STDSPD": _kind("std_1 std_2 std_up"),
    "TIME__": _kind("second"),
}


def read_nmea(
    source: Source, block: int = BLOCK_OF_LINES, losses: Losses | None = None
) -> Iterator[dict[str, Records]]:
    """Read sentences.

    Parameters
    ----------
    source : Source
        The stream.
    block : int
        Number of sentences at a time.
    losses : Losses, optional
        Takes counts of sentences with fewer fields than they should have.

    Yields
    ------
    dict of str to Records
        Structured arrays by the names of `KINDS`, in the order of the stream; what was
        empty or unreadable in a sentence is nan.
    """
    losses = Losses() if losses is None else losses
    rows: dict[str, list[tuple[object, ...]]] = {name: [] for name in KINDS}
    count = 0
    for sentence in sentences(source, ADDRESSES):
        kind, row = decode(sentence)
        if row is None:
            # $PASHR has other forms, whose fields are others.
            if kind == "PASHR":
                losses.skip(_OTHER_PASHR, UNKNOWN_TYPE)
            elif kind in KINDS:
                losses.add(NOT_USABLE, sentence.at)
            continue
        head = (sentence.at, sentence.received, sentence.checked, sentence.address[:2])
        rows[kind].append((*head, *row))
        count += 1
        if count % block == 0:
            yield _records(rows)
            rows = {name: [] for name in KINDS}
    yield _records(rows)


def _records(rows: dict[str, list[tuple[object, ...]]]) -> dict[str, Records]:
    return {name: np.array(rows[name], KINDS[name]) for name in KINDS}


def join(blocks: Iterator[dict[str, Records]]) -> dict[str, Records]:
    """Return all blocks of `read_nmea` as one."""
    parts = list(blocks)
    return {name: np.concatenate([part[name] for part in parts]) for name in KINDS}


def utc(records: dict[str, Records], kind: str) -> Array:
    """Return the UTC of a kind of sentence that has a time of day, seconds since 1970.

    The dates are those of the RMC and ZDA sentences among which it stands.

    Parameters
    ----------
    records : dict of str to Records
        What `read_nmea` returned.
    kind : str
        Name in `KINDS`.

    Returns
    -------
    ndarray, shape (N,), s
        Nan if no sentence has a date.
    """
    wanted = records[kind]
    dated = [records[name] for name in ("RMC", "ZDA") if name != kind]
    at = np.concatenate([wanted["at"], *(part["at"] for part in dated)])
    second = np.concatenate([wanted["second"], *(part["second"] for part in dated)])
    own = wanted["date"] if "date" in (wanted.dtype.names or ()) else np.full(len(wanted), np.nan)
    date = np.concatenate([own, *(part["date"] for part in dated)])
    order = np.argsort(at, kind="stable")
    out = np.empty(len(at))
    out[order] = in_order(second[order], date[order])
    return out[: len(wanted)]


def decode(sentence: Sentence) -> tuple[str, Row | None]:
    """Return the kind of a sentence and its values, None where it has too few fields."""
    address, fields = sentence.address, sentence.fields
    kind = address.decode("ascii")
    if not kind.startswith("P"):
        kind = kind[2:]
    elif kind == "PIXSE":
        kind, fields = fields[0].decode("ascii"), fields[1:]
    shortest, convert = _DECODERS.get(kind, (0, None))
    if convert is None or len(fields) < shortest:
        return kind, None
    # Other sentences of that address have a word there, and other fields.
    if kind == "PASHR" and not fields[0][:6].isdigit():
        return kind, None
    return kind, convert(fields)


def second_of_day(text: bytes) -> float:
    """Return hhmmss.sss as seconds, or nan."""
    if len(text) < 6 or not text[:6].isdigit():
        return math.nan
    hour, minute, second = int(text[:2]), int(text[2:4]), number(text[4:])
    return hour * 3600.0 + minute * 60.0 + second if hour < 24 and minute < 60 else math.nan


def position(lat: bytes, north: bytes, lon: bytes, east: bytes) -> tuple[float, float]:
    """Return latitude and longitude, rad, of ddmm.mmm and dddmm.mmm with hemispheres."""
    out = []
    for text, side, sides, limit in ((lat, north, b"NS", 90.0), (lon, east, b"EW", 180.0)):
        value = number(text)
        # Empty fields are nan and must not reach the arithmetic of integers.
        if not value >= 0.0 or len(side) != 1 or side not in sides:
            return math.nan, math.nan
        degrees = value // 100.0
        minutes = value - 100.0 * degrees
        value = degrees + minutes / 60.0
        if minutes >= 60.0 or value > limit:
            return math.nan, math.nan
        out.append(value * DEG * (1.0 if side == sides[:1] else -1.0))
    return out[0], out[1]


def _angle(text: bytes) -> float:
    return number(text) * DEG


@lru_cache(maxsize=256)
def _calendar(day: bytes, month: bytes, year: bytes) -> float:
    if not (day.isdigit() and month.isdigit() and year.isdigit() and len(year) in (2, 4)):
        return math.nan
    return float(posix(int(year), int(month), int(day))[0])


def _gga(f: list[bytes]) -> Row:
    lat, lon = position(f[1], f[2], f[3], f[4])
    altitude, separation = number(f[8]), number(f[10])
    age = number(f[12]) if len(f) > 12 else math.nan
    return (
        *(second_of_day(f[0]), lat, lon, number(f[5]), number(f[6]), number(f[7])),
        *(altitude, separation, altitude + separation, age),
    )


def _rmc(f: list[bytes]) -> Row:
    lat, lon = position(f[2], f[3], f[4], f[5])
    date = f[8] if len(f[8]) == 6 else b""
    return (
        *(second_of_day(f[0]), _calendar(date[:2], date[2:4], date[4:]), float(f[1] == b"A")),
        *(lat, lon, number(f[6]) * KNOT, _angle(f[7])),
    )


def _vtg(f: list[bytes]) -> Row:
    # Before NMEA 2.0 there were no letters between the numbers.
    has_letters = len(f) >= 8
    knots, km_h = number(f[4 if has_letters else 2]), number(f[6 if has_letters else 3])
    return _angle(f[0]), km_h / 3.6 if math.isnan(knots) else knots * KNOT


def _pashr(f: list[bytes]) -> Row:
    values = (*map(_angle, (f[1], f[3], f[4])), number(f[5]), *map(_angle, f[6:9]))
    flags = (number(f[9]), number(f[10]) if len(f) > 10 else math.nan)
    return (second_of_day(f[0]), *values, *flags)


def _padcp(f: list[bytes]) -> Row:
    is_date = len(f[1]) == 8 and f[1].isdigit()
    midnight = _calendar(f[1][6:], f[1][4:6], f[1][:4]) if is_date else math.nan
    return number(f[0]), midnight + second_of_day(f[2]), number(f[3])


_DECODERS: dict[str, tuple[int, Callable[[list[bytes]], Row]]] = {
    "GGA": (11, _gga),
    "RMC": (9, _rmc),
    "VTG": (4, _vtg),
    "ZDA": (4, lambda f: (second_of_day(f[0]), _calendar(f[1], f[2], f[3]))),
    "GST": (8, lambda f: (second_of_day(f[0]), number(f[1]), *map(number, f[5:8]))),
    "HDT": (1, lambda f: (_angle(f[0]),)),
    "PASHR": (10, _pashr),
    "PRDID": (3, lambda f: (_angle(f[0]), _angle(f[1]), _angle(f[2]))),
    "PADCP": (4, _padcp),
    "ATITUD": (2, lambda f: (_angle(f[0]), _angle(f[1]))),
    "POSITI": (3, lambda f: (_angle(f[0]), _angle(f[1]), number(f[2]))),
    "SPEED_": (3, lambda f: (number(f[0]), number(f[1]), number(f[2]))),
    "STDHRP": (3, lambda f: (_angle(f[0]), _angle(f[1]), _angle(f[2]))),
    "STDPOS": (3, lambda f: (number(f[0]), number(f[1]), number(f[2]))),
    "STDSPD": (3, lambda f: (number(f[0]), number(f[1]), number(f[2]))),
    "TIME__": (1, lambda f: (second_of_day(f[0]),)),
}
ADDRESSES = rb"[A-OQ-Z][A-Z0-9](?:GGA|RMC|VTG|ZDA|GST|HDT)|PASHR|PRDID|PADCP|PIXSE"


Sentences = dict[str, Records]

# GGA: 0 no fix, 6 dead reckoning, 7 typed in, 8 simulated.
_MEASURED = (1, 2, 3, 4, 5, 9)
_NO_FIX = "GGA of quality 0, 6, 7 or 8 is no measurement: left out"
UNCHECKED = "sentence without the checksum that others in the file have"
_OTHER_PASHR = "PASHR of another form"
_UNTIMED = "sentences without a time have that of the sentence with a time before them"
# Chosen: sentences with a time that wait for others of their burst; more are left of lost ones.
_WAITING = 2
_ANY = rb"[A-Z][A-Z0-9]{2,9}"


def share(path: Path, sample: bytes) -> float:
    """Return the share of a sample that is sentences, if some of them can be used."""
    if next(sentences(sample, ADDRESSES), None) is None:
        return 0.0
    return sum(
        len(s.address) + len(b",".join(s.fields)) + 7 for s in sentences(sample, _ANY)
    ) / len(sample)


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    near: float | None = None
    checked = False
    losses = Losses()
    for block in read_nmea(map_file(path), losses=losses):
        checked = checked or any(part["checked"].any() for part in block.values())
        if checked:
            for part in block.values():
                lost = part["at"][~part["checked"]]
                losses.add(UNCHECKED, int(lost[0]) if len(lost) else 0, len(lost))
            block = {kind: part[part["checked"]] for kind, part in block.items()}
        for batch in sentence_batches(block, near, losses):
            if batch.clock == "utc" and len(batch.records):
                near = float(batch.records["time"][-1])
            yield batch
    yield left_out(losses)


def sentence_batches(block: Sentences, near: float | None, losses: Losses) -> Iterator[Batch]:
    """Convert sentences.

    Parameters
    ----------
    block : dict of str to Records
        Block as `read_nmea` yields them.
    near : float or None, s
        Some time within half a day of sentences that have neither a date nor a time of
        reception; None if there is none.
    losses : Losses
        Takes counts of sentences without a fix or a speed, and of those that complete others.

    Yields
    ------
    Batch
    """
    for kind in ("ZDA", "GST"):
        losses.use(kind, len(block[kind]))
    times = {kind: _times(block, kind, near) for kind in ("GGA", "RMC", "ZDA", "PASHR")}
    clock: Clock = "utc"
    if not any(np.isfinite(time).any() for time in times.values()):
        clock = "day"
        times = {kind: np.array(block[kind]["second"]) for kind in times}
    yield from _fixes(block, times, clock, losses)
    yield from _courses(block, times, clock, losses)
    yield from _attitudes(block, times, clock)
    yield from _clocks(block, times, clock)


def _times(block: Sentences, kind: str, near: float | None) -> Array:
    time = utc(block, kind)
    part = block[kind]
    about = part["received"]
    if near is not None:
        about = np.where(np.isnan(about), near, about)
    return np.where(np.isnan(time), nearest_day(part["second"], about), time)


def _at_same_time(block: Sentences, kind: str, times: Mapping[str, Array]) -> Array:
    """Return times of sentences without one: of their burst, by arrival or by place."""
    part = block[kind]
    timed = [name for name in ("GGA", "RMC", "ZDA") if len(times[name])]
    if not timed or not len(part):
        return np.full(len(part), np.nan)
    # One sentence with a time is enough for a burst.
    timed = timed[:1]
    at = np.concatenate([block[name]["at"] for name in timed])
    time = np.concatenate([times[name] for name in timed])
    received = np.concatenate([block[name]["received"] for name in timed])
    order = np.argsort(at, kind="stable")
    last = np.searchsorted(at[order], part["at"]) - 1
    out = np.where(last >= 0, time[order[np.maximum(last, 0)]], np.nan)
    known = np.isfinite(received) & np.isfinite(time)
    stamped = np.isfinite(part["received"])
    if known.any():
        out[stamped] = _in_turn(received[known], time[known], part["received"][stamped])
    return out


def _in_turn(received: Array, time: Array, arrived: Array) -> Array:
    """Return the times that belong to arrivals, each that of the first one not yet taken.

    Arrivals are late by more than the interval of a fast receiver, in bursts; their order is
    what can be relied on.
    """
    out = np.full(len(arrived), np.nan)
    is_arrival = np.concatenate([np.zeros(len(received), int), np.ones(len(arrived), int)])
    order = np.lexsort((is_arrival, np.concatenate([received, arrived])))
    waiting: deque[float] = deque(maxlen=_WAITING)
    latest = np.nan
    for index in order.tolist():
        if index < len(received):
            latest = float(time[index])
            waiting.append(latest)
        else:
            out[index - len(received)] = waiting.popleft() if waiting else latest
    return out


def _fixes(
    block: Sentences, times: Mapping[str, Array], clock: Clock, losses: Losses
) -> Iterator[Batch]:
    gga, rmc, gst = block["GGA"], block["RMC"], block["GST"]
    if len(gga):
        out = empty("fix", len(gga))
        for name in ("at", "received", "lat", "lon", "height", "altitude", "quality"):
            out[name] = gga[name]
        out["time"] = times["GGA"]
        if len(gst):
            order = np.argsort(gst["second"], kind="stable")
            place = np.minimum(np.searchsorted(gst["second"][order], gga["second"]), len(gst) - 1)
            match = order[place]
            same = gst["second"][match] == gga["second"]
            std = np.stack(
                [gst[f"std_{axis}"][match] for axis in ("lon", "lat", "height")], axis=1
            )
            out["std"] = np.where(same[:, None], std, np.nan)
        measured = np.isin(out["quality"], _MEASURED) & np.isfinite(out["lat"])
        more = () if measured.all() else (_NO_FIX,)
        losses.skip(type_name("fix", "GGA"), NO_FIX, int((~measured).sum()))
        yield Batch("fix", out[measured], clock, "GGA", notes=more)
    valid = (rmc["valid"] > 0.0) & np.isfinite(rmc["lat"])
    losses.skip(type_name("fix", "RMC"), NO_FIX, int((~valid).sum()))
    if valid.any():
        out = empty("fix", len(rmc))
        for name in ("at", "received", "lat", "lon"):
            out[name] = rmc[name]
        out["time"] = times["RMC"]
        yield Batch("fix", out[valid], clock, "RMC")


def _courses(
    block: Sentences, times: Mapping[str, Array], clock: Clock, losses: Losses
) -> Iterator[Batch]:
    for kind in ("RMC", "VTG"):
        part = block[kind]
        out = empty("course", len(part))
        for name in ("at", "received", "speed", "course"):
            out[name] = part[name]
        if kind == "RMC":
            out["time"] = times[kind]
        else:
            out["time"] = _at_same_time(block, kind, times)
        more = () if kind == "RMC" else (_UNTIMED,)
        good = np.isfinite(out["speed"])
        losses.skip(type_name("course", kind), NO_VALUE, int((~good).sum()))
        if good.any():
            yield Batch("course", out[good], clock, kind, notes=more)


def _attitudes(block: Sentences, times: Mapping[str, Array], clock: Clock) -> Iterator[Batch]:
    kinds: tuple[tuple[str, tuple[str, ...], HeadingReference], ...] = (
        ("PASHR", ("roll", "pitch", "heading"), "true"),
        ("PRDID", ("roll", "pitch", "heading"), "unknown"),
        ("HDT", ("heading",), "true"),
    )
    for kind, names, reference in kinds:
        part = block[kind]
        if not len(part):
            continue
        out = empty("attitude", len(part))
        for name in ("at", "received", *names):
            out[name] = part[name]
        if kind == "PASHR":
            out["time"] = times[kind]
            for index, name in enumerate(("std_roll", "std_pitch", "std_heading")):
                out["std"][:, index] = part[name]
        else:
            out["time"] = _at_same_time(block, kind, times)
        more = () if kind == "PASHR" else (_UNTIMED,)
        yield Batch("attitude", out, clock, kind, heading=reference, notes=more)


def _clocks(block: Sentences, times: Mapping[str, Array], clock: Clock) -> Iterator[Batch]:
    padcp = block["PADCP"]
    if len(padcp):
        out = empty("clock", len(padcp))
        out["at"], out["received"] = padcp["at"], padcp["pc"]
        out["number"] = np.nan_to_num(padcp["ensemble"], nan=-1.0)
        out["time"] = padcp["pc"] - padcp["pc_minus_utc"]
        yield Batch("clock", out, "utc", "PADCP")


FORMATS = (
    Format(
        "nmea",
        "gnss",
        "NMEA 0183: GGA, RMC, VTG, ZDA, GST, HDT, `$PASHR`, `$PRDID`, `$PADCP`",
        share,
        read,
        "published sentences, by pynmeagps",
        (".nmea", ".txt", ".log", ".n1r", ".n2r", ".nms"),
        in_text=True,
        addresses=ADDRESSES,
    ),
)
