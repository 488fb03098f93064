"""What quantities can be, by the names of settings, columns and parameters."""

from __future__ import annotations

import os
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from builders import edit, write_trial
from everything import EVERYTHING, PLANAR
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.trial_folder import load_trial
from factorgraph_dvl.sensors.attitude import Attitude
from factorgraph_dvl.sensors.catalogue import AIDS
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.sensors.records import arrays_of
from factorgraph_dvl.sensors.usbl import Usbl
from factorgraph_dvl.settings.ranges import out_of_range, range_of
from factorgraph_dvl.simulation import parse_scenario, simulate

KINDS = (Imu, *AIDS)


def records() -> dict[type, Any]:
    trial = simulate(parse_scenario(EVERYTHING))
    planar = simulate(parse_scenario(PLANAR))
    some = np.linspace(0.1, 1.0, 5)
    others = [
        kind.from_columns(
            kind.section_type(),
            dict.fromkeys((*kind.required, *(n for group in kind.optional for n in group)), some),
            kind.section,
        )
        for kind in (Attitude, Ins)
    ]
    # Of a transceiver there would have to be a ship.
    every = dict.fromkeys((n for group in Usbl.optional for n in group), np.full(5, np.nan))
    fixes = every | dict.fromkeys(("time_s", *Usbl.optional[0]), some)
    others.append(Usbl.from_columns(Usbl.section_type(), fixes, Usbl.section))
    return {type(r): r for r in (*planar.records, trial.imu, *trial.aids, *others)}


@pytest.mark.parametrize("kind", KINDS)
def test_every_number_in_settings_and_tables_has_a_range(kind: Any) -> None:
    numbers = ("float", "Vector3", "Sigma3", "Positive", "NonNegative")
    for name, hint in kind.section_type.__annotations__.items():
        if any(word in str(hint) for word in numbers) and name != "positions":
            assert range_of(name) is not None, name
    for name in (*kind.required, *(n for group in kind.optional for n in group)):
        assert name == "beacon" or range_of(name) is not None, name


@pytest.mark.parametrize("kind", KINDS)
def test_records_write_into_nothing_that_they_are_given(kind: Any) -> None:
    record = records()[kind]
    arrays = {name: values.copy() for name, values in arrays_of(record).items()}
    for values in arrays.values():
        values.flags.writeable = False
    given_to_record = {**arrays}
    if "velocity_std" in given_to_record:
        unknown = np.full((record.time.size, 3), np.nan)
        unknown.flags.writeable = False
        # One array for both, as a caller may well do.
        given_to_record |= {"position_std": unknown, "velocity_std": unknown}
    before = {name: values.copy() for name, values in given_to_record.items()}
    own = {f.name for f in fields(record)}
    made = replace(record, **{n: v for n, v in given_to_record.items() if n in own})
    made.columns()
    for name, values in given_to_record.items():
        np.testing.assert_array_equal(values, before[name])
    if "velocity_std" in given_to_record:
        assert np.all(made.position_std == record.settings.position_std_m)
        assert np.all(made.velocity_std == record.settings.velocity_std_m_s)


@pytest.mark.parametrize(
    ("section", "key", "value", "expected"),
    [
        ("dvl", "lever_arm_m", [1e308, 0.0, 0.0], "-1000 to 1000 m"),
        ("dvl", "time_offset_s", 9e18, "-86400 to 86400 s"),
        ("dvl", "velocity_std_m_s", 1e308, "0 to 10000 m/s"),
        ("dvl", "velocity_std_m_s", 1e-300, "1e-12 or more"),
        ("dvl", "scale_error_std", 1e308, "0 to 1000"),
        ("initial", "roll_pitch_heading_deg", [999999999.0, 0.0, 0.0], "-360 to 360 deg"),
        ("gnss", "position_std_m", [1e308, 1.0, 1.0], "0 to 1e+08 m"),
    ],
)
def test_settings_that_cannot_be_are_named(
    tmp_path: Path, section: str, key: str, value: object, expected: str
) -> None:
    path = write_trial(tmp_path)
    described = yaml.safe_load((path / "trial.yaml").read_text())
    described[section][key] = value
    (path / "trial.yaml").write_text(yaml.safe_dump(described))
    with pytest.raises(ConfigError) as caught:
        load_trial(path)
    message = str(caught.value)
    assert message.startswith("trial.yaml line ")
    assert f"{section}.{key}" in message
    assert expected in message


@pytest.mark.parametrize(
    ("key", "value"), [("rate_hz", 1e30), ("gyro_noise_deg_sqrt_h", 1e308), ("rate_hz", 1e-300)]
)
def test_scenarios_that_cannot_be_are_named(key: str, value: float) -> None:
    scenario = EVERYTHING | {"imu": EVERYTHING["imu"] | {key: value}}
    with pytest.raises(ConfigError, match=f"`{key}` must be"):
        parse_scenario(scenario)


@pytest.mark.parametrize("what", ["pipe", "device", "large"])
@pytest.mark.parametrize("name", ["truth.json", "trial.yaml", "calibration.json"])
def test_only_regular_files_of_some_size_are_read(tmp_path: Path, name: str, what: str) -> None:
    path = write_trial(tmp_path)
    if name == "calibration.json":
        edit(path / "trial.yaml", "\ndvl:", f"\ndvl:\n  calibration: {name}")
    file = path / name
    file.unlink(missing_ok=True)
    if what == "pipe":
        os.mkfifo(file)
    elif what == "device":
        file.symlink_to("/dev/zero")
    else:
        with file.open("wb") as large:
            large.truncate(65_000_000)
    expected = "MB" if what == "large" else f"is a {what}"
    with pytest.raises((ConfigError, DataError), match=expected):
        load_trial(path)


@settings(derandomize=True, max_examples=200, deadline=None)
@given(
    st.sampled_from([n for k in KINDS for n in k.section_type.__struct_fields__]),
    st.lists(st.floats(), max_size=3),
)
def test_a_range_holds_only_finite_numbers(name: str, values: list[float]) -> None:
    if not out_of_range(name, values):
        assert np.isfinite(values).all()
        limits = range_of(name)
        assert limits is None or all(limits.low <= v <= limits.high for v in values)
