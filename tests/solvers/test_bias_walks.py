"""Biases that walk more than stated: found, named and estimated; other errors are not mistaken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from msgspec import structs
from truth import CONFIGS, LONGER_TURNS_AND_BRAKING, merged, scenario

from factorgraph_dvl.analysis.error_statistics import trajectory_errors
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import faults, parse_scenario, simulate
from factorgraph_dvl.solvers.batch import solve

SCENE = {
    "noise": True,
    "manoeuvres": LONGER_TURNS_AND_BRAKING,
    "imu": {"rate_hz": 50},
    "dvl": {"velocity_std_fraction": 0.001},
    "trial": {"dvl": {"velocity_std_fraction": 0.001}},
}
KEY = "accel_bias_walk_ug_sqrt_h"


@pytest.fixture(scope="module")
def honest():
    return simulate(scenario(**merged({}, SCENE)), 4)


def of_walks(solution):
    return [f for f in solution.findings if "walk" in f.text and f.code == Code.ESTIMATED_INSTEAD]


def errors(solution, trial):
    """Return errors of the mounting in standard deviations."""
    truth = trial.calibration_truth
    return np.concatenate(
        [
            (solution.estimate(name).value - truth[name]) / solution.estimate(name).std
            for name in ("misalignment_deg", "scale_error", "lever_arm_m")
        ]
    )


@pytest.mark.slow
def test_a_walk_that_was_not_stated_is_estimated(honest):
    walk = 6000.0
    trial = faults.with_faults(honest, [faults.imu_bias_walk(0.0, walk)], 1)
    solution = solve(trial, rate_hz=1.0)
    (found,) = of_walks(solution)
    assert KEY in found.text
    assert solution.verdict.grade == "doubtful"
    assert np.abs(errors(solution, honest)).max() < 4.0
    # As good as if it had been stated.
    settings = structs.replace(trial.imu.settings, **{KEY: walk})
    stated = solve(replace(trial, imu=replace(trial.imu, settings=settings)), rate_hz=1.0)
    assert not of_walks(stated)
    for name in ("misalignment_deg", "scale_error", "lever_arm_m"):
        std = stated.estimate(name).std
        np.testing.assert_allclose(solution.estimate(name).std, std, rtol=0.25)
        moved = solution.estimate(name).value - stated.estimate(name).value
        assert np.abs(moved / std).max() < 0.5
    (row,) = (c for c in solution.error_budget if c.cause.startswith("random walk of accel"))
    assert 0.6 < float(row.assumed.split()[0]) / walk < 1.6


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(faults.correlated_dvl(0.02, 3.0), id="DVL wanders"),
        pytest.param(faults.dvl_slipped((0.0, 0.0, 0.5)), id="mount slips"),
    ],
)
def test_errors_of_others_are_no_walk(honest, fault):
    solution = solve(faults.with_faults(honest, [fault], 1), rate_hz=1.0)
    assert solution.verdict.grade != "good"
    assert not of_walks(solution)


@pytest.mark.slow
@pytest.mark.parametrize(
    "walk",
    [
        (1.0, 0.0),
        (3.0, 0.0),
        (10.0, 0.0),
        (0.0, 2000.0),
        (10.0, 2000.0),
    ],
)
def test_motion_is_within_its_standard_deviations_with_any_walk(walk):
    trial = simulate(
        parse_scenario(yaml.safe_load((CONFIGS / "seed-a-phase-90.yaml").read_text())), 0
    )
    solution = solve(faults.with_faults(trial, [faults.imu_bias_walk(*walk)], 0), rate_hz=1.0)
    assert len(of_walks(solution)) == sum(w > 0.0 for w in walk)
    assert np.abs(errors(solution, trial)).max() < 4.0


def test_a_bias_that_changes_at_once_is_a_walk_before_anything_else():
    """It took the place of noise that persists, of gross errors and of noise of every sensor."""
    plan = yaml.safe_load((CONFIGS / "seed-a-phase-90.yaml").read_text(encoding="utf-8"))
    trial = simulate(parse_scenario(plan), 0)
    fault = faults.imu_bias_step((5.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.4)
    solution = solve(faults.with_faults(trial, [fault]), rate_hz=1.0)
    assert [step.change for step in solution.steps][:2] == ["start", "walks of biases"]
    assert solution.verdict.grade == "doubtful"
    first = solution.verdict.reasons[0]
    assert (first.code, first.parameter) == (Code.ESTIMATED_INSTEAD, "gyro_bias_deg_h")
    motion = trajectory_errors(solution, trial.reference)
    assert np.abs(motion.attitude.normalised).max() < 5.0
