from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from builders import build_trial, edit, write_trial

from factorgraph_dvl.cli.exit_codes import exit_code_of
from factorgraph_dvl.errors import ConfigError, DataError, FactorgraphDvlError
from factorgraph_dvl.files.folders import new_folder
from factorgraph_dvl.files.tables import read_table, write_table
from factorgraph_dvl.files.trial_folder import files_of, load_trial, save_trial
from factorgraph_dvl.trial import Trial


def assert_same(a: Trial, b: Trial) -> None:
    assert (a.name, a.body_axes, a.epoch) == (b.name, b.body_axes, b.epoch)
    for one, other in ((a.imu, b.imu), (a.gnss, b.gnss), (a.dvl, b.dvl)):
        if one is None or other is None:
            assert one is other
            continue
        assert type(one.settings) is type(other.settings)
        settings = msgspec.structs.replace(one.settings, file=other.settings.file)
        assert settings == other.settings
        for name, value in vars(one).items():
            if isinstance(value, np.ndarray):
                np.testing.assert_allclose(getattr(other, name), value, rtol=1e-15, atol=0)
    for hub in ("initial_attitude", "initial_position", "initial_velocity", "reference"):
        one, other = getattr(a, hub), getattr(b, hub)
        assert (one is None) == (other is None)
        for name, value in vars(one).items() if one is not None else ():
            np.testing.assert_allclose(getattr(other, name), value, rtol=1e-15, atol=1e-18)
    assert a.calibration_truth.keys() == b.calibration_truth.keys()
    for name, value in a.calibration_truth.items():
        np.testing.assert_array_equal(b.calibration_truth[name], value)


@pytest.mark.parametrize("parquet", [False, True])
def test_a_saved_trial_loads_as_it_was(tmp_path: Path, parquet: bool) -> None:
    trial = build_trial()
    save_trial(trial, tmp_path / "t", parquet=parquet)
    assert_same(trial, load_trial(tmp_path / "t"))
    assert_same(trial, load_trial(str(tmp_path / "t" / "trial.yaml")))
    suffix = "parquet" if parquet else "csv"
    assert {p.name for p in (tmp_path / "t").iterdir()} == {
        "trial.yaml",
        "truth.json",
        *(f"{table}.{suffix}" for table in ("imu", "gnss", "dvl", "reference")),
    }


def test_optional_parts_may_be_absent(tmp_path: Path) -> None:
    trial = replace(
        build_trial(),
        gnss=None,
        dvl=None,
        epoch="",
        initial_attitude=None,
        initial_position=None,
        initial_velocity=None,
        reference=None,
        calibration_truth={},
    )
    save_trial(trial, tmp_path / "t")
    assert {p.name for p in (tmp_path / "t").iterdir()} == {"trial.yaml", "imu.csv"}
    assert_same(trial, load_trial(tmp_path / "t"))


def test_times_and_measurements_survive_bit_by_bit(tmp_path: Path) -> None:
    trial = build_trial()
    save_trial(trial, tmp_path / "t")
    loaded = load_trial(tmp_path / "t")
    np.testing.assert_array_equal(loaded.imu.time, trial.imu.time)
    np.testing.assert_array_equal(loaded.imu.gyro, trial.imu.gyro)


def test_gnss_columns_are_optional_and_cells_may_be_empty(tmp_path: Path) -> None:
    path = write_trial(tmp_path)
    (path / "gnss.csv").write_text(
        "height_m,lat_deg,time_s,lon_deg,satellites\n"
        "10,34,1,108,12\n"
        ",,2,,0\n"
        "nan,NaN,3,nan,\n"
        "11,34.5,4,108.5,9\n"
    )
    gnss = load_trial(path).gnss
    assert gnss is not None
    np.testing.assert_array_equal(np.isnan(gnss.geodetic[:, 0]), [False, True, True, False])
    np.testing.assert_allclose(np.degrees(gnss.geodetic[3, :2]), [34.5, 108.5])
    assert np.isnan(gnss.velocity).all()
    assert np.all(gnss.position_std[:, 2] == 0.04)


