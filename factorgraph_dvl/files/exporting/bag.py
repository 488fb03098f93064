"""MCAP of a trial, with the messages of ROS 2; rosbags writes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats.vehicles.bags import DVL_TYPE, typestore
from factorgraph_dvl.files.formats.vehicles.library import load, quiet
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.attitude import Attitude
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.trial import Trial

_IMU, _FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
_TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
# What a covariance begins with where the value was not measured.
_NOT_MEASURED = np.array([-1.0, *np.zeros(8)])
_DIAGONAL = 2
_NANO = 1_000_000_000
# Format of the bag's metadata.
_VERSION = 9

Message = tuple[int, str, str, Any]


def write_mcap(trial: Trial, begin: float, path: Path) -> list[str]:
    """Write IMU, attitude, GNSS and DVL of a trial.

    Parameters
    ----------
    trial : Trial
        Its axes stand at the end of the names of frames, as `imu_FRD`.
    begin : float, s
        UTC of time zero, since 1970.
    path : path-like
        Path of the file.

    Returns
    -------
    list of str
        What there is no message for.

    Raises
    ------
    ConfigError
        If rosbags is not installed.
    DataError
        If the trial has none of them.
    """
    rosbag2 = load("rosbags.rosbag2", "bags")
    store = typestore()
    make = _Messages(store.types, begin, trial.body_axes)
    sources: dict[type[Any], Callable[[Any], Iterator[Message]]] = {
        Imu: make.imu,
        Attitude: make.attitude,
        Gnss: make.gnss,
        Dvl: make.dvl,
    }
    records = [r for r in (trial.imu, *trial.aids) if r is not None]
    written = [record for record in records if type(record) in sources]
    if not written:
        raise DataError(
            "has no data that a message can contain",
            where=trial.name,
            expected="imu, attitude, gnss or dvl",
        )
    folder = path.with_suffix(".bag")
    with (
        quiet(),
        rosbag2.Writer(
            folder, version=_VERSION, storage_plugin=rosbag2.StoragePlugin.MCAP
        ) as writer,
    ):
        connections: dict[str, Any] = {}
        for record in written:
            for stamp, topic, kind, message in sources[type(record)](record):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], stamp, store.serialize_cdr(message, kind))
    next(folder.glob("*.mcap")).replace(path)
    left = [record.section for record in records if record not in written]
    return [f"there is no message for {', '.join(left)}: left out"] if left else []


class _Messages:
    def __init__(self, types: Any, begin: float, axes: str) -> None:
        self._types, self._axes = types, axes
        # A clock of floats would round nanoseconds of dates to hundreds of them.
        self._begin = round(begin * 1e6) * 1000

    def _new(self, kind: str, *fields: Any) -> Any:
        return self._types[kind](*fields)

    def _header(self, time: float, frame: str) -> tuple[int, Any]:
        stamp = self._begin + round(time * _NANO)
        moment = self._new("builtin_interfaces/msg/Time", stamp // _NANO, stamp % _NANO)
        return stamp, self._new("std_msgs/msg/Header", moment, frame)

    def _vector(self, values: Array) -> Any:
        return self._new("geometry_msgs/msg/Vector3", *(float(x) for x in values))

    def imu(self, record: Imu) -> Iterator[Message]:
        zero = np.zeros(9)
        for time, gyro, accel in zip(record.time.tolist(), record.gyro, record.accel, strict=True):
            stamp, header = self._header(time, f"imu_{self._axes}")
            turn = self._new("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
            fields = (header, turn, _NOT_MEASURED, self._vector(gyro), zero, self._vector(accel))
            yield stamp, "/imu", _IMU, self._new(_IMU, *fields, zero)

    def attitude(self, record: Attitude) -> Iterator[Message]:
        known = np.isfinite(record.rph).all(axis=1)
        nRb = rotation_from_rph(record.rph[known], self._axes)  # type: ignore[arg-type]
        covariance = np.diag((np.array(record.settings.std_deg) * DEG) ** 2).ravel()
        nothing = self._vector(np.zeros(3))
        quaternions = Rotation.from_matrix(nRb).as_quat()
        for time, quaternion in zip(record.time[known].tolist(), quaternions, strict=True):
            stamp, header = self._header(time, f"attitude_{self._axes}")
            turn = self._new("geometry_msgs/msg/Quaternion", *quaternion.tolist())
            fields = (header, turn, covariance, nothing, _NOT_MEASURED, nothing, _NOT_MEASURED)
            yield stamp, "/attitude", _IMU, self._new(_IMU, *fields)

    def gnss(self, record: Gnss) -> Iterator[Message]:
        status = self._new("sensor_msgs/msg/NavSatStatus", 0, 1)
        for row, time in enumerate(record.time.tolist()):
            stamp, header = self._header(time, "gnss")
            lat, lon, height = record.geodetic[row].tolist()
            if np.isfinite(lat):
                covariance = np.diag(record.position_std[row] ** 2).ravel()
                fields = (header, status, lat / DEG, lon / DEG, height, covariance, _DIAGONAL)
                yield stamp, "/gnss/fix", _FIX, self._new(_FIX, *fields)
            if np.isfinite(record.velocity[row, 0]):
                yield stamp, "/gnss/velocity", _TWIST, self._velocity(record, row, header)

    def _velocity(self, record: Gnss, row: int, header: Any) -> Any:
        covariance = np.zeros((6, 6))
        variance = record.velocity_std[row] ** 2
        covariance[range(3), range(3)] = np.where(np.isfinite(variance), variance, 1e12)
        linear, angular = self._vector(record.velocity[row]), self._vector(np.zeros(3))
        twist = self._new("geometry_msgs/msg/Twist", linear, angular)
        both = self._new("geometry_msgs/msg/TwistWithCovariance", twist, covariance.ravel())
        return self._new(_TWIST, header, both)

    def dvl(self, record: Dvl) -> Iterator[Message]:
        water = record.settings.reference == "water"
        nowhere = [self._vector(np.zeros(3))] * 4
        doubles, floats = np.zeros(4), np.zeros(4, np.float32)
        sigma = record.sigma()
        for row in np.flatnonzero(record.locked).tolist():
            velocity = record.velocity[row]
            # The axes of a DVL are named as those of the body.
            stamp, header = self._header(float(record.time[row]), f"dvl_{self._axes}")
            covariance = np.diag(sigma[row] ** 2).ravel()
            speed, course = float(np.hypot(*velocity[:2])), 0.0
            fields = (
                *(header, 2 if water else 1, 0, self._vector(velocity), covariance),
                *(0.0, course, speed, 4, 0.0, False, False, nowhere),
                *(doubles, floats, floats, floats, floats),
            )
            yield stamp, "/dvl", DVL_TYPE, self._new(DVL_TYPE, *fields)
