"""Calibration parameters: what they are, and what is known of them before a trial."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.unit_vectors import turns_to
from factorgraph_dvl.geometry.units import DEG, DEG_PER_HOUR, HOUR, MICRO_G, PPM, STANDARD_GRAVITY
from factorgraph_dvl.geometry.vectors import Array

# Rounding may leave a correlation matrix with an eigenvalue this far below zero.
_NEGATIVE = 1e-6


XYZ = ("x", "y", "z")
SCALAR = ("",)

Kind = Literal["vector", "angle", "rotation", "directions"]
Frame = Literal["b", "d", "n", ""]


class Unit(NamedTuple):
    """SI value of a unit, and how it is shown to people."""

    si: float
    text: str


# Units of parameters, as their names state them.
UNITS = {
    "": Unit(1.0, ""),
    "deg": Unit(DEG, "deg"),
    "deg_h": Unit(DEG_PER_HOUR, "deg/h"),
    "deg_h_g": Unit(DEG_PER_HOUR / STANDARD_GRAVITY, "deg/h/g"),
    "ug": Unit(MICRO_G, "µg"),
    "m": Unit(1.0, "m"),
    "m_s": Unit(1.0, "m/s"),
    "s": Unit(1.0, "s"),
    "ppm": Unit(PPM, "ppm"),
    "s_m": Unit(1.0, "s/m"),
    "deg_s_m": Unit(DEG, "deg s/m"),
    "1_km": Unit(1e-3, "1/km"),
    "1_h": Unit(1.0 / HOUR, "1/h"),
}


@dataclass(frozen=True)
class ParameterSpec:
    """What a calibration parameter is: its names, unit, frame, and place in reports.

    Parameters
    ----------
    stem : str
        Name without unit.
    unit : str, optional
        One of `UNITS`.
    labels : tuple of str, optional
        Labels of the n components, `SCALAR` for a number.
    kind : Kind, optional
        How the components are to be understood: as they are, as angles, which are the same after
        a full turn, as a rotation vector, or as turns of unit vectors, two each.
    frame : Frame, optional
        Axes of the components: body, DVL, or east, north, up; empty if there are none.
    place : int, optional
        Place in reports. One without is reported after the others, and only if it was estimated.
    limit : float, optional
        Standard deviation that is good enough, unless a trial states another, in `unit`.
    above : float, optional
        Every component is above this, in `unit`.
    nuisance : bool, default False
        Whether it is estimated only for the sake of the others: it makes no
        warning where the data do not determine it.
    plausible : float, optional
        Standard deviation of values that there can be, in `unit`. Where a trial states that the
        parameter is known, tests ask whether another value would explain a misfit.
    usual : bool, default False
        Whether most sensors have it although trials do not state it: a length, above zero.
    of_record : bool, default False
        Whether it changes one record only, and no motion: the rows of that record test it.
    searched : bool, default False
        Whether a search finds when it counts, as where it is zero for most of a trial.
    key : str, optional
        Section and key of trial.yaml with its standard deviation, such as `dvl: bias_std_m_s`.
    """

    stem: str
    unit: str = ""
    labels: tuple[str, ...] = XYZ
    kind: Kind = "vector"
    frame: Frame = ""
    place: int | None = None
    limit: float | None = None
    above: float = -math.inf
    nuisance: bool = False
    plausible: float | None = None
    usual: bool = False
    of_record: bool = False
    searched: bool = False
    key: str = ""

    @cached_property
    def name(self) -> str:
        """Name in calibration.json, with the unit, or the frame of directions."""
        tail = self.frame if self.kind == "directions" else self.unit
        return f"{self.stem}_{tail}" if tail else self.stem

    @cached_property
    def component_names(self) -> tuple[str, ...]:
        """Names of the components as in `covariance.order`."""
        return tuple(
            "_".join(part for part in (self.stem, label, self.unit) if part)
            for label in self.labels
        )

    @cached_property
    def si(self) -> float:
        """SI value of one reported unit."""
        return UNITS[self.unit].si

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.labels)


@dataclass(frozen=True)
class JointPrior:
    """What an earlier calibration knows of several parameters together.

    Parameters
    ----------
    source : str
        Name of the file, for messages.
    values : mapping of str to ndarray, shape (n,)
        Values by reported name, in reported units.
    covariance : ndarray, shape (N, N)
        Covariances of all their components, in the order of `values`, in reported units.
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
            with np.errstate(over="ignore", under="ignore", divide="ignore", invalid="ignore"):
                correlation = P / np.outer(scale, scale)
            correct = bool(np.isfinite(correlation).all())
        if correct:
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
class Relative:
    """The prior of a parameter relative to another one, of one component each.

    Parameters
    ----------
    to : str
        Name of the other parameter.
    sigma : float, SI
        Standard deviation of the difference.
    """

    to: str
    sigma: float


@dataclass(frozen=True)
class Parameter:
    """A constant of a sensor that the solver estimates, with its prior.

    Parameters
    ----------
    spec : ParameterSpec
        What it is.
    mean, sigma : ndarray, shape (n,)
        Prior mean and standard deviation, SI. A component with sigma 0 is fixed at its mean. Of a
        rotation, `mean` is the rotation vector and `sigma` that of its components.
    joint : JointPrior, optional
        The calibration of several parameters that mean and sigma come from.
    relative : Relative, optional
        What its prior is relative to: another parameter.
    nominal : ndarray, shape (N, 3), optional
        Nominal directions: unit vectors in body, which the components turn, two each. Files
        contain the directions.
    """

    spec: ParameterSpec
    mean: Array
    sigma: Array
    joint: JointPrior | None = None
    relative: Relative | None = None
    nominal: Array | None = None

    @cached_property
    def name(self) -> str:
        """Name in calibration.json."""
        return self.spec.name

    @property
    def stem(self) -> str:
        """Name without the unit."""
        return self.spec.stem

    @property
    def component_names(self) -> tuple[str, ...]:
        """Names of the components as in `covariance.order`."""
        return self.spec.component_names

    @cached_property
    def si(self) -> float:
        """SI value of one reported unit."""
        return self.spec.si

    @cached_property
    def rotation(self) -> bool:
        """Whether the value is a rotation."""
        return self.spec.kind == "rotation"

    @cached_property
    def reported_prior(self) -> tuple[Array, Array]:
        """Mean and sigma in the unit in which they are reported."""
        return self.mean / self.si, self.sigma / self.si

    @cached_property
    def estimated(self) -> bool:
        """Whether any component is free."""
        return bool(np.any(self.sigma > 0.0))

    def internal(self, reported: Array) -> Array:
        """Return a value as solvers have it: SI, a rotation's matrix, turns of directions."""
        if self.nominal is not None:
            return turns_to(self.nominal, reported.reshape(-1, 3)).ravel()
        value = reported * self.si + 0.0 * self.mean
        return exp_so3(value) if self.rotation else value
