"""A solution: trajectory, calibration, joint covariance, status."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from factorgraph_dvl.conventions import DEG, Array, BodyAxes
from factorgraph_dvl.directions import turned
from factorgraph_dvl.sensors.protocol import DO_NOT_FIT, TOO_LARGE

_FAR_FROM_PRIOR = 5.0


@dataclass(frozen=True)
class Trajectory:
    """Estimated motion of the IMU over the ellipsoid, with its covariance.

    Parameters
    ----------
    time : (M,) s.
    geodetic : (M, 3) latitude, longitude (rad), ellipsoidal height (m).
    velocity : (M, 3) local-level east, north, up, m/s.
    rph : (M, 3) roll, pitch, heading, rad.
    position_cov : (M, 3, 3) local-level east, north, up, m².
    velocity_cov : (M, 3, 3) local-level east, north, up, m²/s².
    rph_cov : (M, 3, 3) roll, pitch, heading, rad².
    """

    time: Array
    geodetic: Array
    velocity: Array
    rph: Array
    position_cov: Array
    velocity_cov: Array
    rph_cov: Array

    @property
    def position_std(self) -> Array:
        """Standard deviation east, north, up, (M, 3), m."""
        return _std(self.position_cov)

    @property
    def velocity_std(self) -> Array:
        """Standard deviation east, north, up, (M, 3), m/s."""
        return _std(self.velocity_cov)

    @property
    def rph_std(self) -> Array:
        """Standard deviation of roll, pitch, heading, (M, 3), rad."""
        return _std(self.rph_cov)


def _std(covariance: Array) -> Array:
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))


@dataclass(frozen=True)
class Estimate:
    """An estimated calibration parameter, in its reported parametrisation and unit.

    Parameters
    ----------
    name : as in calibration.json, e.g. `misalignment_deg`.
    component_names : as in `covariance.order`.
    value, std : (n,) in the unit of the name.
    prior_value, prior_std : (n,) what was known before.
    observable : (n,) bool, whether the data at least halved the prior's standard
        deviation.
    nominal : (N, 3) unit vectors, if the parameter is N directions: the n = 2 N components
        turn them, in deg (`directions`). None for all other parameters.
    """

    name: str
    component_names: tuple[str, ...]
    value: Array
    std: Array
    prior_value: Array
    prior_std: Array
    observable: np.ndarray
    nominal: Array | None = None

    @property
    def directions(self) -> Array:
        """The unit vectors of a parameter that is directions, (N, 3)."""
        assert self.nominal is not None
        return turned(self.nominal, self.value.reshape(-1, 2) * DEG)


@dataclass(frozen=True)
class Residuals:
    """What a sensor measured against what the solution predicts.

    Parameters
    ----------
    label, unit : of the measurement.
    components : names of the d components.
    time : (M,) s.
    residual : (M, d) predicted - measured; nan where a component was not measured.
    sigma : (M, d) standard deviation of the measurement; likewise.
    """

    label: str
    unit: str
    components: tuple[str, ...]
    time: Array
    residual: Array
    sigma: Array


@dataclass(frozen=True)
class Solution:
    """What a solver found.

    Parameters
    ----------
    trial, solver : names.
    body_axes : axes of the body quantities.
    converged : whether the solver reached a minimum.
    iterations : that it took.
    cost : half the sum of squared whitened residuals, at the solution.
    estimates : the calibration parameters that were estimated.
    covariance : (P, P) joint covariance of all their components, in reported units, in
        the order of `estimates`.
    trajectory : the motion.
    residuals : of each sensor.
    warnings : what the user must know.
    """

    trial: str
    solver: str
    body_axes: BodyAxes
    converged: bool
    iterations: int
    cost: float
    estimates: tuple[Estimate, ...]
    covariance: Array
    trajectory: Trajectory
    residuals: tuple[Residuals, ...] = ()
    warnings: tuple[str, ...] = field(default_factory=tuple)

    @property
    def order(self) -> tuple[str, ...]:
        """Component names of the rows of `covariance`."""
        return tuple(name for e in self.estimates for name in e.component_names)

    def estimate(self, name: str) -> Estimate:
        """Return a parameter by its name in calibration.json.

        Raises
        ------
        KeyError
            If the parameter was not estimated.
        """
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        raise KeyError(f"{name} was not estimated; there are {[e.name for e in self.estimates]}")


@dataclass(frozen=True)
class Calibration:
    """What a solver found of the sensors alone; the fields are those of `Solution`."""

    trial: str
    solver: str
    body_axes: BodyAxes
    converged: bool
    iterations: int
    cost: float
    estimates: tuple[Estimate, ...]
    covariance: Array
    warnings: tuple[str, ...] = ()

    @property
    def order(self) -> tuple[str, ...]:
        """Component names of the rows of `covariance`."""
        return tuple(name for e in self.estimates for name in e.component_names)

    @property
    def values(self) -> dict[str, Array]:
        """Values by name, in reported units."""
        return {e.name: e.value for e in self.estimates}


def doubts(estimates: Sequence[Estimate], residuals: Sequence[Residuals]) -> list[str]:
    """Return warnings where a solution contradicts what was stated before.

    Residuals that are larger than their standard deviations make every reported standard
    deviation too small; a value far outside its prior says that prior or data are wrong.
    """
    out = []
    for e in estimates:
        known = e.prior_std > 0.0
        away = np.abs(e.value - e.prior_value)[known] / e.prior_std[known]
        if away.size and away.max() > _FAR_FROM_PRIOR:
            name = np.array(e.component_names)[known][np.argmax(away)]
            out.append(
                f"{name} is {away.max():.0f} prior standard deviations from its prior: the prior "
                "is too tight, or a unit, an axis or the model is wrong; do not trust the values "
                "before that is cleared up"
            )
    for r in residuals:
        rms = float(np.sqrt(np.nanmean((r.residual / r.sigma) ** 2))) if r.time.size else 0.0
        if rms > DO_NOT_FIT:
            out.append(
                f"{r.label}: residuals are {rms:.0f} times as large as their stated standard "
                "deviation: the model does not fit the data, and the values are not to be used. "
                "A lever arm, a clock offset, a unit or an axis may be missing or wrong"
            )
        elif rms > TOO_LARGE:
            out.append(
                f"{r.label}: residuals are {rms:.1f} times as large as their stated standard "
                "deviation; the reported standard deviations are too small unless it is corrected"
            )
    return out
