"""Several minima of short trials, and the evidence for each."""

from __future__ import annotations

import os
from types import SimpleNamespace

import numpy as np
import pytest
from truth import scenario

from factorgraph_dvl.analysis.error_statistics import calibration_errors
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers import minima
from factorgraph_dvl.solvers.batch import solve

SEEDS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "20"))


def test_a_ping_counts_as_evidence_by_any_of_its_beams():
    residual = np.array([[0.0, 3.0, 4.0], [0.0, 0.0, 0.0]])
    problem = SimpleNamespace(
        log_sigma=lambda _: [np.array([3.0, 2.0])],
    )
    minimum = SimpleNamespace(evaluation=SimpleNamespace(residuals=[residual], cost=20.0))
    terms = minima.cost_terms(SimpleNamespace(problem=problem, minimum=minimum))
    np.testing.assert_allclose(terms, [15.5, 2.0, 7.5])


@pytest.mark.parametrize(("mounting", "seed"), [([180, 0, 0], 1), ([180, 0, 0], 6)])
def test_two_seconds_lead_to_no_mirrored_mounting(mounting, seed):
    turn = [{"turn_deg_s": 6, "duration_s": 2, "ramp_s": 0.5}]
    scene = scenario(noise=True, manoeuvres=turn, dvl={"misalignment_deg": mounting})
    trial = simulate(scene, seed)
    solution = solve(trial, rate_hz=1.0)
    errors = calibration_errors(solution, trial.calibration_truth)
    seen = np.concatenate([e.observable for e in solution.estimates])
    assert np.all(np.abs(errors.error[seen]) < 5.0 * errors.std[seen])


MOTIONS = {
    "turn": lambda s: [{"turn_deg_s": 6, "duration_s": s, "ramp_s": 0.5}],
    "straight": lambda s: [{"straight_s": s}],
    "accelerate": lambda s: [
        {"accelerate_m_s2": 0.1, "to_m_s": 4 + 0.06 * s},
        {"straight_s": 0.4 * s},
    ],
}
MOUNTINGS = ([180, 0, 0], [0, 0, 135], [2, 2, 30])


def normalised(length, motion, seed):
    """Return the largest error of what was observable, in σ."""
    mounting = {"misalignment_deg": MOUNTINGS[seed % len(MOUNTINGS)]}
    scene = scenario(noise=True, manoeuvres=MOTIONS[motion](length), dvl=mounting)
    trial = simulate(scene, seed)
    solution = solve(trial, rate_hz=1.0)
    errors = calibration_errors(solution, trial.calibration_truth)
    observable = {
        name: seen
        for e in solution.estimates
        for name, seen in zip(e.component_names, e.observable, strict=True)
    }
    # A window that chance shows has no true length.
    seen = np.array([observable[name] for name in errors.names])
    return float(np.max(np.abs(errors.error / errors.std)[seen], initial=0.0))


@pytest.mark.slow
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("length", [2, 5, 10, 30, 60])
def test_what_is_observable_in_a_short_trial_is_right(length, motion):
    largest = [normalised(length, motion, seed) for seed in range(SEEDS)]
    print(length, motion, np.round(largest, 1), flush=True)
    assert max(largest) < 5.0
