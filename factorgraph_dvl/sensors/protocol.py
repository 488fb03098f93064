"""What every sensor offers: settings, parameters, and observations with Jacobians."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import Annotated, Any, ClassVar, Protocol, Self, TypeVar, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.unit_vectors import turns_to
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.settings.ranges import out_of_range, range_of

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Vector3 = tuple[float, float, float]
Sigma3 = tuple[NonNegative, NonNegative, NonNegative]
Values = Mapping[str, Array]

# Residuals larger than stated by this factor make every standard deviation too small, and by
# the second the model is another than the data's.
TOO_LARGE = 1.3
DO_NOT_FIT = 10.0


# Rounding may leave a correlation matrix with an eigenvalue this far below zero.
_NEGATIVE = 1e-6


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A section of a YAML file, in the units that its names state."""

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            if wrong := out_of_range(name, _numbers(getattr(self, name))):
                raise ValueError(wrong)


def check_epoch(epoch: str) -> None:
    """Raise ValueError unless an epoch is empty or a date and time of ISO 8601."""
    try:
        if epoch:
            datetime.fromisoformat(epoch)
    except ValueError:
        raise ValueError("`epoch` must be a date and time such as 2022-10-12T02:00:00Z") from None


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, (tuple, list)):
        for item in value:
            yield from _numbers(item)


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


@dataclass(frozen=True)
class Motion:
    """Motion of the body at the times of M measurements.

    Parameters
    ----------
    nRb : ndarray, shape (M, 3, 3)
        Attitude, body to n.
    p_n, v_n : ndarray, shape (M, 3)
        Position and Earth-relative velocity of the IMU in n, m, m/s.
    omega_eb_b : ndarray, shape (M, 3), rad/s
        Angular rate of the body relative to the Earth.
    a_n : ndarray, shape (M, 3)
        Earth-relative acceleration, dv_n/dt, m/s².
    alpha_b : ndarray, shape (M, 3), rad/s²
        Time derivative of the angular rate.
    omega_sigma : ndarray, shape (M, 3), rad/s
        Standard deviation of omega_eb_b from the gyro's noise and from motion that its samples do
        not resolve.
    """

    nRb: Array
    p_n: Array
    v_n: Array
    omega_eb_b: Array
    a_n: Array
    alpha_b: Array
    omega_sigma: Array


@dataclass(frozen=True)
class Linearization:
    """Residual = predicted - measured, and its derivatives (None where zero).

    Parameters
    ----------
    residual : ndarray, shape (M, d)
    d_theta : ndarray, shape (M, d, 3), optional
        With respect to theta in nRb Exp(theta).
    d_p, d_v : ndarray, shape (M, d, 3), optional
        With respect to p_n and v_n.
    d_omega : ndarray, shape (M, d, 3), optional
        With respect to omega_eb_b.
    d_parameters : dict of str to ndarray, optional
        Name to (M, d, n); for a rotation, with respect to delta in R Exp(delta).
    """

    residual: Array
    d_theta: Array | None = None
    d_p: Array | None = None
    d_v: Array | None = None
    d_omega: Array | None = None
    d_parameters: dict[str, Array] = field(default_factory=dict)


class Observation(Protocol):
    """M measurements of one kind, of d components each."""

    @property
    def label(self) -> str:
        """Name of the measurement, for people."""

    @property
    def unit(self) -> str:
        """Unit of the residual."""

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the d components."""

    @property
    def time(self) -> Array:
        """Times as in the record, (M,), s."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the calibration parameters that the measurement depends on."""

    def true_time(self, values: Values) -> Array:
        """Return the (M,) times at which the measurements were true, s."""

    def sigma(self, motion: Motion, values: Values) -> Array:
        """Return the (M, d) standard deviations of the residual.

        Infinite where a component was not measured; its residual need only be finite.
        """

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured, (M, d)."""

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians, of the parameters `wanted` at least."""


class SensorSection(Section, frozen=True, kw_only=True):
    """A sensor's section of trial.yaml, with the table that holds its record."""

    file: str

    @property
    def more_columns(self) -> tuple[str, ...]:
        """Columns that the table must have because the settings say so."""
        return ()


class SensorRecord(Protocol):
    """A sensor's record, and how it stands in files.

    `section` names its part of trial.yaml and its table, `section_type` holds the
    settings; of the columns, `required` and the settings' `more_columns` must be there,
    and of each group of `optional` ones all or none.
    """

    section: ClassVar[str]
    section_type: ClassVar[type[SensorSection]]
    required: ClassVar[tuple[str, ...]]
    optional: ClassVar[tuple[tuple[str, ...], ...]]

    @property
    def settings(self) -> SensorSection:
        """Settings of the sensor."""

    @classmethod
    def from_columns(cls, settings: Any, columns: Mapping[str, Array], source: str) -> Self:
        """Return the record that a table holds; columns that it does not have are nan."""

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""


