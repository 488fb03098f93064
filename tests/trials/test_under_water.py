"""Short trials whose positions below come from a USBL or from transponders, with an IMU or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import LONGER_TURNS_AND_BRAKING, scenario

from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.usbl import Usbl
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve

ATTITUDE = {"rate_hz": 10, "std_deg": [0.02, 0.02, 0.05], "white_std_deg": [0.02] * 3}
SHIP = {
    "start": {"lat_deg": 36.0006, "lon_deg": 121.0004, "height_m": 62, "heading_deg": 80,
              "speed_m_s": 1.5},
    "manoeuvres": [{"straight_s": 60}, {"turn_deg_s": 3, "duration_s": 60, "ramp_s": 8}],
    "sway": {"roll": [{"amplitude_deg": 2, "frequency_hz": 0.12}]},
    "transceiver_lever_arm_m": [2, 5, -6],
    "misalignment_deg": [1, -1.5, 2],
    "sound_speed_error": 0.003,
}  # fmt: skip
PLACES = {
    f"T{i}": {"lat_deg": 36.0 + lat, "lon_deg": 121.0 + lon, "height_m": -40, "std_m": 20}
    for i, (lat, lon) in enumerate([(0.002, -0.002), (0.003, 0.003), (-0.001, 0.002)], 1)
}


def trial(without_imu, **sensors):
    changes = {"imu": None, "attitude": ATTITUDE, "trial": {"imu": None}} if without_imu else {}
    return scenario(
        noise=True,
        manoeuvres=LONGER_TURNS_AND_BRAKING,
        dvl={"rate_hz": 2, "velocity_std_fraction": 0.001},
        **changes,
        **sensors,
    )


def check(solution, truth, names):
    """Assert that errors are within four standard deviations."""
    for name in names:
        e = solution.estimate(name)
        assert np.all(np.abs(e.value - truth[name]) < 4.0 * e.std), name


@pytest.mark.parametrize("without_imu", [False, True])
@pytest.mark.parametrize("measures", ["polar", "position"])
def test_a_usbl_in_place_of_gnss(without_imu, measures):
    usbl = {"rate_hz": 1, "measures": measures, "range_std_m": 0.1, "angle_std_deg": 0.1}
    usbl |= {"position_std_m": [0.2, 0.2, 0.2], "transponder_lever_arm_m": [0.2, 0.5, -0.3]}
    made = simulate(trial(without_imu, gnss=None, usbl={**usbl, "ship": SHIP}), seed=1)
    solution = solve(made, rate_hz=1.0)
    assert solution.converged
    names = ["misalignment_deg", "scale_error", "lever_arm_m"]
    if measures == "polar":
        names += ["usbl_misalignment_deg", "usbl_sound_speed_error"]
    check(solution, made.calibration_truth, names)
    assert solution.estimate("misalignment_deg").std[2] < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("without_imu", [False, True])
def test_transponders_are_found_between_fixes_at_the_surface(without_imu):
    gnss = {"rate_hz": 2, "position_std_m": [0.1, 0.1, 0.2], "outages_s": [[60, 120]]}
    beacons = {"rate_hz": 1, "positions": PLACES, "range_std_m": 0.3}
    made = simulate(trial(without_imu, gnss=gnss, beacons=beacons), seed=1)
    solution = solve(made, rate_hz=1.0)
    names = [f"beacon_{name}_offset_m" for name in PLACES]
    check(solution, made.calibration_truth, [*names, "misalignment_deg", "lever_arm_m"])
    for name in names:
        assert np.all(solution.estimate(name).std[:2] < 1.0)


def test_without_fixes_only_the_shape_of_a_net_is_known_and_said():
    beacons = {"rate_hz": 1, "positions": PLACES, "range_std_m": 0.3}
    made = simulate(trial(False, gnss=None, beacons=beacons), seed=1)
    solution = solve(made, rate_hz=1.0)
    names = [f"beacon_{name}_offset_m" for name in PLACES]
    check(solution, made.calibration_truth, [*names, "misalignment_deg", "lever_arm_m"])
    order = solution.calibration.order
    rows = [order.index(n) for name in names for n in solution.estimate(name).component_names]
    P = solution.calibration.covariance[np.ix_(rows, rows)]
    # Its middle is known as before, 20 m of each of three; how it is spread, by the ranges.
    middle = np.tile(np.eye(3), (1, 3)) / 3.0
    assert np.all(np.sqrt(np.diag(middle @ P @ middle.T)[:2]) > 0.95 * 20.0 / np.sqrt(3.0))
    apart = np.hstack([np.eye(3), -np.eye(3), np.zeros((3, 3))])
    assert np.sqrt(np.linalg.eigvalsh((apart @ P @ apart.T)[:2, :2])[0]) < 2.0
    said = [str(f) for f in solution.findings if f.parameter in names]
    assert len(said) == 3
    assert all("the trial has no GNSS" in text for text in said)


def test_a_heading_of_the_ship_in_grid_north_is_named():
    usbl = {"rate_hz": 1, "measures": "polar", "range_std_m": 0.1, "angle_std_deg": 0.1}
    ship = SHIP | {"misalignment_deg": [0.02, -0.01, 0.03]}
    made = simulate(trial(False, gnss=None, usbl={**usbl, "ship": ship}), seed=1)
    # Grid north is 1.18 deg to the west of north, 2 deg west of the middle of UTM zone 51.
    convergence = -np.arctan(np.tan(np.radians(2.0)) * np.sin(np.radians(36.0)))
    record = made.find(Usbl)
    turned = replace(record.ship, rph=record.ship.rph - [0.0, 0.0, convergence])
    others = tuple(replace(a, ship=turned) if a is record else a for a in made.others)
    for each, named in ((made, False), (replace(made, others=others), True)):
        solution = solve(each, rate_hz=1.0)
        assert (Code.USBL_GRID_NORTH in {f.code for f in solution.findings}) is named
