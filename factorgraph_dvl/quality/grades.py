"""Grades of calibrated components: their standard deviations against limits."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import numpy as np

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.catalogue import every_spec

Grade = Literal["green", "orange", "red", "grey"]

# Standard deviations that are good enough, by parameter, in reported units.
DEFAULT_LIMITS: Mapping[str, float] = MappingProxyType(
    {spec.name: spec.limit for spec in every_spec() if spec.limit is not None}
)
# Chosen: the standard deviation is orange up to this multiple of its limit.
ORANGE = 2.0


def grades(std: Array, observable: np.ndarray, limit: float = np.inf) -> tuple[Grade, ...]:
    """Return the grade of each component of a parameter.

    Green up to the limit, orange up to twice the limit, red above; grey where the data do not
    determine the component, or nobody knows how well they do.

    Parameters
    ----------
    std : ndarray, shape (n,)
        Standard deviations, in reported units.
    observable : ndarray of bool, shape (n,)
        Whether the data determine a component.
    limit : float, optional
        What is good enough; there is none if infinite.
    """
    return tuple(
        "grey"
        if not seen or np.isnan(sigma)
        else "green"
        if sigma <= limit
        else "orange"
        if sigma <= ORANGE * limit
        else "red"
        for sigma, seen in zip(std.tolist(), observable.tolist(), strict=True)
    )


def grades_of(estimate: Estimate, limits: Mapping[str, float]) -> tuple[Grade, ...]:
    """Return the grade of each component of a parameter against its limit, if it has one."""
    return grades(estimate.std, estimate.observable, limits.get(estimate.name, np.inf))
