"""Half an hour below after a DVL calibration, with one beacon: whether the drift is bounded.

    pytest -m slow tests/test_beacon_dive.py

FACTORGRAPH_DVL_SEEDS sets the number of dives, 3 by default.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from truth import config

from factorgraph_dvl.analysis.error_statistics import nees_band, trajectory_errors
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve

SEEDS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "3"))
# GNSS ends, s.
SUBMERGED = 560.0


def below(trial):
    solution = solve(trial, rate_hz=1.0)
    assert solution.converged
    errors = trajectory_errors(solution, trial.reference)
    dive = errors.time > SUBMERGED
    p = errors.position
    return p.error[dive, :2], p.std[dive, :2], solution


@pytest.mark.slow
def test_one_beacon_bounds_the_drift_and_the_position_is_as_good_as_it_says():
    inside, ends, drift = [], [], []
    for seed in range(SEEDS):
        trial = simulate(config("dive-one-beacon"), seed)
        error, std, solution = below(trial)
        P = solution.trajectory.position_cov[-1, :2, :2]
        inside.append((np.abs(error) <= 2.0 * std).mean(axis=0))
        ends.append(error[-1] @ np.linalg.solve(P, error[-1]))
        drift.append(std.max())
        assert any(r.label == "Beacon B1 range" for r in solution.rejected)
        print(seed, inside[-1].round(3), f"{ends[-1]:.2f} {drift[-1]:.2f} m", flush=True)
    print(np.mean(inside, axis=0), np.mean(ends), np.max(drift))
    low, high = nees_band(2, SEEDS, level=0.997)
    assert low < np.mean(ends) < high
    # The epochs of a dive are nearly one.
    assert np.mean(inside) > 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / (2.0 * SEEDS))
    others = tuple(aid for aid in trial.others if not isinstance(aid, Beacons))
    _, without, _ = below(replace(trial, others=others))
    assert max(drift) < 0.25 * without.max()
