"""What a trial has no use for is named, with the reason."""

from __future__ import annotations

from datetime import UTC, datetime

import format_logs as logs
import format_samples as samples
import numpy as np
import pytest
import yaml

from factorgraph_dvl.files.formats.format import Batch, empty
from factorgraph_dvl.files.formats.mapping import MappingSettings
from factorgraph_dvl.files.importing.guess import guess_all
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.importing.spool import Spool
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.settings.yaml_file import parse_yaml

WHEN = datetime(2022, 7, 25, 12, 35, tzinfo=UTC).timestamp()


def imported(tmp_path, files, mapping=None, guess=()):
    for name, data in files.items():
        (tmp_path / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    if guess:
        text = guess_all([tmp_path / name for name in guess])
        mapping = parse_yaml(text, MappingSettings, source="guess")
    return import_files(
        [tmp_path / name for name in files], tmp_path / "trial", mapping=mapping, force=True
    )


def rows(header, line, count=60, step=1.0):
    return "\n".join([header, *(line.format(t=WHEN + step * i, i=i) for i in range(count))]) + "\n"


IMU = rows("time_s,gx,gy,gz,ax,ay,az", "{t},0,0,0.1,0,0,9.8", 600, 0.1)
ATTITUDE = rows("time_s,roll_deg,pitch_deg,heading_deg", "{t},1,2,{i}")
SPEED = rows("time_s,sog_m_s,cog_deg", "{t},1.5,30")
FIX = rows("time_s,lat_deg,lon_deg,height_m", "{t},48.1,11.5{i},300")


def test_an_attitude_beside_an_imu(tmp_path):
    files = {"imu.csv": IMU.replace("gx,gy,gz", "gyro x,gyro y,gyro z"), "compass.csv": ATTITUDE}
    files["imu.csv"] = files["imu.csv"].replace("ax,ay,az", "acc x,acc y,acc z")
    lines = imported(tmp_path, files, guess=files).lines
    said = "attitude: an IMU or a navigation solution says how the vehicle turns → not used"
    assert f"compass.csv attitude: {said}" in lines


def test_a_course_without_fixes(tmp_path):
    files = {"speed.csv": SPEED, "compass.csv": ATTITUDE}
    lines = imported(tmp_path, files, guess=files).lines
    said = "course and speed: there are no fixes that they belong to → not used"
    assert f"speed.csv course: {said}" in lines
    assert not any("attitude: an IMU" in line for line in lines)


def test_cells_of_water_beside_bottom_track(tmp_path):
    decisions = imported(tmp_path, {"a.PD0": b"".join(map(samples.ensemble, range(20)))})
    said = "velocities through the water: there are those over the bottom → not used"
    assert f"a.PD0 cells: {said}" in decisions.lines


def test_what_is_used_is_not_said_to_be_unused(tmp_path):
    files = {"fix.csv": FIX, "speed.csv": SPEED, "compass.csv": ATTITUDE}
    decisions = imported(tmp_path, files, guess=files)
    assert not [line for line in decisions.lines if "not used" in line]
    assert not decisions.warnings


def test_records_without_a_place_are_no_positions(tmp_path):
    mapping = parse_yaml(
        "tables:\n  - file: fix.csv\n    kind: fix\n    time: {column: time_s, clock: utc}\n"
        "    columns: {lat: lat_deg, lon: lon_deg}\n  - file: a.csv\n    kind: attitude\n"
        "    time: {column: time_s, clock: utc}\n    columns: {heading: heading_deg}\n",
        MappingSettings,
        source="map",
    )
    files = {"fix.csv": rows("time_s,lat_deg,lon_deg", "{t},,"), "a.csv": ATTITUDE}
    decisions = imported(tmp_path, files, mapping)
    assert "fix.csv fix: no record has a position → not used" in decisions.lines
    assert decisions.missing[0].startswith("positions: no file has any")
    assert "gnss" not in yaml.safe_load((tmp_path / "trial" / "trial.yaml").read_text())


def test_a_latitude_alone_is_no_fix(tmp_path):
    table = rows("time_s,lat_deg,lon_deg", "{t},48.1,11.5").replace("11.5\n", "\n", 20)
    (account,) = imported(tmp_path, {"a.csv": table}, guess=["a.csv"]).accounts
    assert account.rows() == [("fix (fix)", 40, 20, "no fix")]


def test_positions_of_a_vessel_without_places(tmp_path):
    decisions = imported(tmp_path, {"gga.csv": samples.underwater_gps()["gga"]})
    assert any("no file has places relative to it → not used" in line for line in decisions.lines)


def test_places_without_a_vessel(tmp_path):
    decisions = imported(tmp_path, {"acoustic.csv": samples.underwater_gps()["acoustic"]})
    assert any("no file has the position of the vessel" in text for text in decisions.warnings)


def test_records_of_another_time(tmp_path):
    later = rows("time_s,lat_deg,lon_deg,height_m", "{t},48.1,11.5,300", step=1.0)
    later = later.replace(f"{WHEN:.0f}"[:6], f"{WHEN + 1e6:.0f}"[:6])
    files = {"fix.csv": later, "compass.csv": ATTITUDE}
    decisions = imported(tmp_path, files, guess=files)
    assert decisions.warnings == ["fix.csv fix: no time in common with compass.csv attitude"]


def test_a_log_with_a_compass_of_its_own_is_guessed_as_both(tmp_path):
    header = "time_s,vel_x_m_s,vel_y_m_s,vel_z_m_s,roll_deg,pitch_deg,heading_deg"
    upright = {"dvl.csv": rows(header, "{t},1,0,0,1,2,{i}")}
    decisions = imported(tmp_path, upright, guess=upright)
    assert [row[:2] for row in decisions.accounts[0].rows()] == [
        ("dvl (dvl)", 60),
        ("attitude (attitude)", 60),
    ]
    roll = read_table(tmp_path / "trial" / "attitude.parquet", ("roll_deg",))["roll_deg"]
    np.testing.assert_allclose(roll, 1.0)
    # Beside a better one, it is not used: they are two sensors.
    compass = rows("time_s,heading_true_deg", "{t},{i}")
    lines = imported(tmp_path, upright | {"hdt.csv": compass}, guess=["dvl.csv", "hdt.csv"]).lines
    assert "dvl.csv attitude: attitude not used: hdt.csv attitude 2 is better" in lines
    assert "hdt.csv attitude 2: 60 records of heading alone" in lines
    over = {"dvl.csv": rows(header, "{t},1,0,0,-178,2,{i}")}
    lines = imported(tmp_path, over, guess=over).lines
    assert "dvl.csv attitude: 60 records of heading alone" in lines


def test_parts_of_one_record_are_one_source(tmp_path):
    first = rows("time_s,heading_deg", "{t},{i}")
    second = first.replace(f"{WHEN:.0f}"[:7], f"{WHEN + 1e3:.0f}"[:7])
    files = {"a.csv": first, "b.csv": second}
    lines = imported(tmp_path, files, guess=files).lines
    assert not [line for line in lines if "is better" in line]
    assert len(read_table(tmp_path / "trial" / "attitude.parquet", ("time_s",))["time_s"]) == 120


def test_a_table_with_bytes_that_are_no_text(tmp_path, capfd):
    table = rows("time_s,lat_deg,lon_deg,height_m", "{t},48.1,11.5,300").encode()
    lines = table.splitlines(keepends=True)
    lines[20] = b"\xd0\xff,1,2\n"
    lines[30] = lines[30].replace(b"48.1", b"4\xff.1")
    data = b"".join(lines)
    decisions = imported(tmp_path, {"a.csv": data}, guess=["a.csv"])
    assert decisions.accounts[0].rows() == [
        ("fix (fix)", 58, 1, "no fix"),
        ("damaged", 0, 1, "row with another number of cells"),
    ]
    assert f", at byte {data.index(lines[20]):,} → left out" in decisions.text("")
    assert capfd.readouterr().err == ""


def test_infinite_values_are_no_values(tmp_path):
    records = empty("dvl", 3)
    records["time"] = records["received"] = [0.0, 1.0, 2.0]
    records["velocity"], records["axes"] = 1.0, 1
    records["velocity"][1, 2] = np.inf
    spool = Spool(tmp_path, lambda *_: None)
    spool.append("f", "pd0", Batch("dvl", records, "own", "bottom"))
    (tally,) = spool.tallies("f").values()
    assert (tally.read, tally.skipped) == (2, {"no lock": 1})
    (stream,) = spool.streams()
    assert np.isnan(stream.records[:]["velocity"][1, 2])
    assert np.isinf(records["velocity"][1, 2])


def test_a_log_says_of_gps_raw_int_only_if_it_has_some(tmp_path):
    pytest.importorskip("pymavlink")
    data = b""
    for i in range(20):
        place = (540000001 + i, -30000002)
        given = (0, 0, *place, -4.5, 1.0, 1.0, 0.0, 0.0, 0.0, 0.4, 1.5, 2.5)
        at = logs.START + 0.5 * i
        data += logs.telemetry("GPS_INPUT", at, *given, 16, 0, 0, 3, 10, sender=(1, 220))
    assert "GPS_RAW_INT" not in imported(tmp_path, {"a.tlog": data}).text("")
