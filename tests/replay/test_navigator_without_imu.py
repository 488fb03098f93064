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
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.replay import Replay, replay
from factorgraph_dvl.replay.calibration import CalibrationReport
from factorgraph_dvl.replay.window import Window
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import load_scenario, simulate
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu
from factorgraph_dvl.solvers.rounds import settle

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


def batch_estimates(trial):
    """Return the estimates of a batch solution by name, as a replay reports them."""
    prepared = prepare_without_imu(trial)
    settled = settle(
        prepared,
        prepared.states,
        lambda stage, iteration, cost: None,
        clock_zero=float(max(aid.time[0] for aid in trial.aids)),
    )
    minimum = settled.minimum
    found = Window(settled.problem, minimum.evaluation, minimum.information)
    none = np.zeros((len(found.constants), 0))
    report = CalibrationReport(settled.problem.all_parameters)
    known = report.at(found.values, np.empty(0), found.constants, none)
    return {e.name: e for e in known.estimates}


def far_apart(found, others, names=MOUNTING):
    """Return the differences of results in standard deviations, and the ratios of these."""
    pairs = [(found.estimate(name), others[name]) for name in names]
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
    moved, ratio = far_apart(solution, batch_estimates(ship))
    assert moved < 0.1
    np.testing.assert_allclose(ratio, 1.0, atol=0.03)


def test_trajectories_are_complete(ship, played):
    solution, record = played
    for motion in (solution.trajectory, record.smoothed):
        steps = np.diff(motion.time)
        np.testing.assert_allclose(steps, steps[0], atol=1e-9)
        assert motion.time[0] < ship.gnss.time[0] + 2.0
        assert motion.time[-1] > ship.gnss.time[-1] - 2.0
    assert np.all(np.diff(record.time) > 0.0)
    height = np.interp(record.smoothed.time, ship.reference.time, ship.reference.geodetic[:, 2])
    assert np.median(np.abs(record.smoothed.geodetic[:, 2] - height)) < 3.0


def test_motion_and_attitude_are_known_as_well_as_stated(ship, played):
    solution, _ = played
    motion, true = solution.trajectory, ship.reference
    turned = np.interp(motion.time, true.time, np.unwrap(true.rph[:, 2])) - motion.rph[:, 2]
    off = (turned + np.pi) % (2.0 * np.pi) - np.pi
    assert 0.3 < np.sqrt(np.mean((off / np.sqrt(motion.rph_cov[:, 2, 2])) ** 2)) < 2.0


def test_each_measurement_is_compared_with_its_prediction_once(ship, played):
    solution, record = played
    start = record.time[0]
    for found in solution.residuals:
        assert np.unique(found.time).size == found.time.size
        assert 0.8 < np.sqrt(np.nanmean((found.residual / found.sigma) ** 2)) < 1.4
    (pings,) = (r.time for r in solution.residuals if r.label.startswith("DVL"))
    assert pings.size > 0.98 * np.sum(ship.dvl.time > start + 1.0)


def test_what_comes_later_changes_nothing(ship, played):
    _, whole = played
    end = 100.0
    _, early = replay(ship.until(end), rate_hz=0.2)
    same = np.searchsorted(early.time, end - early.delay - 6.0)
    assert same > 4
    np.testing.assert_allclose(early.values[:same], whole.values[:same], rtol=1e-9, atol=1e-12)


def test_a_live_feed_knows_what_a_recorded_trial_does(ship, played):
    """Rows come one by one; fixes a second late, which counts for nothing behind the delay."""
    session = Replay(ship, rate_hz=0.2)
    assert session.delay == played[1].delay
    late = {"gnss": 1.0}
    rows = sorted(
        (float(time) + late.get(aid.section, 0.0), i, k)
        for i, aid in enumerate(ship.aids)
        for k, time in enumerate(aid.time)
        if time < 85.0
    )
    updates, step = [], ship.attitude.time[0]
    for time, i, k in rows:
        while time >= step:
            updates += session.advance(step)
            step += session.interval
        session.add(rows_of(ship.aids[i], np.array([k])))
    whole = played[1]
    known = [np.concatenate([e.value for e in u.calibration.estimates]) for u in updates]
    assert len(known) > 3
    std = whole.std[: len(known)]
    assert np.nanmax(np.abs(known - whole.values[: len(known)]) / std) < 0.3
    late_ones = session.finish()
    assert late_ones[-1].smoothed is not None
    assert not session.settled


@pytest.mark.slow
def test_outliers_are_left_out(ship, played):
    velocity = ship.dvl.velocity.copy()
    # After the last batch solution.
    velocity[150] += 3.0
    solution, _ = replay(replace(ship, dvl=replace(ship.dvl, velocity=velocity)), rate_hz=0.2)
    moved, _ = far_apart(solution, {e.name: e for e in played[0].estimates})
    assert moved < 0.3
    (found,) = (f for f in solution.findings if f.code == Code.UNUSED)
    assert found.sensor == "DVL velocity"


def test_a_lag_is_all_that_there_is(ship):
    with pytest.raises(ConfigError, match="needs an IMU"):
        replay(ship, smoother="isam2")


@pytest.mark.slow
def test_gaps_of_pings_are_bridged_and_said(ship):
    kept = (ship.dvl.time < 95.0) | (ship.dvl.time > 120.0)
    solution, record = replay(replace(ship, dvl=rows_of(ship.dvl, kept)), rate_hz=0.2)
    assert solution.converged
    assert np.diff(record.time).max() < 12.0
    said = {f.code for _, f in record.findings if f.sensor == "DVL velocity"}
    assert {Code.SILENT, Code.HEARD_AGAIN} <= said


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
    nees = nees_of_seven(scenario(2 * TURNS + [{"straight_s": 60}]))
    assert low < np.sqrt(np.mean(nees) / 7) < high


@pytest.mark.slow
@pytest.mark.study
def test_errors_with_an_ins_are_as_large_as_their_standard_deviations():
    """The INS errs with a period of 84 minutes, whose phase each window must share."""
    low, high = rms_band(7 * RUNS)
    nees = nees_of_seven(with_ins(scenario(2 * TURNS + [{"straight_s": 60}]), SCHULER))
    assert low < np.sqrt(np.mean(nees) / 7) < high


@pytest.mark.slow
@pytest.mark.study
@pytest.mark.parametrize("through_water", [False, True])
def test_an_hour_ends_as_a_batch_solution(through_water):
    name = "ship-water" if through_water else "ship"
    legs = load_scenario(CONFIGS / f"{name}.yaml").manoeuvres[0]["manoeuvres"]
    trial = simulate(scenario([{"repeat": 5, "manoeuvres": legs}], name), 1)
    solution, _ = replay(trial, rate_hz=0.2)
    assert solution.converged
    moved, ratio = far_apart(solution, batch_estimates(trial))
    assert moved < 0.1
    np.testing.assert_allclose(ratio, 1.0, atol=0.03)
