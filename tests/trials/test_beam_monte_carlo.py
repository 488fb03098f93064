"""Whether the covariance of single beams is honest: seeds of the turntable calibration.

    pytest -m slow tests/test_beam_monte_carlo.py

runs 20 seeds; FACTORGRAPH_DVL_SEEDS runs another number, with bands for that number.
"""

from __future__ import annotations

import os

import numpy as np
import pytest
from beam_statistics import nees_of
from truth import CONFIGS

from factorgraph_dvl.analysis.error_statistics import nees_band
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve

pytestmark = pytest.mark.slow

RUNS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "20"))


def test_errors_of_beams_are_as_large_as_stated():
    nees = []
    for seed in range(RUNS):
        trial = simulate(CONFIGS / "beams-turntable.yaml", seed)
        solution = solve(trial, rate_hz=1.0)
        assert solution.converged
        # Errors were drawn up to 1 deg and 1 %.
        assert solution.estimate("beam_direction_b").std.max() <= 0.02
        found, dof = nees_of(solution, trial.calibration_truth)
        assert dof == 15
        nees.append(found)
    low, high = nees_band(15, RUNS, 0.997)
    assert low < np.mean(nees) < high
