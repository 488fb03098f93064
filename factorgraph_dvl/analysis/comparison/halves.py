"""The halves of a trial, and the calibration of one against that of the other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc

from factorgraph_dvl.analysis.comparison.calibration_difference import same_branch
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.plausibility.earlier_calibration import CONTRADICTED_P, DOUBTFUL_P
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.parameters import JointPrior
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import Trial

# Share of the sum of both variances that is left in that of the difference where the data of a
# half are informative. Chosen: far above rounding.
_LEAST_SHARE = 1e-4


@dataclass(frozen=True)
class Halves:
    """Two halves of a trial against each other.

    Parameters
    ----------
    names : tuple of str
        Names of the n components, as in `covariance.order`.
    first, second : ndarray, shape (n,)
        What each half says, in reported units.
    first_std, second_std : ndarray, shape (n,)
        Standard deviations of these.
    std : ndarray, shape (n,)
        Standard deviation of the difference; their common prior correlates the two.
    statistic : float
        Chi-square of all differences.
    freedom : int
        Its degrees of freedom.
    """

    names: tuple[str, ...]
    first: Array
    second: Array
    first_std: Array
    second_std: Array
    std: Array
    statistic: float
    freedom: int

    @property
    def difference(self) -> Array:
        """Second half - first half."""
        return self.second - self.first

    @property
    def probability(self) -> float:
        """Probability of a statistic as large by chance."""
        return float(chdtrc(self.freedom, self.statistic)) if self.freedom else 1.0

    def columns(self) -> dict[str, Any]:
        """Return the halves as a table."""
        return {
            "component": np.array(self.names),
            "first": self.first,
            "first_std": self.first_std,
            "second": self.second,
            "second_std": self.second_std,
            "difference": self.difference,
            "difference_std": self.std,
        }

    def findings(self) -> tuple[Finding, ...]:
        """Return a finding if the halves differ by more than chance."""
        p = self.probability
        if p >= DOUBTFUL_P:
            return ()
        i = int(np.argmax(np.abs(self.difference) / np.where(self.std > 0.0, self.std, np.inf)))
        text = message(
            "halves_differ.contradict",
            statistic=self.statistic,
            freedom=self.freedom,
            probability=p,
            name=self.names[i],
            change=self.difference[i],
            std=self.std[i],
        )
        return (
            Finding(
                Code.HALVES_DIFFER, text, severity="error" if p < CONTRADICTED_P else "warning"
            ),
        )


def halves_of(trial: Trial) -> tuple[Trial, Trial]:
    """Return a trial up to the middle of its IMU's record, and from there.

    What is known of the start is valid for the first half only.

    Raises
    ------
    ConfigError
        If the trial has no GNSS, so that nothing says where the second half starts.
    """
    if trial.gnss is None:
        raise ConfigError(
            "nothing says where the second half starts",
            where="--halves",
            expected="a trial with GNSS",
        )
    record = trial.body_sensor.time
    middle = 0.5 * float(record[0] + record[-1])
    first = trial.until(float(np.nextafter(middle, -np.inf)))
    second = trial.until(np.inf, since=middle)
    imu = second.imu
    if imu is not None:
        imu = replace(imu, prior=imu.prior_after(middle - float(record[0])))
    return first, replace(second, imu=imu, initial_attitude=None, initial_position=None)


def compare_halves(trial: Trial, first: Solution, second: Solution) -> Halves:
    """Return the difference of two halves, and its chi-square.

    With a common prior P0, var(x2 - x1) = P1 + P2 - P1 P0⁻¹ P2 - P2 P0⁻¹ P1: the error of the
    prior goes into each half as P P0⁻¹. Biases of the IMU are left out, which may change.

    Parameters
    ----------
    trial : Trial
        The whole, for its priors.
    first, second : Solution
        Solutions of its halves.
    """
    second = same_branch(second, first)
    prior = None if trial.dvl is None else trial.dvl.prior
    inertial = {spec.name for spec in Imu.specs}
    shared = {e.name for e in second.estimates} - inertial
    estimates = [e for e in first.estimates if e.name in shared]
    of_second = {e.name: e for e in second.estimates}
    names = [n for e in estimates for n in e.component_names]
    sigma = np.concatenate([np.zeros(0), *(e.prior_std for e in estimates)])
    P0 = np.diag(sigma**2)
    if prior is not None:
        P0 = _with_joint(P0, [(e.name, e.prior_std.size) for e in estimates], prior)
    free = np.flatnonzero(sigma > 0.0)
    before = np.concatenate([np.zeros(0), *(e.value for e in estimates)])[free]
    after = np.concatenate([np.zeros(0), *(of_second[e.name].value for e in estimates)])[free]
    names = [names[i] for i in free]
    P1, P2 = (_covariance(s, names) for s in (first, second))
    common = P1 @ np.linalg.pinv(P0[np.ix_(free, free)], hermitian=True) @ P2
    V = P1 + P2 - common - common.T
    # Where neither half is informative, both stay at the prior, and nothing is left of P1 + P2.
    scale = np.sqrt(np.diag(P1 + P2))
    root = scale[:, None] * np.linalg.cholesky((P1 + P2) / np.outer(scale, scale))
    share, directions = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, V).T))
    informed = share > _LEAST_SHARE
    along = directions.T @ np.linalg.solve(root, after - before)
    return Halves(
        tuple(names),
        before,
        after,
        np.sqrt(np.diag(P1)),
        np.sqrt(np.diag(P2)),
        np.sqrt(np.maximum(np.diag(V), 0.0)),
        float(np.sum(along[informed] ** 2 / share[informed])),
        int(informed.sum()),
    )


def _covariance(solution: Solution, names: list[str]) -> Array:
    order = solution.order
    rows = [order.index(name) for name in names]
    return solution.covariance[np.ix_(rows, rows)]


def _with_joint(P0: Array, sizes: list[tuple[str, int]], prior: JointPrior) -> Array:
    """Return a prior covariance with the block of an earlier calibration in it."""
    out, at = P0.copy(), 0
    own: list[int] = []
    earlier: list[int] = []
    for name, size in sizes:
        if name in prior.values:
            own += range(at, at + size)
            earlier += np.arange(len(prior.covariance))[prior.rows(name)].tolist()
        at += size
    out[np.ix_(own, own)] = prior.covariance[np.ix_(earlier, earlier)]
    return out
