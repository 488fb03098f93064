"""Logs of vehicles: written after their documents, read through the libraries."""

from __future__ import annotations

import re
import sys

import format_logs as logs
import numpy as np
import pytest
import yaml

from factorgraph_dvl.cli.exit_codes import exit_code_of
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.formats.vehicles import ardupilot, bags, nucleus, telemetry, ulog
from factorgraph_dvl.files.formats.vehicles.library import load
from factorgraph_dvl.geometry.rotations import rotation_from_rph

DEG = np.pi / 180.0
MODULES = (bags, ardupilot, ulog, telemetry, nucleus)


def needs(module):
    pytest.importorskip(module.FORMAT.module, reason=f"extra {module.FORMAT.extra} not installed")


def read(module, path):
    """Return batches by kind and stream, joined, and all notes."""
    found, notes = {}, []
    for batch in module.read(path):
        assert batch.records.dtype.names
        notes.extend(batch.notes)
        if len(batch.records):
            found.setdefault((batch.kind, batch.stream), []).append(batch)
    joined = {key: np.concatenate([b.records for b in parts]) for key, parts in found.items()}
    return joined, {key: parts[0] for key, parts in found.items()}, notes


def write(path, data):
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("module", MODULES)
def test_a_library_that_is_missing_is_named_with_its_extra(module, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, module.FORMAT.module, None)
    for name in list(sys.modules):
        if name.startswith(module.FORMAT.module + "."):
            monkeypatch.setitem(sys.modules, name, None)
    path = write(tmp_path / "log.bin", b"")
    with pytest.raises(ConfigError, match="is not installed") as caught:
        list(module.read(path))
    assert f"pip install 'factorgraph-dvl[{module.FORMAT.extra}]'" in str(caught.value)
    assert exit_code_of(caught.value) == 2


def test_extras_install_the_libraries():
    tomllib = pytest.importorskip("tomllib")
    root = bags.Path(__file__).resolve().parents[3]
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    everything = extras["all"][0]
    for module in MODULES:
        (requirement,) = extras[module.FORMAT.extra]
        assert requirement.replace("-", "_").startswith(module.FORMAT.module)
        assert module.FORMAT.extra in everything


def test_mcap_of_another_writer(tmp_path):
    needs(bags)
    pytest.importorskip("mcap")
    path = write(tmp_path / "log.mcap", logs.mcap(logs.sea_trial()))
    assert bags.share(path, path.read_bytes()) == 1.0
    found, batches, notes = read(bags, path)
    assert set(found) == {("imu", "/imu"), ("fix", "/gps/fix"), ("dvl", "/dvl")}
    imu = found["imu", "/imu"]
    np.testing.assert_allclose(imu["time"], logs.START + 0.25 * np.arange(40), atol=1e-6)
    np.testing.assert_allclose(imu["received"] - imu["time"], 0.01, atol=1e-6)
    np.testing.assert_allclose(imu["gyro"][:, 2], np.arange(40))
    np.testing.assert_allclose(imu["accel"][7], (0, 0, 9.8))
    assert batches["imu", "/imu"].axes == "FLU"
    fix = found["fix", "/gps/fix"]
    np.testing.assert_allclose(fix["lat"] / DEG, 54.0 + 4e-6 * np.arange(10), atol=1e-12)
    np.testing.assert_allclose(fix["height"], 40.0)
    np.testing.assert_allclose(fix["std"], [[1.0, 2.0, 3.0]] * 10)
    dvl = found["dvl", "/dvl"]
    np.testing.assert_allclose(dvl["velocity"][3], (13.0, -0.5, 0.25))
    np.testing.assert_allclose(dvl["std"][0], (0.01, 0.02, 0.03))
    np.testing.assert_allclose(dvl["beams"][3], logs.UNIT_VECTORS @ (13.0, -0.5, 0.25), rtol=1e-6)
    np.testing.assert_allclose(dvl["range"][0], (10.0, np.nan, 12.0, 13.0))
    np.testing.assert_allclose(dvl["beam_angle"] / DEG, 30.0)
    np.testing.assert_allclose(dvl["sound_speed"], 1480.0)
    assert batches["dvl", "/dvl"].axes == "FRD"
    assert any("REP 103" in note for note in notes)


