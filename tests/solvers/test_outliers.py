"""Trials with gross errors: what is named, what is lost, what comes out."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from monte_carlo import RUNS
from truth import TURNING, config, scenario

from factorgraph_dvl.analysis.error_statistics import calibration_errors
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import faults, simulate
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.change_along_trial import fall_of_change, fall_without_errors
from factorgraph_dvl.solvers.preparation import prepare
from factorgraph_dvl.solvers.rounds import settle

CASES = {
    "pings": [faults.dvl_outliers()],
    "fixes": [faults.gnss_outliers()],
    "false lock": [faults.dvl_false_lock()],
    "jumps": [faults.gnss_jumps()],
    "all": [
        faults.dvl_outliers(),
        faults.gnss_outliers(),
        faults.dvl_false_lock(),
        faults.gnss_jumps(),
    ],
}


def wrong(before, after):
    """Rows that a fault changed, by measurement; displacing fixes by nothing rounds them."""
    moved = np.abs(after.gnss.geodetic - before.gnss.geodetic) * [6.4e6, 6.4e6, 1.0]
    return {
        "DVL velocity": (
            before.dvl.time,
            np.any(after.dvl.velocity != before.dvl.velocity, axis=1),
        ),
        "GNSS position": (before.gnss.time, np.any(moved > 1e-3, axis=1)),
    }


def judged(clean, seed, case):
    """Return the normalised errors, shares named and lost, and the solution."""
    trial = faults.with_faults(clean, CASES[case], seed)
    solution = solve(trial, rate_hz=1.0)
    named, bad_ones, lost, good_ones = 0, 0, 0, 0
    for label, (time, bad) in wrong(clean, trial).items():
        rejected = [r.time for r in solution.rejected if r.label == label]
        out = np.isin(time, np.concatenate([np.empty(0), *rejected]))
        named, bad_ones = named + (out & bad).sum(), bad_ones + bad.sum()
        lost, good_ones = lost + (out & ~bad).sum(), good_ones + (~bad).sum()
    errors = calibration_errors(solution, trial.calibration_truth)
    return errors, named / bad_ones, lost / good_ones, solution


@pytest.fixture(scope="module")
def clean():
    scene = scenario(
        noise=True,
        manoeuvres=[*TURNING, TURNING[1], TURNING[3]],
        imu={"rate_hz": 50},
        dvl={"rate_hz": 5},
    )
    return simulate(scene, 3)


@pytest.mark.parametrize("case", ["pings", "fixes"])
def test_gross_errors_are_named_and_harmless(clean, case):
    errors, named, lost, solution = judged(clean, 3, case)
    assert solution.converged
    assert named >= 0.95
    assert lost <= 0.01
    assert np.all(np.abs(errors.normalised[:7]) < 4.0)
    assert any(f.code == Code.OUTLIERS for f in solution.findings)
    assert all(np.all(np.abs(n.factor - 1.0) < 0.2) for n in solution.noise)


def test_a_clean_trial_loses_nothing(clean):
    solution = solve(clean, rate_hz=1.0)
    assert not solution.rejected
    assert not any(f.code == Code.OUTLIERS for f in solution.findings)


def test_a_mount_that_slips_makes_no_gross_errors(clean):
    """All pings after it are as wrong as gross errors are, and alike."""
    solution = solve(faults.with_faults(clean, [faults.dvl_slipped((0.0, 0.0, 2.0))]), rate_hz=1.0)
    first = solution.verdict.reasons[0]
    assert (first.code, first.parameter) == (Code.CHANGED_ALONG_TRIAL, "misalignment_deg")
    assert not solution.rejected


@pytest.mark.parametrize(
    "fault", [faults.dvl_slipped((0.0, 0.0, 0.3)), faults.clock_step("dvl", 0.02)]
)
def test_what_a_change_takes_off_is_what_it_added(clean, fault):
    """The test of a change, where all else follows it as that of a whole trial, finds less."""
    settings = msgspec.structs.replace(clean.dvl.settings, time_offset_std_s=0.1)
    timed = replace(clean, dvl=replace(clean.dvl, settings=settings))
    found = []
    for made in ([], [fault]):
        trial = faults.with_faults(timed, made)
        prepared = prepare(trial, 1.0, lambda *_: None)
        states = prepared.start_positions.states[0]
        found.append(settle(prepared, states, lambda *_: None, roughly=True))
    honest, slipped = found
    assert not honest.problem.robust_weights
    assert not slipped.problem.robust_weights
    added = 2.0 * (slipped.minimum.evaluation.cost - honest.minimum.evaluation.cost)
    assert added > 100.0
    dvl = trial.dvl.time[:, None]
    every = {"DVL velocity": (dvl < dvl.mean()).astype(float)}
    names = {"misalignment_deg", "time_offset_s"}
    taken = fall_of_change(slipped.problem, slipped.minimum, names)
    assert taken == pytest.approx(added, rel=0.1)
    assert fall_without_errors(slipped.problem, slipped.minimum, every) == taken
    # It makes no single gross errors, and honest pings none at all.
    few = {"DVL velocity": (np.arange(dvl.size) % 20 > 0).astype(float)}
    assert fall_without_errors(slipped.problem, slipped.minimum, few) == 0.0
    assert fall_without_errors(honest.problem, honest.minimum, every) == 0.0


def test_one_beam_is_left_out_alone():
    scene = config("cruise-beams", manoeuvres=TURNING, start={"speed_m_s": 4}, imu={"rate_hz": 50})
    trial = simulate(scene, 1)
    beams = trial.beams
    velocity = beams.velocity.copy()
    velocity[10:300:20, 1] += 0.5
    others = tuple(
        replace(aid, velocity=velocity) if aid.section == beams.section else aid
        for aid in trial.others
    )
    solution = solve(replace(trial, others=others), rate_hz=1.0)
    (rejected,) = (r for r in solution.rejected if r.label == "Beam velocity")
    assert rejected.reason == "outlier"
    bad = np.isin(rejected.time, beams.time[10:300:20])
    assert bad.sum() == beams.time[10:300:20].size
    assert np.all(np.isfinite(rejected.residual[bad]) == [False, True, False, False])
    # One in a thousand good ones is beyond the gate.
    assert (~bad).sum() <= 5


def test_one_wrong_ping_of_a_trial_without_imu_is_left_out():
    lines = [
        {"straight_s": 40},
        {"turn_deg_s": 3, "duration_s": 40, "ramp_s": 5},
        {"straight_s": 40},
        {"turn_deg_s": -3, "duration_s": 40, "ramp_s": 5},
    ]
    trial = simulate(config("ship", manoeuvres=lines), 1)
    velocity = trial.dvl.velocity.copy()
    velocity[150] += 3.0
    # The wrong ping can turn the mount as long as few others are left after it.
    wrong = replace(trial, dvl=replace(trial.dvl, velocity=velocity)).until(160.0)
    solution = solve(wrong, rate_hz=1.0)
    (rejected,) = solution.rejected
    # Chance may take one of the good ones for gross.
    assert trial.dvl.time[150] in rejected.time
    assert rejected.time.size <= 2
    clean = solve(trial.until(160.0), rate_hz=1.0)
    for name in ("misalignment_deg", "lever_arm_m"):
        moved = solution.estimate(name).value - clean.estimate(name).value
        assert np.all(np.abs(moved) < solution.estimate(name).std)


@cache
def exact_errors(seed):
    """Return the errors of a calibration by measurements that are all good."""
    trial = simulate(config("seed-a-phase-90"), seed)
    return calibration_errors(solve(trial, rate_hz=1.0), trial.calibration_truth).error[:7]


# All at once have each of them.
@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [c if c == "all" else pytest.param(c, marks=pytest.mark.study) for c in CASES],
)
def test_errors_are_those_of_clean_data(case):
    own, reference, shares = [], [], []
    # A ratio of a few errors scatters by itself.
    for seed in range(max(RUNS, 6)):
        trial = simulate(config("seed-a-phase-90"), seed)
        errors, named, lost, _ = judged(trial, seed, case)
        reference.append(exact_errors(seed))
        own.append(errors.error[:7])
        shares.append((named, lost))
    named, lost = np.mean(shares, axis=0)
    assert named >= 0.95
    assert lost <= 0.005
    rms = np.sqrt(np.mean(np.square(own), axis=0) / np.mean(np.square(reference), axis=0))
    assert np.all(rms < 1.5), rms
