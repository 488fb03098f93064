"""Errors as data sheets have them, all at once: standard deviations hold."""

from __future__ import annotations

import numpy as np
import pytest
from monte_carlo import DVL, RUNS, columns, one, rms
from scipy.stats import chi2
from workers import in_two_processes

pytestmark = pytest.mark.slow

# Two-sided probability that a mean of an honest solver leaves its band; each grade has one.
_RARE = 0.003


@pytest.fixture(scope="module", params=["navigation", "tactical", "mems"])
def runs(request):
    jobs = [(f"data-sheet-mix-{request.param}", seed) for seed in range(RUNS)]
    return in_two_processes(one, jobs)


def test_standard_deviations_hold(runs):
    own = columns(runs, DVL)
    errors = np.array([run.error[own] for run in runs])
    P = np.array([run.covariance[np.ix_(own, own)] for run in runs])
    nees = np.einsum("ri,rij,rj->r", errors, np.linalg.inv(P), errors)
    freedom = len(DVL) * len(runs)
    low, high = chi2.ppf([_RARE / 2.0, 1.0 - _RARE / 2.0], freedom) / freedom
    assert low < nees.mean() / len(DVL) < high
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert np.all(rms(errors / sigma) < np.sqrt(chi2.ppf(1.0 - 1e-4, len(runs)) / len(runs)))


def test_all_converge(runs):
    assert all(run.converged for run in runs)