def test_beams_of_the_other_sign_are_reversed_and_lost_velocities_are_nan(tmp_path):
    needs(bags)
    pytest.importorskip("mcap")
    kind = "marine_acoustic_msgs/Dvl"
    messages = [
        ("/dvl", kind, 5.0, logs.dvl_message(5.0, (1.0, 0.5, 0.0), sign=-1.0)),
        ("/dvl", kind, 6.0, logs.dvl_message(6.0, (0.0, 0.0, 0.0), beams=0)),
        ("/dvl", kind, 7.0, logs.dvl_message(7.0, (0.3, 0.0, 0.0), mode=2)),
    ]
    path = write(tmp_path / "log.mcap", logs.mcap(messages))
    found, _, notes = read(bags, path)
    dvl = found["dvl", "/dvl"]
    np.testing.assert_allclose(dvl["beams"][0], logs.UNIT_VECTORS @ (1.0, 0.5, 0.0), rtol=1e-6)
    assert np.isnan(dvl["velocity"][1]).all()
    np.testing.assert_allclose(found["water", "/dvl"]["velocity"], [[0.3, 0.0, 0.0]])
    assert any("were reversed" in note for note in notes)
    # Stamps of a clock that starts with the machine: the time of recording stands in.
    assert any("no UTC" in note for note in notes)


@pytest.mark.parametrize("make", ["mcap", "bag"])
@pytest.mark.parametrize("damage", ["cut", "flip", "middle"])
def test_what_is_whole_in_a_damaged_bag_is_kept(tmp_path, make, damage):
    needs(bags)
    pytest.importorskip("mcap")
    small = logs.mcap(logs.sea_trial(), chunk_size=4000)
    data = bytearray(small if make == "mcap" else logs.ros_1_bag(logs.sea_trial()))
    sync = b"op=\x05" if make == "bag" else b"imu\0"
    if damage == "cut":
        # The index and the end of the last chunk are lost.
        data = data[: data.rindex(sync)]
    elif damage == "flip":
        data[data.rindex(sync)] ^= 1
    else:
        at = len(data) // 2
        data[at : at + 10] = b"garbage between records"
    found, _, notes = read(bags, write(tmp_path / f"log.{make}", bytes(data)))
    assert 15 <= len(found["imu", "/imu"]) <= 40
    assert len(np.unique(found["imu", "/imu"]["gyro"][:, 2])) == len(found["imu", "/imu"])
    assert any("damaged" in note for note in notes)


def test_topics_by_the_mapping_of_the_page(tmp_path):
    needs(bags)
    pytest.importorskip("mcap")
    page = (bags.Path(__file__).resolve().parents[3] / "docs" / "formats.md").read_text()
    mapping = yaml.safe_load(re.search(r"```yaml\n(.*?)```", page, re.DOTALL)[1])
    messages = [
        (
            "/dvl/data",
            "dvl_msgs/DVL",
            t,
            logs.foreign_dvl_message(t - 0.1, (1.0, t % 7, 0.5), t % 2),
        )
        for t in range(logs.START, logs.START + 6)
    ]
    path = write(tmp_path / "log.mcap", logs.mcap(messages + logs.sea_trial(4)))
    batches = list(bags.read(path, mapping))
    (dvl,) = (batch for batch in batches if batch.stream == "/dvl/data")
    assert (dvl.kind, dvl.axes, dvl.clock) == ("dvl", "FRD", "utc")
    records = dvl.records
    np.testing.assert_allclose(records["received"] - records["time"], 0.1, atol=1e-6)
    valid = np.arange(logs.START, logs.START + 6) % 2 == 1
    np.testing.assert_array_equal(np.isfinite(records["velocity"]).all(axis=1), valid)
    np.testing.assert_allclose(records["range"][valid], [[10.0, 11.0, 12.0, 13.0]] * 3)
    np.testing.assert_allclose(records["std"][valid, 0], 0.02)
    assert any("vel_x is column velocity.x in m/s" in note for note in dvl.notes)
    assert {batch.stream for batch in batches} >= {"/imu", "/dvl"}
    assert not [batch for batch in bags.read(path) if batch.stream == "/dvl/data"]


def test_a_bag_under_a_wrong_name(tmp_path):
    needs(bags)
    with pytest.raises(DataError, match=r"a name that ends in \.bag"):
        list(bags.read(write(tmp_path / "log.dat", b"#ROSBAG V2.0\n" + bytes(100))))


