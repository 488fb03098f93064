"""ROS bags: ROS 1, ROS 2 (MCAP, SQLite, folders of either), through rosbags.

Frames are those that ROS states: the world is east, north, up, and a body forward, left, up
(REP 103) unless the name of its frame ends in other axes, as `base_link_frd`. Stamps are those of
the messages, `received` the time of recording.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats.format import Batch, Format, Kind, empty, left_out, positive
from factorgraph_dvl.files.formats.framing import BLOCK, Records, map_file
from factorgraph_dvl.files.formats.losses import UNKNOWN_TYPE, Losses
from factorgraph_dvl.files.formats.mapping import UNITS, MappingSettings, TableMapping
from factorgraph_dvl.files.formats.table import describe as describe_mapping
from factorgraph_dvl.files.formats.table import fill, on_clock
from factorgraph_dvl.files.formats.vehicles.damaged_bags import (
    MCAP,
    ROS_1,
    Channel,
    whole_messages,
)
from factorgraph_dvl.files.formats.vehicles.library import (
    describe,
    load,
    quiet,
    silently,
)
from factorgraph_dvl.files.formats.velocities import INSTRUMENT
from factorgraph_dvl.geometry.rotations import BodyAxes, rph_from_rotation
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.settings.convert import from_plain
from factorgraph_dvl.settings.files import check_file, open_file

DVL_TYPE = "marine_acoustic_msgs/msg/Dvl"
_SQLITE = b"SQLite format 3\0"
_ENDINGS = {ROS_1: ".bag", MCAP: ".mcap", _SQLITE: ".db3"}
# Stamps before 1973 count since some start, as in a simulation.
_EARLIEST = 1e8
# Names of topics and frames of velocities that a GNSS receiver measures.
_GNSS_WORDS = ("gnss", "gps", "fix")
_REP_103 = "{}: in axes forward, left, up, as REP 103 has it; the message does not say"
# A velocity belongs to the fix with the same stamp, s.
_SAME = 1e-3
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
FIX = "sensor_msgs/msg/NavSatFix"
IMU, ODOMETRY = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"
# A message by its number in the file, and when it was recorded, s.
Message = tuple[int, float, Any]


def share(path: Path, sample: bytes) -> float:
    """Return whether a path is a bag: by its first bytes, a folder by its metadata."""
    if path.is_dir():
        return float((path / "metadata.yaml").is_file())
    is_table = sample.startswith(_SQLITE) and b"topics" in sample and b"messages" in sample
    return float(sample.startswith((ROS_1, MCAP)) or is_table)


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read messages of the types in `CONVERTERS` and topics of a mapping; others are passed over.

    Parameters
    ----------
    path : Path
        File or folder.
    mapping : mapping, optional
        Content of a mapping YAML, of which tables with a `topic` count.

    Yields
    ------
    Batch

    Raises
    ------
    ConfigError
        If rosbags is not installed.
    DataError
        If nothing in the bag is whole.
    """
    load("rosbags.highlevel", "bags")
    _check_files(path)
    settings = None if mapping is None else from_plain(mapping, MappingSettings)
    topics: dict[str, list[TableMapping]] = {}
    for table in () if settings is None else settings.of(path, topics=True):
        topics.setdefault(table.topic, []).append(table)
    notes: list[str] = []
    losses = Losses()
    yield from _batches(path, _messages(path, notes, topics, losses), notes, topics, losses)
    yield left_out(losses)


class Raw(NamedTuple):
    """A message as it stands in the file.

    Parameters
    ----------
    topic, kind : str
        Name and type, `package/msg/Name`.
    time : int
        Time of recording, ns since 1970.
    data : bytes
        Content.
    decode : callable
        Turns content and type into a message.
    """

    topic: str
    kind: str
    time: int
    data: bytes
    decode: Callable[[bytes, str], Any]


