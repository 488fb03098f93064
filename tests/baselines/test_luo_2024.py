"""The printed filter of Luo et al. (2024): one pass, data rotated from a threshold on."""

from __future__ import annotations

import os

import numpy as np
import pytest
from kalman_trials import LEVER_ARM, MISALIGNMENT, SCALE, exact_points
from truth import config

from factorgraph_dvl.analysis.error_statistics import paper_accuracy
from factorgraph_dvl.baselines import kalman
from factorgraph_dvl.baselines.luo_2024 import THRESHOLD, as_printed
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.simulation import simulate

SEEDS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "50"))


def rotations(outcome):
    return int(str(outcome.findings[1]).split()[-2])


def test_below_the_threshold_nothing_is_rotated():
    small = [0.2 * THRESHOLD, -0.1 * THRESHOLD, 0.3 * THRESHOLD]
    outcome = as_printed(exact_points(misalignment=small), MISALIGNMENT, SCALE, LEVER_ARM)
    assert rotations(outcome) == 0
    np.testing.assert_allclose(log_so3(outcome.estimated.values[0]), small, atol=1e-4)


def test_a_large_angle_is_rotated_away_but_pings_before_stay_as_they_were():
    turn = np.array([0.03, 0.03, 0.5])
    arm = np.array([1.0, 1.2, 1.4])
    points = exact_points(400, misalignment=turn, scale=0.005, arm=arm)
    outcome = as_printed(points, MISALIGNMENT, SCALE, LEVER_ARM)
    assert rotations(outcome) > 0
    assert outcome.iterations == 1
    left = log_so3(exp_so3(turn).T @ outcome.estimated.values[0])
    # One pass on exact data: what is left is the method's own.
    assert 1e-6 < np.linalg.norm(left) < 0.05
    assert len(outcome.history) == 400


@pytest.mark.slow
def test_it_comes_near_the_accuracy_of_the_paper():
    found = []
    for phase in ("0", "90"):
        for seed in range(max(SEEDS // 6, 1)):
            trial = simulate(config(f"luo-2024-phase-{phase}"), seed)
            found.append(
                paper_accuracy(kalman(trial, "luo-2024").estimates, trial.calibration_truth)
            )
    # Printed: 97.28 %.
    assert 95.5 < np.mean(found) < 98.8