def bag_messages(store, rph):
    types = store.types

    def header(seconds, frame):
        stamp = types["builtin_interfaces/msg/Time"](sec=int(seconds), nanosec=500_000_000)
        kind = types["std_msgs/msg/Header"]
        names = kind.__dataclass_fields__
        return kind(**({"seq": 1} if "seq" in names else {}), stamp=stamp, frame_id=frame)

    def vector(x, y, z):
        return types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)

    matrix = rotation_from_rph(rph, "FLU")
    x, y, z, w = bags.Rotation.from_matrix(matrix).as_quat()
    quaternion = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    covariance = np.diag([0.01, 0.04, 0.09, 1e-4, 4e-4, 9e-4]).ravel()
    pose = types["geometry_msgs/msg/PoseWithCovariance"](
        pose=types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=3.0), orientation=quaternion
        ),
        covariance=covariance,
    )
    twist = types["geometry_msgs/msg/TwistWithCovariance"](
        twist=types["geometry_msgs/msg/Twist"](
            linear=vector(1.0, -0.5, 0.25), angular=vector(0.0, 0.0, 0.0)
        ),
        covariance=covariance,
    )
    odometry = types["nav_msgs/msg/Odometry"]
    stamped = types["geometry_msgs/msg/TwistWithCovarianceStamped"]
    start = logs.START
    return [
        (
            "/odom",
            odometry(header=header(start, "odom"), child_frame_id="base", pose=pose, twist=twist),
        ),
        ("/dvl", stamped(header=header(start, "dvl_link"), twist=twist)),
        ("/gps/velocity", stamped(header=header(start, "world"), twist=twist)),
        (
            "/gps/fix",
            types["sensor_msgs/msg/NavSatFix"](
                header=header(start, "gps"),
                status=types["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
                **{"latitude": 54.0, "longitude": -3.0, "altitude": 40.0},
                **{"position_covariance": np.zeros(9), "position_covariance_type": 0},
            ),
        ),
        (
            "/imu",
            types["sensor_msgs/msg/Imu"](
                header=header(start, "imu"),
                orientation=quaternion,
                orientation_covariance=np.diag([1e-4, 4e-4, 9e-4]).ravel(),
                angular_velocity=vector(1.0, 2.0, 3.0),
                angular_velocity_covariance=np.array([-1.0] + [0.0] * 8),
                linear_acceleration=vector(4.0, 5.0, 6.0),
                linear_acceleration_covariance=np.zeros(9),
            ),
        ),
    ]


@pytest.mark.parametrize("version", [1, 2])
def test_bags_of_both_versions_of_ros(tmp_path, version):
    needs(bags)
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_JAZZY)
    rph = np.array([2.0, -3.0, 250.0]) * DEG
    path = tmp_path / ("log.bag" if version == 1 else "log")
    with Writer1(path) if version == 1 else Writer2(path, version=9) as writer:
        for topic, message in bag_messages(store, rph):
            connection = writer.add_connection(topic, message.__msgtype__, typestore=store)
            pack = store.serialize_ros1 if version == 1 else store.serialize_cdr
            writer.write(connection, (logs.START + 1) * 10**9, pack(message, message.__msgtype__))
    found, _, _ = read(bags, path)
    (odometry,) = found["attitude", "/odom"]
    np.testing.assert_allclose([odometry[n] for n in ("roll", "pitch", "heading")], rph, atol=1e-9)
    np.testing.assert_allclose(odometry["std"], (0.01, 0.02, 0.03))
    (dvl,) = found["dvl", "/dvl"]
    np.testing.assert_allclose(dvl["velocity"], (1.0, -0.5, 0.25))
    np.testing.assert_allclose(dvl["std"], (0.1, 0.2, 0.3))
    assert (dvl["time"], dvl["received"]) == (logs.START + 0.5, logs.START + 1.0)
    (fix,) = found["fix", "/gps/fix"]
    np.testing.assert_allclose(fix["velocity"], (1.0, -0.5, 0.25))
    (imu,) = found["imu", "/imu"]
    assert np.isnan(imu["gyro"]).all()
    np.testing.assert_allclose(imu["accel"], (4.0, 5.0, 6.0))
    (attitude,) = found["attitude", "/imu"]
    np.testing.assert_allclose([attitude[n] for n in ("roll", "pitch", "heading")], rph, atol=1e-9)
    assert bags.share(path, b"" if path.is_dir() else path.read_bytes()) == 1.0
    if path.is_dir():
        database = next(path.glob("*.db3"))
        assert bags.share(database, database.read_bytes()) == 1.0


