"""Dives without GNSS: whether the position is as good as its standard deviation says.

    pytest -m slow tests/test_dive.py

FACTORGRAPH_DVL_SEEDS sets the number of dives of each kind, 6 by default.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np
import pytest
from truth import config

from factorgraph_dvl.analysis.dead_reckoning.before_after import before_after
from factorgraph_dvl.analysis.error_statistics import nees_band, trajectory_errors
from factorgraph_dvl.baselines import sins
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.files.earlier_calibration import calibrated_by
from factorgraph_dvl.imu.attitude_history import AttitudeHistory
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solution import Calibration
from factorgraph_dvl.solvers.batch import solve

RUNS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "6"))
# What an 80-minute cruise leaves unknown, about.
STD = {
    "misalignment_deg": [0.0014, 0.0066, 0.0015],
    "scale_error": [1.4e-5],
    "lever_arm_m": [0.001, 0.0012, 0.0011],
}


def drawn_calibration(truth, rng):
    """A calibration whose errors are drawn from the covariance that it states."""
    estimates = []
    for name, std in STD.items():
        std = np.array(std)
        value = truth[name] + std * rng.standard_normal(std.size)
        names = tuple(f"{name}{i}" for i in range(std.size))
        estimates.append(Estimate(name, names, value, std, value, std, np.ones(std.size, bool)))
    covariance = np.diag(np.concatenate(list(STD.values())) ** 2)
    return Calibration("cruise", "batch", "RFU", True, 1, 0.0, tuple(estimates), covariance)


@dataclass(frozen=True)
class Run:
    inside: np.ndarray
    end_nees: float
    end_std: np.ndarray
    start_std: np.ndarray
    smoothed: float
    dead_reckoned: float


def one(seed, ends):
    changes = {"gnss": {"outages_s": [[305, 1e5]]}} if ends else {}
    trial = simulate(config("dive", **changes), seed)
    found = drawn_calibration(trial.calibration_truth, np.random.default_rng(seed + 100))
    trial = replace(trial, dvl=calibrated_by(trial.dvl, found, "RFU", "cruise"))
    solution = solve(trial)
    assert solution.converged
    p = trajectory_errors(solution, trial.reference).position
    motion, bias, _ = sins(trial)
    source = AttitudeHistory(trial.imu, motion, "RFU", bias)
    reckoned = before_after(trial, found.values, source.at).calibrated.score
    return Run(
        inside=(np.abs(p.error) <= 2.0 * p.std).mean(axis=0),
        end_nees=float(p.nees[-1]),
        end_std=p.std[-1],
        start_std=p.std[0],
        smoothed=float(np.mean(p.error[:, :2] ** 2)),
        dead_reckoned=float(np.mean(reckoned.error[:, :2] ** 2)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("ends", [True, False], ids=["GNSS ends", "GNSS returns"])
def test_dives_are_as_good_as_they_say_and_better_than_dead_reckoning(ends):
    runs = [one(seed, ends) for seed in range(RUNS)]
    low, high = nees_band(3, RUNS, level=0.997)
    assert low < np.mean([r.end_nees for r in runs]) < high
    # The epochs of a dive are nearly one: so few dives leave the share of 95 % much to chance.
    inside = np.mean([r.inside for r in runs])
    assert inside > 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / (3.0 * RUNS))
    ratio = np.sqrt(np.mean([r.dead_reckoned for r in runs]) / np.mean([r.smoothed for r in runs]))
    assert ratio > 2.0
    if ends:
        for r in runs:
            assert (r.end_std[:2] > 2.0 * r.start_std[:2]).all()


def test_a_dive_grows_uncertain_and_says_so():
    short = [
        {"straight_s": 30},
        {"turn_deg_s": 6, "duration_s": 30, "ramp_s": 4},
        {"straight_s": 30},
        {"climb_m_s": -0.5, "to_height_m": 0},
        {"straight_s": 100},
    ]
    scn = config(
        "dive",
        start={"speed_m_s": 2},
        manoeuvres=short,
        gnss={"outages_s": [[100, 1000]]},
        dvl={"no_lock_s": [[150, 190]]},
    )
    trial = simulate(scn, 0)
    found = drawn_calibration(trial.calibration_truth, np.random.default_rng(0))
    trial = replace(trial, dvl=calibrated_by(trial.dvl, found, "RFU", "cruise"))
    solution = solve(trial)
    assert solution.converged
    p = trajectory_errors(solution, trial.reference).position
    time = solution.trajectory.time
    horizontal = np.hypot(p.std[:, 0], p.std[:, 1])
    surfaced, before, after = (horizontal[np.searchsorted(time, t)] for t in (95, 149, 191))
    # Without GNSS it grows, without bottom lock it grows faster.
    assert surfaced < before < after
    assert (after - before) / 42.0 > (before - surfaced) / 54.0
    assert np.abs(p.normalised).max() < 4.0
    # The depth sensor knows what the DVL loses.
    assert p.std[:, 2].max() < 2.0 * p.std[0, 2]
