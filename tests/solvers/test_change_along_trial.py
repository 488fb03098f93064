"""Changes along a trial without IMU: found where they are, and no honest trial is accused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import config

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve_with_problem
from factorgraph_dvl.solvers.calibration import reported
from factorgraph_dvl.solvers.change_along_trial import CHANGED, component_changes
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu
from factorgraph_dvl.solvers.rounds import settle
from factorgraph_dvl.statistics.constancy import by_interval
from factorgraph_dvl.statistics.rows import rows_by_source, rows_with_times

pytestmark = pytest.mark.slow

LINES = [
    {"straight_s": 80},
    {"turn_deg_s": 3, "duration_s": 40, "ramp_s": 5},
    {"straight_s": 80},
    {"turn_deg_s": -3, "duration_s": 40, "ramp_s": 5},
]
# Fixes that show a heading within minutes, a compass that does not swing, and clocks that agree.
ACCURATE = {
    "gnss": {"position_std_m": [0.1, 0.1, 0.2]},
    "attitude": {"schuler_rms_deg": 0},
    "trial": {
        "gnss": {"position_std_m": [0.07, 0.07, 0.14], "correlated_std_m": [0.07, 0.07, 0.14]},
        "attitude": {"time_offset_std_s": 0},
        "dvl": {"time_offset_std_s": 0},
    },
}


def most_probable_changes(trial):
    prepared = prepare_without_imu(trial)
    found = settle(prepared, prepared.states, lambda *_: None)
    minimum = found.minimum
    return component_changes(found.problem, minimum.evaluation, minimum.information)


def turned(trial, degrees, after):
    """Return a trial whose DVL turned in its mount at a time."""
    dvl = trial.dvl
    changed = dvl.velocity @ exp_so3(np.array([0.0, 0.0, degrees * DEG])).T
    velocity = np.where(dvl.time[:, None] > after, changed, dvl.velocity)
    return replace(trial, dvl=replace(dvl, velocity=velocity))


@pytest.mark.parametrize("seed", [1, 2])
def test_a_mount_that_turns_is_found(seed):
    trial = simulate(config("ship", manoeuvres=LINES * 2, **ACCURATE), seed)
    middle = float(np.mean(trial.dvl.time[[0, -1]]))
    found = max(most_probable_changes(turned(trial, 0.5, middle)), key=lambda t: t.change.fall)
    assert found.name == "misalignment_z_deg"
    assert found.change.significance > CHANGED
    assert found.change.time == pytest.approx(middle, abs=10.0)
    assert abs(found.change.size) == pytest.approx(0.5, abs=4.0 * found.change.std)


@pytest.mark.parametrize("seed", [1, 2])
def test_an_honest_mount_is_not_accused(seed):
    trial = simulate(config("ship", manoeuvres=LINES * 2, **ACCURATE), seed)
    assert max(t.change.significance for t in most_probable_changes(trial)) < CHANGED


def test_scores_of_all_times_are_the_slope_of_the_objective():
    """Where the rows of the motion had no times, a third of it was missing."""
    _, found = solve_with_problem(
        simulate(config("ship-water", manoeuvres=LINES * 3), 0), rate_hz=1.0
    )
    problem, evaluation = found.problem, found.minimum.evaluation
    (functional,) = (by for p, _, by in reported(problem, evaluation) if p.name == "scale_error")
    information = found.covariances.information
    following = information.covariance_with([functional])
    rows = rows_with_times(problem, rows_by_source(problem, evaluation))
    score, _ = by_interval(rows, following, np.zeros(0))
    along = sum(
        following[problem.key(name)].T @ problem.tilt.gradient[own]
        for name, own in problem.columns.items()
    )
    # Priors are wide.
    assert abs(along[0]) > 0.3 * np.sqrt(information.covariance_of([functional])[0, 0])
    np.testing.assert_allclose(score[0], along, rtol=0.02)