def test_dvl_of_a_database_without_definitions(tmp_path):
    needs(bags)
    from rosbags.rosbag2 import Writer

    store = bags.typestore()
    folder = tmp_path / "log"
    with Writer(folder, version=8) as writer:
        connection = writer.add_connection("/dvl", bags.DVL_TYPE, typestore=store)
        writer.write(connection, 10**9, logs.dvl_message(logs.START, (1.0, 2.0, 3.0)))
    import sqlite3

    with sqlite3.connect(next(folder.glob("*.db3"))) as database:
        database.execute("DELETE FROM message_definitions")
    found, _, _ = read(bags, folder)
    np.testing.assert_allclose(found["dvl", "/dvl"]["velocity"], [[1.0, 2.0, 3.0]])


def test_ardupilot(tmp_path):
    needs(ardupilot)
    path = write(tmp_path / "1.BIN", logs.ardupilot_log(logs.ardupilot_trial()))
    assert ardupilot.share(path, path.read_bytes()) == 1.0
    found, batches, _ = read(ardupilot, path)
    imu = found["imu", "IMU[0]"]
    np.testing.assert_allclose(imu["time"], 10.0 + 0.05 * np.arange(40))
    np.testing.assert_allclose(imu["gyro"][:, 2], 0.3 + np.arange(40), rtol=1e-6)
    np.testing.assert_allclose(imu["accel"][0], (1.0, 2.0, -9.8), rtol=1e-6)
    assert len(found["imu", "IMU[1]"]) == 40
    assert (batches["imu", "IMU[0]"].clock, batches["imu", "IMU[0]"].axes) == ("own", "FRD")
    fix = found["fix", "GPS[0]"]
    # GPS week 2100 began on 5 April 2020; 18 leap seconds.
    assert fix["time"][0] == pytest.approx(1586044800 + 345600 - 18)
    np.testing.assert_allclose(fix["time"] - fix["time"][0], 0.25 * np.arange(8), atol=1e-6)
    np.testing.assert_allclose(fix["received"], 10.0 + 0.25 * np.arange(8))
    np.testing.assert_allclose(fix["lat"][1] / DEG, 54.0000006, atol=1e-10)
    np.testing.assert_allclose((fix["altitude"], fix["height"]), [[40.25] * 8, [87.75] * 8])
    np.testing.assert_allclose(fix["velocity"], [[2.0, 0.0, 0.1]] * 8, atol=1e-6)
    np.testing.assert_allclose(fix["std"], [[0.5, 0.5, 0.9]] * 8)
    np.testing.assert_allclose(fix["velocity_std"], 0.12)
    np.testing.assert_allclose(fix["quality"], 4.0)
    attitude = found["attitude", "ATT[0]"][0]
    np.testing.assert_allclose(
        [attitude[n] / DEG for n in ("roll", "pitch", "heading")], [1.5, -2.5, 270.5]
    )
    dvl = found["dvl", "VISO[0]"]
    np.testing.assert_allclose(dvl["velocity"][0], (1.0, -0.2, 0.1), rtol=1e-6)
    np.testing.assert_allclose(dvl["delay"], -0.125)


def test_ardupilot_says_how_it_turned_movements_before_it_logged_them(tmp_path):
    needs(ardupilot)
    settings = [("PARM", 0, b"VISO_TYPE", 1.0, 0.0), ("PARM", 0, b"VISO_ORIENT", 4.0, 0.0)]
    path = write(tmp_path / "1.BIN", logs.ardupilot_log(settings + logs.ardupilot_trial()))
    _, _, notes = read(ardupilot, path)
    assert [note for note in notes if note.startswith("VISO_ORIENT was 4:")]
    settings[1] = ("PARM", 0, b"VISO_ORIENT", 0.0, 0.0)
    _, _, notes = read(ardupilot, write(path, logs.ardupilot_log(settings)))
    assert not [note for note in notes if "VISO_ORIENT" in note]


