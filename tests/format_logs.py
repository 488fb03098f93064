"""Logs of vehicles as their documents describe them, written without the libraries that read them.

Bags of rosbags' own writer are the exception; they are compared with the values that it was given.
"""

from __future__ import annotations

import io
import struct
import tempfile
from pathlib import Path

import format_writers as writers
import numpy as np

START = 1_600_000_000
HEADER = "std_msgs/Header header\n"
TIME = "int32 sec\nuint32 nanosec\n"
DEFINITIONS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": TIME,
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "sensor_msgs/NavSatStatus": "int8 status\nuint16 service\n",
    "sensor_msgs/Imu": HEADER
    + "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    + "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    + "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
    "sensor_msgs/NavSatFix": HEADER
    + "NavSatStatus status\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude\n"
    + "float64[9] position_covariance\nuint8 position_covariance_type\n",
    "marine_acoustic_msgs/Dvl": HEADER
    + "uint8 velocity_mode\nuint8 dvl_type\ngeometry_msgs/Vector3 velocity\n"
    + "float64[9] velocity_covar\nfloat64 altitude\nfloat64 course_gnd\nfloat64 speed_gnd\n"
    + "uint8 num_good_beams\nfloat32 sound_speed\nbool beam_ranges_valid\n"
    + "bool beam_velocities_valid\ngeometry_msgs/Vector3[4] beam_unit_vec\nfloat64[4] range\n"
    + "float32[4] range_covar\nfloat32[4] beam_quality\nfloat32[4] beam_velocity\n"
    + "float32[4] beam_velocity_covar\n",
}
DEFINITIONS |= {
    "dvl_msgs/DVLBeam": "int64 id\nfloat64 velocity\nfloat64 distance\nbool valid\n",
    "dvl_msgs/DVL": HEADER
    + "geometry_msgs/Vector3 velocity\nfloat64 fom\nDVLBeam[] beams\nbool velocity_valid\n",
}
NEEDS = {
    "dvl_msgs/DVL": ("geometry_msgs/Vector3", "dvl_msgs/DVLBeam"),
    "sensor_msgs/Imu": ("geometry_msgs/Quaternion", "geometry_msgs/Vector3"),
    "sensor_msgs/NavSatFix": ("sensor_msgs/NavSatStatus",),
    "marine_acoustic_msgs/Dvl": ("geometry_msgs/Vector3",),
}


def schema(name):
    parts = [DEFINITIONS[name]]
    for other in (*NEEDS[name], "std_msgs/Header", "builtin_interfaces/Time"):
        parts.append(f"{'=' * 80}\nMSG: {other}\n{DEFINITIONS[other]}")
    return "\n".join(parts)


def cdr(*values):
    """Pack (format, value, ...) pairs as CDR: each number at a multiple of its size."""
    out = bytearray()
    for form, *numbers in values:
        if form == "s":
            text = numbers[0].encode() + b"\0"
            out += b"\0" * (-len(out) % 4) + struct.pack("<I", len(text)) + text
            continue
        size = struct.calcsize("<" + form)
        out += b"\0" * (-len(out) % size) + struct.pack(f"<{len(numbers)}{form}", *numbers)
    return b"\x00\x01\x00\x00" + bytes(out)


def stamp(seconds):
    return ("i", int(seconds)), ("I", round((seconds % 1) * 1e9))


def imu_message(seconds, gyro, accel, quaternion=(0, 0, 0, 1), unset=False):
    cov = [-1.0 if unset else 0.0, *[0.0] * 8]
    return cdr(
        *stamp(seconds),
        ("s", "imu"),
        ("d", *quaternion),
        ("d", *cov),
        ("d", *gyro),
        ("d", *[0.0] * 9),
        ("d", *accel),
        ("d", *[0.0] * 9),
    )


def fix_message(seconds, lat, lon, height, status=0, variances=(1.0, 4.0, 9.0)):
    cov = np.diag(variances).ravel()
    return cdr(
        *stamp(seconds),
        ("s", "gps"),
        ("b", status),
        ("H", 1),
        ("d", lat, lon, height),
        ("d", *cov),
        ("B", 2),
    )


UNIT_VECTORS = np.array(
    [[0.5, 0, 0.75**0.5], [-0.5, 0, 0.75**0.5], [0, 0.5, 0.75**0.5], [0, -0.5, 0.75**0.5]]
)


