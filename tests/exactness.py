"""How close results are: of noiseless trials to the truth, of covariances to each other."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.analysis.error_statistics import calibration_errors, trajectory_errors

INITIAL = {"initial": {"attitude_std_deg": [0.5, 0.5, 0.5], "position_std_m": [1, 1, 1]}}


def pull(solution, truth):
    """Return the errors and what the priors explain of them, both over sigma.

    Without noise an estimate is P L (x0 - x) away from the truth x: the prior x0, of
    information L, against the data.
    """
    errors = calibration_errors(solution, truth)
    prior = np.concatenate([e.prior_value for e in solution.estimates])
    sigma = np.concatenate([e.prior_std for e in solution.estimates])
    keep = errors.std > 0.0
    away = (errors.truth - prior)[keep] / sigma[keep] ** 2
    P = errors.covariance[np.ix_(keep, keep)]
    return errors.error[keep] / errors.std[keep], -(P @ away) / errors.std[keep]


def assert_exact(trial, solution, *, limit=0.05, trajectory=0.05):
    assert solution.converged
    found, explained = pull(solution, trial.calibration_truth)
    assert np.abs(found - explained).max() < limit
    errors = trajectory_errors(solution, trial.reference)
    assert errors.time.size == solution.trajectory.time.size
    for vector in (errors.position, errors.velocity, errors.attitude):
        assert np.sqrt(np.mean(vector.normalised**2)) < trajectory


def worst_relative(found, expected):
    """Largest difference in units of the standard deviations."""
    std = np.sqrt(np.diag(expected))
    return float(np.abs((found - expected) / np.outer(std, std)).max())