def test_ardupilot_keeps_what_follows_damage(tmp_path):
    needs(ardupilot)
    data = logs.ardupilot_log(logs.ardupilot_trial())
    at = data.index(logs.log_message("IMU", *logs.ardupilot_trial()[60][1:]))
    path = write(tmp_path / "1.BIN", data[:at] + b"\xa3\x95garbage" * 90 + data[at:])
    found, _, notes = read(ardupilot, path)
    assert len(found["imu", "IMU[0]"]) == 40
    assert notes[-1] == "1.BIN: 810 bytes are in no message"
    assert [entry.name for entry in tmp_path.iterdir()] == ["1.BIN"]


def test_telemetry(tmp_path):
    needs(telemetry)
    path = write(tmp_path / "1.tlog", logs.telemetry_trial())
    assert telemetry.share(path, path.read_bytes()) == pytest.approx(1.0, abs=0.02)
    found, batches, notes = read(telemetry, path)
    imu = found["imu", "RAW_IMU 1:1"]
    # The least delay is 20 ms; what is late is not late by its own clock.
    times = logs.START + 0.02 + 0.1 * np.arange(40)
    np.testing.assert_allclose(imu["time"], times, atol=1e-5)
    np.testing.assert_allclose(imu["received"], times, atol=1e-5)
    np.testing.assert_allclose(imu["gyro"][:, 2], 0.03 + 0.001 * np.arange(40))
    np.testing.assert_allclose(imu["accel"][0], np.array((0.1, -0.05, -1.0)) * 9.80665)
    assert batches["imu", "RAW_IMU 1:1"].axes == "FRD"
    attitude = found["attitude", "ATTITUDE 1:1"][3]
    angles = [attitude[n] for n in ("roll", "pitch", "heading")]
    np.testing.assert_allclose(angles, [0.1, -0.2, 2.0 * np.pi - 0.5], rtol=1e-6)
    np.testing.assert_allclose(found["depth", "SCALED_PRESSURE2 1:1"]["depth"], 5.0)
    fix = found["fix", "GPS_INPUT 1:220"]
    utc = 1586044800 + 345600 - 18
    np.testing.assert_allclose(fix["time"], utc + 0.1 * np.arange(40), atol=1e-6)
    np.testing.assert_allclose(fix["lat"][1] / DEG, 54.0000002, atol=1e-10)
    np.testing.assert_allclose(fix["altitude"], -4.5)
    np.testing.assert_allclose(fix["velocity"], [[0.2, 0.1, np.nan]] * 40, rtol=1e-6)
    np.testing.assert_allclose(fix["std"], [[1.5, 1.5, 2.5]] * 40)
    np.testing.assert_allclose(fix["velocity_std"], 0.4, rtol=1e-6)
    dvl = found["dvl", "VISION_POSITION_DELTA 1:191"]
    np.testing.assert_allclose(dvl["velocity"], [[1.0, -0.2, 0.1]] * 40, rtol=1e-6)
    np.testing.assert_allclose(dvl["delay"], -0.05)
    np.testing.assert_allclose(dvl["time"], times, atol=1e-5)
    clock = found["clock", "SYSTEM_TIME 1:1"]
    np.testing.assert_allclose(clock["time"], times - 0.02, atol=1e-5)
    assert ("fix", "GPS_RAW_INT 1:1") not in found
    assert any("repeats" in note for note in notes)


def test_positions_of_telemetry_without_those_that_it_was_given(tmp_path):
    needs(telemetry)
    found, _, _ = read(telemetry, write(tmp_path / "1.tlog", logs.telemetry_trial(gps=False)))
    fix = found["fix", "GPS_RAW_INT 1:1"]
    assert np.isnan(fix["lat"][0]), "the first has no fix"
    np.testing.assert_allclose(fix["lat"][2] / DEG, 54.0000003, atol=1e-10)
    np.testing.assert_allclose((fix["altitude"], fix["height"]), [[4.0] * 40, [52.0] * 40])
    np.testing.assert_allclose(fix["std"], [[0.5, 0.5, 0.9]] * 40)
    course = found["course", "GPS_RAW_INT 1:1"]
    np.testing.assert_allclose(course["speed"], [np.nan] + [2.5] * 39)
    np.testing.assert_allclose(course["course"] / DEG, 90.0)
    estimate = found["fix", "GLOBAL_POSITION_INT 1:1"]
    np.testing.assert_allclose(estimate["velocity"], [[0.1, 0.2, 0.3]] * 40)
    np.testing.assert_allclose(estimate["quality"], 6.0)


