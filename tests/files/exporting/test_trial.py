"""Trials in other formats, and what comes back of them."""

from dataclasses import replace

import builders
import numpy as np
import pytest
from scipy.io import netcdf_file

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.exporting.trial import export_trial
from factorgraph_dvl.files.formats.janus import beam_directions
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.trial_folder import load_trial, save_trial
from factorgraph_dvl.sensors.dvl_beams import DvlBeams, DvlBeamsSettings


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "trial"
    trial = replace(builders.build_trial(seconds=20), epoch="2024-05-06T07:08:09Z")
    save_trial(trial, path)
    return path


@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_tables(folder, tmp_path, to):
    out, notes = export_trial(folder, to, tmp_path / "out")
    before, after = load_trial(folder), load_trial(out)
    assert notes == ()
    assert (out / f"dvl.{to}").exists()
    np.testing.assert_array_equal(after.dvl.velocity, before.dvl.velocity)
    np.testing.assert_array_equal(after.imu.gyro, before.imu.gyro)


def test_netcdf(folder, tmp_path):
    out, _ = export_trial(folder, "netcdf", tmp_path / "trial.nc")
    trial = load_trial(folder)
    with netcdf_file(out, mmap=False) as file:
        np.testing.assert_array_equal(file.variables["imu_gyro_y_rad_s"][:], trial.imu.gyro[:, 1])
        assert file.variables["imu_gyro_y_rad_s"].units == b"rad s-1"
        np.testing.assert_array_equal(file.variables["dvl_vel_x_m_s"][:], trial.dvl.velocity[:, 0])
        assert b"format: 1" in file.trial_yaml


def test_pd0(folder, tmp_path):
    out, notes = export_trial(folder, "pd0", tmp_path / "trial.pd0")
    import_files([out], tmp_path / "back")
    before, after = load_trial(folder), load_trial(tmp_path / "back")
    lost = np.isnan(before.dvl.velocity).any(axis=1)
    np.testing.assert_array_equal(np.isnan(after.dvl.velocity).any(axis=1), lost)
    np.testing.assert_allclose(after.dvl.velocity, before.dvl.velocity, atol=0.51e-3)
    has_fix = np.isfinite(before.gnss.geodetic[:, 0]) & (before.gnss.time <= before.dvl.time[-1])
    np.testing.assert_allclose(after.gnss.geodetic, before.gnss.geodetic[has_fix], atol=1e-4)
    # Stamps by the clock that fixes and pings share.
    apart = after.dvl.time[0] - after.gnss.time[0]
    wanted = before.dvl.time[0] - before.gnss.time[has_fix][0]
    assert apart == pytest.approx(wanted, abs=0.011)
    assert any("no room for imu" in note for note in notes)


def test_pd0_of_beams(tmp_path):
    trial = builders.build_trial(seconds=10)
    time = np.arange(1.0, 9.0)
    settings = DvlBeamsSettings(directions=tuple(map(tuple, beam_directions(np.pi / 6).tolist())))
    velocity = np.random.default_rng(0).normal(0.0, 1.0, (8, 4)).round(3)
    velocity[2, 1] = np.nan
    beams = replace(trial, epoch="", dvl=None, others=(DvlBeams(settings, time, velocity),))
    save_trial(beams, tmp_path / "trial")
    out, notes = export_trial(tmp_path / "trial", "pd0")
    assert out == tmp_path / "trial" / "trial.pd0"
    assert any("no epoch" in note for note in notes)
    import_files([out], tmp_path / "back")
    back = load_trial(tmp_path / "back").beams
    np.testing.assert_allclose(back.velocity, velocity, atol=1e-9)
    np.testing.assert_allclose(back.nominal_b, beam_directions(np.pi / 6), atol=1e-6)


def test_mcap(folder, tmp_path):
    pytest.importorskip("rosbags", exc_type=ImportError)
    out, _ = export_trial(folder, "mcap", tmp_path / "trial.mcap")
    import_files([out], tmp_path / "back")
    before, after = load_trial(folder), load_trial(tmp_path / "back")
    np.testing.assert_array_equal(after.imu.gyro, before.imu.gyro)
    np.testing.assert_allclose(np.diff(after.imu.time), np.diff(before.imu.time), atol=1e-6)
    assert after.body_axes == before.body_axes
    locked = before.dvl.locked
    np.testing.assert_array_equal(after.dvl.velocity, before.dvl.velocity[locked])
    has_fix = np.isfinite(before.gnss.geodetic[:, 0])
    np.testing.assert_allclose(after.gnss.geodetic, before.gnss.geodetic[has_fix], rtol=1e-15)


def test_refuses_what_it_cannot_write(folder, tmp_path):
    with pytest.raises(ConfigError, match="is not a format of trials; expected csv, parquet"):
        export_trial(folder, "tum", tmp_path / "x")
    (tmp_path / "there.pd0").write_bytes(b"mine")
    with pytest.raises(DataError, match="the file exists"):
        export_trial(folder, "pd0", tmp_path / "there.pd0")
    assert (tmp_path / "there.pd0").read_bytes() == b"mine"


def test_refuses_velocities_beyond_the_format(tmp_path):
    trial = builders.build_trial(seconds=10)
    fast = replace(trial.dvl, velocity=trial.dvl.velocity * 0.0 + 40.0)
    save_trial(replace(trial, dvl=fast), tmp_path / "trial")
    with pytest.raises(DataError, match=r"above 32\.767 m/s"):
        export_trial(tmp_path / "trial", "pd0", tmp_path / "x.pd0")
    assert not (tmp_path / "x.pd0").exists()
