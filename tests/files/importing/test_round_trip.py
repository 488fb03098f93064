"""A simulated trial, written as instruments write, and read back."""

import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import format_writers as writers
import msgspec
import numpy as np
import pytest
import simulated
import yaml

from factorgraph_dvl import solve
from factorgraph_dvl.files.formats.mapping import MappingSettings
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.trial_folder import load_trial
from factorgraph_dvl.settings.yaml_file import read_yaml

EPOCH = datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC)
GYRO = [f"gyro_{axis}_rad_s" for axis in "xyz"]
ACCEL = [f"accel_{axis}_m_s2" for axis in "xyz"]


def pd0_file(dvl, *, local=timedelta(0)):
    parts = []
    for i, (time, velocity) in enumerate(zip(dvl.time, dvl.velocity, strict=True)):
        when = EPOCH + local + timedelta(seconds=round(float(time), 2))
        bottom = [None] * 4 if np.isnan(velocity).any() else [*(-velocity), 0.0]
        parts.append(
            writers.pd0(
                [
                    writers.fixed_leader(frame=1),
                    writers.variable_leader(i, when),
                    writers.bottom_track(bottom, (20.0,) * 4),
                ]
            )
        )
    return b"".join(parts)


def nmea_file(gnss):
    out = []
    for time, (lat, lon, height), velocity in zip(
        gnss.time, gnss.geodetic, gnss.velocity, strict=True
    ):
        when = EPOCH + timedelta(seconds=round(float(time), 2))
        clock = when.strftime("%H%M%S.") + f"{when.microsecond // 10000:02d}"
        place = f"{angle(lat, 2)},N,{angle(lon, 3)},E"
        speed = math.hypot(velocity[0], velocity[1]) / (1852 / 3600)
        course = math.degrees(math.atan2(velocity[0], velocity[1])) % 360
        date = when.strftime("%d%m%y")
        out.append(writers.nmea(f"GPRMC,{clock},A,{place},{speed:.4f},{course:.4f},{date},,,A"))
        heights = f"{height - 12.5:.3f},M,12.5,M"
        out.append(writers.nmea(f"GPGGA,{clock},{place},4,9,0.8,{heights},,"))
    return b"".join(out)


def angle(value, digits):
    degrees, minutes = divmod(math.degrees(value) * 60, 60)
    return f"{int(degrees):0{digits}d}{minutes:010.7f}"


def imu_file(imu):
    # Degrees, and up instead of down: what a mapping is for.
    time = imu.time + EPOCH.timestamp()
    rows = np.column_stack([time, imu.gyro * [1, 1, -1] * 180 / np.pi, imu.accel * [1, 1, -1]])
    header = "stamp;wx;wy;wz;fx;fy;fz"
    cells = [";".join([f"{row[0]:.6f}", *(f"{x:.12g}" for x in row[1:])]) for row in rows]
    return "\n".join([header, *cells]).encode()