def test_telemetry_of_a_vehicle_that_starts_anew_and_damage(tmp_path):
    needs(telemetry)
    first = logs.telemetry_trial()
    second = bytearray(logs.telemetry_trial(start=logs.START + 600.0, boot=5.0))
    second[300] ^= 1
    data = first[:-9] + b"\xfd\xfe garbage" + bytes(second)
    found, _, _ = read(telemetry, write(tmp_path / "1.tlog", data))
    time = found["attitude", "ATTITUDE 1:1"]["time"]
    expected = logs.START + 0.02 + np.concatenate([0.1 * np.arange(40), 600 + 0.1 * np.arange(40)])
    assert 78 <= len(time) <= 80
    assert np.abs(time[:, None] - expected).min(axis=1).max() < 1e-5
    losses = [batch.losses for batch in telemetry.read(tmp_path / "1.tlog") if batch.losses]
    assert "message with a wrong checksum" in losses[-1].counts
    assert losses[-1].counts["byte outside records"] > 9


def test_an_imu_that_is_not_there_has_no_values(tmp_path):
    needs(telemetry)
    data = logs.telemetry("RAW_IMU", logs.START, 1000, *[0] * 9, 0, 0) * 3
    found, _, _ = read(telemetry, write(tmp_path / "1.tlog", data))
    assert np.isnan(found["imu", "RAW_IMU 1:1"]["accel"]).all()


def test_what_the_receivers_of_px4_sent_stands_beside_what_was_chosen_of_it(tmp_path):
    needs(ulog)
    utc = logs.START * 1_000_000
    sent = [
        ("sensor_gps", 0, (5_000_000 + i, utc + i, 54.0, -3.0, 40.25, 87.75, 0.5, 0.9, 3))
        for i in range(7)
    ]
    found, _, _ = read(ulog, write(tmp_path / "log.ulg", logs.ulog(sent)))
    fix = found["fix", "sensor_gps[0]"]
    np.testing.assert_allclose(fix["lat"] / DEG, 54.0)
    np.testing.assert_allclose((fix["altitude"], fix["height"]), [[40.25] * 7, [87.75] * 7])
    both = write(tmp_path / "log.ulg", logs.ulog(sent + logs.ulog_trial()))
    (losses,) = (batch.losses for batch in ulog.read(both) if batch.losses)
    assert losses.skipped == {"sensor_gps": {"repeats another one": 7}}
    assert ("fix", "sensor_gps[0]") not in read(ulog, both)[0]


def test_px4(tmp_path):
    needs(ulog)
    path = write(tmp_path / "log.ulg", logs.ulog(logs.ulog_trial()))
    assert ulog.share(path, path.read_bytes()) == 1.0
    found, batches, _ = read(ulog, path)
    imu = found["imu", "sensor_combined[0]"]
    np.testing.assert_allclose(imu["time"], 5.0 + 0.01 * np.arange(40))
    np.testing.assert_allclose(imu["gyro"][0], (0.1, 0.2, 0.3), rtol=1e-6)
    np.testing.assert_allclose(imu["accel"][0], (1.0, 2.0, -9.8), rtol=1e-6)
    fix = found["fix", "vehicle_gps_position[0]"]
    np.testing.assert_allclose(fix["time"], logs.START + 0.05 * np.arange(8), atol=1e-6)
    np.testing.assert_allclose(fix["received"], 5.0 + 0.05 * np.arange(8))
    np.testing.assert_allclose(fix["lat"][1] / DEG, 54.0000006, atol=1e-10)
    np.testing.assert_allclose((fix["altitude"], fix["height"]), [[40.25] * 8, [87.75] * 8])
    np.testing.assert_allclose(fix["velocity"], [[-2.5, 1.5, -0.25]] * 8)
    np.testing.assert_allclose(fix["quality"], 4.0)
    attitude = found["attitude", "vehicle_attitude[0]"]
    np.testing.assert_allclose(attitude["heading"] / DEG, 270.0, atol=1e-5)
    np.testing.assert_allclose(attitude["received"] - attitude["time"], 0.002, atol=1e-9)
    dvl = found["dvl", "vehicle_visual_odometry[0]"]
    assert np.isnan(dvl["velocity"][0]).all()
    np.testing.assert_allclose(dvl["velocity"][1], (1.0, -0.5, 0.25))
    np.testing.assert_allclose(dvl["std"][1], (0.1, 0.2, np.nan), rtol=1e-6)
    assert {batch.axes for batch in batches.values()} == {"FRD", ""}


