"""Calibration in the parametrisation, the units and the order in which it is reported."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from factorgraph_dvl.estimates import Estimate, as_estimates
from factorgraph_dvl.geometry.rotations import (
    inverse_right_jacobian,
    reported_rotation_vector,
    wrapped,
)
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.parameters import Parameter

_Row = TypeVar("_Row")


@dataclass(frozen=True)
class Reported:
    """A parameter as it is reported.

    Parameters
    ----------
    parameter : Parameter
        What it is.
    value : ndarray, shape (n,)
        Value in its unit.
    derivative : ndarray, shape (n, n), SI
        Derivative of `value` by the parameter's tangent space.
    """

    parameter: Parameter
    value: Array
    derivative: Array


def in_unit(p: Parameter, value: Array) -> Reported:
    """Return a parameter as it is reported, from its value in SI or its rotation matrix."""
    si, derivative = p.si, np.eye(p.mean.size)
    if p.rotation:
        value = reported_rotation_vector(value, p.mean)
        derivative = inverse_right_jacobian(value)
    elif p.spec.kind == "angle":
        value = wrapped(value)
    return Reported(p, value / si, derivative / si)


def in_order(rows: Iterable[_Row], parameter: Callable[[_Row], Parameter]) -> list[_Row]:
    """Return what is reported in its order: DVL, IMU, others that were estimated."""

    def place(row: _Row) -> float:
        own = parameter(row).spec.place
        return np.inf if own is None else own

    kept = (r for r in rows if parameter(r).estimated or np.isfinite(place(r)))
    return sorted(kept, key=place)


def estimates_of(
    rows: Sequence[tuple[Parameter, Array]], joint: Array
) -> tuple[tuple[Estimate, ...], Array]:
    """Return estimates and the covariance of all of them.

    Parameters
    ----------
    rows : sequence of tuple of (Parameter, ndarray)
        Parameters with their values in reported units, in order.
    joint : ndarray, shape (F, F)
        Covariance of those that were estimated, in reported units.
    """
    total = sum(value.size for _, value in rows)
    covariance = np.zeros((total, total))
    if not rows:
        return (), covariance
    is_free = np.concatenate([np.full(value.size, p.estimated) for p, value in rows])
    covariance[np.ix_(is_free, is_free)] = joint
    exact = np.concatenate([p.sigma == 0.0 for p, _ in rows])
    covariance[exact] = covariance[:, exact] = 0.0
    values = np.concatenate([value for _, value in rows])
    return as_estimates([p for p, _ in rows], values, covariance), covariance
