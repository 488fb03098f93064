from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import build_solution

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.solution_folder import load_solution, save_solution
from factorgraph_dvl.quality.finding import Code


def reject(text: str) -> float:
    raise ValueError(f"{text} is not JSON")


def read_json(folder: Path) -> Any:
    return json.loads((folder / "calibration.json").read_text(), parse_constant=reject)


def test_the_files_are_those_of_the_format(tmp_path: Path) -> None:
    save_solution(build_solution(), tmp_path / "s")
    assert {p.name for p in (tmp_path / "s").iterdir()} == {"calibration.json", "trajectory.csv"}
    content = read_json(tmp_path / "s")
    assert content["format"] == 1
    assert content["trial"] == "by hand"
    assert content["solver"] == "batch"
    assert content["converged"] is True
    assert content["iterations"] == 5
    assert content["cost"] == 123.456
    text = "misalignment_z_deg (±4) above the limit of 0.1 deg"
    assert content["warnings"] == [text]
    assert content["findings"] == [
        {
            "code": "not_observable",
            "severity": "note",
            "sensor": "",
            "parameter": "misalignment_deg",
            "text": "misalignment_z_deg was not observable",
        }
    ]
    (reason,) = content["verdict"]["reasons"]
    assert content["verdict"]["grade"] == "doubtful"
    assert reason["code"] == "uncertain"
    assert reason["parameter"] == "misalignment_deg"
    assert reason["text"] == text
    assert reason["action"] == Code.UNCERTAIN.action
    assert content["limits"]["scale_error"] == 1e-3
    assert content["parameters"]["misalignment_deg"]["grade"] == ["green", "orange", "grey"]
    assert list(content["parameters"]) == ["misalignment_deg", "scale_error"]
    scale = content["parameters"]["scale_error"]
    assert scale["value"] == [0.00512345678901234]
    assert scale["std"] == [1e-4 / 3.0]
    assert scale["observable"] == [True]
    assert content["parameters"]["misalignment_deg"]["observable"] == [True, True, False]
    assert content["covariance"]["order"] == [
        "misalignment_x_deg",
        "misalignment_y_deg",
        "misalignment_z_deg",
        "scale_error",
    ]
    np.testing.assert_array_equal(content["covariance"]["matrix"], build_solution().covariance)