def test_csv_may_have_crlf_bom_spaces_and_a_blank_end(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    file.write_bytes(b"\xef\xbb\xbfa, b\r\n1, 2\r\n3,4e-1\r\n\r\n")
    table = read_table(file, ("a", "b"))
    np.testing.assert_array_equal(table["a"], [1.0, 3.0])
    np.testing.assert_array_equal(table["b"], [2.0, 0.4])


def test_parquet_may_hold_integers_and_nulls(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet

    pa.parquet.write_table(pa.table({"a": [1, 2, None], "b": ["x", "y", "z"]}), tmp_path / "t.pq")
    np.testing.assert_array_equal(read_table(tmp_path / "t.pq", ("a",))["a"], [1.0, 2.0, np.nan])
    with pytest.raises(DataError, match="column b contains string; expected numbers"):
        read_table(tmp_path / "t.pq", ("b",))
    (tmp_path / "bad.parquet").write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match=r"bad\.parquet: is not a Parquet file"):
        read_table(tmp_path / "bad.parquet", ("a",))


def test_tables_keep_every_digit(tmp_path: Path) -> None:
    values = np.random.default_rng(1).normal(size=1000) * 10.0 ** np.arange(-150, 150, 0.3)
    values[7] = np.nan
    write_table(tmp_path / "t.csv", {"a": values, "b": values})
    np.testing.assert_array_equal(read_table(tmp_path / "t.csv", ("a",))["a"], values)


def test_yaml_numbers_dates_and_names_are_taken_as_written(tmp_path: Path) -> None:
    path = write_trial(tmp_path)
    file = path / "trial.yaml"
    edit(file, "name: by hand", "name: no")
    edit(file, "'2022-10-12T02:00:00Z'", "2022-10-12T02:00:00Z")
    edit(file, "gyro_noise_deg_sqrt_h: 0.01", "gyro_noise_deg_sqrt_h: 5e-4")
    trial = load_trial(path)
    assert trial.name == "no"
    assert trial.epoch == "2022-10-12T02:00:00Z"
    assert trial.imu.settings.gyro_noise_deg_sqrt_h == 5e-4


def test_a_trial_without_a_name_is_called_as_its_folder(tmp_path: Path) -> None:
    path = write_trial(tmp_path)
    edit(path / "trial.yaml", "name: by hand\n", "")
    assert load_trial(path).name == "trial"


BAD_SETTINGS = {
    "unknown key": ("misalignment_deg:", "misalinment_deg:", "dvl.misalinment_deg", "`misalignm"),
    "unknown section": ("gnss:\n", "gps:\n", "gps", "gnss"),
    "wrong type": ("time_offset_s: 0.0", "time_offset_s: abc", "time_offset_s is 'abc'", "a numb"),
    "boolean": ("time_offset_s: 0.0", "time_offset_s: true", "gnss.time_offset_s", "a number"),
    "negative": (
        "velocity_std_m_s: 0.001",
        "velocity_std_m_s: -1",
        "velocity_std_m_s is -1",
        ">=",
    ),
    "zero": (
        "gyro_bias_std_deg_h: 1.0",
        "gyro_bias_std_deg_h: 0",
        "gyro_bias_std_deg_h is 0",
        ">",
    ),
    "negative scalar of a union": (
        "scale_error_std: [0.01, 0.02, 0.03]",
        "scale_error_std: -0.1",
        "scale_error_std",
        "0 to 1000",
    ),
    "negative in a union": (
        "scale_error_std: [0.01, 0.02, 0.03]",
        "scale_error_std: [0.01, -0.02, 0.03]",
        "dvl.scale_error_std[1] is -0.02",
        "a number >= 0",
    ),
    "infinite": ("time_offset_s: 0.0", "time_offset_s: .inf", "time_offset_s", "finite"),
    "nan": ("time_offset_s: 0.0", "time_offset_s: .nan", "time_offset_s", "finite"),
    "short list": (
        "position_std_m: [0.02, 0.02, 0.04]",
        "position_std_m: [0.02, 0.02]",
        "gnss.position_std_m",
        "a list of length 3",
    ),
    "choice": ("sampling: mean", "sampling: average", "imu.sampling", "mean or instantaneous"),
    "axes": ("body_axes: RFU", "body_axes: NED", "body_axes is 'NED'", "RFU or FRD or FLU"),
    "format": ("format: 1", "format: 2", "format is 2", "expected 1"),
    "epoch": ("'2022-10-12T02:00:00Z'", "yesterday", "epoch", "date"),
    "scale": ("scale_error: 0.0", "scale_error: -1", "scale_error", "above -1"),
    "twice": ("body_axes: RFU", "body_axes: RFU\nbody_axes: RFU", "body_axes", "twice"),
    "empty section": ("reference: {", "depth:\nreference: {", "depth is empty", "a mapping"),
    "latitude": ("lat_deg: 34.0", "lat_deg: 134", "initial.position.lat_deg", "-90 to 90 deg"),
    "swapped": ("lat_deg: 34.0", "lat_deg: 134", "Latitude and longitude seem to be swapped"),
    "syntax": ("body_axes: RFU", "body_axes: [RFU", "a bracket or brace is not closed"),
    "tab": ("body_axes: RFU", "\tbody_axes: RFU", "a tab, where YAML takes spaces only"),
    "colon": ("body_axes: RFU", "body_axes: RFU: b", "a colon within a value (put it in quotes)"),
    "unit": ("[0.02, 0.02, 0.04]", "[20 mm, 0, 0]", "in m, without a unit: 0.02"),
    "unit of a list": (
        "[0.02, 0.02, 0.04]",
        "2 cm",
        "a list of numbers in m, without a unit: 0.02",
    ),
    "other unit": ("time_offset_s: 0.0", "time_offset_s: 2 m", "in s, without a unit"),
    "no number": ("time_offset_s: 0.0", "time_offset_s: late", "expected a number in s"),
    "tag": ("body_axes: RFU", "body_axes: !!python/name:os.system RFU", "body_axes", "plain"),
    "half an attitude": ("  std_deg", "  # std_deg", "only together", "initial"),
}


@pytest.mark.parametrize("case", BAD_SETTINGS)
def test_bad_settings_name_line_key_and_expectation(tmp_path: Path, case: str) -> None:
    old, new, *texts = BAD_SETTINGS[case]
    path = write_trial(tmp_path)
    line = edit(path / "trial.yaml", old, new)
    with pytest.raises(ConfigError) as caught:
        load_trial(path)
    message = str(caught.value)
    assert message.startswith("trial.yaml line ")
    for text in texts:
        assert text in message
    named = int(message.split()[2].rstrip(":"))
    assert abs(named - line) <= 1, f"{message!r} is about line {line}"
    assert exit_code_of(caught.value) == 2


def test_a_folder_or_file_that_is_no_trial_is_named(tmp_path: Path) -> None:
    result = tmp_path / "result"
    result.mkdir()
    (result / "calibration.json").write_text("{}")
    photo = tmp_path / "photo.jpg"
    photo.write_bytes(b"x")
    for path, said in (
        (result, "the folder of a result, not of a trial"),
        (tmp_path, "the folder has no trial.yaml"),
        (photo, "photo.jpg: not a trial; expected a trial folder"),
        (tmp_path / "none", "the trial does not exist"),
    ):
        with pytest.raises(DataError, match=said):
            load_trial(path)


def test_missing_keys_are_named(tmp_path: Path) -> None:
    lines = ["name: x", "imu:", "  gyro_bias_std_deg_h: 1", "  accel_noise_ug_sqrt_hz: 1"]
    (tmp_path / "trial.yaml").write_text("name: x\n")
    with pytest.raises(ConfigError, match=r"trial\.yaml: missing key `format`"):
        load_trial(tmp_path)
    (tmp_path / "trial.yaml").write_text("\n".join(["format: 1", *lines]))
    with pytest.raises(
        ConfigError, match=r"yaml line 3: missing key `imu\.gyro_noise_deg_sqrt_h`"
    ):
        load_trial(tmp_path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "no keys"),
        ("- 1\n", "not a mapping"),
        ("just text\n", "not a mapping"),
        ("format: 1\nname: x\n", "missing key `imu`"),
        ("format: 1\nimu: imu.csv\n", "imu is 'imu.csv'; expected a mapping"),
        ("a: &a [*a]\n", "nested too deeply"),
        ("[" * 3000, "YAML"),
        ("? [1, 2]\n: 3\n", "a key is not text"),
        ("format: *nothing\n", "not valid YAML"),
        ("\x00", "not valid YAML"),
    ],
)
def test_a_file_that_is_no_trial_is_an_error(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "trial.yaml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_trial(tmp_path)
    assert str(caught.value).startswith("trial.yaml")
    assert expected in str(caught.value)
    assert ": :" not in str(caught.value)


def test_an_explosion_of_aliases_is_an_error(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    (tmp_path / "trial.yaml").write_text("\n".join(lines))
    with pytest.raises(ConfigError, match="too large"):
        load_trial(tmp_path)


def test_files_of_a_trial_are_all_that_it_is_read_from(tmp_path: Path) -> None:
    (tmp_path / "trial.yaml").write_text(
        "format: 1\nbody_axes: FRD\nimu: {grade: tactical}\nreference: {file: truth.csv}\n"
        "gnss: {file: fixes.csv, position_std_m: [1, 1, 1]}\ndvl: {velocity_std_m_s: 0.01}\n"
    )
    (tmp_path / "truth.csv").touch()
    # Records that the settings do not name are imu.csv and dvl.csv.
    names = [path.name for path in files_of(tmp_path)]
    assert names == ["trial.yaml", "dvl.csv", "fixes.csv", "imu.csv", "truth.csv"]
    assert files_of(tmp_path / "trial.yaml") == files_of(tmp_path)


def test_missing_trials_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere: the trial does not exist"):
        load_trial(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"the folder has no trial\.yaml"):
        load_trial(tmp_path)


BAD_TABLES = {
    "bad number": ("imu.csv", 3, "1,2,abc,4,5,6,7", "line 4: gyro_y_rad_s is 'abc'; expected a n"),
    "few cells": ("imu.csv", 3, "1,2,3", "line 4: there are 3 cells; expected 7"),
    "many cells": ("dvl.csv", 2, "1,2,3,4,5,6,7,8", "line 3: there are 8 cells; expected 7"),
    "empty time": ("dvl.csv", 2, ",1,2,3,,,", "line 3: time_s is not a number"),
    "empty cell": ("imu.csv", 3, "0.06,0,,0,0,0,9", "line 4: gyro_y_rad_s is empty"),
    "time back": ("imu.csv", 3, "0,0,0,0,0,0,9", "line 4: time_s does not increase"),
    "rate": ("imu.csv", 1, "0,0,0,500,0,0,9", "line 2: gyro_z_rad_s = 500 is out of range"),
    "infinite": ("imu.csv", 1, "0,0,0,inf,0,0,9", "line 2: gyro_z_rad_s"),
    "latitude": ("gnss.csv", 1, "0.5,91,108,0,1,1,1,,,,,,", "line 2: lat_deg = 91 is out of"),
    "swapped": (
        "gnss.csv",
        1,
        "0.5,108,34,0,1,1,1,,,,,,",
        "line 2: lat_deg = 108 is out of range; expected -90 to 90 deg. Latitude and longitude",
    ),
    "half a ping": ("dvl.csv", 1, "0.5,1,,3,,,", "line 2: only some of vel_x_m_s"),
    "no column": (
        "dvl.csv",
        0,
        "time_s,vel_x_m_s,vel_z_m_s,a,b,c,d",
        "line 1: missing column vel",
    ),
    "column twice": (
        "dvl.csv",
        0,
        "time_s,vel_x_m_s,vel_y_m_s,vel_z_m_s,vel_x_m_s,a,b",
        "line 1: column vel_x_m_s is given 2 times",
    ),
    "half a group": (
        "gnss.csv",
        0,
        "time_s,lat_deg,lon_deg,height_m,vel_e_m_s,b,c,d,e,f,g,h,i",
        "line 1: there is vel_e_m_s but not vel_n_m_s, vel_u_m_s",
    ),
    "no header": ("imu.csv", 0, "1,2,3,4,5,6,7", "line 1: missing column time_s"),
    "empty header": ("imu.csv", 0, "", "line 1: the file has an empty first line"),
    "reference": ("reference.csv", 2, "2,0,0,0,x,0,0,0,0,0", "line 3: vel_e_m_s is 'x'"),
    "empty reference": ("reference.csv", 2, "2,0,0,0,,0,0,0,0,0", "line 3: vel_e_m_s is empty"),
}


@pytest.mark.parametrize("case", BAD_TABLES)
def test_bad_tables_name_line_and_column(tmp_path: Path, case: str) -> None:
    name, row, new, expected = BAD_TABLES[case]
    path = write_trial(tmp_path)
    lines = (path / name).read_text().splitlines()
    lines[row] = new
    (path / name).write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError) as caught:
        load_trial(path)
    assert f"{name} {expected}" in str(caught.value)
    assert exit_code_of(caught.value) == 2


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "imu.csv: the file does not exist"),
        (b"", "imu.csv line 1: the file is empty"),
        (b"\xff\xfe\x00", "imu.csv line 1: is not a CSV text file"),
        (b"time_s;gyro_x_rad_s\n0;0\n", "separated by semicolons"),
        (
            b"time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2\n",
            "imu.csv: no samples",
        ),
    ],
)
def test_files_without_a_table_are_errors(
    tmp_path: Path, content: bytes | None, expected: str
) -> None:
    path = write_trial(tmp_path)
    file = path / "imu.csv"
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(DataError) as caught:
        load_trial(path)
    assert expected in str(caught.value)


