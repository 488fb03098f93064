from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders import build_solution, build_trial, write_trial

from factorgraph_dvl.analysis.comparison.crosscheck import crosscheck
from factorgraph_dvl.cli.exit_codes import exit_code_of
from factorgraph_dvl.errors import DataError, FactorgraphDvlError
from factorgraph_dvl.files.external_results import load_results, load_truth, read_truth
from factorgraph_dvl.files.motion_table import motion_columns
from factorgraph_dvl.files.solution_folder import save_solution
from factorgraph_dvl.files.tables import write_table
from factorgraph_dvl.solution import Solution

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "crosscheck"

FOREIGN = """
solver: vendor
misalignment_deg: [1.0, 2.0, 3.0]
scale_error: {value: 0.005, std: 1e-4}
lever_arm_m: {value: [1, 2, null], std: [0.1, null, null], observable: [true, false, true]}
"""


def foreign(tmp_path: Path, text: str, name: str = "b.yaml") -> Solution:
    save_solution(build_solution(), tmp_path / "a", force=True)
    (tmp_path / name).write_text(text)
    return load_results(tmp_path / "a", tmp_path / name)[1]


def test_calibration_from_elsewhere(tmp_path: Path) -> None:
    b = foreign(tmp_path, FOREIGN)
    assert b.solver == "vendor"
    assert b.body_axes == "FRD"
    assert b.trajectory.time.size == 0
    assert np.isnan(b.estimate("misalignment_deg").std).all()
    assert b.estimate("scale_error").std == [1e-4]
    np.testing.assert_array_equal(b.estimate("lever_arm_m").value, [1.0, 2.0, np.nan])
    np.testing.assert_array_equal(b.estimate("lever_arm_m").observable, [True, False, False])
    assert b.order[:4] == build_solution().order
    assert b.covariance[3, 3] == pytest.approx(1e-8)


def test_json_and_nested_parameters(tmp_path: Path) -> None:
    text = '{\t"parameters": {"scale_error": {"value": [1e-3, 2E-3, 0.003]}}, "body_axes": "RFU"}'
    b = foreign(tmp_path, text, "b.json")
    np.testing.assert_array_equal(b.estimate("scale_error").value, [1e-3, 2e-3, 3e-3])
    assert b.order == ("scale_error_x", "scale_error_y", "scale_error_z")
    assert b.body_axes == "RFU"


def test_trajectory_from_elsewhere(tmp_path: Path) -> None:
    trajectory = build_solution().trajectory
    columns = motion_columns(trajectory)
    write_table(tmp_path / "b.csv", columns)
    save_solution(build_solution(), tmp_path / "a")
    a, b = load_results(tmp_path / "a" / "calibration.json", tmp_path / "b.csv")
    assert b.estimates == ()
    check = crosscheck(a, b)
    assert check.motion is not None
    assert set(check.motion.kinds) == {"none"}
    for name in ("std_e_m", "std_n_m", "std_u_m"):
        columns[name] = np.full(4, 0.3)
    write_table(tmp_path / "b.csv", columns)
    (tmp_path / "b.yml").write_text("trajectory: b.csv\nscale_error: 0.005\n")
    motion = crosscheck(*load_results(tmp_path / "a", tmp_path / "b.yml")).motion
    assert motion is not None
    assert motion.kinds == ("upper bound",) * 3 + ("none",) * 6
    np.testing.assert_allclose(motion.std[:, 0], np.hypot(0.1, 0.3))


@pytest.mark.parametrize(
    ("text", "name", "expected"),
    [
        ("misalignment: [1, 2, 3]", "b.yaml", "b.yaml line 1: unknown key `misalignment`"),
        ("misalignment: [1, 2, 3]", "b.yaml", "Did you mean `misalignment_deg`"),
        ("solver: x\nlever_arm_m: [1, 2]", "b.yaml", "b.yaml line 2: lever_arm_m: "),
        ("lever_arm_m: [1, 2]", "b.yaml", "must have 3 numbers, not 2"),
        ("scale_error: [1, 2]", "b.yaml", "must have 1 or 3 numbers, not 2"),
        ("scale_error: {value: 1, std: [1, 2]}", "b.yaml", "as many numbers in `std` as in"),
        ("scale_error: {value: 1, std: -1}", "b.yaml", "`std` must be 0 or more"),
        ("scale_error: {value: 1, observable: [true, true]}", "b.yaml", "1 entries"),
        ("scale_error: .nan", "b.yaml", "must be finite"),
        ("scale_error: large", "b.yaml", "scale_error is 'large'; expected a number or"),
        ("scale_error: {valu: 1}", "b.yaml", "unknown key `scale_error.valu`"),
        ("scale_error: 1\nparameters: {scale_error: 1}", "b.yaml", "all values in `parameters`"),
        ("solver: vendor", "b.yaml", "there are no calibration values"),
        ("trajectory: none.csv\nscale_error: 1", "b.yaml", "none.csv: the file does not exist"),
        # Python 3.13 places the fault at the comma, earlier versions at what follows it.
        ('{"scale_error": 1,\n}', "b.json", "not valid JSON"),
        ('{"scale_error": 1,\n"solver" "x"}', "b.json", "b.json line 2: not valid JSON"),
        ("time_s,lat_deg\n1,2\n", "b.csv", "b.csv line 1: missing column"),
        ("scale_error: 1", "b.txt", "the suffix `.txt` says nothing; expected .csv"),
        ("scale_error: 1", "b", "has no suffix"),
    ],
)
def test_bad_results_from_elsewhere(tmp_path: Path, text: str, name: str, expected: str) -> None:
    with pytest.raises(FactorgraphDvlError) as caught:
        foreign(tmp_path, text, name)
    assert exit_code_of(caught.value) == 2
    assert expected in str(caught.value)


