"""Angle and scale of a ship's ADCP by the fits of Joyce and of Pollard and Read."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from kalman_trials import MISALIGNMENT, SCALE
from truth import CONFIGS

from factorgraph_dvl.baselines import kalman
from factorgraph_dvl.baselines.ship_adcp import joyce, outcome_of, pollard_read
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.rotations import log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.simulation import load_scenario, simulate

# North, east, south, west for five minutes each, as east + i north.
COURSES = np.array([5j, 5.0, -5j, -5.0])
TIME = np.arange(1200.0)
SHIP = COURSES[(TIME // 300).astype(int)]
HEADING = np.array([0.0, 90.0, 180.0, 270.0])[(TIME // 300).astype(int)] * DEG
# An ADCP that reads 1 % too much and is turned by 2 deg about up.
READS = 1.01 * np.exp(2j * DEG)


@pytest.mark.parametrize("current", [0.0, 0.3 - 0.2j])
def test_fits_are_exact_without_noise(current):
    adcp = READS * (SHIP - current)
    water = current != 0.0
    for c, sigma in (
        joyce(TIME, SHIP, adcp, water=water),
        pollard_read(TIME, HEADING, SHIP, adcp, water=water),
    ):
        assert c == pytest.approx(1.0 / READS, abs=1e-12)
        assert sigma < 1e-12


def test_joyce_by_hand():
    # Four minutes at 5 m/s, off by +0.1, -0.1, +0.1, -0.1 m/s east of what the ADCP says.
    time = np.arange(240.0)
    adcp = COURSES[(time // 60).astype(int)]
    off = np.array([0.1, -0.1, 0.1, -0.1])[(time // 60).astype(int)]
    c, sigma = joyce(time, adcp + off, adcp, water=False)
    # What is off adds 0.1 (-5j) - 0.1 (5) + 0.1 (5j) - 0.1 (-5) = 0 to a sum of 100.
    assert c == pytest.approx(1.0)
    # Squares left: 4 x 0.01 over 2 x 3 degrees of freedom, and a power of 100.
    assert sigma == pytest.approx(np.sqrt(0.04 / 6.0 / 100.0))


def test_a_point_is_the_change_across_a_turn():
    current = 0.03 * (TIME // 300)
    c, _ = pollard_read(TIME, HEADING, SHIP, READS * (SHIP - current), water=True)
    # The current changes by 0.03 m/s from one leg to the next, the ship by 5 sqrt 2.
    changes = np.array([5.0 - 5j, -5.0 - 5j, -5.0 + 5j])
    seen = READS * (changes - 0.03)
    expected = np.sum(changes * seen.conj()) / np.sum(np.abs(seen) ** 2)
    assert c == pytest.approx(expected, abs=1e-9)


def test_the_angle_is_about_the_vertical():
    found = outcome_of(1.0 / READS, 0.01, MISALIGNMENT, SCALE, "FRD").estimated
    np.testing.assert_allclose(log_so3(found.values[0]), [0.0, 0.0, -2.0 * DEG], atol=1e-12)
    assert found.values[1][0] == pytest.approx(0.01)
    std = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(std, [3.0, 3.0, 0.0101, 0.0101 * 1.01], rtol=1e-6)


def test_too_little_is_an_error():
    few = slice(0, 100)
    with pytest.raises(DataError, match="minutes"):
        joyce(TIME[few], SHIP[few], SHIP[few], water=False)
    with pytest.raises(DataError, match="points"):
        pollard_read(TIME[few], HEADING[few], SHIP[few], SHIP[few], water=True)


def ship(name, **changes):
    scenario = load_scenario(CONFIGS / f"{name}.yaml")
    legs = [{"repeat": 2, "manoeuvres": scenario.manoeuvres[0]["manoeuvres"]}]
    dvl = msgspec.structs.replace(scenario.dvl, lever_arm_m=(0.0, 0.0, 0.0))
    changed = {"manoeuvres": legs, "dvl": dvl, "noise": False, **changes}
    return msgspec.structs.replace(scenario, **changed)


@pytest.fixture(scope="module")
def trials():
    return {name: simulate(ship(name), 0) for name in ("ship", "ship-water")}


@pytest.mark.parametrize("method", ["joyce", "pollard-read"])
@pytest.mark.parametrize("name", ["ship", "ship-water"])
def test_a_simulated_ship_without_imu(trials, name, method):
    solution = kalman(trials[name], method, rate_hz=0.1)
    # Roll and pitch that are off, 0.3 and 0.2 deg, and turns smoothed over seconds remain.
    assert solution.estimate("misalignment_deg").value[2] == pytest.approx(1.5, abs=0.05)
    assert solution.estimate("scale_error").value[0] == pytest.approx(0.006, abs=1e-3)
    assert "gyro_bias_deg_h" not in solution.order


def test_the_point_set_filter_takes_what_a_ship_records(trials):
    solution = kalman(trials["ship"], "point-set", rate_hz=0.1)
    assert solution.estimate("misalignment_deg").value[2] == pytest.approx(1.5, abs=0.05)
    np.testing.assert_allclose(solution.estimate("lever_arm_m").value, 0.0, atol=0.1)
    with pytest.raises(ConfigError, match="do not estimate a current"):
        kalman(trials["ship-water"], "point-set")


def test_methods_of_the_gyros_ask_for_an_imu(trials):
    with pytest.raises(DataError, match="star"):
        kalman(trials["ship"], "star")
    with pytest.raises(DataError, match="dvl_beams"):
        kalman(trials["ship"], "beams")
