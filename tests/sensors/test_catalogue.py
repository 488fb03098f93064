"""Sensors of other packages: found by their entry point, and only if a trial names them."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import numpy as np
import pytest
from builders import build_trial, edit, write_trial
from factorgraph_dvl_compass import BIAS, Compass

from factorgraph_dvl import load_trial
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.files.tables import write_table
from factorgraph_dvl.sensors import catalogue

COMPASS = EntryPoint("compass", "factorgraph_dvl_compass:Compass", catalogue.GROUP)


@pytest.fixture
def offered(monkeypatch):
    """Entry points that there are, and how often they were asked for."""
    found, asked = [COMPASS], []

    def entry_points(group):
        asked.append(group)
        return found

    monkeypatch.setattr(catalogue, "entry_points", entry_points)
    monkeypatch.setattr(catalogue, "_PLUG_INS", {})
    return found, asked


@pytest.fixture
def folder(tmp_path):
    path = write_trial(tmp_path, build_trial(seconds=20.0))
    time = np.arange(1.0, 20.0)
    write_table(path / "compass.csv", {"time_s": time, "heading_deg": 0.0 * time})
    return path


def name_compass(folder, keys="{bias_std_deg: 5}"):
    edit(folder / "trial.yaml", "gnss:", f"compass: {keys}\ngnss:")


def test_plug_ins_are_searched_only_for_an_unknown_section(offered, folder):
    _, asked = offered
    load_trial(folder)
    assert not asked
    assert Compass not in catalogue.aid_types()
    name_compass(folder)
    (compass,) = load_trial(folder).others
    assert asked == [catalogue.GROUP]
    assert type(compass) is Compass
    assert compass.settings.bias_std_deg == 5.0
    load_trial(folder)
    assert len(asked) == 1


def test_a_plug_ins_parameter_is_known_with_its_unit(offered, folder):
    assert not catalogue.specs_of(BIAS.name)
    name_compass(folder)
    load_trial(folder)
    assert catalogue.specs_of(BIAS.name) == {1: BIAS}


def test_keys_of_a_plug_ins_section_are_checked(offered, folder):
    name_compass(folder, "{bias_std: 5}")
    with pytest.raises(ConfigError, match=r"unknown key `compass.bias_std`.*bias_std_deg"):
        load_trial(folder)


def test_a_section_that_nobody_offers_is_an_unknown_key(offered, folder):
    offered[0].clear()
    name_compass(folder)
    with pytest.raises(ConfigError, match=r"unknown key `compass`.*install that package"):
        load_trial(folder)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("no_such_package:Compass", "cannot be imported"),
        ("factorgraph_dvl_compass:NoSuch", "cannot be imported"),
        ("factorgraph_dvl_compass:CompassHeading", "lacks section"),
        ("factorgraph_dvl.sensors.depth:Depth", "has section 'depth'"),
    ],
)
def test_an_entry_point_that_offers_no_such_sensor_is_named(offered, folder, value, text):
    offered[0][:] = [EntryPoint("compass", value, catalogue.GROUP)]
    name_compass(folder)
    with pytest.raises(ConfigError, match=f"{text}.*compass = {value}|compass = {value}.*{text}"):
        load_trial(folder)
