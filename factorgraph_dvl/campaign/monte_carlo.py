"""Many seeds of one scenario, each simulated and solved; NEES, coverage, with bands of chance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time

import msgspec
import numpy as np
from scipy.special import bdtrik, chdtri, ndtr

from factorgraph_dvl.analysis.error_statistics import calibration_errors
from factorgraph_dvl.campaign.record import RunRecord, fingerprint_of, read_record, write_record
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve

# Chosen: probability with which an honest statistic lies inside its band.
BAND = 0.99
# Standard deviations of which the coverage is counted.
SIGMAS = (1.0, 2.0, 3.0)


@dataclass(frozen=True)
class Statistic:
    """A statistic with the band in which it lies by chance.

    Parameters
    ----------
    name : str
        What it is of.
    value, expected, low, high : float
        Measured, expected, and the band.
    """

    name: str
    value: float
    expected: float
    low: float
    high: float

    @property
    def inside(self) -> bool:
        """Whether it is in its band."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True)
class MonteCarlo:
    """Statistics of the seeds that were solved.

    Parameters
    ----------
    runs : int
        Seeds with a result.
    names : tuple of str
        Components that are known in all of them.
    nees : Statistic
        Mean normalised estimation error squared of all components together.
    ratio : tuple of Statistic
        Root mean square of error over σ, by component.
    coverage : tuple of Statistic
        Share of errors of all components within 1, 2 and 3 σ; the components are taken as
        independent in the bands.
    rms : tuple of float
        Root mean square error, by component, in reported units.
    """

    runs: int
    names: tuple[str, ...]
    nees: Statistic
    ratio: tuple[Statistic, ...]
    coverage: tuple[Statistic, ...]
    rms: tuple[float, ...]


def monte_carlo(records: Sequence[SeedRecord]) -> MonteCarlo | None:
    """Return the statistics of seeds; None if none was solved.

    Parameters
    ----------
    records : sequence of SeedRecord
        Records of the seeds.
    """
    solved = [r for r in records if r.done and r.names]
    if not solved:
        return None
    common = set.intersection(*(set(r.names) for r in solved))
    names = tuple(n for n in solved[0].names if n in common)
    errors, normalised, nees = [], [], []
    for r in solved:
        at = [r.names.index(n) for n in names]
        error, P = np.array(r.deviation)[at], np.array(r.covariance)[np.ix_(at, at)]
        std = np.sqrt(np.diag(P))
        z = error / std
        errors.append(error)
        normalised.append(z)
        nees.append(float(z @ np.linalg.solve(P / np.outer(std, std), z)))
    runs, size = len(solved), len(names)
    z = np.array(normalised)
    low, high = _chi_square_band(runs * size)
    ratio_low, ratio_high = np.sqrt(np.array(_chi_square_band(runs)) / runs)
    rms = np.sqrt(np.mean(z**2, axis=0))
    return MonteCarlo(
        runs=runs,
        names=names,
        nees=Statistic("NEES", float(np.mean(nees)), float(size), low / runs, high / runs),
        ratio=tuple(
            Statistic(n, float(v), 1.0, float(ratio_low), float(ratio_high))
            for n, v in zip(names, rms, strict=True)
        ),
        coverage=tuple(_coverage(np.abs(z), k) for k in SIGMAS),
        rms=tuple(np.sqrt(np.mean(np.square(errors), axis=0)).tolist()),
    )


def _chi_square_band(freedom: int) -> tuple[float, float]:
    tail = 0.5 * (1.0 - BAND)
    return float(chdtri(freedom, 1.0 - tail)), float(chdtri(freedom, tail))


def _coverage(z: Array, sigmas: float) -> Statistic:
    expected = 1.0 - 2.0 * float(ndtr(-sigmas))
    tail = 0.5 * (1.0 - BAND)
    low, high = (float(np.ceil(bdtrik(p, z.size, expected))) for p in (tail, 1.0 - tail))
    share = float(np.mean(z <= sigmas))
    return Statistic(f"within {sigmas:g} σ", share, expected, low / z.size, high / z.size)


SEEDS_FOLDER = "seeds"


class SeedRecord(RunRecord, kw_only=True):
    """Errors of the calibration of one seed, in reported units.

    Parameters
    ----------
    names : list of str
        Names of the n components whose truth is known and that the data determine.
    deviation : list of float
        Estimate less truth, (n,), without what the prior pulls.
    covariance : list of list of float
        Covariance of the deviation, (n, n).
    grade : str
        Grade of the verdict.
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