def _messages(
    path: Path, notes: list[str], topics: Container[str], losses: Losses
) -> Iterator[Raw]:
    """Read messages by the index of the bag, and without it from where that fails."""
    latest = -1
    rosbags = load("rosbags.highlevel", "bags")
    try:
        with quiet():
            reader = rosbags.AnyReader([path], default_typestore=typestore())
            reader.open()
        try:
            wanted = []
            for c in reader.connections:
                if c.msgtype in CONVERTERS or c.topic in topics:
                    wanted.append(c)
                else:
                    losses.skip(f"{c.topic} ({c.msgtype})", UNKNOWN_TYPE, c.msgcount)
            found = reader.messages(connections=wanted) if wanted else ()
            for connection, time, data in found:
                yield Raw(connection.topic, connection.msgtype, time, data, reader.deserialize)
                latest = max(latest, time)
        finally:
            reader.close()
    except Exception as error:  # Of any type: the library does not foresee all damage.
        reason = describe(error)
    else:
        return
    notes.append(f"{path.name} is damaged ({reason}): what is whole in it was read")
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    decoders: dict[Channel, Callable[[bytes, str], Any] | None] = {}
    for file in files:
        for channel, time, data in whole_messages(map_file(file)):
            is_wanted = channel.kind in CONVERTERS or channel.topic in topics
            if time <= latest:
                continue
            if not is_wanted:
                losses.skip(f"{channel.topic} ({channel.kind})", UNKNOWN_TYPE)
                continue
            if channel not in decoders:
                decoders[channel] = _decoder(channel)
            if (decode := decoders[channel]) is not None:
                yield Raw(channel.topic, channel.kind, time, data, decode)


def _decoder(channel: Channel) -> Callable[[bytes, str], Any] | None:
    """Return what turns the messages of a channel into objects, None if its definition is none."""
    typesys = load("rosbags.typesys", "bags")
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    try:
        if channel.encoding == "ros2idl":
            store.register(typesys.get_types_from_idl(channel.definition))
        else:
            store.register(typesys.get_types_from_msg(channel.definition, channel.kind))
    except Exception:  # Of any type: the library does not foresee all damage.
        return None
    is_first = channel.encoding == "ros1msg"
    decode: Callable[[bytes, str], Any]
    decode = store.deserialize_ros1 if is_first else store.deserialize_cdr
    return decode


def typestore() -> Any:
    """Return message definitions for bags without them: ROS 2's, and that of DVLs."""
    typesys = load("rosbags.typesys", "bags")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    package = resources.files("factorgraph_dvl.files.formats.vehicles")
    text = (package / "marine_acoustic_msgs" / "Dvl.msg").read_text(encoding="utf-8")
    store.register(typesys.get_types_from_msg(text, DVL_TYPE))
    return store


def _check_files(path: Path) -> None:
    """The library opens files by their names, and goes by the ending of that of a bag."""
    if path.is_dir():
        for inside in path.iterdir():
            if inside.name == "metadata.yaml" or inside.suffix in _ENDINGS.values():
                check_file(inside, expected="a file of a bag")
        return
    with open_file(path, expected="a bag", where=path.name) as file:
        head = file.read(16)
    for magic, ending in _ENDINGS.items():
        if head.startswith(magic) and path.suffix != ending:
            raise DataError(
                "is a bag by its content and not by its name",
                where=path.name,
                expected=f"a name that ends in {ending}",
            )


def _batches(
    path: Path,
    messages: Iterator[Raw],
    notes: list[str],
    topics: Mapping[str, list[TableMapping]],
    losses: Losses,
) -> Iterator[Batch]:
    gathered: dict[tuple[str, str], list[Message]] = {}
    velocities: list[Message] = []
    count = 0
    unread: list[BaseException] = []
    for count, raw in enumerate(messages, 1):
        try:
            message = raw.decode(raw.data, raw.kind)
        except Exception as error:  # Of any type, as above.
            unread.append(error)
            losses.skip(f"{raw.topic} ({raw.kind})", "damaged")
            continue
        row = count, raw.time * 1e-9, message
        if raw.kind == TWIST and raw.topic not in topics and _is_gnss(raw.topic, message):
            velocities.append(row)
            losses.use(f"{raw.topic} ({raw.kind})")
            continue
        key = raw.topic, raw.kind
        rows = gathered.setdefault(key, [])
        rows.append(row)
        if len(rows) >= BLOCK:
            yield from _converted(key, gathered.pop(key), velocities, notes, topics)
    if unread:
        notes.append(f"{path.name}: {len(unread)} messages are damaged ({describe(unread[0])})")
    if count == len(unread) and notes:
        raise DataError(
            f"nothing whole was found in it: {notes[0]}",
            where=path.name,
            expected="a bag, cut at most: `ros2 bag reindex` mends those in SQLite",
        )
    for key, rows in gathered.items():
        yield from _converted(key, rows, velocities, notes, topics)
    if velocities:
        notes.append(f"{len(velocities)} velocities of a GNSS receiver without fixes: left out")
    if notes:
        yield Batch("clock", empty("clock", 0), notes=tuple(notes))