def dvl_message(seconds, velocity, mode=1, beams=4, sign=1.0):
    along = sign * UNIT_VECTORS @ np.nan_to_num(velocity)
    return cdr(
        *stamp(seconds),
        ("s", "dvl"),
        ("B", mode, 0),
        ("d", *velocity),
        ("d", *np.diag([1e-4, 4e-4, 9e-4]).ravel()),
        ("d", 12.0, 0.0, 0.0),
        ("B", beams),
        ("f", 1480.0),
        ("?", True, True),
        ("d", *UNIT_VECTORS.ravel()),
        ("d", 10.0, 0.0, 12.0, 13.0),
        ("f", *[-1.0] * 4),
        ("f", *[0.0] * 4),
        ("f", *along),
        ("f", *[-1.0] * 4),
    )


def foreign_dvl_message(seconds, velocity, valid=True):
    beams = [(("q", i), ("d", 0.1 * i, 10.0 + i), ("?", True)) for i in range(4)]
    return cdr(
        *stamp(seconds),
        ("s", "dvl"),
        ("d", *velocity),
        ("d", 0.02),
        ("I", 4),
        *(value for beam in beams for value in beam),
        ("?", valid),
    )


def mcap(messages, chunk_size=1 << 20):
    """Return an MCAP file of (topic, type, seconds, data), by the reference library."""
    from mcap.writer import CompressionType, Writer

    out = io.BytesIO()
    writer = Writer(out, chunk_size=chunk_size, compression=CompressionType.NONE)
    writer.start(profile="ros2", library="test")
    channels = {}
    for topic, kind, seconds, data in messages:
        if topic not in channels:
            package, name = kind.split("/")
            identity = writer.register_schema(
                f"{package}/msg/{name}", "ros2msg", schema(kind).encode()
            )
            channels[topic] = writer.register_channel(topic, "cdr", identity)
        when = round(seconds * 1e9)
        writer.add_message(channels[topic], log_time=when, publish_time=when, data=data)
    writer.finish()
    return out.getvalue()


