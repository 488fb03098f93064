"""PX4 logs (ULog), through pyulog.

Source: PX4, uORB message reference. Bodies are forward, right, down. Times are microseconds since
the start, which GPS messages relate to UTC.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats.format import Batch, Format, empty, left_out, positive
from factorgraph_dvl.files.formats.framing import Source, map_file
from factorgraph_dvl.files.formats.losses import REPEATED, UNKNOWN_TYPE, Losses
from factorgraph_dvl.files.formats.vehicles.library import (
    gga_quality,
    load,
    locate,
    quiet,
    silently,
    started,
    unreadable,
)
from factorgraph_dvl.files.formats.velocities import INSTRUMENT
from factorgraph_dvl.geometry.units import MICROSECOND
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.settings.files import open_file

_MAGIC = b"ULog\x01\x12\x35"
# Bytes before the first message, and of the name of a topic that is shown.
_FILE_HEADER, _LONGEST_NAME = 16, 60
_NO_TOPIC = "messages of no topic"
# A receiver without time reports less.
_EARLIEST = 1e8
# Columns by name: of one message of the log.
Columns = Mapping[str, Array]


def share(path: Path, sample: bytes) -> float:
    """Return whether a sample starts as a ULog file does."""
    return float(sample.startswith(_MAGIC))


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read the messages in `CONVERTERS`; others are passed over.

    Parameters, result and errors are those of `Format.read`.
    """
    library = load("pyulog", "px4")
    expected = "a ULog file of PX4"
    with open_file(path, expected=expected, where=path.name) as file, quiet():
        try:
            log = library.ULog(file, list(CONVERTERS), disable_str_exceptions=True)
        except Exception as error:  # Of any type: the library does not foresee all damage.
            raise unreadable(path, error, expected) from None
    found = [data for data in log.data_list if len(data.data.get("timestamp", ()))]
    if not found:
        raise DataError(
            "has none of the messages that are read here",
            where=path.name,
            expected=", ".join(CONVERTERS),
        )
    # What the receivers sent stands in the log beside what was chosen of it.
    if any(data.name == "vehicle_gps_position" for data in found):
        found = [data for data in found if data.name != "sensor_gps"]
    yield from silently(
        CONVERTERS[data.name](f"{data.name}[{data.multi_id}]", data.data) for data in found
    )
    yield left_out(_passed_over(map_file(path), {data.name for data in found}))
    if log.file_corruption:
        note = f"{path.name} is damaged: pyulog left messages out"
        yield Batch("clock", empty("clock", 0), notes=(note,))


def _passed_over(source: Source, read: Container[str]) -> Losses:
    """Count the messages of topics that are not read, which the library does not keep."""
    losses = Losses()
    topics: dict[int, str] = {}
    counts: Counter[int] = Counter()
    at, size = _FILE_HEADER, len(source)
    while at + 3 <= size:
        head = source[at : at + 6]
        length = int.from_bytes(head[:2], "little")
        if head[2:3] == b"D":
            counts[int.from_bytes(head[3:5], "little")] += 1
        elif head[2:3] == b"A":
            message = source[at + 3 : at + 3 + length]
            number = int.from_bytes(message[1:3], "little")
            topics[number] = message[3:].decode("latin-1")[:_LONGEST_NAME]
        at += 3 + length
    for number, count in counts.items():
        topic = topics.get(number, _NO_TOPIC)
        if topic not in read:
            losses.skip(topic, REPEATED if topic in CONVERTERS else UNKNOWN_TYPE, count)
    return losses


def _column(columns: Columns, *names: str) -> Array:
    """Return the first column that is there, or nan: names changed between versions."""
    for name in names:
        if name in columns:
            return np.asarray(columns[name], float)
    return np.full(len(columns["timestamp"]), np.nan)


def _vectors(columns: Columns, name: str, count: int = 3) -> Array:
    return np.stack([_column(columns, f"{name}[{i}]") for i in range(count)], axis=1)


def _time(columns: Columns) -> dict[str, Any]:
    received = _column(columns, "timestamp") * MICROSECOND
    stamps = _column(columns, "timestamp_sample") * MICROSECOND
    time = np.where(stamps > 0.0, stamps, received)
    return {"at": np.arange(len(received)), "time": time, "received": received}


