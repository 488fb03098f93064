"""A simulated vehicle, written as its ground station logs it, and read back."""

from __future__ import annotations

import format_logs as logs
import msgspec
import numpy as np
import pytest
from truth import config

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats.clocks import utc_to_gps
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.files.trial_folder import load_trial
from factorgraph_dvl.geometry.units import DAY, DEG
from factorgraph_dvl.settings.yaml_file import read_yaml
from factorgraph_dvl.simulation import simulate

START, BOOT, LATE = 1_700_000_000.0, 55.0, 0.03
INTERVAL = 0.2


def telemetry(trial):
    """Return the log of a vehicle in axes forward, right, down, its messages in order."""
    out = []
    for time, (roll, pitch, heading) in zip(trial.attitude.time, trial.attitude.rph, strict=True):
        ms = round((time + BOOT) * 1e3)
        out.append((time, "ATTITUDE", (ms, roll, pitch, heading, 0.0, 0.0, 0.0), (1, 1)))
    gnss = trial.gnss
    for time, (lat, lon, height), std in zip(
        gnss.time, gnss.geodetic, gnss.position_std, strict=True
    ):
        week, second = divmod(float(utc_to_gps(time + START)) - 315964800.0, 7.0 * DAY)
        place = (round(lat / DEG * 1e7), round(lon / DEG * 1e7), height)
        rest = (1.0, 1.0, 0.0, 0.0, 0.0, 0.0, std[0], std[2])
        given = (0, round(second * 1e3), *place, *rest, 56, round(week), 0, 3, 10)
        out.append((time, "GPS_INPUT", given, (1, 220)))
    for time, velocity in zip(trial.dvl.time, trial.dvl.velocity, strict=True):
        us = round((time + 0.5 * INTERVAL + BOOT) * 1e6)
        delta = (us, round(INTERVAL * 1e6), 0, 0, 0, *(velocity * INTERVAL), 90.0)
        out.append((time + 0.5 * INTERVAL, "VISION_POSITION_DELTA", delta, (1, 191)))
    rng = np.random.default_rng(5)
    return b"".join(
        logs.telemetry(name, START + time + LATE * (1.0 + rng.exponential()), *values, sender=by)
        for time, name, values, by in sorted(out, key=lambda x: x[0])
    )


def test_the_log_of_the_dvl_is_better_than_what_the_vehicle_made_of_it(tmp_path):
    pytest.importorskip("pymavlink")
    utc = 1586044800 + 345600 - 18
    (tmp_path / "a.tlog").write_bytes(logs.telemetry_trial(start=utc))
    rows = (f"{utc + 0.1 * i},1.0,0.0,0.0,0.01,1" for i in range(40))
    table = "\n".join(["timestamp,vx,vy,vz,fom,velocity_valid", *rows])
    (tmp_path / "dvl.csv").write_text(table)
    decisions = import_files([tmp_path / "a.tlog", tmp_path / "dvl.csv"], tmp_path / "trial")
    assert "left out: it repeats the DVL's own log, dvl.csv" in decisions.text("")
    np.testing.assert_allclose(load_trial(tmp_path / "trial").dvl.velocity, [[1, 0, 0]] * 40)


def turning_logs(shift, seconds=300):
    """Return a .BIN with the time since its start, and a .tlog with GPS_INPUT, of one drive.

    What both have in common is how the vehicle turns; the .BIN started `shift` s after the Epoch.
    """

    rates = np.random.default_rng(3).normal(0.0, 5.0, 2000)
    turned = np.cumsum(np.convolve(rates, np.ones(4) / 2.0, "same"))

    def heading(t):
        return np.interp(t, np.arange(2000.0), turned)

    binary = []
    for i in range(12 * seconds):
        t = 20.0 + i / 12.0
        us = round(t * 1e6)
        binary.append(("IMU", us, 0, 0.1, 0.2, 0.3, 1.0, 2.0, -9.8))
        if i % 3 == 0:
            yaw = round(100.0 * (heading(t + shift - START) % 360.0))
            binary.append(("ATT", us, 0, 0, 0, 0, 0, yaw))
    data = b""
    for i in range(4 * seconds):
        at = 0.25 * i
        own, yaw = round(1e3 * (100.0 + at)), np.deg2rad(heading(at))
        arrival = START + at + 0.02
        yaw = float(np.angle(np.exp(1j * yaw)))
        data += logs.telemetry("ATTITUDE", arrival, own, 0.0, 0.0, yaw, 0, 0, 0)
        if i % 4 == 0:
            place = (540000001 + 40 * i, -30000002)
            given = (0, 0, *place, -4.5, 1.0, 1.0, 0.0, 0.0, 0.0, 0.4, 1.5, 2.5)
            data += logs.telemetry("GPS_INPUT", arrival, *given, 16, 0, 0, 3, 10, sender=(1, 220))
    return logs.ardupilot_log(binary), data


