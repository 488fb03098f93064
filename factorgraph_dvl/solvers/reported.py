"""Calibration in the parametrisation, the units and the order in which it is reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.conventions import (
    Array,
    inverse_right_jacobian,
    reported_rotation_vector,
)
from factorgraph_dvl.sensors.protocol import Parameter
from factorgraph_dvl.solution import Estimate

# The data observed a component if they at least halved what was unknown of it.
_OBSERVABLE = 0.5
_FIRST = ("misalignment", "scale_error", "lever_arm", "gyro_bias", "accel_bias")


@dataclass(frozen=True)
class Reported:
    """A parameter as it is reported.

    Parameters
    ----------
    parameter : what it is.
    value : (n,) in its unit.
    derivative : (n, n) of `value` by the parameter's tangent space, SI.
    """

    parameter: Parameter
    value: Array
    derivative: Array


def reported(p: Parameter, value: Array) -> Reported:
    """Return a parameter as it is reported, from its value in SI or its rotation matrix."""
    derivative = np.eye(p.mean.size)
    if p.rotation:
        value = reported_rotation_vector(value, p.mean)
        derivative = inverse_right_jacobian(value)
    return Reported(p, value / p.si, derivative / p.si)


def in_order(rows: Sequence[Reported]) -> list[Reported]:
    """Return what is reported in its order: DVL, IMU, others that were estimated."""
    kept = [r for r in rows if r.parameter.estimated or r.parameter.stem in _FIRST]
    return sorted(
        kept,
        key=lambda r: (
            _FIRST.index(r.parameter.stem) if r.parameter.stem in _FIRST else len(_FIRST)
        ),
    )


def estimates_of(rows: Sequence[Reported], joint: Array) -> tuple[tuple[Estimate, ...], Array]:
    """Return estimates and the covariance of all of them.

    Parameters
    ----------
    rows : in order.
    joint : (F, F) covariance of those that were estimated, in reported units.
    """
    total = sum(r.value.size for r in rows)
    covariance = np.zeros((total, total))
    is_free = np.concatenate([np.full(r.value.size, r.parameter.estimated) for r in rows])
    covariance[np.ix_(is_free, is_free)] = joint
    known = np.concatenate([r.parameter.sigma == 0.0 for r in rows])
    covariance[known] = covariance[:, known] = 0.0
    std = np.sqrt(np.diag(covariance))
    estimates, at = [], 0
    for r in rows:
        p = r.parameter
        own = std[at : at + r.value.size]
        at += r.value.size
        prior = p.sigma / p.si
        estimates.append(
            Estimate(
                name=p.name,
                component_names=p.component_names,
                value=np.array(r.value),
                std=own,
                prior_value=p.mean / p.si,
                prior_std=prior,
                observable=(prior > 0.0) & (own <= _OBSERVABLE * prior),
            )
        )
    return tuple(estimates), covariance
