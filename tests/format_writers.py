"""Files as the makers' documents describe them, written without the readers' tables."""

from __future__ import annotations

import struct
from functools import reduce
from operator import xor


def nmea(text):
    """Return a sentence with its checksum, of what stands between `$` and `*`."""
    return b"$%s*%02X\r\n" % (text.encode(), reduce(xor, text.encode()))


def pd0(parts):
    """Return an ensemble of data types, each with its identity in front (Figure 32)."""
    header = 6 + 2 * len(parts)
    offsets, at = [], header
    for part in parts:
        offsets.append(at)
        at += len(part)
    body = b"\x7f\x7f" + struct.pack("<HBB", at, 0, len(parts))
    body += struct.pack(f"<{len(parts)}H", *offsets) + b"".join(parts)
    return body + struct.pack("<H", sum(body) % 65536)


def fixed_leader(
    *,
    frame=0,
    cells=2,
    up=False,
    convex=True,
    angle=1,
    alignment=0,
    tilts=True,
    pings=(1, 0.0),
    sensors=0,
):
    """Return Table 33: configuration, cells, pings and interval in s, EX, EA, EZ; 59 bytes."""
    out = bytearray(59)
    out[0:2] = b"\x00\x00"
    out[4] = 0b0100_0011 | (0x80 if up else 0) | (0x08 if convex else 0)
    out[5] = 0x40 | angle
    out[8], out[9] = 4, cells
    out[10:12] = struct.pack("<H", pings[0])
    out[22:25] = int(pings[1]) // 60, int(pings[1]) % 60, round(pings[1] % 1.0 * 100.0)
    out[12:14] = struct.pack("<H", 50)
    out[25] = frame << 3 | (0b100 if tilts else 0) | 0b10
    out[26:28] = struct.pack("<h", alignment)
    out[30] = sensors
    out[32:34] = struct.pack("<H", 110)
    return bytes(out)


