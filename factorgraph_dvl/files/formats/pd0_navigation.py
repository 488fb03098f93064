"""Positions and sentences that VmDas and WinRiver add to PD0 ensembles.

Sources: Teledyne, VmDas User's Guide, binary navigation data (read through two public
readers that agree); RiverPro and RioPro ADCP Guide (October 2017), NMEA PD0 Message
Format; the binary forms of WinRiver II through the public reader of QRevInt.
"""

from __future__ import annotations

import math
import struct

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.files.formats.clocks import nearest_day, posix
from factorgraph_dvl.files.formats.framing import Bytes, Index, Records
from factorgraph_dvl.files.formats.nmea import ADDRESSES, KINDS, Row, decode, second_of_day
from factorgraph_dvl.files.formats.sentences import sentences
from factorgraph_dvl.geometry.units import DEG, KNOT

__all__ = ["VMDAS", "embedded_sentences", "vmdas_fixes"]

# `first`: the fix after the ping before; `last`: the one before this ping. Angles in rad.
# `time`: of the ensemble by the clock of the PC, which may show local time; `pc_minus_utc`:
# what to subtract from it.
VMDAS = np.dtype(
    [
        ("at", "i8"),
        ("flags", "u2"),
        *((name, "f8") for name in ["first_utc", "first_lat", "first_lon"]),
        *((name, "f8") for name in ["last_utc", "last_lat", "last_lon"]),
        *((name, "f8") for name in ["speed", "course", "made_good_speed", "made_good_course"]),
        *((name, "f8") for name in ["pc_minus_utc", "time", "heading", "pitch", "roll"]),
    ]
)
_RAW = np.dtype(
    [
        ("identity", "<u2"),
        ("day", "u1"),
        ("month", "u1"),
        ("year", "<u2"),
        ("first_time", "<u4"),
        ("offset", "<i4"),
        ("first", "<i4", (2,)),
        ("last_time", "<u4"),
        ("last", "<i4", (2,)),
        ("speed", "<u2"),
        ("course", "<u2"),
        ("magnetic_course", "<u2"),
        ("made_good_speed", "<u2"),
        ("made_good_course", "<u2"),
        ("reserved", "<u2"),
        ("flags", "<u2"),
        ("reserved_2", "<u2"),
        ("ensemble", "<u4"),
        ("adcp_year", "<u2"),
        ("adcp_day", "u1"),
        ("adcp_month", "u1"),
        ("adcp_time", "<u4"),
        ("pitch", "<i2"),
        ("roll", "<i2"),
        ("heading", "<u2"),
        ("counts", "<u2", (5,)),
    ]
)
_PLACED = 94
_POSITION, _SPEED, _COURSE, _DATE, _MADE_GOOD, _TILT, _HEADING, _OFFSET = (
    *(1 << 1, 1 << 2, 1 << 4, 1 << 5),
    *(1 << 6, 1 << 7, 1 << 8, 1 << 10),
)
_BAM4, _BAM2 = np.pi / 2.0**31, np.pi / 2.0**15
# Kinds by the numbers that stand before a message: first form with longer names.
_BINARY = {100: ("GGA", 10), 104: ("GGA", 7), 101: ("VTG", 10), 105: ("VTG", 7)}
_BINARY |= {103: ("HDT", 10), 107: ("HDT", 7)}
_GENERAL, _TEXT = 0x2022, (0x2100, 0x2101, 0x2102, 0x2103, 0x2104)