def test_nucleus(tmp_path):
    needs(nucleus)
    data = bytearray(logs.nucleus_trial())
    path = write(tmp_path / "log.nucleus", bytes(data))
    assert nucleus.share(path, path.read_bytes()) == 1.0
    found, batches, notes = read(nucleus, path)
    imu = found["imu", "IMU"]
    np.testing.assert_allclose(imu["time"], logs.START + 0.1 * np.arange(40), atol=1e-5)
    np.testing.assert_allclose(imu["accel"][3], (0.1, 0.2, -9.8), rtol=1e-6)
    np.testing.assert_allclose(imu["gyro"][3], (0.01, 0.02, 3.0), rtol=1e-6)
    dvl = found["dvl", "bottom track"]
    np.testing.assert_allclose(dvl["velocity"][3], (4.0, -0.5, 0.25))
    np.testing.assert_allclose(dvl["std"][3], (0.01, 0.02, 0.03), rtol=1e-6)
    np.testing.assert_allclose(dvl["range"][3], (10.0, np.nan, 12.0, np.nan))
    np.testing.assert_allclose(dvl["delay"], 0.02, rtol=1e-6)
    np.testing.assert_allclose(dvl["window"], 0.005, rtol=1e-6)
    attitude = found["attitude", "AHRS"][0]
    np.testing.assert_allclose(
        [attitude[n] / DEG for n in ("roll", "pitch", "heading")], [1.5, -2.5, 270.5]
    )
    assert batches["attitude", "AHRS"].heading == "magnetic"
    np.testing.assert_allclose(found["depth", "AHRS"]["depth"], 3.5)
    # What the instrument navigated by the same IMU and DVL is no reference for them.
    assert not [key for key in found if key[0] == "ins"]
    assert any("INS were left out" in note for note in notes)
    # A flipped bit costs one packet.
    data[len(logs.nucleus_imu(0, (0, 0, 0), (0, 0, 0))) + 40] ^= 1
    found, _, _ = read(nucleus, write(path, b"noise" + bytes(data)))
    assert (len(found["dvl", "bottom track"]), len(found["imu", "IMU"])) == (39, 40)


def test_nucleus_without_lock_and_without_utc(tmp_path):
    needs(nucleus)
    data = logs.nucleus_track(5.0, (-32.768, -32.768, -32.768), merit=(10.0, 10.0, 10.0))
    data += logs.nucleus_track(5.1, (1.0, 2.0, 3.0), status=0)
    data += logs.nucleus_imu(5.0, (0, 0, 0), (0, 0, 0), valid=False, posix=False)
    data += logs.nucleus_track(5.2, (1.0, 2.0, 3.0), kind=0xBE)
    found, batches, _ = read(nucleus, write(tmp_path / "log.nucleus", data))
    np.testing.assert_array_equal(
        np.isnan(found["dvl", "bottom track"]["velocity"]).all(axis=1), [True, False]
    )
    np.testing.assert_array_equal(batches["dvl", "bottom track"].valid, [True, False])
    assert not batches["imu", "IMU"].valid.any()
    assert batches["water", "water track"].valid.all()
    np.testing.assert_allclose(found["water", "water track"]["velocity"], [[1.0, 2.0, 3.0]])


@pytest.mark.parametrize(
    ("module", "name", "data"),
    [
        (bags, "a.bag", b"#ROSBAG V2.0\n" + bytes(50)),
        (bags, "a.mcap", b"\x89MCAP0\r\n" + bytes(50)),
        (bags, "a.db3", b"SQLite format 3\0" + bytes(200)),
        (ardupilot, "a.BIN", b"\xa3\x95\x80" + bytes(50)),
        (ulog, "a.ulg", b"ULog\x01\x12\x35" + bytes(50)),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, module, name, data, capfd):
    needs(module)
    with pytest.raises(DataError, match=name):
        list(module.read(write(tmp_path / name, data)))
    assert capfd.readouterr() == ("", "")


def test_what_is_loaded_is_a_module():
    assert load("json.decoder", "none").JSONDecoder