def test_the_trajectory_is_in_the_units_of_its_columns(tmp_path: Path) -> None:
    save_solution(build_solution(), tmp_path / "s")
    with (tmp_path / "s" / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert ",".join(rows[0]) == (
        "time_s,lat_deg,lon_deg,height_m,vel_e_m_s,vel_n_m_s,vel_u_m_s,roll_deg,pitch_deg,"
        "heading_deg,std_e_m,std_n_m,std_u_m,vel_std_e_m_s,vel_std_n_m_s,vel_std_u_m_s,"
        "roll_std_deg,pitch_std_deg,heading_std_deg"
    )
    assert len(rows) == 4
    assert float(rows[0]["lat_deg"]) == pytest.approx(34.0, abs=1e-12)
    assert float(rows[1]["time_s"]) == 1.0 / 3.0
    assert float(rows[0]["heading_deg"]) == pytest.approx(np.degrees(6.0), rel=1e-15)
    assert float(rows[0]["std_n_m"]) == pytest.approx(0.1)
    assert float(rows[0]["heading_std_deg"]) == pytest.approx(np.degrees(0.001))


def test_a_saved_solution_loads_as_it_was(tmp_path: Path) -> None:
    solution = build_solution()
    save_solution(solution, tmp_path / "s")
    loaded = load_solution(str(tmp_path / "s"))
    same = ("trial", "solver", "body_axes", "converged", "iterations", "cost", "findings")
    for name in (*same, "limits", "grades", "verdict"):
        assert getattr(loaded, name) == getattr(solution, name)
    assert loaded.order == solution.order
    for one, other in zip(solution.estimates, loaded.estimates, strict=True):
        for name, value in vars(one).items():
            np.testing.assert_array_equal(getattr(other, name), value)
    np.testing.assert_array_equal(loaded.covariance, solution.covariance)
    for name, value in vars(solution.trajectory).items():
        np.testing.assert_allclose(getattr(loaded.trajectory, name), value, rtol=1e-14)


def test_what_is_not_a_number_is_null(tmp_path: Path) -> None:
    solution = build_solution()
    scale = replace(solution.estimates[1], std=np.array([np.inf]), prior_std=np.array([np.nan]))
    solution = replace(
        solution,
        cost=float("nan"),
        estimates=(solution.estimates[0], scale),
        covariance=np.full((4, 4), np.nan),
    )
    save_solution(solution, tmp_path / "s")
    content = read_json(tmp_path / "s")
    assert content["cost"] is None
    assert content["parameters"]["scale_error"]["std"] == [None]
    loaded = load_solution(tmp_path / "s")
    assert np.isnan(loaded.cost)
    assert np.isnan(loaded.covariance).all()


@pytest.mark.parametrize(
    ("verdict", "grade", "text"),
    [
        ({"grade": "do not use"}, "do not use", "no reason is given"),
        (
            {"grade": "do not use", "reasons": [{"code": "of_the_future", "text": "worn out"}]},
            "do not use",
            "worn out",
        ),
        ({"grade": "good"}, "doubtful", "misalignment_z_deg (±4) above the limit of 0.1 deg"),
        (None, "doubtful", "misalignment_z_deg (±4) above the limit of 0.1 deg"),
    ],
)
def test_the_verdict_of_a_file_counts(tmp_path: Path, verdict: Any, grade: str, text: str) -> None:
    save_solution(build_solution(), tmp_path / "s")
    content = read_json(tmp_path / "s")
    content["verdict"] = verdict
    if verdict is None:
        del content["verdict"], content["limits"]
        for finding in content["findings"]:
            finding["severity"] = "warning"
    (tmp_path / "s" / "calibration.json").write_text(json.dumps(content))
    found = load_solution(tmp_path / "s").verdict
    assert found.grade == grade
    assert found.reasons[0].text == text


def test_a_solution_without_estimates_is_saved(tmp_path: Path) -> None:
    solution = build_solution(estimates=(), covariance=np.zeros((0, 0)))
    save_solution(solution, tmp_path / "s")
    assert load_solution(tmp_path / "s").covariance.shape == (0, 0)


def test_extra_files_appear_with_the_solution(tmp_path: Path) -> None:
    path = tmp_path / "s"

    def extra(folder: Path) -> None:
        assert not path.exists()
        (folder / "figures").mkdir()
        (folder / "figures" / "track.png").write_text("png")

    save_solution(build_solution(), path, extra=extra)
    assert (path / "figures" / "track.png").exists()
    save_solution(build_solution(), path, force=True)
    assert not (path / "figures").exists()


def test_an_existing_folder_is_kept_without_force(tmp_path: Path) -> None:
    path = tmp_path / "s"
    path.mkdir()
    save_solution(build_solution(), path)
    before = (path / "calibration.json").read_bytes()
    with pytest.raises(DataError, match="--force"):
        save_solution(build_solution(converged=False), path)
    assert (path / "calibration.json").read_bytes() == before
    save_solution(build_solution(converged=False), path, force=True)
    assert read_json(path)["converged"] is False
    assert {p.name for p in path.iterdir()} == {"calibration.json", "trajectory.csv"}


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('"format": 1', '"format": 2', "format"),
        ('"converged": true', '"converged": 1', "converged"),
        ('"scale_error"\n', '"scale_error", "more"\n', "the covariance does not fit"),
        ("{", "", "cannot be read"),
    ],
)
def test_bad_files_are_errors(tmp_path: Path, old: str, new: str, expected: str) -> None:
    save_solution(build_solution(), tmp_path / "s")
    file = tmp_path / "s" / "calibration.json"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(DataError) as caught:
        load_solution(tmp_path / "s")
    assert "calibration.json" in str(caught.value)
    assert expected in str(caught.value)


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"calibration\.json: the file does not exist"):
        load_solution(tmp_path)
    save_solution(build_solution(), tmp_path / "s")
    (tmp_path / "s" / "trajectory.csv").unlink()
    with pytest.raises(DataError, match=r"trajectory\.csv: the file does not exist"):
        load_solution(tmp_path / "s")