EMPTY_TRUTH = '{"parameters": {"lever_arm_m": {"value": []}}}'


@pytest.mark.parametrize("text", ["{", '{"parameters": {"a": 1}}', "[]", "\xff", EMPTY_TRUTH])
def test_bad_truth_is_an_error(tmp_path: Path, text: str) -> None:
    path = write_trial(tmp_path)
    (path / "truth.json").write_text(text)
    with pytest.raises(DataError, match=r"truth\.json"):
        load_trial(path)


def test_an_existing_folder_is_kept_without_force(tmp_path: Path) -> None:
    path = write_trial(tmp_path)
    before = (path / "trial.yaml").read_text()
    with pytest.raises(DataError, match="--force"):
        save_trial(replace(build_trial(), name="other"), path)
    assert (path / "trial.yaml").read_text() == before
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="is a file"):
        save_trial(build_trial(), tmp_path / "file", force=True)


def test_force_replaces_no_trial_that_someone_else_wrote(tmp_path: Path) -> None:
    path = write_trial(tmp_path)
    settings = path / "trial.yaml"
    first, _, rest = settings.read_text().partition("\n")
    assert first.startswith("# Saved by factorgraph_dvl")
    settings.write_text(rest)
    before = {p.name: p.read_bytes() for p in path.iterdir()}
    with pytest.raises(DataError, match="`save_trial` did not write"):
        save_trial(build_trial(), path, force=True)
    assert {p.name: p.read_bytes() for p in path.iterdir()} == before