def ros_1_bag(messages, chunk_size=4000):
    """Return a ROS 1 bag of (topic, type, seconds, data), by rosbags' own writer."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    # Headers of ROS 1 also have a number, which the conversion adds.
    store, older = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
    kind = "marine_acoustic_msgs/msg/Dvl"
    for one in (store, older):
        one.register(get_types_from_msg(DEFINITIONS["marine_acoustic_msgs/Dvl"], kind))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.bag"
        with Writer(path) as writer:
            writer.chunk_threshold = chunk_size
            connections = {}
            for topic, kind, seconds, data in messages:
                name = kind.replace("/", "/msg/")
                if topic not in connections:
                    text, digest = older.generate_msgdef(name)
                    connections[topic] = writer.add_connection(
                        topic, name, msgdef=text, md5sum=digest
                    )
                raw = store.cdr_to_ros1(data, name)
                writer.write(connections[topic], round(seconds * 1e9), raw)
        return path.read_bytes()


def sea_trial(count=40):
    """Return the messages of a short trial: IMU, fixes, DVL."""
    out = []
    for i in range(count):
        t = START + 0.25 * i
        out.append(
            ("/imu", "sensor_msgs/Imu", t + 0.01, imu_message(t, (0.1, 0.2, i), (0, 0, 9.8)))
        )
        if i % 4 == 0:
            fix = fix_message(t, 54.0 + i * 1e-6, -3.0, 40.0)
            out.append(("/gps/fix", "sensor_msgs/NavSatFix", t + 0.05, fix))
            dvl = dvl_message(t, (1.0 + i, -0.5, 0.25))
            out.append(("/dvl", "marine_acoustic_msgs/Dvl", t + 0.02, dvl))
    return out


# --- ArduPilot -----------------------------------------------------------------------------------

SIZES = {"B": 1, "b": 1, "H": 2, "h": 2, "I": 4, "i": 4, "f": 4, "d": 8, "Q": 8, "q": 8}
SIZES |= {"c": 2, "C": 2, "e": 4, "E": 4, "L": 4, "n": 4, "N": 16, "Z": 64, "M": 1}
PACK = {
    "c": "h",
    "C": "H",
    "e": "i",
    "E": "I",
    "L": "i",
    "n": "4s",
    "N": "16s",
    "Z": "64s",
    "M": "B",
}
LOG_MESSAGES = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "UNIT": (129, "QbZ", "TimeUS,Id,Label"),
    "MULT": (130, "Qbd", "TimeUS,Id,Mult"),
    "FMTU": (131, "QBNN", "TimeUS,FmtType,UnitIds,MultIds"),
    "IMU": (132, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "GPS": (
        133,
        "QBBIHBcLLeffffB",
        "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U",
    ),
    "GPA": (134, "QBCCCCf", "TimeUS,I,VDop,HAcc,VAcc,SAcc,Und"),
    "ATT": (135, "QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "PARM": (137, "QNff", "TimeUS,Name,Value,Default"),
    "VISO": (136, "Qffffffff", "TimeUS,dt,AngDX,AngDY,AngDZ,PosDX,PosDY,PosDZ,conf"),
}


def log_message(name, *values):
    """Return a message of a binary log of ArduPilot, its values as they are stored."""
    number, form, _ = LOG_MESSAGES[name]
    packed = struct.pack("<" + "".join(PACK.get(c, c) for c in form), *values)
    return bytes([0xA3, 0x95, number]) + packed


def ardupilot_log(messages):
    out = b""
    for name, (number, form, columns) in LOG_MESSAGES.items():
        length = 3 + sum(SIZES[c] for c in form)
        texts = (text.encode() for text in (name, form, columns))
        out += log_message("FMT", number, length, *texts)
    for name, (number, _, _) in LOG_MESSAGES.items():
        if name in ("IMU", "GPS", "GPA"):
            out += log_message("FMTU", 0, number, b"s#", b"F-")
    return out + b"".join(log_message(*message) for message in messages)


def ardupilot_trial(count=40):
    out = []
    for i in range(count):
        at = 10_000_000 + 50_000 * i
        out.append(("IMU", at, 0, 0.1, 0.2, 0.3 + i, 1.0, 2.0, -9.8))
        out.append(("IMU", at, 1, 0.1, 0.2, 0.3, 1.0, 2.0, -9.7))
        out.append(("ATT", at, 0, 150, 0, -250, 0, 27050))
        if i % 5 == 0:
            out.append(("GPA", at, 0, 120, 50, 90, 12, 47.5))
            place = (540000001 + i, -30000002, 4025)
            out.append(
                (
                    "GPS",
                    at,
                    0,
                    6,
                    345600000 + 50 * i,
                    2100,
                    14,
                    80,
                    *place,
                    2.0,
                    90.0,
                    -0.1,
                    0.0,
                    1,
                )
            )
            out.append(("VISO", at, 0.25, 0.0, 0.0, 0.0, 0.25, -0.05, 0.025, 100.0))
    return out


# --- MAVLink telemetry ---------------------------------------------------------------------------

# Number, seed of the checksum, and values in the order in which they are sent.
MAVLINK = {
    "SYSTEM_TIME": (2, 137, "QI"),
    "GPS_RAW_INT": (24, 24, "QiiiHHHHBBiIIIIH"),
    "RAW_IMU": (27, 144, "Q9hBh"),
    # Version 1 has no extensions.
    "RAW_IMU_1": (27, 144, "Q9h"),
    "ATTITUDE": (30, 39, "I6f"),
    "GLOBAL_POSITION_INT": (33, 104, "I4i3hH"),
    "HEARTBEAT": (0, 50, "I5B"),
    "SCALED_PRESSURE2": (137, 195, "Iff2h"),
    "GPS_INPUT": (232, 151, "QIii9f2H3B"),
    "VISION_POSITION_DELTA": (11011, 106, "QQ7f"),
}


def crc_x25(data):
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0x8408 * (crc & 1)
    return crc


def telemetry(name, seconds, *values, version=2, sender=(1, 1), signed=False):
    """Return a message as a ground station logs it: stamp, header, content, checksum."""
    number, seed, form = MAVLINK[name]
    content = struct.pack("<" + form, *values)
    if version == 2:
        content = content.rstrip(b"\0") or b"\0"
        head = bytes([len(content), int(signed), 0, 7, *sender]) + number.to_bytes(3, "little")
    else:
        head = bytes([len(content), 7, *sender, number])
    crc = crc_x25(head + content + bytes([seed]))
    out = round(seconds * 1e6).to_bytes(8, "big") + bytes([0xFD if version == 2 else 0xFE])
    return out + head + content + crc.to_bytes(2, "little") + bytes(13 if signed else 0)


def telemetry_trial(count=40, start=START, boot=100.0, gps=True):
    """Return a log: each message arrives 20 ms late, some later."""
    out = []
    for i in range(count):
        own, late = boot + 0.1 * i, 0.02 + 0.3 * (i % 3 == 1)
        at = start + 0.1 * i + late
        ms, us = round(own * 1e3), round(own * 1e6)
        out.append(telemetry("HEARTBEAT", at, 0, 12, 3, 81, 4, 3))
        imu = (us, 100, -50, -1000, 10, 20, 30 + i, 0, 0, 0, 0, 0)
        out.append(
            telemetry("RAW_IMU", at, *imu, signed=i % 2 == 0)
            if i % 4
            else telemetry("RAW_IMU_1", at, *imu[:10], version=1)
        )
        out.append(telemetry("ATTITUDE", at, ms, 0.1, -0.2, -0.5, 0.0, 0.0, 0.0))
        out.append(telemetry("SCALED_PRESSURE2", at, ms, 1513.25, 0.0, 1200, 0))
        place = (540000001 + i, -30000002)
        out.append(telemetry("GLOBAL_POSITION_INT", at, ms, *place, 1500, 0, 20, 10, -30, 9000))
        if gps:
            given = (0, 345600000 + 100 * i, *place, -4.5, 1.0, 1.0, 0.1, 0.2, -0.3, 0.4, 1.5, 2.5)
            # Vertical velocity is to be ignored.
            out.append(telemetry("GPS_INPUT", at, *given, 16, 2100, 0, 3, 10, sender=(1, 220)))
        kind = 3 if i else 1
        received = (us, *place, 4000, 100, 100, 250, 9000, kind, 9, 52000, 500, 900, 120, 0, 0)
        out.append(telemetry("GPS_RAW_INT", at, *received))
        delta = (0, 0, 0, 0.1, -0.02, 0.01, 90.0)
        out.append(telemetry("VISION_POSITION_DELTA", at, us, 100_000, *delta, sender=(1, 191)))
        out.append(telemetry("SYSTEM_TIME", at, round((start + 0.1 * i) * 1e6), ms))
    return b"".join(out)


# --- PX4 -----------------------------------------------------------------------------------------


def columns(text):
    """Return (name, type, count) of fields such as `float[3] velocity`."""
    out = []
    for field in text.split("; "):
        kind, name = field.split()
        kind, _, count = kind.rstrip("]").partition("[")
        out.append((name, kind, int(count or 1)))
    return out


ULOG = {
    "sensor_combined": columns(
        "uint64_t timestamp; float[3] gyro_rad; uint32_t gyro_integral_dt; "
        "int32_t accelerometer_timestamp_relative; float[3] accelerometer_m_s2; "
        "uint8_t[4] _padding0"
    ),
    "vehicle_attitude": columns("uint64_t timestamp; uint64_t timestamp_sample; float[4] q"),
    "vehicle_gps_position": columns(
        "uint64_t timestamp; uint64_t time_utc_usec; int32_t lat; int32_t lon; int32_t alt; "
        "int32_t alt_ellipsoid; float eph; float epv; float s_variance_m_s; float vel_n_m_s; "
        "float vel_e_m_s; float vel_d_m_s; uint8_t fix_type; bool vel_ned_valid"
    ),
    # As PX4 has positions since 1.14.
    "sensor_gps": columns(
        "uint64_t timestamp; uint64_t time_utc_usec; double latitude_deg; double longitude_deg; "
        "double altitude_msl_m; double altitude_ellipsoid_m; float eph; float epv; "
        "uint8_t fix_type"
    ),
    "vehicle_visual_odometry": columns(
        "uint64_t timestamp; uint64_t timestamp_sample; float[3] velocity; "
        "float[3] velocity_variance; uint8_t velocity_frame"
    ),
}
LETTERS = {
    "uint64_t": "Q",
    "uint32_t": "I",
    "int32_t": "i",
    "uint8_t": "B",
    "float": "f",
    "double": "d",
    "bool": "?",
}


def ulog(rows):
    """Return a ULog file of (message, instance, values): header, definitions, data."""

    def block(letter, body):
        return struct.pack("<HB", len(body), ord(letter)) + body

    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000)
    out += block("B", bytes(40))
    for name, fields in ULOG.items():
        text = "".join(
            f"{kind}{f'[{count}]' if count > 1 else ''} {field};" for field, kind, count in fields
        )
        out += block("F", f"{name}:{text}".encode())
    key = b"char[4] sys_name"
    out += block("I", bytes([len(key)]) + key + b"PX4\0")
    numbers = {}
    for name, instance, values in rows:
        if (name, instance) not in numbers:
            numbers[name, instance] = len(numbers)
            body = struct.pack("<BH", instance, numbers[name, instance]) + name.encode()
            out += block("A", body)
        letters = "".join(
            f"{count}{LETTERS[kind]}" if count > 1 else LETTERS[kind]
            for field, kind, count in ULOG[name]
            if not field.startswith("_padding")
        )
        body = struct.pack("<H", numbers[name, instance]) + struct.pack("<" + letters, *values)
        out += block("D", body)
        if len(out) % 7 == 0:
            out += block("S", bytes([0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12]))
    return out


def ulog_trial(count=40):
    rows = []
    for i in range(count):
        at = 5_000_000 + 10_000 * i
        rows.append(("sensor_combined", 0, (at, 0.1, 0.2, 0.3, 4000, 0, 1.0, 2.0, -9.8)))
        half = np.radians(270.0) / 2.0
        rows.append(("vehicle_attitude", 0, (at, at - 2000, np.cos(half), 0.0, 0.0, np.sin(half))))
        if i % 5 == 0:
            utc = START * 1_000_000 + 10_000 * i
            place = (540000001 + i, -30000002, 40250, 87750)
            rest = (0.5, 0.9, 0.1, 1.5, -2.5, 0.25, 6, True)
            rows.append(("vehicle_gps_position", 0, (at, utc, *place, *rest)))
            values = (at, at - 5000, 1.0, -0.5, 0.25, 0.01, 0.04, 0.0, 3 if i else 1)
            rows.append(("vehicle_visual_odometry", 0, values))
    return rows


# --- Nortek Nucleus ------------------------------------------------------------------------------


def nucleus_packet(kind, body):
    head = bytes([0xA5, 10, kind, 0x20]) + struct.pack("<H", len(body))
    head += struct.pack("<H", writers.word_sum(body))
    return head + struct.pack("<H", writers.word_sum(head)) + body


def nucleus_body(seconds, offset, size, status=0, posix=True):
    out = bytearray(size)
    out[0:4] = bytes([1, offset, 1 if posix else 0, 0])
    out[4:12] = struct.pack("<II", int(seconds), round((seconds % 1) * 1e6))
    out[12:16] = struct.pack("<I", status)
    return out


def nucleus_imu(seconds, accel, gyro, valid=True, posix=True):
    out = nucleus_body(seconds, 16, 44, int(valid), posix)
    out[16:44] = struct.pack("<7f", *accel, *gyro, 12.0)
    return nucleus_packet(0x82, bytes(out))


def nucleus_track(seconds, velocity, merit=(0.01, 0.02, 0.03), status=0x7FFF, kind=0xB4):
    out = nucleus_body(seconds, 124, 124, status)
    out[24:36] = struct.pack("<3f", 1480.0, 11.0, 10.0)
    out[36:60] = struct.pack("<6f", 0.1, 0.2, 0.3, 10.0, 0.0, 12.0)
    # Durations of estimates along beams, of which one was not made.
    out[84:96] = struct.pack("<3f", 0.004, 0.0, 0.006)
    out[96:124] = struct.pack("<7f", *velocity, *merit, 0.02)
    return nucleus_packet(kind, bytes(out))


def nucleus_ahrs(seconds, rph, declination=0.0, depth=3.5):
    out = nucleus_body(seconds, 36, 108)
    out[36:48] = struct.pack("<3f", *rph)
    out[100:108] = struct.pack("<2f", declination, depth)
    return nucleus_packet(0xD2, bytes(out))


def nucleus_ins(seconds, lat, lon, ned, located=True):
    out = nucleus_body(seconds, 36, 36 + 172)
    out[36 + 76 : 36 + 80] = struct.pack("<I", int(located))
    out[36 + 96 : 36 + 112] = struct.pack("<2d", lat, lon)
    out[36 + 132 : 36 + 144] = struct.pack("<3f", *ned)
    return nucleus_packet(0xDC, bytes(out))


def nucleus_trial(count=40):
    out = b""
    for i in range(count):
        t = START + 0.1 * i
        out += nucleus_imu(t, (0.1, 0.2, -9.8), (0.01, 0.02, i))
        out += nucleus_track(t, (1.0 + i, -0.5, 0.25))
        out += nucleus_ahrs(t, (1.5, -2.5, 270.5))
        out += nucleus_ins(t, 54.0, -3.0, (1.0, 2.0, 3.0))
    return out