class Aid(SensorRecord, Protocol):
    """A sensor that observes the motion which the IMU integrates."""

    @property
    def label(self) -> str:
        """Name of the sensor, for people."""

    @property
    def time(self) -> Array:
        """Times of the record, (M,), s."""

    @property
    def missing(self) -> Array:
        """Rows without a measurement, (M,) bool."""

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the calibration parameters, fixed ones included."""

    def observations(self, frame: LocalFrame) -> tuple[Observation, ...]:
        """Return the measurements, with positions expressed in `frame`."""

    def explain(self, parameter: str, component: int, motion: Motion | None) -> str:
        """Say why a component could not be observed, given the motion of the trial."""


@dataclass(frozen=True)
class Attitudes:
    """Attitudes that a sensor measures by itself, without any motion.

    Parameters
    ----------
    time : ndarray, shape (M,), s
    nRs : ndarray, shape (M, 3, 3)
        Attitude of the sensor's axes.
    sigma : ndarray, shape (M,), rad
        Standard deviation about the axis that is known best.
    mounting : Parameter
        The parameter sRb, with its prior.
    consistency_warnings : tuple of str, optional
        What the record says against itself, for people.
    """

    time: Array
    nRs: Array
    sigma: Array
    mounting: Parameter
    consistency_warnings: tuple[str, ...] = ()


@runtime_checkable
class AttitudeAid(Aid, Protocol):
    """An aid from which a vehicle at rest can start."""

    def attitudes(self, frame: LocalFrame) -> Attitudes:
        """Return the attitudes that were measured, in `frame`."""


_AnyRecord = TypeVar("_AnyRecord")


def rows_of(record: _AnyRecord, rows: slice | NDArray[Any] | list[int]) -> _AnyRecord:
    """Return some rows of a sensor's record, in the order of time: of every array in it."""
    return _with(record, {name: values[rows] for name, values in arrays_of(record).items()})


def joined(records: Sequence[_AnyRecord]) -> _AnyRecord:
    """Return records of one sensor as one, in the order of time.

    Of rows at the same time the first is kept.
    """
    if len(records) == 1:
        return records[0]
    columns = [arrays_of(record) for record in records]
    whole = {name: np.concatenate([c[name] for c in columns]) for name in columns[0]}
    _, rows = np.unique(whole["time"], return_index=True)
    return _with(records[0], {name: values[rows] for name, values in whole.items()})


def _with(record: _AnyRecord, arrays: Mapping[str, Array]) -> _AnyRecord:
    # Rows of a record that was checked need no check, which would take most of the time.
    out = copy(record)
    for name, values in arrays.items():
        object.__setattr__(out, name, values)
    return out


def arrays_of(record: Any) -> dict[str, Array]:
    """Return the arrays of a record, by name; each has a row for each time."""
    return {name: value for name, value in vars(record).items() if isinstance(value, np.ndarray)}


def lever_arm_sigma(motion: Motion, lever_arm: Array) -> Array:
    """Return the standard deviation, (M,), m/s, of omega x l from that of omega.

    Across the lever arm, (3,) or (M, 3), where it is largest: half the trace of the
    covariance.
    """
    l2 = lever_arm**2
    across = l2.sum(axis=-1, keepdims=True) - l2
    return np.asarray(np.sqrt(0.5 * np.sum(motion.omega_sigma**2 * across, axis=1)))


def check_times(time: Array, source: str) -> None:
    """Raise DataError unless (M,) times are finite and strictly increasing."""
    if time.ndim != 1 or time.size == 0:
        raise DataError("no samples", where=source, expected="at least one row")
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise DataError("time_s is not a number", where=at_row(source, bad[0]))
    check_possible({"time_s": time}, source)
    bad = np.flatnonzero(np.diff(time) <= 0.0)
    if bad.size:
        i = int(bad[0]) + 1
        raise DataError(
            f"time_s does not increase ({time[i - 1]:.9g} is followed by {time[i]:.9g})",
            where=at_row(source, i),
            expected="strictly increasing times",
        )


def check_finite(columns: Mapping[str, Array], source: str) -> None:
    """Raise DataError, naming row and column, unless all values are finite."""
    for name, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise DataError(
                f"{name} is empty or not a number",
                where=at_row(source, bad[0]),
                expected="a finite number in every row",
            )


def check_range(
    columns: Mapping[str, Array], low: float, high: float, unit: str, source: str
) -> None:
    """Raise DataError where a value that is present lies outside [low, high]."""
    for name, values in columns.items():
        bad = np.flatnonzero((values < low) | (values > high))
        if bad.size:
            raise DataError(
                f"{name} = {values[bad[0]]:.6g} is out of range",
                where=at_row(source, bad[0]),
                expected=f"{low:g} to {high:g} {unit}",
            )


def check_possible(columns: Mapping[str, Array], source: str) -> None:
    """Raise DataError where a value that is present cannot be, by the name of its column."""
    for name, values in columns.items():
        if limits := range_of(name):
            check_range({name: values}, limits.low, limits.high, limits.unit, source)


def check_all_or_none(columns: Mapping[str, Array], source: str) -> None:
    """Raise DataError where some of the columns are empty in a row and others are not."""
    missing = np.isnan(np.stack(list(columns.values()), axis=1))
    bad = np.flatnonzero(missing.any(axis=1) & ~missing.all(axis=1))
    if bad.size:
        raise DataError(
            f"only some of {', '.join(columns)} are given",
            where=at_row(source, bad[0]),
            expected="all of them, or none",
        )


def at_row(source: str, row: int | np.integer[Any]) -> str:
    """Name a row of a record so that it is found in the file (one header line)."""
    return f"{source} line {int(row) + 2}"


def stack(columns: Mapping[str, Array], names: Sequence[str]) -> Array:
    """Return the columns of those names side by side, (M, n)."""
    return np.column_stack([columns[name] for name in names])


def named_columns(names: Iterable[str], values: Array) -> dict[str, Array]:
    """Pair names with the columns of an (M, n) array."""
    return {name: values[:, i] for i, name in enumerate(names)}
