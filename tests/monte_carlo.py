"""Monte-Carlo runs of a scenario."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2
from truth import CONFIGS

from factorgraph_dvl.analysis.error_statistics import (
    calibration_errors,
    paper_accuracy,
    trajectory_errors,
)
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve

RUNS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "50"))


# Two-sided probability that a statistic of an honest filter leaves its band: each file of
# scenarios makes some thirty of them.
_RARE = 0.003


DVL = (
    "misalignment_x_deg",
    "misalignment_y_deg",
    "misalignment_z_deg",
    "scale_error",
    "lever_arm_x_m",
    "lever_arm_y_m",
    "lever_arm_z_m",
)


def nees_of(solution, trial, names=DVL):
    """Return the NEES of some components of a solution's calibration."""
    errors = calibration_errors(solution, trial.calibration_truth)
    rows = [errors.names.index(name) for name in names]
    P = errors.covariance[np.ix_(rows, rows)]
    return float(errors.error[rows] @ np.linalg.solve(P, errors.error[rows]))


@dataclass(frozen=True)
class Run:
    """Of one seed: errors, covariance and prior of the calibration, mean squares over time."""

    names: tuple[str, ...]
    error: np.ndarray
    covariance: np.ndarray
    prior_away: np.ndarray
    prior_sigma: np.ndarray
    accuracy: float
    trajectory: np.ndarray
    trajectory_nees: np.ndarray
    converged: bool


def one(job):
    config, seed = job
    trial = simulate(CONFIGS / f"{config}.yaml", seed)
    solution = solve(trial)
    errors = calibration_errors(solution, trial.calibration_truth)
    assert errors.names == solution.order
    motion = trajectory_errors(solution, trial.reference)
    vectors = (motion.position, motion.velocity, motion.attitude)
    return Run(
        names=errors.names,
        error=errors.error,
        covariance=errors.covariance,
        prior_away=errors.truth - np.concatenate([e.prior_value for e in solution.estimates]),
        prior_sigma=np.concatenate([e.prior_std for e in solution.estimates]),
        accuracy=paper_accuracy(solution.estimates, trial.calibration_truth),
        trajectory=np.stack([np.mean(v.normalised**2, axis=0) for v in vectors]),
        trajectory_nees=np.array([v.nees.mean() for v in vectors]),
        converged=solution.converged,
    )


def rms_band(dof):
    """Band of the root mean square of `dof` independent normalised errors."""
    return tuple(np.sqrt(chi2.ppf([_RARE / 2.0, 1.0 - _RARE / 2.0], dof) / dof))


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


def columns(runs, names):
    return [runs[0].names.index(name) for name in names]


def without_pull(run):
    """Return the error that noise makes, and its covariance.

    An estimate is drawn from the truth x towards its prior x0: the mean of its error is
    -P L (x - x0) with the prior's information L, and P - P L P the covariance around it. A
    truth that is not drawn from the prior shows that pull, seed after seed.
    """
    P = run.covariance
    with np.errstate(divide="ignore"):
        information = np.where(run.prior_sigma > 0.0, 1.0 / run.prior_sigma**2, 0.0)
    gain = P * information
    return run.error + gain @ run.prior_away, P - gain @ P
