"""Teledyne PD0 of a trial: pings with the sentences of GNSS, as WinRiver stores them.

Source: Teledyne, Pathfinder DVL Guide (April 2018), PD0 Output Data Format; RiverPro and
RioPro ADCP Guide (October 2017), NMEA PD0 Message Format.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats.janus import beam_directions
from factorgraph_dvl.geometry.rotations import (
    exp_so3,
    rotation_from_rph,
    rph_from_rotation,
)
from factorgraph_dvl.geometry.units import DEG, KNOT
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.attitude import Attitude
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.dvl_beams import DvlBeams
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.trial import Trial

# A velocity that is missing, as TRDI defines it, and the coordinates of a ping.
_BAD = -32768
_INSTRUMENT, _BEAM = 1, 0
# Nominal beam angles that the format has a code for, deg.
_ANGLES = (15, 20, 30)
# What beams may be off the nominal ones by, deg. Chosen: ten times what calibrations find.
_NEAR_BEAM = 0.5
# Time between samples of attitude, s, beyond which angles are not interpolated. Chosen: a vessel
# turns meanwhile.
_LONGEST_STEP = 5.0
# Bits of EZ: pitch and roll are those of the instrument; a heading would be magnetic.
_OWN_TILT = 0b01100
_GENERAL = 204


def write_pd0(trial: Trial, begin: float, path: Path) -> list[str]:
    """Write the pings of a trial, with its fixes.

    Parameters
    ----------
    trial : Trial
        Trial with `dvl`, or with `dvl_beams` of a Janus instrument.
    begin : float, s
        UTC of time zero, since 1970.
    path : path-like
        Path of the file.

    Returns
    -------
    list of str
        What the format has no room for.

    Raises
    ------
    DataError
        If the trial has no such log, or a velocity is beyond the format.
    """
    log: Dvl | DvlBeams | None = trial.dvl if trial.dvl is not None else trial.beams
    if log is None:
        raise DataError("has no velocity log", where=trial.name, expected="dvl or dvl_beams")
    if np.nanmax(np.abs(log.velocity), initial=0.0) > 32.767:
        raise DataError(
            "has velocities above 32.767 m/s", where=log.source, expected="the range of PD0"
        )
    code = _angle_code(log) if isinstance(log, DvlBeams) else 2
    rph = _attitudes(trial, log)
    frame = _BEAM if isinstance(log, DvlBeams) else _INSTRUMENT
    with path.open("wb") as file:
        sentences = _sentences(trial.gnss, begin, log.time)
        for number, (time, velocity, angles, text) in enumerate(
            zip(log.time.tolist(), log.velocity, rph, sentences, strict=True), 1
        ):
            parts = [_fixed_leader(frame, code), _variable_leader(number, begin + time, angles)]
            parts.append(_bottom_track(velocity, frame))
            file.write(_ensemble(parts + text))
    notes = ["velocities are rounded to 1 mm/s, and stamps to 10 ms"]
    written = {log.section, "gnss", "attitude" if np.isfinite(rph).any() else ""}
    others = [r for r in (trial.imu, *trial.aids) if r is not None and r.section not in written]
    if others:
        notes.append(f"PD0 has no room for {', '.join(record.section for record in others)}")
    return notes


def _angle_code(log: DvlBeams) -> int:
    nominal = log.settings.nominal_d
    for code, angle in enumerate(_ANGLES):
        if nominal.shape == (4, 3):
            cosine = np.sum(nominal * beam_directions(angle * DEG), axis=1)
            if np.all(np.arccos(np.clip(cosine, -1.0, 1.0)) < _NEAR_BEAM * DEG):
                return code
    raise DataError(
        "its beams are not those of a Janus instrument",
        where=log.source,
        expected=f"four beams, {', '.join(map(str, _ANGLES))}° from the vertical, in the axes "
        "starboard, forward, up",
    )


def _attitudes(trial: Trial, log: Dvl | DvlBeams) -> Array:
    """Return roll, pitch and heading of the instrument (M, 3), rad, nan where not known."""
    source: Attitude | Ins | None = trial.find(Attitude) or trial.find(Ins)
    out = np.full((log.time.size, 3), np.nan)
    if source is None:
        return out
    known = np.isfinite(source.rph).all(axis=1)
    time, rph = source.time[known], source.rph[known]
    if time.size < 2:
        return out
    place = np.clip(np.searchsorted(time, log.time), 1, time.size - 1)
    inside = (log.time >= time[0]) & (log.time <= time[-1])
    near = inside & (time[place] - time[place - 1] < _LONGEST_STEP)
    angles = [np.interp(log.time, time, column) for column in np.unwrap(rph, axis=0).T]
    nRb = rotation_from_rph(np.stack(angles, axis=1), trial.body_axes)
    dRb = exp_so3(np.array(log.settings.misalignment_deg) * DEG)
    turned = rph_from_rotation(nRb @ dRb.T, "RFU")
    return np.where(near[:, None], turned, np.nan)


def _sentences(gnss: Gnss | None, begin: float, pings: Array) -> Iterator[list[bytes]]:
    """Yield for each ping the fixes since the ping before, with their delays."""
    first = 0
    for time in pings.tolist():
        last = 0 if gnss is None else int(np.searchsorted(gnss.time, time, "right"))
        parts = []
        for row in range(first, last):
            assert gnss is not None
            delay = time - float(gnss.time[row])
            parts += [_general(delay, text) for text in _fix(gnss, row, begin)]
        first = last
        yield parts


def _general(delay: float, sentence: bytes) -> bytes:
    return b"\x22\x20" + struct.pack("<HHd", _GENERAL, len(sentence), delay) + sentence


def _fix(gnss: Gnss, row: int, begin: float) -> Iterator[bytes]:
    when = datetime.fromtimestamp(begin, UTC) + timedelta(seconds=float(gnss.time[row]))
    clock = when.strftime("%H%M%S.") + f"{when.microsecond // 1000:03d}"
    date = when.strftime("%d%m%y")
    lat, lon, height = gnss.geodetic[row].tolist()
    if not np.isfinite(lat):
        return
    place = f"{_angle(lat, 2)},{'NS'[lat < 0]},{_angle(lon, 3)},{'EW'[lon < 0]}"
    east, north = gnss.velocity[row, :2].tolist()
    motion = ","
    if np.isfinite(east):
        knots = np.hypot(east, north) / KNOT
        motion = f"{knots:.4f},{np.arctan2(east, north) / DEG % 360.0:.4f}"
    yield _checked(f"GPRMC,{clock},A,{place},{motion},{date},,,A")
    # Height above the ellipsoid, with a geoid that coincides.
    yield _checked(f"GPGGA,{clock},{place},{_quality(gnss, row)},10,1.0,{height:.4f},M,0.0,M,,")


def _quality(gnss: Gnss, row: int) -> int:
    level = float(np.max(gnss.position_std[row, :2]))
    return 4 if level < 0.1 else 5 if level < 0.5 else 2 if level < 2.0 else 1


def _angle(value: float, digits: int) -> str:
    # Rounded first: 59.99999999 minutes would be written as 60.
    minutes = round(abs(value) / DEG * 60.0, 8)
    return f"{int(minutes // 60.0):0{digits}d}{minutes % 60.0:011.8f}"


def _checked(text: str) -> bytes:
    return b"$%s*%02X\r\n" % (text.encode(), reduce(xor, text.encode()))


def _ensemble(parts: list[bytes]) -> bytes:
    at = 6 + 2 * len(parts)
    offsets = []
    for part in parts:
        offsets.append(at)
        at += len(part)
    body = b"\x7f\x7f" + struct.pack(f"<HBB{len(parts)}H", at, 0, len(parts), *offsets)
    body += b"".join(parts)
    return body + struct.pack("<H", sum(body) & 0xFFFF)


def _fixed_leader(frame: int, angle_code: int) -> bytes:
    out = bytearray(59)
    # Convex, and looking down.
    out[4], out[5] = 0b0100_1011, 0x40 | angle_code
    out[8] = 4
    out[10:12] = struct.pack("<H", 1)
    out[25] = frame << 3
    out[30] = out[31] = _OWN_TILT
    out[58] = _ANGLES[angle_code]
    return bytes(out)


def _variable_leader(number: int, time: float, rph: Array) -> bytes:
    out = bytearray(65)
    when = datetime.fromtimestamp(round(time, 2), UTC)
    # Hundredths of the time itself: those of microseconds would be cut, not rounded.
    hundredths = int(round(time % 1.0, 2) * 100.0 + 0.5) % 100
    clock = bytes([when.month, when.day, when.hour, when.minute, when.second, hundredths])
    out[0:2] = b"\x80\x00"
    out[2:4], out[11] = struct.pack("<H", number & 0xFFFF), number >> 16 & 0xFF
    out[4:11] = bytes([when.year % 100]) + clock
    out[57:65] = bytes([when.year // 100, when.year % 100]) + clock
    roll, pitch, heading = np.nan_to_num(rph / DEG).tolist()
    out[18:20] = struct.pack("<H", round(heading % 360.0 * 100.0) % 36000)
    out[20:24] = struct.pack("<hh", round(pitch * 100.0), round(roll * 100.0))
    return bytes(out)


def _bottom_track(velocity: Array, frame: int) -> bytes:
    out = bytearray(81)
    out[0:2] = b"\x00\x06"
    # The bottom's velocity; along beams it is positive towards the transducer, as it is here.
    values = velocity if frame == _BEAM else np.append(-velocity, np.nan)
    cells = [_BAD if np.isnan(x) else round(x * 1000.0) for x in values.tolist()]
    out[24:32] = struct.pack("<4h", *cells)
    for i, cell in enumerate(cells):
        out[40 + i] = 0 if cell == _BAD else 100
    return bytes(out)
