"""Folders of planar trials: what they refuse."""

from __future__ import annotations

import pytest
from builders import edit
from planar import trial

from factorgraph_dvl.errors import FactorgraphDvlError
from factorgraph_dvl.files.trial_folder import load_trial, save_trial


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("trial.yaml", "heading: {", "headings: {", "unknown key `headings`"),
        ("trial.yaml", "log:", "dvl:", "unknown key `dvl.speed_std_m_s`"),
        ("trial.yaml", "format: 1", "format: 1\ngnss: {}", "gnss.csv"),
        ("trial.yaml", "format: 1", "format: 1\nimu: {grade: mems}", "imu.csv"),
        ("trial.yaml", "reference: water", "reference: air", "expected water or bottom"),
        (
            "trial.yaml",
            "sound_speed_error_std: 0.0",
            "sound_speed_error_std: 1500",
            "expected a number <= 0.5",
        ),
        ("log.csv", "speed_m_s", "speed", "missing column speed_m_s"),
        ("heading.csv", "time_s,heading_deg\n0,", "time_s,heading_deg\n0,9", "out of range"),
    ],
)
def test_bad_input_is_named(tmp_path, file, old, new, says):
    save_trial(trial(), tmp_path / "t")
    edit(tmp_path / "t" / file, old, new)
    with pytest.raises(FactorgraphDvlError) as error:
        load_trial(tmp_path / "t")
    assert says in str(error.value)
