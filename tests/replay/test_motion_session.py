"""Replays of trials without IMU: the same answer as a batch solution, without what comes later."""

from __future__ import annotations

import os
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from monte_carlo import rms_band
from truth import CONFIGS, SCHULER, with_ins

from factorgraph_dvl.analysis.error_statistics import calibration_errors
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.replay import replay
from factorgraph_dvl.sensors.finding import Code
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import load_scenario, simulate
from factorgraph_dvl.solvers.batch import solve

RUNS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "8"))
MOUNTING = ("misalignment_deg", "scale_error", "lever_arm_m")
TURNS = [
    {"straight_s": 40},
    {"turn_deg_s": 3, "duration_s": 40, "ramp_s": 5},
    {"straight_s": 40},
    {"turn_deg_s": -3, "duration_s": 40, "ramp_s": 5},
]


def scenario(manoeuvres, name="ship"):
    return msgspec.structs.replace(load_scenario(CONFIGS / f"{name}.yaml"), manoeuvres=manoeuvres)


def far_apart(found, batch, names=MOUNTING):
    """Return the differences of two results in standard deviations, and the ratios of these."""
    pairs = [(found.estimate(name), batch.estimate(name)) for name in names]
    moved = np.concatenate([(a.value - b.value) / b.std for a, b in pairs])
    return np.abs(moved).max(), np.concatenate([a.std / b.std for a, b in pairs])


@pytest.fixture(scope="module")
def ship():
    return simulate(scenario(TURNS), 1)


@pytest.fixture(scope="module")
def played(ship):
    return replay(ship, rate_hz=0.2)


def test_the_end_is_that_of_a_batch_solution(ship, played):
    solution, record = played
    assert solution.converged
    assert record.delay > 0.0
    moved, ratio = far_apart(solution, solve(ship, rate_hz=1.0))
    assert moved < 0.5
    # Noise and strength of the motion are those of the first 135 s.
    np.testing.assert_allclose(ratio, 1.0, atol=0.25)


def test_trajectories_are_complete(ship, played):
    solution, record = played
    for motion in (solution.trajectory, record.smoothed):
        steps = np.diff(motion.time)
        np.testing.assert_allclose(steps, steps[0], atol=1e-9)
        assert motion.time[0] < ship.gnss.time[0] + 2.0
        assert motion.time[-1] > ship.gnss.time[-1] - record.delay - 7.0
    assert np.all(np.diff(record.time) > 0.0)
    late = np.interp(record.smoothed.time, ship.reference.time, ship.reference.geodetic[:, 2])
    assert np.median(np.abs(record.smoothed.geodetic[:, 2] - late)) < 3.0
    # Each ping once.
    (pings,) = (r.time for r in solution.residuals if r.label.startswith("DVL"))
    assert np.unique(pings).size == pings.size > 0.9 * ship.dvl.time.size


def test_what_comes_later_changes_nothing(ship, played):
    _, whole = played
    end = 100.0
    _, early = replay(ship.until(end), rate_hz=0.2)
    same = np.searchsorted(early.time, end - early.delay - 6.0)
    assert same > 4
    np.testing.assert_allclose(early.values[:same], whole.values[:same], rtol=1e-9, atol=1e-12)


def test_outliers_are_left_out(ship, played):
    velocity = ship.dvl.velocity.copy()
    # After the last batch solution.
    velocity[150] += 3.0
    solution, _ = replay(replace(ship, dvl=replace(ship.dvl, velocity=velocity)), rate_hz=0.2)
    moved, _ = far_apart(solution, played[0])
    assert moved < 0.3
    (found,) = (f for f in solution.findings if f.code == Code.UNUSED)
    assert found.sensor == "DVL velocity"


def test_a_lag_is_all_that_there_is(ship):
    with pytest.raises(ConfigError, match="needs an IMU"):
        replay(ship, smoother="isam2")


def test_gaps_of_pings_are_bridged(ship):
    kept = (ship.dvl.time < 90.0) | (ship.dvl.time > 120.0)
    solution, record = replay(replace(ship, dvl=rows_of(ship.dvl, kept)), rate_hz=0.1)
    assert solution.converged
    assert np.diff(record.time).max() < 45.0


def nees_of_seven(made):
    """Return the NEES of misalignment, scale and lever arm of each seed."""
    out = []
    for seed in range(RUNS):
        trial = simulate(made, seed)
        errors = calibration_errors(replay(trial, rate_hz=0.2)[0], trial.calibration_truth)
        keep = [n.startswith(("misalignment", "scale", "lever_arm")) for n in errors.names]
        error, P = errors.error[keep], errors.covariance[np.ix_(keep, keep)]
        out.append(error @ np.linalg.solve(P, error))
    return np.array(out)


@pytest.mark.slow
def test_errors_are_as_large_as_their_standard_deviations():
    low, high = rms_band(7 * RUNS)
    assert (
        low
        < np.sqrt(np.mean(nees_of_seven(scenario(2 * TURNS + [{"straight_s": 60}]))) / 7)
        < high
    )


@pytest.mark.slow
def test_errors_with_an_ins_are_as_large_as_their_standard_deviations():
    """The INS errs with a period of 84 minutes, whose phase each window must share."""
    low, high = rms_band(7 * RUNS)
    nees = nees_of_seven(with_ins(scenario(2 * TURNS + [{"straight_s": 60}]), SCHULER))
    assert low < np.sqrt(np.mean(nees) / 7) < high


@pytest.mark.slow
@pytest.mark.parametrize("through_water", [False, True])
def test_an_hour_ends_as_a_batch_solution(through_water):
    name = "ship-water" if through_water else "ship"
    legs = load_scenario(CONFIGS / f"{name}.yaml").manoeuvres[0]["manoeuvres"]
    trial = simulate(scenario([{"repeat": 5, "manoeuvres": legs}], name), 1)
    solution, _ = replay(trial, rate_hz=0.2)
    assert solution.converged
    moved, ratio = far_apart(solution, solve(trial, rate_hz=1.0))
    assert moved < 0.5
    assert 0.8 < ratio.min() < ratio.max() < 1.4
