from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders import build_trial

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.corrected_record import corrected_dvl, save_corrected_dvl
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG

VALUES = {
    "misalignment_deg": np.array([1.0, -2.0, 30.0]),
    "scale_error": np.array([0.01, 0.02, -0.01]),
    "lever_arm_m": np.array([1.0, 2.0, 3.0]),
    "dvl_bias_m_s": np.array([0.01, 0.0, -0.02]),
    "time_offset_s": np.array([0.05]),
}


def test_a_velocity_that_went_through_the_errors_comes_back(tmp_path: Path) -> None:
    dvl = build_trial().dvl
    assert dvl is not None
    true = np.array([[0.1, 2.0, -0.3], [1.0, 0.5, 0.0]])
    R = exp_so3(VALUES["misalignment_deg"] * DEG)
    measured = (1.0 + VALUES["scale_error"]) * (true @ R.T) + VALUES["dvl_bias_m_s"]
    dvl = replace(dvl, time=dvl.time[:2], velocity=measured, std=np.full((2, 3), 0.01))
    found = save_corrected_dvl(dvl, VALUES, tmp_path / "out")
    np.testing.assert_allclose(found.velocity, true, atol=1e-12)
    table = read_table(tmp_path / "out" / "dvl.csv", ("vel_x_m_s", "vel_y_m_s", "vel_z_m_s"))
    np.testing.assert_allclose(np.stack(list(table.values()), axis=1), true, atol=1e-12)
    content = json.loads((tmp_path / "out" / "instrument.json").read_text())
    again = (measured - content["bias_m_s"]) @ np.array(content["dvl_to_body"]).T
    np.testing.assert_allclose(again, true, atol=1e-12)
    assert content["dvl"]["lever_arm_m"] == [1.0, 2.0, 3.0]
    assert content["dvl"]["time_offset_s"] == 0.05
    assert content["dvl"]["misalignment_deg"] == content["dvl"]["misalignment_std_deg"]


def test_the_noise_turns_with_the_velocity() -> None:
    dvl = build_trial().dvl
    assert dvl is not None
    std = np.tile([0.01, 0.02, 0.03], (dvl.time.size, 1))
    quarter = {"misalignment_deg": np.array([0.0, 0.0, 90.0]), "scale_error": np.array([1.0])}
    found = corrected_dvl(replace(dvl, std=std), quarter)
    np.testing.assert_allclose(found.std[0], [0.01, 0.005, 0.015])


def test_a_folder_that_is_there_is_kept(tmp_path: Path) -> None:
    dvl = build_trial().dvl
    assert dvl is not None
    save_corrected_dvl(dvl, VALUES, tmp_path / "out")
    with pytest.raises(DataError, match="not empty"):
        save_corrected_dvl(dvl, VALUES, tmp_path / "out")