def _converted(
    key: tuple[str, str],
    rows: list[Message],
    velocities: list[Message],
    notes: list[str],
    topics: Mapping[str, list[TableMapping]],
) -> Iterator[Batch]:
    topic, kind = key
    if topic in topics:
        yield from silently(_mapped(table, rows) for table in topics[topic])
        return
    try:
        batches = silently(CONVERTERS[kind](topic, rows))
    except (AttributeError, TypeError, ValueError) as error:
        # Bags bring definitions of their own, which damage can change.
        notes.append(f"{topic}: its messages are no {kind} ({describe(error)}): left out")
        return
    for batch in batches:
        if kind == FIX and velocities:
            with np.errstate(all="ignore"):
                _add_velocities(batch.records, velocities)
            velocities.clear()
        yield batch


def _mapped(table: TableMapping, messages: list[Message]) -> Batch:
    """Return the records that a mapping makes of a topic."""
    out = empty(table.kind, len(messages))
    out["at"] = [at for at, _, _ in messages]
    out["received"] = [received for _, received, _ in messages]

    def column(name: str | int) -> Array:
        return np.array([_field(message, str(name)) for _, _, message in messages])

    (name,) = table.time.names
    out["time"] = on_clock(table, column(name) * UNITS[table.time.unit])
    fill(out, table, column)
    clock, topic, heading = table.time.batch_clock, table.topic, table.heading_reference
    notes = tuple(describe_mapping(table))
    return Batch(table.kind, out, clock, topic, table.axes, heading, notes)


def _field(message: Any, name: str) -> float:
    """Return a field of a message as a number: of others within it by `.`, of lists by number."""
    value = message
    for part in name.split("."):
        try:
            value = value[int(part)] if part.isdigit() else getattr(value, part)
        except (AttributeError, IndexError, TypeError):
            return float("nan")
    if hasattr(value, "nanosec"):
        return float(value.sec + value.nanosec * 1e-9)
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def _is_gnss(topic: str, message: Any) -> bool:
    name = f"{topic} {message.header.frame_id}".lower()
    return any(word in name for word in _GNSS_WORDS)


def _add_velocities(fixes: Records, velocities: list[Message]) -> None:
    """Give fixes the velocities, east, north, up, with the same stamps."""
    bodies = [m for _, _, m in velocities]
    stamps = _stamped("fix", velocities)["time"]
    covariances = [m.twist.covariance for m in bodies]
    order = np.argsort(stamps, kind="stable")
    place = np.clip(np.searchsorted(stamps[order], fixes["time"] - _SAME), 0, len(order) - 1)
    nearest = order[place]
    same = (np.abs(stamps[nearest] - fixes["time"]) <= _SAME)[:, None]
    velocity = _vectors([m.twist.twist.linear for m in bodies])
    velocity[_unset(covariances)] = np.nan
    fixes["velocity"] = np.where(same, velocity[nearest], np.nan)
    fixes["velocity_std"] = np.where(same, _deviations(covariances)[nearest], np.nan)


def _axes(message: Any, usual: BodyAxes) -> BodyAxes:
    """Return the axes that the name of a frame ends in, or else the usual ones."""
    ending = str(message.header.frame_id).rpartition("_")[2].upper()
    return ending if ending in ("RFU", "FRD", "FLU") else usual  # type: ignore[return-value]


def _stamped(kind: Kind, messages: list[Message]) -> Records:
    out = empty(kind, len(messages))
    out["at"] = [at for at, _, _ in messages]
    out["received"] = [received for _, received, _ in messages]
    stamps = [m.header.stamp for _, _, m in messages]
    times = np.array([stamp.sec + stamp.nanosec * 1e-9 for stamp in stamps])
    out["time"] = np.where(times >= _EARLIEST, times, out["received"])
    return out


def _about_axes(topic: str, axes: BodyAxes) -> tuple[str, ...]:
    return (_REP_103.format(topic),) if axes == "FLU" else ()


def _about_stamps(topic: str, messages: list[Message]) -> tuple[str, ...]:
    if all(m.header.stamp.sec >= _EARLIEST for _, _, m in messages):
        return ()
    return (f"{topic}: stamps that are no UTC: times of recording were taken",)


