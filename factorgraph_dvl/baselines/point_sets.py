"""The two point sets of a calibration, and what a calibrator makes of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.geometry.rotations import (
    exp_so3,
    inverse_right_jacobian,
    reported_rotation_vector,
    right_jacobian,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.sensors.parameters import Parameter

# Beyond this prior standard deviation a misalignment may be anything.
_WIDE = 30.0 * DEG
# Pings that tell which of several starts is the best, and rows of a history.
_FEW = 1500
_ROWS = 2000


@dataclass(frozen=True)
class Points:
    """Velocities of body and DVL at M pings.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        True times.
    v_b : ndarray, shape (M, 3)
        Velocity of the IMU over the Earth, in body, m/s.
    v_b_covariance : ndarray, shape (M, 3, 3)
    omega_b : ndarray, shape (M, 3), rad/s
        Rate relative to the Earth.
    omega_sigma : ndarray, shape (M, 3)
        Its standard deviation.
    v_d : ndarray, shape (M, 3)
        Reported by the DVL, in its own axes, m/s.
    sigma_d : ndarray, shape (M, 3)
    """

    time: Array
    v_b: Array
    v_b_covariance: Array
    omega_b: Array
    omega_sigma: Array
    v_d: Array
    sigma_d: Array

    def __len__(self) -> int:
        return int(self.time.size)

    def take(self, which: np.ndarray | slice) -> Points:
        """Return some of the pings."""
        return Points(*(getattr(self, name)[which] for name in self.__dataclass_fields__))

    def thinned(self) -> Points:
        """Return as many pings as tell good starts from bad ones."""
        return self.take(slice(None, None, max(len(self) // _FEW, 1)))

    def at_dvl(self, lever_arm: Array) -> Array:
        """Return the velocity at the DVL, in body, (M, 3)."""
        return self.v_b + np.cross(self.omega_b, lever_arm)

    def lever_arm_variance(self, square: Array) -> Array:
        """Return the variance of omega x l, (M,), for squared components `square` of l.

        Across the lever arm, where it is largest: half the trace of the covariance.
        """
        return 0.5 * (self.omega_sigma**2 @ (square.sum() - square))

    def covariance_d(self, dRb: Array, lever_arm: Array) -> Array:
        """Return the covariance (M, 3, 3) of measured - predicted, in d.

        The error of SINS/GNSS counts as if it were new at every ping.
        """
        out = dRb @ self.v_b_covariance @ dRb.T
        diagonal = self.sigma_d**2 + self.lever_arm_variance(lever_arm**2)[:, None]
        return out + diagonal[:, :, None] * np.eye(3)


@dataclass(frozen=True)
class Estimated:
    """Calibration parameters with their joint covariance, SI.

    Parameters
    ----------
    parameters : tuple of Parameter
        With their priors.
    values : tuple of ndarray
        Of each, (n,); a rotation as its matrix.
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
        At the end.
    iterations : int
        Passes over the data, or rotations of them.
    history : tuple of tuple of (float, Estimated), optional
        Time and estimate after some of the pings; empty for closed forms.
    warnings : tuple of str, optional
        What the user must know.
    unseparated : frozenset of str, optional
        Component names that the data alone do not separate.
    converged : bool, optional
        Whether the method reached its end.
    """

    estimated: Estimated
    iterations: int
    history: tuple[tuple[float, Estimated], ...] = ()
    warnings: tuple[str, ...] = ()
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


def rotation_starts(misalignment: Parameter) -> list[Array]:
    """Return rotations to start from: the prior's, and where it is wide, those of a cube.

    No rotation is further than 63 degrees from one of the 24.
    """
    starts = [exp_so3(misalignment.mean)]
    if misalignment.sigma.max() > _WIDE:
        starts += list(Rotation.create_group("O").as_matrix())
    return starts


def misfit(points: Points, estimated: Estimated, lever_arm: Array) -> float:
    """Return the mean square of the normalised residuals of a calibration."""
    if len(points) == 0:
        return 0.0
    residual, sigma = residuals(points, estimated, lever_arm)
    return float(np.mean((residual / sigma) ** 2))


def residuals(points: Points, estimated: Estimated, lever_arm: Array) -> tuple[Array, Array]:
    """Return predicted - measured and its standard deviation, (M, 3), m/s.

    Parameters
    ----------
    points, estimated : Points or Estimated
        The pings and the calibration.
    lever_arm : ndarray
        Where the calibration has none.
    """
    dRb = estimated.value("misalignment", np.eye(3))
    scale = 1.0 + estimated.value("scale_error", np.zeros(1))
    arm = estimated.value("lever_arm", lever_arm)
    bias = estimated.value("dvl_bias", np.zeros(3))
    residual = scale * rotate(dRb[None], points.at_dvl(arm)) + bias - points.v_d
    P = points.covariance_d(dRb, arm)
    return residual, np.sqrt(np.diagonal(P, axis1=1, axis2=2))


def rows_of_history(count: int) -> np.ndarray:
    """Return which of `count` pings a history keeps: the first, the last, some between."""
    if count == 0:
        return np.zeros(0, dtype=int)
    return np.unique(np.linspace(0, count - 1, min(count, _ROWS)).round().astype(int))


PointsAt = Callable[[float], Points]