def test_every_parameter_of_a_sensor_may_come_from_elsewhere(tmp_path: Path) -> None:
    text = """star_mounting_deg: [1, 2, 3]
sound_speed_error: 0.002
heading_bias_deg: 0.5
log_scale_error: 0.01
beacon_B1_offset_m: {value: [1, 2, 3], std: [0.1, 0.2, 0.3]}
beam_scale_error: [0.001, 0.002, 0.003, 0.004]
"""
    b = foreign(tmp_path, text)
    assert b.estimate("beacon_B1_offset_m").component_names == (
        "beacon_B1_offset_e_m",
        "beacon_B1_offset_n_m",
        "beacon_B1_offset_u_m",
    )
    assert {f"beam_scale_error_{i}" for i in range(1, 5)} < set(b.order)
    nested = {"parameters": {e.name: {"value": e.value.tolist()} for e in b.estimates}}
    (tmp_path / "truth.json").write_text(json.dumps(nested))
    truth = read_truth(tmp_path / "truth.json")
    assert truth.keys() == {e.name for e in b.estimates}
    for text, expected in (
        ("beacon_B1_offset_m: [1, 2]", "must have 3 numbers, not 2"),
        ("beacon_offset_m: [1, 2, 3]", "unknown key `beacon_offset_m`"),
    ):
        with pytest.raises(FactorgraphDvlError, match=expected):
            foreign(tmp_path, text)


def test_bad_sigmas_of_a_trajectory(tmp_path: Path) -> None:
    columns = motion_columns(build_solution().trajectory)
    for name in ("std_e_m", "std_n_m", "std_u_m"):
        columns[name] = np.array([0.1, 0.1, 0.0, 0.1])
    write_table(tmp_path / "b.csv", columns)
    with pytest.raises(DataError, match=r"b\.csv line 4: std_e_m = 0 is out of range"):
        load_results(tmp_path / "b.csv", tmp_path / "b.csv")


def test_folders_that_are_no_results(tmp_path: Path) -> None:
    trial = write_trial(tmp_path)
    with pytest.raises(DataError, match="is a trial folder; expected a solution folder"):
        load_results(trial, trial)
    with pytest.raises(DataError, match="the result does not exist"):
        load_results(tmp_path / "none", trial)


def test_truth(tmp_path: Path) -> None:
    trial = write_trial(tmp_path)
    (tmp_path / "truth.yaml").write_text("scale_error: 0.007\nlever_arm_m: [1, 2, 3]\n")
    motion, values = load_truth(trial, tmp_path / "truth.yaml")
    assert motion is not None
    assert motion.time.size == 60
    assert {k: v.tolist() for k, v in values.items()} == {
        "misalignment_deg": [1.0, 2.0, 3.0],
        "scale_error": [0.007],
        "lever_arm_m": [1.0, 2.0, 3.0],
    }
    assert load_truth(None, None) == (None, {})
    motion, values = load_truth(trial / "reference.csv", None)
    assert motion is not None
    assert values == {}
    with pytest.raises(DataError, match="is not a file of calibration values"):
        read_truth(trial / "imu.csv")
    bare = replace(build_trial(), reference=None, calibration_truth={})
    (tmp_path / "bare").mkdir()
    with pytest.raises(DataError, match="the trial has no truth"):
        load_truth(write_trial(tmp_path / "bare", bare), None)


def test_documentation_s_calibration_is_read(tmp_path: Path) -> None:
    text = (EXAMPLES.parent.parent / "docs" / "crosscheck.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(.*?)```", text, flags=re.DOTALL)
    b = foreign(tmp_path, block)
    assert [e.name for e in b.estimates] == ["misalignment_deg", "scale_error", "lever_arm_m"]