def mapping(trial):
    columns = {
        f"{kind}_{axis}": {"column": f"{letter}{axis}", "sign": -1 if axis == "z" else 1} | unit
        for kind, letter, unit in (("gyro", "w", {"unit": "deg/s"}), ("accel", "f", {}))
        for axis in "xyz"
    }
    settings = trial.imu.settings
    return {
        "tables": [
            {
                "file": "*.txt",
                "kind": "imu",
                "time": {"column": "stamp", "clock": "utc"},
                "columns": columns,
            }
        ],
        "trial": {
            "imu": {
                "gyro_noise_deg_sqrt_h": settings.gyro_noise_deg_sqrt_h,
                "gyro_bias_std_deg_h": settings.gyro_bias_std_deg_h,
                "accel_noise_ug_sqrt_hz": settings.accel_noise_ug_sqrt_hz,
                "accel_bias_std_ug": settings.accel_bias_std_ug,
                "grade": "navigation",
            },
            "gnss": {
                "lever_arm_m": list(trial.gnss.settings.lever_arm_m),
                "lever_arm_std_m": [0, 0, 0],
                "time_offset_std_s": 0,
            },
            "dvl": {
                "velocity_std_m_s": 0.002,
                "misalignment_std_deg": [10, 10, 10],
                "bias_std_m_s": [0, 0, 0],
                "time_offset_std_s": 0,
            },
        },
    }


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("raw")
    trial = simulated.run(
        noise=True,
        start={"speed_m_s": 2},
        gnss={
            "rate_hz": 2,
            "position_std_m": [0.02, 0.02, 0.04],
            "velocity_std_m_s": [0.1, 0.1, 0.1],
        },
        imu={
            "rate_hz": 100,
            "gyro_noise_deg_sqrt_h": 0.01,
            "accel_noise_ug_sqrt_hz": 50,
        },
        dvl={"misalignment_deg": [1, -2, 3], "scale_error": 0.01},
        sway=simulated.SWELL,
    )
    (folder / "dvl.bin").write_bytes(pd0_file(trial.dvl))
    (folder / "receiver.log").write_bytes(nmea_file(trial.gnss))
    (folder / "imu.txt").write_bytes(imu_file(trial.imu))
    (folder / "map.yaml").write_text(yaml.safe_dump(mapping(trial)))
    return folder, trial


def run(folder, out, names=("imu.txt", "receiver.log", "dvl.bin")):
    settings = read_yaml(folder / "map.yaml", MappingSettings)
    decisions = import_files([folder / name for name in names], out, mapping=settings)
    return decisions, load_trial(out)


@pytest.fixture(scope="module")
def imported(written, tmp_path_factory):
    return run(written[0], tmp_path_factory.mktemp("trial") / "out")


def test_records_are_the_simulated_ones(written, imported):
    trial, (_, found) = written[1], imported
    start = found.imu.time[0] - trial.imu.time[0]
    assert start == pytest.approx(round(start), abs=2e-6)
    np.testing.assert_allclose(found.imu.gyro, trial.imu.gyro, atol=1e-9)
    np.testing.assert_allclose(found.imu.accel, trial.imu.accel, atol=1e-9)
    np.testing.assert_allclose(found.dvl.velocity, trial.dvl.velocity, atol=0.51e-3)
    np.testing.assert_allclose(found.dvl.time - start, trial.dvl.time, atol=5.1e-3)
    np.testing.assert_allclose(found.gnss.geodetic[:, 2], trial.gnss.geodetic[:, 2], atol=1e-3)
    np.testing.assert_allclose(found.gnss.geodetic[:, :2], trial.gnss.geodetic[:, :2], atol=3e-11)
    fast = np.isfinite(found.gnss.velocity[:, 0])
    assert fast.mean() > 0.8
    np.testing.assert_allclose(
        found.gnss.velocity[fast, :2], trial.gnss.velocity[fast, :2], atol=1e-3
    )


def test_order_of_files_does_not_matter(written, imported, tmp_path):
    _, again = run(written[0], tmp_path / "out", ("dvl.bin", "imu.txt", "receiver.log"))
    np.testing.assert_array_equal(again.dvl.velocity, imported[1].dvl.velocity)
    np.testing.assert_array_equal(again.gnss.time, imported[1].gnss.time)


def test_gives_the_same_calibration(written, imported):
    trial = written[1]
    settings = msgspec.structs.replace(trial.dvl.settings, misalignment_std_deg=(10.0, 10.0, 10.0))
    direct = solve(replace(trial, dvl=replace(trial.dvl, settings=settings)))
    through_files = solve(imported[1])
    for name in ("misalignment_deg", "scale_error", "lever_arm_m"):
        one, other = direct.estimate(name), through_files.estimate(name)
        # Velocities are rounded to 1 mm/s, which is far below what the pings scatter by.
        assert np.all(np.abs(other.value - one.value) < 0.3 * one.std), (one, other)
        assert np.all(np.abs(other.std / one.std - 1.0) < 0.2), (one, other)
