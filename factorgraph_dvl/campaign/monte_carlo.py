"""Statistics of many seeds of one scenario: NEES, error over σ, coverage, with bands of chance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import bdtrik, chdtri, ndtr

from factorgraph_dvl.campaign.seed_run import SeedRecord
from factorgraph_dvl.geometry.vectors import Array

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
        Of the seeds.
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
