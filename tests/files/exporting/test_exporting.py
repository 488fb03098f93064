from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from reports import build_result
from scipy.io import loadmat, netcdf_file
from scipy.spatial.transform import Rotation

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.exporting.geographic import write_geojson, write_kml
from factorgraph_dvl.files.exporting.navigation import write_nmea, write_sbet
from factorgraph_dvl.files.exporting.trajectories import (
    ExportedMotion,
    exported_motion,
    write_matlab,
    write_netcdf,
    write_parquet,
    write_tum,
)
from factorgraph_dvl.files.formats.clocks import gps_to_utc, utc_to_gps
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.units import DEG

EPOCH = "2022-10-12T02:00:00Z"
# Wednesday, 02:00:18 GPS time: leap seconds are 18.
START_OF_WEEK = 3 * 86400.0 + 2 * 3600.0 + 18.0


@pytest.fixture(scope="module")
def motion() -> ExportedMotion:
    return exported_motion(build_result(60.0).solution, EPOCH)


def test_gps_time_and_back() -> None:
    utc = np.array([1665540000.0, 1483228799.0, 1483228800.0, 500000000.0])
    gps = utc_to_gps(utc)
    assert gps[0] - utc[0] == 18.0
    assert gps[2] - gps[1] == 2.0
    np.testing.assert_array_equal(gps_to_utc(0, gps - 315964800.0), utc)


def test_tum(motion: ExportedMotion, tmp_path: Path) -> None:
    write_tum(motion, tmp_path / "t")
    rows = np.loadtxt(tmp_path / "t")
    t = motion.trajectory
    frame = LocalFrame(*t.geodetic[0])
    assert rows[0, 0] == 1665540000.0
    np.testing.assert_allclose(rows[:, 1:4], frame.position(*t.geodetic.T), atol=1e-6)
    # The last attitude, in the frame of the first place.
    level = rotation_from_rph(t.rph[-1], motion.body_axes)
    nRb = frame.level_from_tangent(*t.geodetic[-1, :2]).T @ level
    np.testing.assert_allclose(Rotation.from_quat(rows[-1, 4:]).as_matrix(), nRb, atol=1e-8)


def test_evo_reports_the_same_rms(motion: ExportedMotion, tmp_path: Path) -> None:
    if importlib.util.find_spec("evo") is None:
        pytest.skip("evo is not installed")
    write_tum(motion, tmp_path / "a.tum")
    rng = np.random.default_rng(3)
    rows = np.loadtxt(tmp_path / "a.tum")
    error = rng.normal(0.0, 0.3, (len(rows), 3))
    rows[:, 1:4] += error
    np.savetxt(tmp_path / "b.tum", rows, fmt="%.9f")
    program = [sys.executable, "-c", "from evo.cli.entry_points import ape; ape()", "tum"]
    files = [str(tmp_path / "a.tum"), str(tmp_path / "b.tum")]
    home = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "PYTHONPATH": ":".join(sys.path)}
    found = subprocess.run([*program, *files], capture_output=True, text=True, env=home)
    assert found.returncode == 0, found.stderr
    (line,) = (x for x in found.stdout.splitlines() if x.split()[:1] == ["rmse"])
    expected = np.sqrt(np.mean(np.sum(error**2, axis=1)))
    assert float(line.split()[1]) == pytest.approx(expected, abs=1e-5)


def test_kml_passes_its_schema(motion: ExportedMotion, tmp_path: Path) -> None:
    write_kml(replace(motion, name="a < b & c"), tmp_path / "t.kml")
    pytest.importorskip("lxml", reason="lxml is not installed")
    validator = pytest.importorskip("fastkml.validator", reason="fastkml is not installed")
    assert validator.validate(file_to_validate=tmp_path / "t.kml")
    text = (tmp_path / "t.kml").read_text()
    lon, lat, height = text.split("<coordinates>")[1].split()[0].split(",")
    latitude, longitude, up = motion.trajectory.geodetic[0]
    assert float(lat) * DEG == pytest.approx(latitude, abs=1e-11)
    assert float(lon) * DEG == pytest.approx(longitude, abs=1e-11)
    assert float(height) == pytest.approx(up, abs=1e-3)
    assert "<when>2022-10-12T02:00:00.000Z</when>" in text


def test_geojson(motion: ExportedMotion, tmp_path: Path) -> None:
    write_geojson(motion, tmp_path / "t")
    (feature,) = json.loads((tmp_path / "t").read_text())["features"]
    places = np.array(feature["geometry"]["coordinates"])
    assert feature["properties"]["coordTimes"][10] == "2022-10-12T02:00:01.000Z"
    np.testing.assert_allclose(places[:, 1] * DEG, motion.trajectory.geodetic[:, 0], atol=1e-10)
    assert len(feature["properties"]["std_e_m"]) == len(places)


