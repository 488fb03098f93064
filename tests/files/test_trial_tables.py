"""Trials from tables in memory."""

from __future__ import annotations

import numpy as np
import pytest
from builders import build_trial

from factorgraph_dvl import load_trial, save_trial, trial_from_tables
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.motion_table import motion_columns

TRIAL = build_trial(seconds=20.0)
IMU = {
    "gyro_noise_deg_sqrt_h": 0.01,
    "gyro_bias_std_deg_h": 1.0,
    "accel_noise_ug_sqrt_hz": 100,
    "accel_bias_std_ug": 1000,
}


def tables():
    out = {record.section: record.columns() for record in (TRIAL.imu, TRIAL.gnss, TRIAL.dvl)}
    return out | {"reference": motion_columns(TRIAL.reference)}


def test_a_trial_of_arrays_is_that_of_its_folder(tmp_path):
    save_trial(TRIAL, tmp_path / "trial")
    expected = load_trial(tmp_path / "trial")
    found = trial_from_tables(
        tables(), imu=IMU, gnss={"position_std_m": np.array([0.02, 0.02, 0.04])}, name="arrays"
    )
    assert found.name == "arrays"
    for section in ("imu", "gnss", "dvl"):
        own, other = getattr(found, section).columns(), getattr(expected, section).columns()
        for name, values in other.items():
            np.testing.assert_array_equal(own[name], values)
    np.testing.assert_array_equal(found.reference.rph, expected.reference.rph)
    assert found.gnss.settings.position_std_m == (0.02, 0.02, 0.04)
    own = tables()["imu"]
    assert not np.shares_memory(found.imu.time, own["time_s"])


def test_data_frames_are_tables():
    pandas = pytest.importorskip("pandas")
    given = {name: pandas.DataFrame(columns) for name, columns in tables().items()}
    found = trial_from_tables(given, imu=IMU, body_axes="RFU")
    np.testing.assert_array_equal(found.dvl.velocity, TRIAL.dvl.velocity)


@pytest.mark.parametrize(
    ("section", "column", "values", "text"),
    [
        ("imu", "time_s", None, "missing column time_s"),
        ("dvl", "vel_x_m_s", ["a"] * 20, "contains no numbers"),
        ("dvl", "vel_x_m_s", np.zeros(3), "shape"),
        ("gnss", "lat_deg", np.full(20, 900.0), "lat_deg"),
    ],
)
def test_a_bad_table_is_named(section, column, values, text):
    given = tables()
    given[section] = {k: v for k, v in given[section].items() if k != column}
    if values is not None:
        given[section][column] = values
    with pytest.raises(DataError, match=text) as error:
        trial_from_tables(given, imu=IMU)
    assert f"table {section}" in str(error.value)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"imu": IMU | {"grade": "toy"}}, "imu.grade"),
        ({"imu": IMU, "axes": "FRD"}, "axes"),
        ({"imu": IMU, "depth": {"std_m": 0.1}}, "depth has no table"),
    ],
)
def test_a_bad_key_is_named(settings, text):
    with pytest.raises(ConfigError, match=text):
        trial_from_tables(tables(), **settings)
