"""Replays of planar trials: the same answer as `solve`, without what comes later."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import planar
import pytest
from findings import of_code

from factorgraph_dvl import load_solution, save_trial
from factorgraph_dvl.analysis.error_statistics import motion_errors, nees_band, true_value_of
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.replay import Replay, replay
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.sensors.speed_log import SpeedLog
from factorgraph_dvl.solvers.batch import solve

RUNS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "12"))
# Two-sided probability that the mean NEES of an honest filter leaves its band.
_RARE = 0.003
ECHOES = {"missed": 0.05, "multipath": 0.05, "multipath_m": [10, 50]}
TWO = {
    "B1": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": -80},
    "B2": {"lat_deg": 25.004, "lon_deg": 135.004, "height_m": -90},
}
DRAWN = {
    "heading": {"bias_deg": "draw", "bias_std_deg": 1.0},
    "log": {"scale_error": "draw", "scale_error_std": 0.02},
}
TURNS = [
    {"straight_s": 60},
    {"turn_deg_s": 2, "duration_s": 30},
    {"straight_s": 60},
    {"turn_deg_s": -3, "duration_s": 20},
    {"straight_s": 30},
]


def two_beacons(seed=0, manoeuvres=TURNS):
    return planar.trial(seed, manoeuvres=manoeuvres, beacons={"positions": TWO, **ECHOES}, **DRAWN)


def fed(trial, until, step, late=None):
    """Return the updates of a feed whose rows come one by one, those of some sections late, s."""
    session, updates, late = Replay(trial, rate_hz=1.0 / step), [], late or {}
    rows = sorted(
        (float(time) + late.get(aid.section, 0.0), i, k)
        for i, aid in enumerate(trial.aids)
        for k, time in enumerate(aid.time)
        if time <= until
    )
    at = float(trial.body_sensor.time[0])
    for time, i, k in rows:
        while time > at:
            updates += session.advance(at)
            at += step
        session.add(rows_of(trial.aids[i], np.array([k])))
    return session, updates + session.advance(at)


def numbers(update):
    return np.concatenate([e.value for e in update.calibration.estimates])


@pytest.fixture(scope="module")
def trial():
    return two_beacons()


@pytest.fixture(scope="module")
def played(trial):
    return replay(trial, rate_hz=0.2)


@pytest.fixture(scope="module")
def solved(trial):
    return solve(trial)


def test_the_end_is_that_of_solve(played, solved):
    solution, _ = played
    assert solution.converged
    assert solution.order == solved.order
    for e in solved.estimates:
        found = solution.estimate(e.name)
        np.testing.assert_allclose(found.value, e.value, atol=0.1 * e.std.min())
        np.testing.assert_allclose(found.std, e.std, rtol=0.03)


def test_the_smoothed_motion_ends_as_that_of_solve(trial, played, solved):
    solution, record = played
    for motion in (solution.trajectory, record.smoothed):
        np.testing.assert_allclose(motion.time, solved.trajectory.time, atol=1e-9)
        assert np.all(np.isnan(motion.rph_cov[:, 0, 0]))
    newest = slice(-100, None)
    frame = trial.frame()
    found, others = (
        frame.position(*t.geodetic[newest].T) for t in (record.smoothed, solved.trajectory)
    )
    std = solved.trajectory.position_std[newest]
    assert np.abs((found - others) / std).max() < 0.1
    np.testing.assert_allclose(record.smoothed.position_std[newest], std, rtol=0.03)


def test_each_measurement_is_compared_with_its_prediction_once(trial, played):
    solution, record = played
    for found in solution.residuals:
        assert np.unique(found.time).size == found.time.size
        # The motion may change by the most that log and compass leave open, so that velocities are
        # predicted better than stated.
        assert 0.4 < np.sqrt(np.nanmean((found.residual / found.sigma) ** 2)) < 1.3
    ranges = [r.time for r in solution.residuals if r.label == "Beacon B1 range"]
    heard = np.sum(trial.find(Beacons).time > record.time[0])
    assert heard / 3 < ranges[0].size < heard


@pytest.mark.slow
def test_what_comes_later_changes_nothing(trial, played):
    _, whole = played
    _, early = replay(trial.until(110.0), rate_hz=0.2)
    same = np.flatnonzero(early.time < 108.0)
    assert same.size > 5
    np.testing.assert_allclose(early.values[same], whole.values[same], rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_ranges_that_come_late_and_out_of_order_count_as_if_in_time(trial, played):
    """However late: no state is left behind."""
    session, updates = fed(trial, 120.0, 5.0, late={"beacons": 8.0})
    # None is too late; some are echoes.
    assert {dict(f.message.values)["why"].key for f in session.counts()} <= {"unused.contradicted"}
    assert session.delay == 0.0
    whole = played[1]
    k = int(np.searchsorted(whole.time, 120.0))
    assert updates[-1].time > 119.0
    apart = np.abs(numbers(updates[-1]) - whole.values[k]) / whole.std[k]
    assert apart.max() < 0.3


def test_a_log_that_is_silent_is_bridged(trial):
    kept = (trial.find(SpeedLog).time < 100.0) | (trial.find(SpeedLog).time > 112.0)
    gap = planar.changed(trial, rows_of(trial.find(SpeedLog), kept))
    _, updates = fed(gap, 130.0, 5.0)
    times = np.array([u.time for u in updates])
    assert not np.any((times > 101.0) & (times < 112.0))
    assert times[-1] > 128.0


@pytest.mark.slow
def test_silence_of_a_beacon_is_said_and_makes_the_position_less_certain(trial):
    ranges = trial.find(Beacons)
    kept = (ranges.time < 100.0) | (ranges.time > 125.0)
    _, updates = fed(planar.changed(trial, rows_of(ranges, kept)), 135.0, 5.0)
    said = [f for u in updates for f in u.findings]
    assert of_code(said, Code.SILENT)
    assert of_code(said, Code.HEARD_AGAIN)
    std = {round(u.time / 5.0) * 5: u.state.position_std[0, 0] for u in updates}
    assert std[125] > 1.5 * std[100] > 0.0
    assert std[135] < std[125]


@pytest.mark.slow
def test_two_tracks_are_none(trial):
    straight = planar.trial(manoeuvres=[{"straight_s": 75}])
    with pytest.raises(SolveError, match="2 trajectories fit the ranges; turn by 30 degrees"):
        replay(straight)


@pytest.mark.slow
def test_a_start_waits_for_the_turn_and_ends_as_solve():
    """One beacon: mirror images until the turn, then an arc around it, which becomes straight."""
    made = planar.trial(
        manoeuvres=[
            {"straight_s": 80},
            {"turn_deg_s": 3, "duration_s": 40},
            {"straight_s": 40},
        ],
        beacons=ECHOES,
    )
    solution, record = replay(made, rate_hz=0.2)
    said = [f.message.values for _, f in record.findings if f.code == Code.NOT_STARTED]
    assert said
    assert 80.0 < record.time[0] < 140.0
    whole = solve(made)
    for e in whole.estimates:
        found = solution.estimate(e.name)
        np.testing.assert_allclose(found.value, e.value, atol=0.1 * e.std.min())


@pytest.mark.slow
def test_an_arc_that_never_becomes_straight_ends_as_in_solve():
    """What turns the track about its only beacon is the bias of the heading."""
    made = planar.trial(
        manoeuvres=[{"straight_s": 60}, {"turn_deg_s": 3, "duration_s": 30}],
        heading={"bias_deg": 1.0, "bias_std_deg": 2.0},
    )
    solution, record = replay(made, rate_hz=0.1)
    whole = solve(made)
    for e in whole.estimates:
        found = solution.estimate(e.name)
        np.testing.assert_allclose(found.value, e.value, atol=0.1 * e.std.min())
        np.testing.assert_allclose(found.std, e.std, rtol=0.03)
    ratio = record.smoothed.position_std[-50:] / whole.trajectory.position_std[-50:]
    np.testing.assert_allclose(ratio, 1.0, rtol=0.03)


def test_nothing_needs_to_be_estimated():
    made = planar.trial(
        manoeuvres=[{"straight_s": 75}],
        beacons={"positions": TWO},
        log={"reference": "bottom"},
        current_m_s=[0, 0, 0],
    )
    solution, record = replay(made, rate_hz=0.2)
    assert solution.estimates == ()
    assert solution.trajectory.time[-1] == record.time[-1]


@pytest.mark.slow
def test_the_command_shows_what_is_known(trial, tmp_path, capsys):
    save_trial(trial, tmp_path / "trial")
    command = ["replay", str(tmp_path / "trial"), "--out", str(tmp_path / "out"), "--live"]
    with pytest.raises(SystemExit) as end:
        main([*command, "--rate", "0.1"])
    assert end.value.code == 0
    assert "behind the records" in capsys.readouterr().out
    assert load_solution(tmp_path / "out").solver == "replay"


@pytest.mark.slow
def test_a_range_that_is_wrong_for_long_is_not_used(trial, played):
    """Beacon B2 hears an echo for 25 s: 20 m more."""
    ranges = trial.find(Beacons)
    wrong = (ranges.time > 140.0) & (ranges.time < 165.0) & (ranges.name == "B2")
    echo = replace(ranges, range=np.where(wrong, ranges.range + 20.0, ranges.range))
    _, updates = fed(planar.changed(trial, echo), 170.0, 5.0)
    whole = played[1]
    k = int(np.searchsorted(whole.time, updates[-1].time - 0.1))
    assert np.abs((numbers(updates[-1]) - whole.values[k]) / whole.std[k]).max() < 1.0


@pytest.mark.slow
@pytest.mark.study
@pytest.mark.parametrize("beacons", [1, 2])
def test_errors_are_as_large_as_stated_all_along(beacons):
    legs = [
        {"straight_s": 80},
        {"turn_deg_s": 3, "duration_s": 40},
        {"straight_s": 80},
        {"turn_deg_s": -3, "duration_s": 40},
        {"straight_s": 80},
    ]
    times = np.array([117.0, 130.0, 150.0, 180.0, 200.0, 230.0, 260.0, 290.0, 318.0])
    nees, size = [], 0
    for seed in range(RUNS):
        made = (
            two_beacons(seed, legs)
            if beacons == 2
            else planar.trial(seed, manoeuvres=legs, beacons=ECHOES)
        )
        _, updates = fed(made, 320.0, 5.0)
        when = np.array([u.time for u in updates])
        row = []
        for u in (updates[int(np.argmin(np.abs(when - t)))] for t in times):
            errors = motion_errors(u.state, made.reference)
            estimates, P = u.calibration.estimates, u.calibration.covariance
            truth = [true_value_of(e, made.calibration_truth) for e in estimates]
            error = np.concatenate([e.value - t for e, t in zip(estimates, truth, strict=True)])
            free = np.diag(P) > 0.0
            size = int(free.sum())
            pairs = [
                (v.error[0, :2], v.covariance[0, :2, :2])
                for v in (errors.position, errors.velocity)
            ]
            pairs.append((error[free], P[np.ix_(free, free)]))
            row.append([x @ np.linalg.solve(C, x) for x, C in pairs])
        nees.append(row)
    mean = np.mean(nees, axis=0)
    for k, dof in enumerate((2, 2, size)):
        low, high = nees_band(dof, RUNS, 1.0 - _RARE)
        if k == 1:
            # The motion may change by the most that log and compass leave open: velocities may be
            # better than stated.
            low = 0.0
        assert np.all((mean[:, k] > low) & (mean[:, k] < high)), mean[:, k] / dof
