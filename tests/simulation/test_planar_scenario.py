"""Planar scenarios."""

from __future__ import annotations

import pytest
from planar import BASE
from truth import CONFIGS, merged

from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.files.trial_folder import load_trial
from factorgraph_dvl.simulation import parse_scenario, simulate


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"beacons": None}, "missing key `beacons`"),
        ({"heading": None, "log": None}, "missing key `imu`"),
        ({"imu": {"rate_hz": 10}}, "belongs to a planar trial"),
        ({"gnss": {"rate_hz": 1, "position_std_m": [1, 1, 1]}}, "`gnss` needs an imu"),
    ],
)
def test_a_scenario_is_planar_or_has_an_imu(changes, says):
    with pytest.raises(ConfigError, match=says):
        parse_scenario(merged(BASE, changes))


def test_a_planar_scenario_makes_a_trial_as_any_other(tmp_path, capsys):
    assert simulate(parse_scenario(BASE)).planar
    with pytest.raises(SystemExit) as exit_info:
        main(["simulate", str(CONFIGS / "one-beacon.yaml"), "--out", str(tmp_path / "t")])
    capsys.readouterr()
    assert exit_info.value.code == 0
    assert load_trial(tmp_path / "t").name == "one-beacon"