def test_force_replaces_a_trial_but_no_other_file(tmp_path: Path) -> None:
    path = write_trial(tmp_path)
    (path / "notes.txt").write_text("mine")
    trial = replace(build_trial(), calibration_truth={}, reference=None)
    save_trial(trial, path, force=True, parquet=True)
    assert {p.name for p in path.iterdir()} == {
        "trial.yaml",
        "imu.parquet",
        "gnss.parquet",
        "dvl.parquet",
        "notes.txt",
    }
    assert_same(trial, load_trial(path))


@pytest.mark.parametrize("exists", [False, True])
def test_nothing_appears_when_writing_fails(tmp_path: Path, exists: bool) -> None:
    path = tmp_path / "deep" / "out"
    if exists:
        path.mkdir(parents=True)
        (path / "old").write_text("old")
    with pytest.raises(KeyboardInterrupt), new_folder(path, force=exists) as folder:  # noqa: PT012
        (folder / "new").write_text("new")
        raise KeyboardInterrupt
    if exists:
        assert [p.name for p in path.iterdir()] == ["old"]
    else:
        assert not path.parent.exists()


def test_errors_have_one_base() -> None:
    assert issubclass(ConfigError, FactorgraphDvlError)


def test_limits_are_read_checked_and_kept(tmp_path: Path) -> None:
    path = write_trial(tmp_path)
    assert "limits" not in (path / "trial.yaml").read_text()
    edit(path / "trial.yaml", "imu:", "limits: {misalignment_deg: 0.03}\nimu:")
    trial = load_trial(path)
    assert trial.limits["misalignment_deg"] == 0.03
    assert trial.limits["lever_arm_m"] == 0.1
    save_trial(trial, tmp_path / "again")
    assert load_trial(tmp_path / "again").limits == trial.limits
    line = edit(path / "trial.yaml", "misalignment_deg: 0.03", "misalignment_deg: 0")
    with pytest.raises(ConfigError, match=f"line {line}.*misalignment_deg"):
        load_trial(path)
    edit(path / "trial.yaml", "misalignment_deg: 0}", "misalignment: 0.1}")
    with pytest.raises(ConfigError, match=r"unknown key `limits.misalignment`"):
        load_trial(path)
