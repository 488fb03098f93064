from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.files.trial_yaml import TrialSettings, to_yaml
from factorgraph_dvl.report.tables import imu_lines
from factorgraph_dvl.sensors.imu import (
    TYPICAL,
    ZERO_WITHOUT_GRADE,
    Grade,
    ImuErrorStd,
    ImuSettings,
)
from factorgraph_dvl.settings.yaml_file import parse_yaml

STATED = {
    "gyro_noise_deg_sqrt_h": 0.01,
    "gyro_bias_std_deg_h": 1.0,
    "accel_noise_ug_sqrt_hz": 100.0,
    "accel_bias_std_ug": 1000.0,
}
DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "imu-grades.md"


def read(imu: str) -> ImuSettings:
    return parse_yaml(f"format: 1\nimu: {imu}", TrialSettings, source="trial.yaml").imu


@pytest.mark.parametrize("grade", get_args(Grade))
def test_a_grade_gives_what_is_not_stated(grade: Grade) -> None:
    settings = read(f"{{grade: {grade}, accel_scale_std_ppm: 7, gyro_bias_walk_deg_h_sqrt_h: 0}}")
    own = {"accel_scale_std_ppm": 7.0, "gyro_bias_walk_deg_h_sqrt_h": 0.0}
    for name, value in (TYPICAL[grade] | own).items():
        assert getattr(settings, name) == value


def test_errors_are_zero_without_a_grade() -> None:
    settings = ImuSettings(**STATED)
    assert settings.error_std == ImuErrorStd()
    for name in ZERO_WITHOUT_GRADE:
        assert getattr(settings, name) == 0.0


def test_errors_in_si() -> None:
    errors = {
        "gyro_scale_std_ppm": 300.0,
        "gyro_misalignment_std_deg": 0.1,
        "gyro_g_sensitivity_std_deg_h_g": 9.80665 * 3600.0,
        "accel_scale_std_ppm": 50.0,
        "accel_misalignment_std_deg": 1.0,
    }
    got = ImuSettings(**STATED, **errors).error_std
    np.testing.assert_allclose(
        [got.gyro_scale, got.gyro_misalignment, got.accel_scale, got.accel_misalignment],
        [3e-4, np.pi / 1800.0, 5e-5, np.pi / 180.0],
    )
    np.testing.assert_allclose(got.gyro_g_sensitivity, np.pi / 180.0)


def test_settings_are_written_and_read_back() -> None:
    sections: dict[str, Any] = {
        "imu": ImuSettings(grade="industrial", gyro_noise_deg_sqrt_h=0.2, noise="stated"),
        "noise": "stated",
    }
    settings = TrialSettings(format=1, **sections)
    assert parse_yaml(to_yaml(settings), TrialSettings, source="trial.yaml") == settings


@pytest.mark.parametrize(
    ("imu", "expected"),
    [
        ("{}", "missing key `imu.gyro_noise_deg_sqrt_h`; expected this key, or `grade`"),
        (
            "{grade: marine}",
            "imu.grade is 'marine'; expected navigation or tactical or industrial or mems",
        ),
        ("{grade: mems, gyro_scale_std_ppm: -1}", "imu.gyro_scale_std_ppm is -1"),
        ("{grade: mems, gyro_noise_deg_sqrt_h: .nan}", "imu.gyro_noise_deg_sqrt_h is nan"),
        ("{grade: mems, noise: loud}", "imu.noise is 'loud'; expected estimated or stated"),
    ],
)
def test_wrong_keys_are_named(imu: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read(imu)
    assert str(caught.value).startswith("trial.yaml line 2")
    assert expected in str(caught.value)


def test_what_is_assumed_is_shown() -> None:
    gyros, accelerometers = imu_lines(ImuSettings(grade="navigation", gyro_scale_std_ppm=8.0))
    assert gyros.startswith("gyros (navigation where not stated): noise 0.002 deg/√h")
    assert "scale 8 ppm" in gyros
    assert "scale 100 ppm" in accelerometers
    assert imu_lines(ImuSettings(**STATED))[0].startswith("gyros: noise 0.01 deg/√h")


def test_the_documented_table_is_the_one_in_use() -> None:
    rows = [line for line in DOCUMENT.read_text(encoding="utf-8").splitlines() if "`" in line]
    for name in TYPICAL["mems"]:
        (row,) = (row for row in rows if row.startswith(f"| `{name}`"))
        cells = [float(cell) for cell in row.split("|")[2:6]]
        assert cells == [TYPICAL[grade][name] for grade in get_args(Grade)]
