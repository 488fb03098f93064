"""Calibration parameters: what they are, and what is known of them before a trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.unit_vectors import turns_to
from factorgraph_dvl.geometry.vectors import Array

# Rounding may leave a correlation matrix with an eigenvalue this far below zero.
_NEGATIVE = 1e-6


@dataclass(frozen=True)
class JointPrior:
    """What an earlier calibration knows of several parameters together.

    Parameters
    ----------
    source : str
        Name of the file, for messages.
    values : mapping of str to ndarray, shape (n,)
        By reported name, in reported units.
    covariance : ndarray, shape (N, N)
        Of all their components, in the order of `values`, in reported units.
    inputs : tuple of str, optional
        Fingerprints of the data that it came from.

    Raises
    ------
    DataError
        If a number is not finite, or the covariance is not one.
    """

    source: str
    values: Mapping[str, Array]
    covariance: Array
    inputs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, value in self.values.items():
            if not np.isfinite(value).all():
                raise DataError(f"{name} is not a number", where=self.source)
        P = self.covariance
        size = sum(value.size for value in self.values.values())
        std = np.sqrt(np.maximum(np.diag(P), 0.0)) if P.ndim == 2 else np.zeros(0)
        scale = np.where(std > 0.0, std, 1.0)
        correct = P.shape == (size, size) and bool(np.isfinite(P).all())
        if correct:
            correlation = P / np.outer(scale, scale)
            lowest = np.linalg.eigvalsh(0.5 * (correlation + correlation.T))[0] if size else 0.0
            symmetric = np.allclose(correlation, correlation.T, atol=1e-6)
            correct = symmetric and lowest > -_NEGATIVE and bool(np.all(np.diag(P) >= 0.0))
        if not correct:
            raise DataError(
                "the covariance is not one",
                where=self.source,
                expected="a symmetric matrix of finite numbers, without negative eigenvalues",
            )

    def rows(self, name: str) -> slice:
        """Return the place of a parameter's components in the covariance."""
        at = 0
        for other, value in self.values.items():
            if other == name:
                return slice(at, at + value.size)
            at += value.size
        raise KeyError(name)

    def std(self, name: str) -> Array:
        """Return the standard deviations of a parameter, in reported units."""
        rows = self.rows(name)
        return np.asarray(np.sqrt(np.diag(self.covariance)[rows]))


@dataclass(frozen=True)
class Parameter:
    """A constant of a sensor that the solver estimates, with its prior.

    Parameters
    ----------
    stem, unit : str
        Reported name without unit, and the unit (empty if dimensionless).
    si : float
        SI value of one reported unit.
    mean, sigma : ndarray, shape (n,)
        Prior mean and standard deviation, SI. A component with sigma 0 is held at its mean.
    rotation : bool, optional
        The value is a rotation, `mean` its rotation vector and `sigma` that of the components of
        the rotation vector.
    labels : tuple of str, optional
        Component names; empty for a scalar.
    joint : JointPrior, optional
        Where mean and sigma come from a calibration of several parameters: all of it.
    nominal : ndarray, shape (N, 3), optional
        Unit vectors in body, if the parameter is N directions: the components then turn them, two
        each (`directions`). Files hold the directions.
    """

    stem: str
    unit: str
    si: float
    mean: Array
    sigma: Array
    rotation: bool = False
    labels: tuple[str, ...] = ("x", "y", "z")
    joint: JointPrior | None = None
    nominal: Array | None = None

    @cached_property
    def name(self) -> str:
        """Name in calibration.json, with the unit, or the frame of directions."""
        if self.nominal is not None:
            return f"{self.stem}_b"
        return f"{self.stem}_{self.unit}" if self.unit else self.stem

    def internal(self, reported: Array) -> Array:
        """Return a value as solvers hold it: SI, a rotation's matrix, turns of directions."""
        if self.nominal is not None:
            return turns_to(self.nominal, reported.reshape(-1, 3)).ravel()
        value = reported * self.si + 0.0 * self.mean
        return exp_so3(value) if self.rotation else value

    @cached_property
    def component_names(self) -> tuple[str, ...]:
        """Names of the components as in `covariance.order`."""
        parts = [(self.stem, label) if label else (self.stem,) for label in self.labels]
        tail = (self.unit,) if self.unit else ()
        return tuple("_".join((*part, *tail)) for part in parts)

    @cached_property
    def estimated(self) -> bool:
        """Whether any component is free."""
        return bool(np.any(self.sigma > 0.0))