def _vectors(values: list[Any]) -> Array:
    return np.array([(v.x, v.y, v.z) for v in values], float).reshape(-1, 3)


def _deviations(covariances: list[Any]) -> Array:
    """Return standard deviations (N, 3) of 3 x 3 or 6 x 6 covariances by rows; nan if unset."""
    rows = np.array(covariances, float).reshape(len(covariances), -1)
    side = 3 if rows.shape[1] == 9 else 6
    variance = rows[:, [0, side + 1, 2 * side + 2]]
    return np.sqrt(positive(variance))


def _unset(covariances: list[Any]) -> NDArray[np.bool_]:
    """Return where a covariance says that the value was not measured: by -1 in front."""
    return np.array([row[0] == -1.0 for row in covariances], bool)


def _orientations(quaternions: list[Any], axes: BodyAxes) -> tuple[Array, Array]:
    """Return nRb (N, 3, 3) and roll, pitch, heading (N, 3); nan where there is no quaternion."""
    q = np.array([(q.x, q.y, q.z, q.w) for q in quaternions], float)
    norm = np.linalg.norm(q, axis=1)
    good = np.isfinite(norm) & (norm > 0.5)
    nRb = np.full((len(q), 3, 3), np.nan)
    nRb[good] = Rotation.from_quat(q[good]).as_matrix()
    return nRb, rph_from_rotation(nRb, axes)


def _imu(topic: str, messages: list[Message]) -> Iterator[Batch]:
    """`sensor_msgs/Imu`: rates and specific force, and the orientation where it has one."""
    bodies = [m for _, _, m in messages]
    out = _stamped("imu", messages)
    axes = _axes(bodies[0], "FLU")
    notes = (*_about_axes(topic, axes), *_about_stamps(topic, messages))
    unset = _unset([m.angular_velocity_covariance for m in bodies])[:, None]
    out["gyro"] = np.where(unset, np.nan, _vectors([m.angular_velocity for m in bodies]))
    unset = _unset([m.linear_acceleration_covariance for m in bodies])[:, None]
    out["accel"] = np.where(unset, np.nan, _vectors([m.linear_acceleration for m in bodies]))
    if np.isfinite(out["gyro"]).any() or np.isfinite(out["accel"]).any():
        yield Batch("imu", out, "utc", topic, axes, notes=notes)
    attitude = _stamped("attitude", messages)
    nRb, rph = _orientations([m.orientation for m in bodies], axes)
    rph[_unset([m.orientation_covariance for m in bodies])] = np.nan
    # Drivers without an orientation leave the identity there.
    if np.isfinite(rph).any() and not np.array_equal(nRb, np.broadcast_to(np.eye(3), nRb.shape)):
        attitude["roll"], attitude["pitch"], attitude["heading"] = rph.T
        attitude["std"] = _deviations([m.orientation_covariance for m in bodies])
        yield Batch("attitude", attitude, "utc", topic, axes, notes=notes)


def _fix(topic: str, messages: list[Message]) -> Iterator[Batch]:
    """`sensor_msgs/NavSatFix`: heights are above the ellipsoid."""
    bodies = [m for _, _, m in messages]
    out = _stamped("fix", messages)
    for name in ("latitude", "longitude"):
        out[name[:3]] = np.radians([getattr(m, name) for m in bodies])
    out["height"] = [m.altitude for m in bodies]
    # Without, with, satellite-based and ground-based augmentation.
    out["quality"] = [{-1: 0, 0: 1}.get(m.status.status, 2) for m in bodies]
    known = np.array([m.position_covariance_type != 0 for m in bodies])[:, None]
    out["std"] = np.where(known, _deviations([m.position_covariance for m in bodies]), np.nan)
    yield Batch("fix", out, "utc", topic, notes=_about_stamps(topic, messages))


def _odometry(topic: str, messages: list[Message]) -> Iterator[Batch]:
    """`nav_msgs/Odometry`: attitude; positions are relative to an origin that is not stated."""
    bodies = [m for _, _, m in messages]
    out = _stamped("attitude", messages)
    axes = _axes(bodies[0], "FLU")
    _, rph = _orientations([m.pose.pose.orientation for m in bodies], axes)
    out["roll"], out["pitch"], out["heading"] = rph.T
    # Rotations are the second half of the 6 x 6 covariance.
    turned = np.array([m.pose.covariance for m in bodies], float).reshape(-1, 6, 6)[:, 3:, 3:]
    out["std"] = _deviations(list(turned.reshape(-1, 9)))
    note = (
        f"{topic}: attitude in a world of east, north, up (REP 103); positions are relative to an "
        "origin that the message does not state, and velocities those of a filter: left out"
    )
    notes = (note, *_about_axes(topic, axes), *_about_stamps(topic, messages))
    yield Batch("attitude", out, "utc", topic, axes, notes=notes)