def vmdas_fixes(
    data: Bytes, frames: Index, begin: Index, end: Index, present: NDArray[np.bool_]
) -> Records:
    """Read the navigation that VmDas stores with an ensemble.

    Parameters
    ----------
    data : Bytes
        What the ensembles lie in.
    frames : ndarray of int, shape (K, 2)
        Starts and stops of ensembles.
    begin, end, present : ndarray, shape (K,)
        Where the data type stands, as listed in the header.

    Returns
    -------
    Records, shape (M,)
        Of type `VMDAS`; nan where the flags call a value invalid.
    """
    start, stop = frames[:, 0], frames[:, 1]
    # Some versions do not list it: it is then the last of the ensemble.
    unlisted = ~present & (stop - _PLACED > start + 6)
    tail = np.where(unlisted, stop - _PLACED, start)
    unlisted = unlisted & (data[tail] == 0x00) & (data[tail + 1] == 0x20)
    row = np.flatnonzero(present | unlisted)
    at = np.where(present, begin, tail)[row]
    raw = np.ascontiguousarray(data[at[:, None] + np.arange(_RAW.itemsize)]).view(_RAW)[:, 0]
    out = np.zeros(len(row), VMDAS)
    out["at"], out["flags"] = start[row], raw["flags"]
    dated = (raw["flags"] & _DATE) > 0
    day = posix(raw["year"], raw["month"], raw["day"])
    out["last_utc"] = np.where(dated, day + raw["last_time"] * 1e-4, np.nan)
    out["first_utc"] = nearest_day(raw["first_time"] * 1e-4, out["last_utc"])
    adcp_day = posix(raw["adcp_year"], raw["adcp_month"], raw["adcp_day"])
    out["time"] = adcp_day + raw["adcp_time"] * 1e-2
    values = {
        "first_lat": (_POSITION, raw["first"][:, 0] * _BAM4),
        "first_lon": (_POSITION, raw["first"][:, 1] * _BAM4),
        "last_lat": (_POSITION, raw["last"][:, 0] * _BAM4),
        "last_lon": (_POSITION, raw["last"][:, 1] * _BAM4),
        "speed": (_SPEED, raw["speed"] * 1e-3),
        "course": (_COURSE, raw["course"] * _BAM2),
        "made_good_speed": (_MADE_GOOD, raw["made_good_speed"] * 1e-3),
        "made_good_course": (_MADE_GOOD, raw["made_good_course"] * _BAM2),
        "pc_minus_utc": (_OFFSET, raw["offset"] * 1e-3),
        "heading": (_HEADING, raw["heading"] * _BAM2),
        "pitch": (_TILT, raw["pitch"] * _BAM2),
        "roll": (_TILT, raw["roll"] * _BAM2),
    }
    for name, (flag, value) in values.items():
        out[name] = np.where((raw["flags"] & flag) > 0, value, np.nan)
    return out


def embedded_sentences(
    data: Bytes, identity: Index, begin: Index, end: Index, pings: Records, offset: int
) -> dict[str, Records]:
    """Read the sentences that WinRiver stores with ensembles, text or binary.

    Parameters
    ----------
    data : Bytes
        What the ensembles lie in.
    identity, begin, end : ndarray of int, shape (K, J)
        Kind and place of each data type.
    pings : Records, shape (K,)
        Pings with `time`.
    offset : int
        Position of `data` in the file.

    Returns
    -------
    dict of str to Records
        As `read_nmea` returns them.
    """
    parts: dict[str, list[tuple[object, ...]]] = {name: [] for name in KINDS}
    where = np.nonzero((identity == _GENERAL) | np.isin(identity, _TEXT))
    for kind, first, last, time in zip(
        *(part[where].tolist() for part in (identity, begin, end)),
        pings["time"][where[0]].tolist(),
        strict=True,
    ):
        message, received, number = data[first + 2 : last].tobytes(), math.nan, 0
        if kind == _GENERAL:
            if len(message) < 12:
                continue
            number, size, delta = struct.unpack_from("<HHd", message)
            message, first = message[12 : 12 + size], first + 12
            # Beyond a day it is no delay.
            if abs(delta) < 86400.0:
                received = time - delta
        place = first + 2 + offset
        # The name is then followed by zeros; numbers may hold any byte, commas among them.
        if number in _BINARY and message[6:7] == b"\0":
            name, name_size = _BINARY[number]
            row = _binary(name, message, name_size)
            if row is not None:
                parts[name].append((place, received, False, message[1:3], *row))
            continue
        for sentence in sentences(message, ADDRESSES):
            name, row = decode(sentence)
            if row is not None:
                head = (place + sentence.at, received, sentence.checked, sentence.address[:2])
                parts[name].append((*head, *row))
    return {name: np.array(rows, KINDS[name]) for name, rows in parts.items()}


def _binary(kind: str, message: bytes, name_size: int) -> Row | None:
    """Return the values of a sentence that WinRiver II turned into binary, or None."""
    body = message[name_size:]
    if not message.startswith(b"$") or message[3:6] != kind.encode():
        return None
    if kind == "GGA" and len(body) >= 50:
        utc, lat, north, lon, east, quality, satellites, hdop, altitude, _, separation, _, age = (
            struct.unpack_from("<10sdcdcBBffcfcf", body)
        )
        lat *= _sign(north, b"NS", lat, 90.0)
        lon *= _sign(east, b"EW", lon, 180.0)
        # The form cannot say that a separation was not given; an exact 0 is that.
        separation = separation if separation != 0.0 else math.nan
        values = (lat * DEG, lon * DEG, quality, satellites, hdop)
        heights = (altitude, separation, altitude + separation, age)
        return (second_of_day(utc.rstrip(b"\0 ")), *values, *heights)
    if kind == "VTG" and len(body) >= 20:
        course, _, _, _, knots = struct.unpack_from("<fcfcf", body)
        return course * DEG, knots * KNOT
    if kind == "HDT" and len(body) >= 8:
        return (struct.unpack_from("<d", body)[0] * DEG,)
    return None


def _sign(side: bytes, sides: bytes, value: float, limit: float) -> float:
    if not 0.0 <= value <= limit or side not in (sides[:1], sides[1:]):
        return math.nan
    return 1.0 if side == sides[:1] else -1.0
