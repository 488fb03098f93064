"""The two point sets of a calibration, their residuals and the derivatives of these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.baselines.outcome import Estimated
from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.rotations import (
    exp_so3,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, cross_variance, rotate, skew
from factorgraph_dvl.sensors.parameters import Parameter

# Chosen: prior standard deviation beyond which a misalignment may be anything.
_WIDE = 30.0 * DEG
# Chosen: pings that compare several starts; more change no decision.
_FEW = 1500


@dataclass(frozen=True)
class Points:
    """Velocities of body and DVL at M pings.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        True times.
    v_b : ndarray, shape (M, 3)
        Velocity of the IMU over the Earth, in body, m/s.
    v_b_covariance : ndarray, shape (M, 3, 3), m²/s²
        Covariance of `v_b`.
    omega_b : ndarray, shape (M, 3), rad/s
        Rate relative to the Earth.
    omega_sigma : ndarray, shape (M, 3)
        Its standard deviation.
    v_d : ndarray, shape (M, 3)
        Reported by the DVL, in its own axes, m/s.
    sigma_d : ndarray, shape (M, 3), m/s
        Standard deviation of `v_d`.
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
        return rows_of(self, which)

    def thinned(self) -> Points:
        """Return as many pings as it takes to compare starts."""
        return self.take(slice(None, None, max(len(self) // _FEW, 1)))

    def at_dvl(self, lever_arm: Array) -> Array:
        """Return the velocity at the DVL, in body, (M, 3)."""
        return self.v_b + np.cross(self.omega_b, lever_arm)

    def covariance_d(self, dRb: Array, lever_arm: Array) -> Array:
        """Return the covariance (M, 3, 3) of measured - predicted, in d.

        The error of SINS/GNSS counts as if it were new at every ping.
        """
        out = dRb @ self.v_b_covariance @ dRb.T
        diagonal = self.sigma_d**2 + cross_variance(self.omega_sigma, lever_arm**2)[:, None]
        return out + diagonal[:, :, None] * np.eye(3)


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


def derivatives(points: Points, estimated: Estimated, lever_arm: Array) -> Array:
    """Return the derivatives of `residuals` by what was estimated, (M, 3, n).

    Those by a time offset, which changes the points themselves, are zero.
    """
    dRb = estimated.value("misalignment", np.eye(3))
    scale = 1.0 + estimated.value("scale_error", np.zeros(1))
    M = np.broadcast_to(scale, 3)[:, None] * dRb
    at_dvl = points.at_dvl(estimated.value("lever_arm", lever_arm))
    by_scale = (at_dvl @ dRb.T)[:, :, None]
    columns = {
        "misalignment": -M @ skew(at_dvl),
        "scale_error": by_scale if scale.size == 1 else by_scale * np.eye(3),
        "lever_arm": M @ skew(points.omega_b),
        "dvl_bias": np.broadcast_to(np.eye(3), (len(points), 3, 3)),
    }
    return np.concatenate(
        [
            columns.get(p.stem, np.zeros((len(points), 3, p.mean.size)))
            for p in estimated.parameters
        ],
        axis=2,
    )


PointsAt = Callable[[float], Points]