def _twist(topic: str, messages: list[Message]) -> Iterator[Batch]:
    """`geometry_msgs/TwistWithCovarianceStamped`: of a DVL, where no GNSS receiver is named."""
    bodies = [m for _, _, m in messages]
    axes = _axes(bodies[0], "FLU")
    velocity = _vectors([m.twist.twist.linear for m in bodies])
    covariances = [m.twist.covariance for m in bodies]
    velocity[_unset(covariances)] = np.nan
    out = _stamped("dvl", messages)
    out["axes"], out["velocity"], out["std"] = INSTRUMENT, velocity, _deviations(covariances)
    notes = (*_about_axes(topic, axes), *_about_stamps(topic, messages))
    yield Batch("dvl", out, "utc", topic, axes, notes=notes)


def _dvl(topic: str, messages: list[Message]) -> Iterator[Batch]:
    """`marine_acoustic_msgs/Dvl`: x forward, z where the instrument looks."""
    modes = np.array([m.velocity_mode for _, _, m in messages])
    kinds: tuple[tuple[Kind, NDArray[np.bool_]], ...] = (
        ("dvl", modes != 2),
        ("water", modes == 2),
    )
    for kind, chosen in kinds:
        part = [message for message, is_one in zip(messages, chosen, strict=True) if is_one]
        if part:
            yield _pings(kind, topic, part)


def _pings(kind: Kind, topic: str, messages: list[Message]) -> Batch:
    bodies = [m for _, _, m in messages]
    out = _stamped(kind, messages)
    velocity = _vectors([m.velocity for m in bodies])
    lost = np.array([m.num_good_beams == 0 for m in bodies]) & ~velocity.any(axis=1)
    velocity[lost] = np.nan
    out["axes"], out["velocity"] = INSTRUMENT, velocity
    out["std"] = _deviations([m.velocity_covar for m in bodies])
    speeds = np.array([m.sound_speed for m in bodies], float)
    out["sound_speed"] = positive(speeds)
    axes = _axes(bodies[0], "FRD")
    notes = []
    if axes == "FRD":
        notes.append(f"{topic}: axes forward, right, down, as its messages' definition has them")
    notes.extend(_about_stamps(topic, messages))
    beams = np.array([m.beam_velocity for m in bodies], float)
    outward = np.array([_vectors(list(m.beam_unit_vec)) for m in bodies])
    given = np.array([m.beam_velocities_valid for m in bodies], bool)[:, None]
    beams = np.where(given, beams, np.nan)
    along = np.einsum("nbi,ni->nb", outward, velocity)
    agreement = np.nansum(beams * along)
    if agreement < 0.0:
        beams = -beams
        notes.append(f"{topic}: velocities along beams were reversed: they oppose the velocity")
    out["beams"] = beams
    with np.errstate(invalid="ignore"):
        angle = np.arccos(np.clip(outward[..., 2], -1.0, 1.0)).mean(axis=1)
    out["beam_angle"] = np.where((angle > 0.0) & (angle < np.pi / 2.0), angle, np.nan)
    ranges = np.array([m.range for m in bodies], float)
    given = np.array([m.beam_ranges_valid for m in bodies], bool)[:, None]
    out["range"] = np.where(given & (ranges > 0.0), ranges, np.nan)
    return Batch(kind, out, "utc", topic, axes, notes=tuple(notes))


CONVERTERS: dict[str, Callable[[str, list[Message]], Iterator[Batch]]] = {
    IMU: _imu,
    FIX: _fix,
    ODOMETRY: _odometry,
    TWIST: _twist,
    DVL_TYPE: _dvl,
}

FORMAT = Format(
    name="bag",
    family="vehicle",
    title="ROS 1 and ROS 2 bags, MCAP",
    share=share,
    read=read,
    verified="no recording; files written by the library mcap and by rosbags, by their values",
    endings=(".bag", ".mcap", ".db3"),
    module="rosbags",
    extra="bags",
    limit="rosbags keeps the index of a ROS 1 bag in memory",
)
