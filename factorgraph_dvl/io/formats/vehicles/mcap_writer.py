"""Records as ROS 2 messages in an MCAP file."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.geometry.rotations import BodyAxes, rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.io.formats.format import Batch
from factorgraph_dvl.io.formats.vehicles.bags import DVL_TYPE, FIX, IMU, ODOMETRY, TWIST, typestore
from factorgraph_dvl.io.formats.vehicles.library import load

# Topic, type, and for each message its time, s, and what its type is made of.
Messages = tuple[str, str, Iterator[tuple[float, Any]]]
# What the definitions have for a value that is not known.
_UNKNOWN = -1.0


def write_mcap(path: Path, batches: Iterable[Batch]) -> tuple[str, ...]:
    """Write records as messages of ROS 2.

    IMUs and attitudes become `sensor_msgs/Imu`, fixes `sensor_msgs/NavSatFix` with their
    velocities as `geometry_msgs/TwistWithCovarianceStamped` (east, north, up), pings
    `marine_acoustic_msgs/Dvl`, navigation solutions `nav_msgs/Odometry` and `NavSatFix`. Names of
    frames end in the axes of the records, such as `imu_rfu`.

    Parameters
    ----------
    path : Path
        File to write; it appears complete or not at all, and replaces one that is there.
    batches : iterable of Batch
        With times on UTC, or on any one clock.

    Returns
    -------
    tuple of str
        Kinds of records for which ROS has no message here, and which were left out.

    Raises
    ------
    ConfigError
        If rosbags is not installed.
    """
    bags = load("rosbags.rosbag2", "bags")
    store = typestore()
    left_out: dict[str, None] = {}
    with TemporaryDirectory(dir=path.parent, prefix=f".{path.name}-") as folder:
        bag = Path(folder) / "bag"
        writer = bags.Writer(bag, version=9, storage_plugin=bags.StoragePlugin.MCAP)
        writer.set_compression(bags.CompressionMode.STORAGE, bags.CompressionFormat.ZSTD)
        connections: dict[str, Any] = {}
        with writer:
            for batch in batches:
                if batch.kind not in _CONVERTERS:
                    left_out[batch.kind] = None
                    continue
                for topic, kind, messages in _CONVERTERS[batch.kind](store.types, batch):
                    if topic not in connections:
                        connections[topic] = writer.add_connection(topic, kind, typestore=store)
                    for time, message in messages:
                        data = store.serialize_cdr(message, kind)
                        writer.write(connections[topic], round(time * 1e9), data)
        shutil.move(bag / "bag.mcap", path)
    return tuple(left_out)


def _header(types: Any, time: float, name: str, axes: str) -> Any:
    seconds, nanoseconds = divmod(round(time * 1e9), 1_000_000_000)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    frame = f"{name}_{axes.lower()}" if axes else name
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def _vector(types: Any, values: Array) -> Any:
    x, y, z = map(float, values)
    return types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def _quaternion(types: Any, rph: Array, axes: BodyAxes) -> Any:
    """Return the orientation of a body, all zero where its angles are unknown."""
    x = y = z = w = 0.0
    if np.isfinite(rph).all():
        x, y, z, w = map(float, Rotation.from_matrix(rotation_from_rph(rph, axes)).as_quat())
    return types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def _covariance(std: Array, size: int = 3, first: int = 0) -> Array:
    """Return a covariance as a row; -1 in front where there is none."""
    out = np.zeros((size, size))
    if np.isfinite(std).all():
        out[range(first, first + 3), range(first, first + 3)] = std**2
    else:
        out[0, 0] = _UNKNOWN
    return out.ravel()


def _angles(records: Any) -> Array:
    return np.stack([records[name] for name in ("roll", "pitch", "heading")], axis=-1)


def _imu(types: Any, batch: Batch) -> Iterator[Messages]:
    def messages() -> Iterator[tuple[float, Any]]:
        known = np.zeros(9)
        for row in batch.records:
            yield (
                row["time"],
                types[IMU](
                    header=_header(types, row["time"], "imu", batch.axes),
                    orientation=_quaternion(types, np.full(3, np.nan), "FLU"),
                    orientation_covariance=_covariance(np.full(3, np.nan)),
                    angular_velocity=_vector(types, row["gyro"]),
                    angular_velocity_covariance=known,
                    linear_acceleration=_vector(types, row["accel"]),
                    linear_acceleration_covariance=known,
                ),
            )

    yield "/imu", IMU, messages()


def _attitude(types: Any, batch: Batch) -> Iterator[Messages]:
    axes: BodyAxes = batch.axes or "RFU"

    def messages() -> Iterator[tuple[float, Any]]:
        none = _covariance(np.full(3, np.nan))
        zero = _vector(types, np.zeros(3))
        for row, rph in zip(batch.records, _angles(batch.records), strict=True):
            known = np.isfinite(row["std"]).all()
            yield (
                row["time"],
                types[IMU](
                    header=_header(types, row["time"], "attitude", axes),
                    orientation=_quaternion(types, rph, axes),
                    orientation_covariance=_covariance(row["std"]) if known else np.zeros(9),
                    angular_velocity=zero,
                    angular_velocity_covariance=none,
                    linear_acceleration=zero,
                    linear_acceleration_covariance=none,
                ),
            )

    yield "/attitude", IMU, messages()


def _fixes(types: Any, batch: Batch) -> Iterator[Messages]:
    yield "/gnss/fix", FIX, _positions(types, batch, "gnss")
    if np.isfinite(batch.records["velocity"]).any():
        yield "/gnss/velocity", TWIST, _velocities(types, batch)


def _positions(types: Any, batch: Batch, name: str) -> Iterator[tuple[float, Any]]:
    for row in batch.records:
        is_fix = bool(np.isfinite(row["lat"]) and np.isfinite(row["lon"]))
        # No fix, plain, and augmented by another station.
        quality = row["quality"] if "quality" in (row.dtype.names or ()) else np.nan
        status = -1 if not is_fix or quality == 0.0 else 0 if not quality > 1.0 else 2
        known = np.isfinite(row["std"]).all()
        yield (
            row["time"],
            types[FIX](
                header=_header(types, row["time"], name, ""),
                status=types["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
                latitude=float(np.degrees(row["lat"])),
                longitude=float(np.degrees(row["lon"])),
                altitude=float(row["height"]),
                position_covariance=_covariance(row["std"]) if known else np.zeros(9),
                position_covariance_type=2 if known else 0,
            ),
        )


def _twist(types: Any, velocity: Array, covariance: Array) -> Any:
    twist = types["geometry_msgs/msg/Twist"](
        linear=_vector(types, velocity), angular=_vector(types, np.zeros(3))
    )
    return types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=covariance)


def _velocities(types: Any, batch: Batch) -> Iterator[tuple[float, Any]]:
    for row in batch.records:
        if np.isfinite(row["velocity"]).any():
            known = np.isfinite(row["velocity_std"]).all()
            covariance = _covariance(row["velocity_std"], 6) if known else np.zeros(36)
            header = _header(types, row["time"], "gnss", "")
            twist = _twist(types, row["velocity"], covariance)
            yield row["time"], types[TWIST](header=header, twist=twist)


def _pings(types: Any, batch: Batch) -> Iterator[Messages]:
    def messages() -> Iterator[tuple[float, Any]]:
        none = _vector(types, np.zeros(3))
        for row in batch.records:
            velocity, beams, ranges = row["velocity"], row["beams"], row["range"]
            is_lock = np.isfinite(velocity).all()
            speed = row["sound_speed"]
            yield (
                row["time"],
                types[DVL_TYPE](
                    header=_header(types, row["time"], "dvl", batch.axes),
                    velocity_mode=1 if batch.kind == "dvl" else 2,
                    dvl_type=0,
                    velocity=_vector(types, velocity if is_lock else np.zeros(3)),
                    velocity_covar=_covariance(row["std"]),
                    altitude=float(np.nan_to_num(np.nanmin(ranges, initial=np.inf), posinf=0.0)),
                    course_gnd=float(np.arctan2(velocity[1], velocity[0])) if is_lock else 0.0,
                    speed_gnd=float(np.hypot(velocity[0], velocity[1])) if is_lock else 0.0,
                    num_good_beams=max(int(np.isfinite(ranges).sum()), 3) if is_lock else 0,
                    sound_speed=float(speed) if np.isfinite(speed) else 0.0,
                    beam_ranges_valid=bool(np.isfinite(ranges).any()),
                    beam_velocities_valid=bool(np.isfinite(beams).any()),
                    beam_unit_vec=np.array([none] * 4),
                    range=np.nan_to_num(ranges),
                    range_covar=np.full(4, _UNKNOWN, np.float32),
                    beam_quality=np.zeros(4, np.float32),
                    beam_velocity=beams.astype(np.float32),
                    beam_velocity_covar=np.full(4, _UNKNOWN, np.float32),
                ),
            )

    yield "/dvl", DVL_TYPE, messages()


def _solution(types: Any, batch: Batch) -> Iterator[Messages]:
    axes: BodyAxes = batch.axes or "RFU"
    angles = _angles(batch.records)
    nRb = rotation_from_rph(np.nan_to_num(angles), axes)
    in_body = rotate(np.swapaxes(nRb, -1, -2), batch.records["velocity"])
    in_body[np.isnan(angles).any(axis=1)] = np.nan

    def messages() -> Iterator[tuple[float, Any]]:
        for row, rph, velocity in zip(batch.records, angles, in_body, strict=True):
            point = types["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0)
            pose = types["geometry_msgs/msg/Pose"](
                position=point, orientation=_quaternion(types, rph, axes)
            )
            known = np.isfinite(row["attitude_std"]).all()
            covariance = _covariance(row["attitude_std"], 6, 3) if known else np.zeros(36)
            yield (
                row["time"],
                types[ODOMETRY](
                    header=_header(types, row["time"], "ins", axes),
                    child_frame_id="ins",
                    pose=types["geometry_msgs/msg/PoseWithCovariance"](
                        pose=pose, covariance=covariance
                    ),
                    twist=_twist(types, velocity, np.zeros(36)),
                ),
            )

    yield "/ins", ODOMETRY, messages()
    if np.isfinite(batch.records["lat"]).any():
        yield "/ins/position", FIX, _positions(types, batch, "ins")


_CONVERTERS: dict[str, Callable[[Any, Batch], Iterator[Messages]]] = {
    "imu": _imu,
    "attitude": _attitude,
    "fix": _fixes,
    "dvl": _pings,
    "water": _pings,
    "ins": _solution,
}
