"""What a solver finds: trajectory, parameters, residuals, noise, causes of standard deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import wrapped
from factorgraph_dvl.geometry.unit_vectors import turned
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.catalogue import specs_of
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec

# The data observed a component if they at least halved what was unknown of it.
OBSERVABLE = 0.5


@dataclass(frozen=True)
class Trajectory:
    """Estimated motion of the IMU over the ellipsoid, with its covariance.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the epochs.
    geodetic : ndarray, shape (M, 3)
        Latitude, longitude (rad), ellipsoidal height (m).
    velocity : ndarray, shape (M, 3)
        Local-level east, north, up, m/s.
    rph : ndarray, shape (M, 3)
        Roll, pitch, heading, rad.
    position_cov : ndarray, shape (M, 3, 3)
        Local-level east, north, up, m².
    velocity_cov : ndarray, shape (M, 3, 3)
        Local-level east, north, up, m²/s².
    rph_cov : ndarray, shape (M, 3, 3)
        Roll, pitch, heading, rad².

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> motion = fd.solve(fd.simulate("examples/short.yaml", seed=1)).trajectory
    >>> motion.geodetic.shape == motion.position_std.shape == (motion.time.size, 3)
    True
    """

    time: Array
    geodetic: Array
    velocity: Array
    rph: Array
    position_cov: Array
    velocity_cov: Array
    rph_cov: Array

    def __repr__(self) -> str:
        if not self.time.size:
            return "<Trajectory without epochs>"
        return f"<Trajectory of {self.time.size} epochs, {self.time[0]:g} to {self.time[-1]:g} s>"

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
    name : str
        Name as in calibration.json, e.g. `misalignment_deg`.
    component_names : tuple of str
        Component names as in `covariance.order`.
    value, std : ndarray, shape (n,)
        Value and standard deviations in the unit of the name.
    prior_value, prior_std : ndarray, shape (n,)
        What was known before.
    observable : ndarray of bool, shape (n,)
        Whether the data at least halved the prior's standard deviation.
    nominal : ndarray, shape (N, 3), optional
        Unit vectors, if the parameter is N directions: the n = 2 N components turn them, in deg
        (`directions`). None for all other parameters.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> lever_arm = solution.estimate("lever_arm_m")
    >>> lever_arm.value.round(1), lever_arm.observable
    (array([ 0.8,  1.2, -1. ]), array([ True,  True,  True]))
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
    def spec(self) -> ParameterSpec:
        """What the parameter is; one that no sensor has is a number without a unit."""
        found = specs_of(self.name)
        return found.get(self.value.size) or next(
            iter(found.values()), ParameterSpec(self.name, labels=SCALAR)
        )

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
    label, unit : str
        Label and unit of the measurement.
    components : tuple of str
        Names of the d components.
    time : ndarray, shape (M,), s
        Times of the epochs.
    residual : ndarray, shape (M, d)
        Predicted - measured; nan where a component was not measured.
    sigma : ndarray, shape (M, d)
        Standard deviation of the measurement; likewise.
    reason : {'echo', 'outlier', 'window'}, optional
        Why they were rejected, if they were: `window` if those about them are wrong together.
    """

    label: str
    unit: str
    components: tuple[str, ...]
    time: Array
    residual: Array
    sigma: Array
    reason: str = "echo"


@dataclass(frozen=True)
class NoiseBySpeed:
    """Noise of a velocity log, where its two parts are not as stated.

    Parameters
    ----------
    std : float, m/s
        Standard deviation of the part that is constant.
    fraction : float
        Standard deviation of the part that grows with speed, over the speed.
    stated_std, stated_fraction : float
        The same as stated.
    """

    std: float
    fraction: float
    stated_std: float
    stated_fraction: float


@dataclass(frozen=True)
class Noise:
    """Noise of a measurement against what is stated of it.

    Parameters
    ----------
    name : str
        Name as in calibration.json, e.g. `dvl_velocity`.
    factor : ndarray, shape (d,)
        Factor on the stated standard deviations, by component; of white and correlated noise
        together.
    correlation_time : ndarray, shape (d,), s, optional
        Correlation time of what persists from one measurement to the next; nan for a component
        whose noise is white, None where all are.
    correlated_std : ndarray, shape (d,), optional
        Standard deviation of what persists, in the unit of the measurement.
    by_speed : NoiseBySpeed, optional
        What is constant of the noise, and what grows with speed; None where it is as stated but
        for the factor.
    """

    name: str
    factor: Array
    correlation_time: Array | None = None
    correlated_std: Array | None = None
    by_speed: NoiseBySpeed | None = None


