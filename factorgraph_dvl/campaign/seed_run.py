"""One seed of a Monte-Carlo campaign: simulated, solved, compared with the truth."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter, process_time

import msgspec
import numpy as np

from factorgraph_dvl.analysis.error_statistics import calibration_errors
from factorgraph_dvl.campaign.record import (
    RunRecord,
    fingerprint_of,
    read_record,
    write_record,
)
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve

SEEDS_FOLDER = "seeds"


class SeedRecord(RunRecord, kw_only=True):
    """Errors of the calibration of one seed, in reported units.

    Parameters
    ----------
    names : list of str
        Of the n components whose truth is known and that the data determine.
    deviation : list of float
        Estimate less truth, (n,), without what the prior pulls.
    covariance : list of list of float
        Of the deviation, (n, n).
    grade : str
        Of the verdict.
    """

    names: list[str] = msgspec.field(default_factory=list)
    deviation: list[float] = msgspec.field(default_factory=list)
    covariance: list[list[float]] = msgspec.field(default_factory=list)
    grade: str = ""


def run_seed(scenario: str, seed: int, out: str) -> SeedRecord:
    """Simulate and solve a scenario with one seed, unless that is done already.

    Parameters
    ----------
    scenario : str
        Path of the scenario, absolute.
    seed : int
        Random seed.
    out : str
        Folder of the campaign, absolute.
    """
    file = Path(out) / SEEDS_FOLDER / f"{seed}.json"
    fingerprint = fingerprint_of([Path(scenario)], {"seed": str(seed)})
    earlier = read_record(file, SeedRecord)
    if earlier is not None and earlier.done and earlier.fingerprint == fingerprint:
        return earlier
    start, cpu = perf_counter(), process_time()
    trial = simulate(scenario, seed)
    solution = solve(trial)
    errors = calibration_errors(solution, trial.calibration_truth)
    priors = {
        name: (prior, std)
        for e in solution.estimates
        for name, prior, std in zip(e.component_names, e.prior_value, e.prior_std, strict=True)
    }
    known = np.array([priors[name] for name in errors.names]).reshape(-1, 2)
    deviation, covariance = errors.without_pull(known[:, 0], known[:, 1])
    used = errors.tested
    record = SeedRecord(
        name=str(seed),
        fingerprint=fingerprint,
        done=solution.converged,
        error="" if solution.converged else "the solver did not converge",
        wall_s=perf_counter() - start,
        cpu_s=process_time() - cpu,
        names=[n for n, u in zip(errors.names, used, strict=True) if u],
        deviation=deviation[used].tolist(),
        covariance=covariance[np.ix_(used, used)].tolist(),
        grade=solution.verdict.grade,
    )
    write_record(record, file)
    return record