def _count(columns: Columns) -> int:
    return len(columns["timestamp"])


def _imu(stream: str, columns: Columns) -> Batch:
    out = started(empty("imu", _count(columns)), **_time(columns))
    out["gyro"] = _vectors(columns, "gyro_rad")
    out["accel"] = _vectors(columns, "accelerometer_m_s2")
    return Batch("imu", out, "own", stream, "FRD")


def _attitude(stream: str, columns: Columns) -> Batch:
    out = started(empty("attitude", _count(columns)), **_time(columns))
    q = _vectors(columns, "q", 4)
    good = np.isfinite(q).all(axis=1) & (np.linalg.norm(q, axis=1) > 0.5)
    # PX4 has the scalar first; the rotation takes the body to north, east, down.
    angles = Rotation.from_quat(q[good][:, [1, 2, 3, 0]]).as_euler("ZYX")
    rph = np.full((len(q), 3), np.nan)
    rph[good] = angles[:, ::-1]
    out["roll"], out["pitch"], out["heading"] = rph[:, 0], rph[:, 1], rph[:, 2] % (2.0 * np.pi)
    note = f"{stream}: the filter of the autopilot; its heading may rest on a compass"
    return Batch("attitude", out, "own", stream, "FRD", notes=(note,))


def _fix(stream: str, columns: Columns) -> Batch:
    out = started(empty("fix", _count(columns)), **_time(columns))
    utc = _column(columns, "time_utc_usec") * MICROSECOND
    out["time"] = np.where(utc > _EARLIEST, utc, np.nan)
    # Before version 1.14 positions were integers of 1e-7 degrees and of millimetres.
    units = (1e-7, 1e-3) if "lat" in columns else (1.0, 1.0)
    lat = _column(columns, "latitude_deg", "lat") * units[0]
    lon = _column(columns, "longitude_deg", "lon") * units[0]
    kind = _column(columns, "fix_type")
    # The last is extrapolated.
    locate(out, lat, lon, np.where(kind == 8.0, 6.0, gga_quality(kind)))
    out["altitude"] = _column(columns, "altitude_msl_m", "alt") * units[1]
    out["height"] = _column(columns, "altitude_ellipsoid_m", "alt_ellipsoid") * units[1]
    north, east, down = (_column(columns, f"vel_{axis}_m_s") for axis in "ned")
    velocity = np.stack([east, north, -down], axis=1)
    valid = _column(columns, "vel_ned_valid") != 0.0
    out["velocity"] = np.where(valid[:, None], velocity, np.nan)
    stds = np.stack([_column(columns, name) for name in ("eph", "eph", "epv")], axis=1)
    out["std"] = positive(stds)
    out["velocity_std"] = positive(_column(columns, "s_variance_m_s"))[:, None]
    return Batch("fix", out, "utc", stream)


def _odometry(stream: str, columns: Columns) -> Batch:
    """`vehicle_visual_odometry`, as which vehicles under water log their DVL."""
    out = started(empty("dvl", _count(columns)), **_time(columns))
    in_body = _column(columns, "velocity_frame") == 3.0
    out["velocity"] = np.where(in_body[:, None], _vectors(columns, "velocity"), np.nan)
    variance = _vectors(columns, "velocity_variance")
    out["std"] = np.sqrt(positive(variance))
    out["axes"] = INSTRUMENT
    note = f"{stream}: velocities in the body's axes, taken as those of a DVL; others left out"
    return Batch("dvl", out, "own", stream, "FRD", notes=(note,))


CONVERTERS: dict[str, Callable[[str, Columns], Batch]] = {
    "sensor_combined": _imu,
    "vehicle_attitude": _attitude,
    "vehicle_gps_position": _fix,
    "sensor_gps": _fix,
    "vehicle_visual_odometry": _odometry,
}

FORMAT = Format(
    name="ulog",
    family="vehicle",
    title="PX4 ULog",
    share=share,
    read=read,
    verified=(
        "IMU, attitude, GPS: a recording of PX4, counts by type by pyulog; "
        "odometry by its document only"
    ),
    endings=(".ulg", ".ulog"),
    module="pyulog",
    extra="px4",
    limit="pyulog keeps the messages that are read here in memory, at most the size of the file",
)