@pytest.mark.parametrize("order", [("a.BIN", "a.tlog"), ("a.tlog", "a.BIN")])
def test_a_log_without_a_date_is_related_by_how_the_vehicle_turns(tmp_path, order):
    pytest.importorskip("pymavlink")
    shift = START + 31.3
    names = dict(zip(("a.BIN", "a.tlog"), turning_logs(shift), strict=True))
    for name, data in names.items():
        (tmp_path / name).write_bytes(data)
    decisions = import_files([tmp_path / name for name in order], tmp_path / "trial")
    text = decisions.text("")
    assert f"a.BIN: its clock starts at {np.datetime64(int(shift), 's')}" in text
    assert "where its turns agree with those of other files" in text
    assert "a.BIN ATT[0]: attitude: an IMU or a navigation solution says how" in text
    time = read_table(tmp_path / "trial" / "imu.parquet", ("time_s",))["time_s"]
    epoch = read_yaml(tmp_path / "trial" / "trial.yaml", dict)["epoch"]
    first = np.datetime64(epoch.removesuffix("Z"), "s").astype(float) + time[0]
    assert first == pytest.approx(20.0 + shift, abs=0.2)


def test_speeds_are_compared_with_positions_that_have_no_utc(tmp_path):
    """The DVL counts from its start; GPS_INPUT states no GPS time: it has that of a computer."""
    pytest.importorskip("pymavlink")
    speed = np.abs(np.cumsum(np.random.default_rng(4).normal(0.0, 0.3, 600)))
    metres = np.concatenate([[0.0], np.cumsum(speed)])
    data = b""
    for t in range(500):
        place = (540000000 + round(metres[t] / 6.371e6 / DEG * 1e7), -30000002)
        given = (0, 0, *place, -4.5, 1.0, 1.0, 0.0, 0.0, 0.0, 0.4, 0.5, 0.5)
        at = START + t
        data += logs.telemetry("GPS_INPUT", at, *given, 16, 0, 0, 3, 10, sender=(1, 220))
        data += logs.telemetry("ATTITUDE", at, 1000 * t, 0.0, 0.0, 0.0, 0, 0, 0)
    (tmp_path / "a.tlog").write_bytes(data)
    # Half a second after each fix, the DVL has the mean speed until the next one.
    rows = (f"{t + 0.5 - 80.0},{speed[t]:.4f},0.0,0.0,0.01,1" for t in range(100, 400))
    table = "\n".join(["timestamp,vx,vy,vz,fom,velocity_valid", *rows])
    (tmp_path / "dvl.csv").write_text(table)
    decisions = import_files([tmp_path / "dvl.csv", tmp_path / "a.tlog"], tmp_path / "trial")
    assert "dvl.csv: its clock starts at" in decisions.text("")
    assert "where its speeds agree with those of other files" in decisions.text("")
    time = read_table(tmp_path / "trial" / "dvl.parquet", ("time_s",))["time_s"]
    epoch = read_yaml(tmp_path / "trial" / "trial.yaml", dict)["epoch"]
    first = np.datetime64(epoch.removesuffix("Z"), "s").astype(float) + time[0]
    assert first == pytest.approx(START + 100.5, abs=0.3)


def test_a_log_of_another_dive_is_refused(tmp_path):
    """Its stamps are no dates: taken as UTC, they would be in 1970."""
    pytest.importorskip("pymavlink")
    binary, _ = turning_logs(START + 1000.0, 100)
    _, telemetry_ = turning_logs(START, 100)
    (tmp_path / "a.BIN").write_bytes(binary)
    (tmp_path / "a.tlog").write_bytes(telemetry_)
    with pytest.raises(
        DataError, match=r"a\.BIN: its clock cannot be related.*no lag of speeds or"
    ):
        import_files([tmp_path / "a.BIN", tmp_path / "a.tlog"], tmp_path / "trial")


def test_a_vehicle_comes_back_from_its_telemetry(tmp_path):
    pytest.importorskip("pymavlink")
    scenario = config("ship")
    manoeuvres = scenario.manoeuvres[0]["manoeuvres"][:2]
    trial = simulate(msgspec.structs.replace(scenario, manoeuvres=manoeuvres), 1)
    assert trial.body_axes == "FRD"
    (tmp_path / "a.tlog").write_bytes(telemetry(trial))
    import_files([tmp_path / "a.tlog"], tmp_path / "trial")
    found = load_trial(tmp_path / "trial")
    assert (found.imu, found.body_axes) == (None, "FRD")
    # One shift for all that the vehicle stamps: of how much later than at once things arrive.
    epoch = np.datetime64(found.epoch.removesuffix("Z"), "s").astype(float) - START
    pings = trial.dvl.time
    assert len(found.dvl.time) == len(pings)
    shift = found.dvl.time + epoch - pings
    assert np.ptp(shift) < 2e-6
    assert abs(shift[0]) < 0.05
    np.testing.assert_allclose(
        found.attitude.time + epoch - shift[0], trial.attitude.time, atol=1e-3
    )
    np.testing.assert_allclose(found.gnss.time + epoch, trial.gnss.time, atol=1e-3)
    np.testing.assert_allclose(found.dvl.velocity, trial.dvl.velocity, atol=1e-5)
    turned = np.angle(np.exp(1j * (found.attitude.rph - trial.attitude.rph)))
    np.testing.assert_allclose(turned, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.gnss.geodetic[:, :2], trial.gnss.geodetic[:, :2], atol=1e-9)
    np.testing.assert_allclose(found.gnss.position_std, trial.gnss.position_std, rtol=1e-5)