def variable_leader(number, when, *, heading=0.0, pitch=0.0, roll=0.0, century=True):
    """Return Table 34 for a datetime, angles in degrees; 65 bytes."""
    out = bytearray(65)
    out[0:2] = b"\x80\x00"
    out[2:4] = struct.pack("<H", number & 0xFFFF)
    out[11] = number >> 16
    clock = (when.month, when.day, when.hour, when.minute, when.second, when.microsecond // 10000)
    out[4:11] = bytes([when.year % 100, *clock])
    out[14:16] = struct.pack("<H", 1500)
    out[18:20] = struct.pack("<H", round(heading * 100))
    out[20:24] = struct.pack("<hh", round(pitch * 100), round(roll * 100))
    out[26:28] = struct.pack("<h", 1234)
    if century:
        out[57:65] = bytes([when.year // 100, when.year % 100, *clock])
    return bytes(out)


def bottom_track(velocity, ranges):
    """Return bottom track, m/s (None: bad) and m; 81 bytes."""
    out = bytearray(81)
    out[0:2] = b"\x00\x06"
    for i in range(4):
        v = -32768 if velocity[i] is None else round(velocity[i] * 1000)
        out[24 + 2 * i : 26 + 2 * i] = struct.pack("<h", v)
        far = round(ranges[i] * 100)
        out[16 + 2 * i : 18 + 2 * i] = struct.pack("<H", far & 0xFFFF)
        out[77 + i] = far >> 16
        out[32 + i], out[36 + i], out[40 + i] = 200 + i, 80 + i, 100
    return bytes(out)


def water_profile(cells):
    """Return velocities of cells, mm/s integers (C, 4)."""
    return b"\x00\x01" + b"".join(struct.pack("<4h", *cell) for cell in cells)


def winriver_text(number, delta, sentence):
    """Return a general NMEA message (RiverPro guide, Table 42)."""
    return b"\x22\x20" + struct.pack("<HHd", number, len(sentence), delta) + sentence


def winriver_gga(delta, utc, lat, lon, quality, altitude, separation):
    """Return the binary GGA of WinRiver II; southern and western are negative."""
    body = b"$GPGGA\0" + utc.encode().ljust(10, b"\0")
    body += struct.pack("<d", abs(lat)) + (b"N" if lat >= 0 else b"S")
    body += struct.pack("<d", abs(lon)) + (b"E" if lon >= 0 else b"W")
    body += struct.pack("<BBff", quality, 9, 0.8, altitude) + b"M"
    body += struct.pack("<f", separation) + b"M" + struct.pack("<fH", 1.0, 133)
    return winriver_text(104, delta, body)


def vmdas(day, first, last, offset_s, adcp_day, adcp_second, heading, flags):
    """Return VmDas navigation: fixes are (second of the day, lat, lon), degrees; 94 bytes."""
    bam = lambda degrees: round(degrees * 2**31 / 180)  # noqa: E731
    out = b"\x00\x20" + struct.pack("<BBH", day.day, day.month, day.year)
    out += struct.pack("<IiII", round(first[0] * 1e4), round(offset_s * 1e3), 0, 0)[:8]
    out += struct.pack("<ii", bam(first[1]), bam(first[2]))
    out += struct.pack("<Iii", round(last[0] * 1e4), bam(last[1]), bam(last[2]))
    out += struct.pack("<8H", 1500, 0x4000, 0, 1400, 0x8000, 0, flags, 0)
    out += struct.pack(
        "<IHBBI", 7, adcp_day.year, adcp_day.day, adcp_day.month, round(adcp_second * 100)
    )
    out += struct.pack("<hhH", 0, 0, round(heading * 65536 / 360) & 0xFFFF)
    return out.ljust(94, b"\0")


def ad2cp(kind, data):
    """Return a record with its header (Integrator's Guide 6.1)."""
    header = struct.pack("<BBBBHH", 0xA5, 10, kind, 0x10, len(data), word_sum(data))
    return header + struct.pack("<H", word_sum(header)) + data


def word_sum(data):
    """Return 0xB58C plus 16-bit words."""
    total = 0xB58C
    for i in range(0, len(data) - 1, 2):
        total += data[i] | data[i + 1] << 8
    if len(data) % 2:
        total += data[-1] << 8
    return total % 65536


def df20(when, velocity, distance, merit, *, heading=0.0, scale=-5, frame=2, ahrs=None):
    """Return a bottom-track record, velocities m/s, distances m."""
    flags = 1 << 5 | 1 << 8 | 1 << 9 | (0 if ahrs is None else 1 << 10)
    out = bytearray(78)
    struct.pack_into("<BBHI", out, 0, 1, 78, flags, 101654)
    struct.pack_into(
        "<6B",
        out,
        8,
        when.year - 1900,
        when.month - 1,
        when.day,
        when.hour,
        when.minute,
        when.second,
    )
    struct.pack_into("<HHhI", out, 14, when.microsecond // 100, 15000, 1200, 10500)
    struct.pack_into("<HhhH", out, 24, round(heading * 100), 150, -200, 4 << 12 | frame << 10)
    struct.pack_into("<b", out, 60, scale)
    struct.pack_into("<I", out, 74, 77)
    body = struct.pack("<4i", *(round(v / 10.0**scale) for v in velocity))
    body += struct.pack("<4i", *(round(d * 1000) for d in distance))
    body += struct.pack("<4H", *merit)
    if ahrs is not None:
        body += struct.pack("<16f", *ahrs)
    return bytes(out) + body


def df21(when, velocity, beams, ranges, *, merit=0.01, delay=0.02, status=0xFFFFF):
    """Return a track of a DVL: X, Y, Z1, Z2 and four beams, m/s, ranges in m; 212 bytes."""
    out = struct.pack("<BBI", 1, 36, 4711)
    clock = (when.year - 1900, when.month - 1, when.day, when.hour, when.minute, when.second)
    out += struct.pack("<6BHHII", *clock, when.microsecond // 100, 4, 0, status)
    out += struct.pack("<3f", 1490.0, 11.5, 2.25)
    for values in (beams, ranges, [merit] * 4, [delay] * 4, [-0.1] * 4, [0.005] * 4):
        out += struct.pack("<4f", *values)
    for values in (velocity, [merit] * 4, [delay] * 4, [-0.1] * 4, [0.005] * 4):
        out += struct.pack("<4f", *values)
    return out


def pd4(frame, velocity, ranges, clock, *, long=False, heading=0.0):
    """Return PD4, or PD5 if long (Tables 48 and 49); velocities m/s, None: bad."""
    v = [-32768 if x is None else round(x * 1000) for x in velocity]
    out = struct.pack(
        "<BBHB4h4HB",
        0x7D,
        int(long),
        86 if long else 45,
        frame << 6,
        *v,
        *(round(r * 100) for r in ranges),
        0,
    )
    out += struct.pack("<4hHHB4BHHh", 0, 0, 0, 0, 0, 0, 0, *clock, 0, 1501, 1050)
    if long:
        out += struct.pack("<BHhhH8i", 35, 123, 150, -250, round(heading * 100), *range(8))
    return out + struct.pack("<H", sum(out) % 65536)


def rowe(number, when, bottom, sentence=b"", pings=1.0):
    """Return a Rowe ensemble; `bottom` is what follows the 14 leading floats, by beams."""

    def data_set(kind, elements, multiplier, name, content):
        return (
            struct.pack("<5I", kind, elements, multiplier, 0, 8) + name.ljust(8, b"\0") + content
        )

    clock = (
        when.year,
        when.month,
        when.day,
        when.hour,
        when.minute,
        when.second,
        when.microsecond // 10000,
    )
    ints = struct.pack("<6I7I", number, 30, 4, 1, 1, 0, *clock) + bytes(40)
    lead = [0.0, 1.0, 123.0, 2.0, 181.0, 11.0, 20.0, 35.0, 1.0, 2.0, 1480.0, 0.0]
    lead += [len(bottom) / 10.0, pings]
    floats = struct.pack(f"<{14 + len(bottom)}f", *lead, *bottom)
    payload = data_set(20, 23, 1, b"E000008", ints) + data_set(
        10, len(floats) // 4, 1, b"E000010", floats
    )
    if sentence:
        payload += data_set(50, len(sentence), 1, b"E000011", sentence)
    mask = 0xFFFFFFFF
    header = b"\x80" * 16 + struct.pack(
        "<4I", number, number ^ mask, len(payload), len(payload) ^ mask
    )
    crc = 0
    for byte in payload:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return header + payload + struct.pack("<I", crc)


def sbet(rows):
    """Return records of 17 doubles."""
    return b"".join(struct.pack("<17d", *row) for row in rows)
