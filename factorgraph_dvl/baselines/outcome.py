"""What a calibrator finds: estimates, their history, and how it ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.rotations import (
    exp_so3,
    inverse_right_jacobian,
    reported_rotation_vector,
    right_jacobian,
)
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.sensors.parameters import Parameter

# Chosen: rows of a history, as many as a figure can show.
_ROWS = 2000


@dataclass(frozen=True)
class History:
    """How a recursive filter converged.

    Parameters
    ----------
    time : ndarray, shape (H,), s
        Times on the clock of the IMU.
    names : tuple of str
        Names of the n components, as in `covariance.order`.
    values, std : ndarray, shape (H, n)
        Values and standard deviations in reported units.
    """

    time: Array
    names: tuple[str, ...]
    values: Array
    std: Array


@dataclass(frozen=True)
class Estimated:
    """Calibration parameters with their joint covariance, SI.

    Parameters
    ----------
    parameters : tuple of Parameter
        Parameters with their priors.
    values : tuple of ndarray
        Values of each parameter, (n,); a rotation as its matrix.
    covariance : ndarray
        Joint, stacked; of a rotation R, of delta in R Exp(delta).
    """

    parameters: tuple[Parameter, ...]
    values: tuple[Array, ...]
    covariance: Array

    def value(self, stem: str, default: Array) -> Array:
        """Return the value of a parameter, or `default` where it was not estimated."""
        stems = [p.stem for p in self.parameters]
        return self.values[stems.index(stem)] if stem in stems else default

    def reported(self) -> tuple[Array, Array]:
        """Return all components and their covariance, in reported parametrisation and units."""
        values, blocks = [], []
        for p, value in zip(self.parameters, self.values, strict=True):
            derivative = np.eye(p.mean.size)
            if p.rotation:
                value = reported_rotation_vector(value, p.mean)
                derivative = inverse_right_jacobian(value)
            values.append(value / p.si)
            blocks.append(derivative / p.si)
        size = self.covariance.shape[0]
        J, at = np.zeros((size, size)), 0
        for block in blocks:
            J[at : at + len(block), at : at + len(block)] = block
            at += len(block)
        covariance = J @ self.covariance @ J.T
        known = np.concatenate([p.sigma == 0.0 for p in self.parameters])
        covariance[known] = covariance[:, known] = 0.0
        return np.concatenate(values), covariance


@dataclass(frozen=True)
class Outcome:
    """What a calibrator found.

    Parameters
    ----------
    estimated : Estimated
        Estimates at the end.
    iterations : int
        Passes over the data, or rotations of them.
    history : tuple of tuple of (float, Estimated), optional
        Time and estimate after some of the pings; empty for closed forms.
    findings : tuple of Finding, optional
        Findings for the user.
    unseparated : frozenset of str, optional
        Component names that the data alone do not separate.
    converged : bool, optional
        Whether the method reached its end.
    """

    estimated: Estimated
    iterations: int
    history: tuple[tuple[float, Estimated], ...] = ()
    findings: tuple[Finding, ...] = ()
    unseparated: frozenset[str] = frozenset()
    converged: bool = True


def prior_of(parameters: Sequence[Parameter]) -> Estimated:
    """Return the priors as if they were estimates."""
    values, blocks = [], []
    for p in parameters:
        values.append(exp_so3(p.mean) if p.rotation else p.mean)
        J = right_jacobian(p.mean) if p.rotation else np.eye(p.mean.size)
        blocks.append(J @ np.diag(p.sigma**2) @ J.T)
    size = sum(len(b) for b in blocks)
    covariance, at = np.zeros((size, size)), 0
    for block in blocks:
        covariance[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return Estimated(tuple(parameters), tuple(values), covariance)


def history_rows(count: int) -> np.ndarray:
    """Return which of `count` pings a history keeps: the first, the last, some between."""
    if count == 0:
        return np.zeros(0, dtype=int)
    return np.unique(np.linspace(0, count - 1, min(count, _ROWS)).round().astype(int))


def history_of(outcome: Outcome) -> History | None:
    """Return the history of a calibrator in reported units, None if it is not recursive."""
    if not outcome.history:
        return None
    reported = [estimated.reported() for _, estimated in outcome.history]
    names = tuple(n for p in outcome.estimated.parameters for n in p.component_names)
    return History(
        time=np.array([time for time, _ in outcome.history]),
        names=names,
        values=np.stack([values for values, _ in reported]),
        std=np.stack([np.sqrt(np.maximum(np.diag(P), 0.0)) for _, P in reported]),
    )