@dataclass(frozen=True)
class Cause:
    """What one cause adds to the standard deviations of a calibration.

    Parameters
    ----------
    cause : str
        Such as the noise of a sensor, or the prior of a parameter.
    assumed : str
        What is assumed of it, with its unit; empty where there is no number.
    adds : ndarray, shape (P,)
        Standard deviations in the order of the covariance, in reported units; their squares add
        up over causes to the variances.
    """

    cause: str
    assumed: str
    adds: Array


@dataclass(frozen=True)
class Hypothesis:
    """A trajectory that the data allow, or allowed for some time.

    Parameters
    ----------
    weight : float
        Normalised likelihood at the end, among all hypotheses.
    born : float
        Time of the last data when it was found, s.
    died : float or None
        Time of the data since which its weight is nil, s; None if it still has some.
    trajectory : Trajectory
        The motion, up to the end or to its death; covariances are its own.
    history : ndarray, shape (H, 2)
        Time, s, and weight.
    """

    weight: float
    born: float
    died: float | None
    trajectory: Trajectory
    history: Array


def noise_name(label: str) -> str:
    """Return the name in calibration.json of a measurement's noise."""
    return label.lower().replace(" ", "_")


def white_noise(factors: Mapping[str, Array]) -> tuple[Noise, ...]:
    """Return noise that is white, from factors (d,) on what is stated, by label."""
    return tuple(Noise(noise_name(label), factor) for label, factor in factors.items())


def values_of(estimates: Sequence[Estimate]) -> dict[str, Array]:
    """Return values by name as in calibration.json: of directions the unit vectors, (N, 3)."""
    return {e.name: e.value if e.nominal is None else e.directions for e in estimates}


def as_estimates(
    parameters: Sequence[Parameter],
    values: Array,
    covariance: Array,
    unseparated: frozenset[str] = frozenset(),
) -> tuple[Estimate, ...]:
    """Return parameters with their values (n,) and covariance (n, n), in reported units.

    Components of which the data determine only a sum are `unseparated`, so not observable.
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    estimates, at = [], 0
    for p in parameters:
        rows = slice(at, at + p.mean.size)
        at += p.mean.size
        prior_value, prior = p.reported_prior
        observable = (prior > 0.0) & (std[rows] <= OBSERVABLE * prior)
        if unseparated:
            observable &= [name not in unseparated for name in p.component_names]
        estimates.append(
            Estimate(
                name=p.name,
                component_names=p.component_names,
                value=values[rows],
                std=std[rows],
                prior_value=prior_value,
                prior_std=prior,
                observable=observable,
                nominal=p.nominal,
            )
        )
    return tuple(estimates)


def mixed(trajectories: Sequence[Trajectory], weights: Array) -> Trajectory:
    """Return the first of some trajectories, with covariances that include the others.

    With weights w, covariances P and differences d from the first, the mean square error of
    the first is the sum of w (P + d dᵀ).

    Parameters
    ----------
    trajectories : sequence of Trajectory
        Trajectories of the same epochs.
    weights : ndarray, shape (T,)
        Likelihoods.
    """
    first = trajectories[0]
    if len(trajectories) == 1:
        return first
    share = weights / weights.sum()
    frame = LocalFrame(*first.geodetic[0])
    p = [frame.position(*t.geodetic.T) for t in trajectories]
    rph = [first.rph + wrapped(t.rph - first.rph) for t in trajectories]

    def spread(values: Sequence[Array], covs: Sequence[Array]) -> Array:
        out = np.zeros_like(covs[0])
        for w, value, cov in zip(share, values, covs, strict=True):
            deviation = value - values[0]
            out += w * (cov + deviation[:, :, None] * deviation[:, None, :])
        return out

    return replace(
        first,
        position_cov=spread(p, [t.position_cov for t in trajectories]),
        velocity_cov=spread(
            [t.velocity for t in trajectories], [t.velocity_cov for t in trajectories]
        ),
        rph_cov=spread(rph, [t.rph_cov for t in trajectories]),
    )
