"""Whether a plan's prediction comes true: its σ against the scatter of solved seeds.

    pytest -m slow tests/test_plan_monte_carlo.py

solves 10 seeds of each sway phase; FACTORGRAPH_DVL_SEEDS another number, with the χ² band
for that number. With 50 the band is 0.7 to 1.3.
"""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from monte_carlo import DVL, columns, one, rms, rms_band, without_pull
from truth import config

from factorgraph_dvl.planning import predict

pytestmark = pytest.mark.slow

RUNS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "10"))


@pytest.mark.parametrize("name", ["seed-a-phase-0", "seed-a-phase-90"])
def test_predicted_standard_deviations_come_true(name, monkeypatch):
    # One thread each: the two workers share two cores.
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, context) as pool:
        runs = list(pool.map(one, [(name, seed) for seed in range(RUNS)]))
    predicted = predict(config(name)).solution
    assert predicted.order == runs[0].names
    std = np.sqrt(np.diag(predicted.covariance))
    low, high = rms_band(RUNS)

    # The scenario's DVL has no prior to speak of.
    index = columns(runs, DVL)
    ratio = rms(np.array([r.error for r in runs]) / std)[index]
    found = dict(zip(DVL, ratio.round(3), strict=True))
    print(f"\n{name}, {RUNS} seeds: RMS error / predicted σ {found}, band {low:.2f} to {high:.2f}")
    assert np.all((ratio > low) & (ratio < high)), found
    # Biases have one, and the truth is not drawn from it: without its pull.
    z = []
    for run in runs:
        error, covariance = without_pull(replace(run, covariance=predicted.covariance))
        z.append(error / np.sqrt(np.diag(covariance)))
    ratio = rms(np.array(z))
    found = dict(zip(predicted.order, ratio.round(3), strict=True))
    print(f"without the prior's pull {found}")
    assert np.all((ratio > low) & (ratio < high)), found