def test_arrays(motion: ExportedMotion, tmp_path: Path) -> None:
    heading = motion.trajectory.rph[:, 2] / DEG
    write_parquet(motion, tmp_path / "trajectory.table")
    table = pyarrow.parquet.read_table(tmp_path / "trajectory.table")
    np.testing.assert_allclose(table["heading_deg"], heading, rtol=1e-15)
    assert table["utc_s"][0].as_py() == 1665540000.0
    write_matlab(motion, tmp_path / "trajectory.matlab")
    found = loadmat(tmp_path / "trajectory.matlab", simplify_cells=True)["trajectory"]
    np.testing.assert_allclose(found["heading_deg"], heading, rtol=1e-15)
    assert found["trial"] == "by hand"
    write_netcdf(motion, tmp_path / "t.nc")
    with netcdf_file(tmp_path / "t.nc", mmap=False) as file:
        np.testing.assert_array_equal(file.variables["heading_deg"][:], heading)
        assert file.variables["vel_e_m_s"].units == b"m s-1"
        assert file.variables["std_e_m"].units == b"m"


def test_sbet_by_the_published_record(motion: ExportedMotion, tmp_path: Path) -> None:
    """The table of the record: 17 doubles, as hydrographic software documents them."""
    names = (
        "time latitude longitude altitude x_vel y_vel z_vel roll pitch heading wander x_acc "
        "y_acc z_acc x_rate y_rate z_rate"
    )
    write_sbet(motion, tmp_path / "t.sbet")
    found = np.fromfile(tmp_path / "t.sbet", [(name, "<f8") for name in names.split()])
    t = motion.trajectory
    assert found["time"][0] == pytest.approx(START_OF_WEEK, abs=1e-6)
    np.testing.assert_array_equal(found["latitude"], t.geodetic[:, 0])
    np.testing.assert_array_equal(found["longitude"], t.geodetic[:, 1])
    np.testing.assert_array_equal(found["x_vel"], t.velocity[:, 1])
    np.testing.assert_array_equal(found["y_vel"], t.velocity[:, 0])
    np.testing.assert_allclose(found["heading"], t.rph[:, 2] % (2 * np.pi))
    np.testing.assert_array_equal(found["wander"], 0.0)
    # The attitude changes as the rates say: to first order over a step of 0.1 s.
    frd = rotation_from_rph(t.rph, "FRD")
    turn = Rotation.from_matrix(np.swapaxes(frd[:-1], 1, 2) @ frd[1:]).as_rotvec() / 0.1
    rates = np.stack([found[f"{axis}_rate"] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(rates[1:-1], 0.5 * (turn[:-1] + turn[1:]), atol=2e-4)
    errors = np.fromfile(tmp_path / "t.smrmsg", "<f8").reshape(-1, 10)
    np.testing.assert_allclose(errors[:, 1], t.position_std[:, 1])
    np.testing.assert_allclose(errors[:, 9] / 60.0 * DEG, t.rph_std[:, 2])


def test_nmea(motion: ExportedMotion, tmp_path: Path) -> None:
    write_nmea(motion, tmp_path / "t")
    lines = (tmp_path / "t").read_bytes().decode("ascii").split("\r\n")
    assert len(lines) == 5 * motion.trajectory.time.size + 1
    for line in lines[:-1]:
        body, checksum = line[1:].split("*")
        assert int(checksum, 16) == np.bitwise_xor.reduce(np.frombuffer(body.encode(), "u1"))
    gga = lines[6].split(",")
    assert gga[0] == "$INGGA"
    assert gga[1] == "020000.10"
    latitude = float(gga[2][:2]) + float(gga[2][2:]) / 60.0
    assert latitude * DEG == pytest.approx(motion.trajectory.geodetic[1, 0], abs=2e-11)
    assert gga[3] == "N"


def test_without_an_epoch_there_is_no_utc(tmp_path: Path) -> None:
    motion = exported_motion(build_result(10.0).solution, "")
    write_tum(motion, tmp_path / "t")
    assert np.loadtxt(tmp_path / "t")[0, 0] == 0.0
    with pytest.raises(DataError, match="SBET needs UTC"):
        write_sbet(motion, tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_the_same_trajectory_makes_the_same_bytes(motion: ExportedMotion, tmp_path: Path) -> None:
    writers = (write_tum, write_kml, write_geojson, write_parquet, write_matlab, write_netcdf)
    for write in (*writers, write_sbet, write_nmea):
        write(motion, tmp_path / "a")
        write(motion, tmp_path / "b")
        assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
