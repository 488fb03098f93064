"""Errors of a solution against the truth, and whether its covariance is consistent with them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from factorgraph_dvl.estimates import Estimate, Trajectory
from factorgraph_dvl.geometry.earth import radii
from factorgraph_dvl.geometry.rotations import (
    exp_so3,
    log_so3,
    rotation_from_rph,
    rph_from_rotation,
    wrapped,
)
from factorgraph_dvl.geometry.unit_vectors import turns_to
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.dvl import LEVER_ARM, MISALIGNMENT, SCALE_ERROR
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import Reference

# Chosen: files hold times to a microsecond or better.
_COINCIDENT_S = 1e-6
# Chosen: at 20 Hz, cubics follow a wave of 1 Hz to 0.03 % of its amplitude.
_LONGEST_INTERVAL_S = 0.05
_PAPER_PARAMETERS = (MISALIGNMENT, SCALE_ERROR, LEVER_ARM)


@dataclass(frozen=True)
class VectorErrors:
    """Errors of a vector over time, and their estimated covariance.

    Parameters
    ----------
    error : ndarray, shape (M, 3)
        Estimate - truth.
    covariance : ndarray, shape (M, 3, 3)
        Estimated covariance, in the squared unit of `error`.
    """

    error: Array
    covariance: Array

    @property
    def std(self) -> Array:
        """Standard deviations, (M, 3)."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0))

    @property
    def normalised(self) -> Array:
        """Errors over their standard deviations, (M, 3)."""
        return self.error / self.std

    @property
    def nees(self) -> Array:
        """Normalised estimation errors squared, e' P^-1 e, (M,); 3 on average."""
        return _nees(self.error, self.covariance)


@dataclass(frozen=True)
class TrajectoryErrors:
    """Errors of a trajectory at the epochs where the truth is known.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Epochs at which the truth is known.
    epochs : ndarray of np.intp, shape (M,)
        Indices of these epochs in the trajectory.
    position : VectorErrors
        Local-level east, north, up, m.
    velocity : VectorErrors
        Local-level east, north, up, m/s.
    attitude : VectorErrors
        Roll, pitch, heading, rad; each difference in [-pi, pi).
    """

    time: Array
    epochs: NDArray[np.intp]
    position: VectorErrors
    velocity: VectorErrors
    attitude: VectorErrors


@dataclass(frozen=True)
class CalibrationErrors:
    """Errors of the calibration components whose truth is known.

    Parameters
    ----------
    names : tuple of str
        Names of the n components, as in `covariance.order`.
    estimate, truth, error : ndarray, shape (n,)
        Estimate, truth and error in reported units; error = estimate - truth.
    covariance : ndarray, shape (n, n)
        Joint covariance of the components.
    observable : ndarray of bool, shape (n,)
        Whether the data determine each component.
    """

    names: tuple[str, ...]
    estimate: Array
    truth: Array
    error: Array
    covariance: Array
    observable: NDArray[np.bool_]

    @property
    def std(self) -> Array:
        """Standard deviations, (n,), in reported units."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))

    @property
    def normalised(self) -> Array:
        """Errors over their standard deviations, (n,); nan for fixed components."""
        std = self.std
        out = np.full(std.shape, np.nan)
        np.divide(self.error, std, out=out, where=std > 0.0)
        return out

    @property
    def tested(self) -> NDArray[np.bool_]:
        """Components that enter `nees`, (n,): observable and not fixed."""
        return np.asarray(self.observable & (self.std > 0.0))

    @property
    def dof(self) -> int:
        """Number of components that enter `nees`, its mean."""
        return int(self.tested.sum())

    @property
    def nees(self) -> float:
        """Joint normalised estimation error squared of the tested components."""
        m = self.tested
        return float(_nees(self.error[None, m], self.covariance[np.ix_(m, m)][None])[0])

    def without_pull(self, prior: Array, prior_std: Array) -> tuple[Array, Array]:
        """Return the errors that noise makes (n,), and their covariance (n, n).

        An estimate is drawn from the truth x towards its prior x0: the mean of its error is
        -P L (x - x0) with the prior's information L, and P - P L P the covariance around it. A
        truth that is not drawn from the prior shows that pull, seed after seed.

        Parameters
        ----------
        prior, prior_std : ndarray, shape (n,)
            Mean and standard deviations of the prior, in reported units.
        """
        information = np.zeros(prior_std.shape)
        np.divide(1.0, prior_std**2, out=information, where=prior_std > 0.0)
        gain = self.covariance * information
        return self.error + gain @ (self.truth - prior), self.covariance - gain @ self.covariance


def trajectory_errors(solution: Solution, reference: Reference) -> TrajectoryErrors:
    """Return the errors of a trajectory against a reference.

    Epochs within 1 µs of one of the reference are compared with it as it is. Between
    epochs the reference is interpolated by cubics through its four surrounding epochs,
    for the attitude in rotation vectors relative to one of them, and only where the
    intervals between those four are shorter than 0.05 s: a longer interval misses waves
    larger than the errors of interest. All other epochs are omitted; none may remain.

    Parameters
    ----------
    solution : Solution
        Solution whose trajectory has N epochs.
    reference : Reference
        Truth or a trusted solution.

    Returns
    -------
    TrajectoryErrors
        Errors at M <= N epochs.
    """
    return motion_errors(solution.trajectory, reference)


def motion_errors(trajectory: Trajectory, reference: Reference) -> TrajectoryErrors:
    """Return the errors of a motion against another; see `trajectory_errors`."""
    epochs, truth = _reference_at(reference, trajectory.time)
    lat, lon, height = trajectory.geodetic[epochs].T
    meridian, prime_vertical = radii(truth.geodetic[:, 0])
    height_true = truth.geodetic[:, 2]
    position = np.stack(
        [
            wrapped(lon - truth.geodetic[:, 1])
            * (prime_vertical + height_true)
            * np.cos(truth.geodetic[:, 0]),
            (lat - truth.geodetic[:, 0]) * (meridian + height_true),
            height - height_true,
        ],
        axis=1,
    )
    return TrajectoryErrors(
        time=truth.time,
        epochs=epochs,
        position=VectorErrors(position, trajectory.position_cov[epochs]),
        velocity=VectorErrors(
            trajectory.velocity[epochs] - truth.velocity, trajectory.velocity_cov[epochs]
        ),
        attitude=VectorErrors(
            wrapped(trajectory.rph[epochs] - truth.rph), trajectory.rph_cov[epochs]
        ),
    )


def calibration_errors(solution: Solution, truth: Mapping[str, ArrayLike]) -> CalibrationErrors:
    """Return the errors of the calibration against its truth.

    A rotation near 180 deg has two rotation vectors; the true one that is nearer to the
    estimate is used. A parameter is omitted if its truth has another number of components
    than its estimate, unless the truth is a single number for all of them.

    Parameters
    ----------
    solution : Solution
        Solution whose estimates are compared.
    truth : mapping of str to array_like
        True values by reported name, (n,) each, in reported units.
    """
    names: list[str] = []
    values: list[Array] = []
    truths: list[Array] = []
    observable: list[NDArray[np.bool_]] = []
    rows: list[int] = []
    start = 0
    for estimate in solution.estimates:
        n = len(estimate.component_names)
        true_value = true_value_of(estimate, truth)
        if true_value is not None:
            names += estimate.component_names
            values.append(estimate.value)
            truths.append(true_value)
            observable.append(np.asarray(estimate.observable, dtype=bool))
            rows += range(start, start + n)
        start += n
    joined = np.concatenate([*values, np.zeros(0)])
    joined_truth = np.concatenate([*truths, np.zeros(0)])
    return CalibrationErrors(
        names=tuple(names),
        estimate=joined,
        truth=joined_truth,
        error=joined - joined_truth,
        covariance=solution.covariance[np.ix_(rows, rows)],
        observable=np.concatenate([*observable, np.zeros(0, dtype=bool)]),
    )


def true_value_of(estimate: Estimate, truth: Mapping[str, ArrayLike]) -> Array | None:
    """Return the truth to compare an estimate with, (n,), or None.

    Parameters
    ----------
    estimate : Estimate
        Estimate of n components.
    truth : mapping of str to array_like
        True values by reported name, in reported units; directions as (N, 3) vectors.
    """
    if estimate.name not in truth:
        return None
    value = np.atleast_1d(np.asarray(truth[estimate.name], dtype=float))
    if estimate.nominal is not None:
        if value.size != estimate.nominal.size:
            return None
        return turns_to(estimate.nominal, value.reshape(-1, 3)).ravel() / DEG
    if value.size not in (1, estimate.value.size):
        return None
    value = np.broadcast_to(value, estimate.value.shape).copy()
    if estimate.spec.kind == "rotation":
        return nearest_rotation_vector(value, estimate.value)
    if estimate.spec.kind == "angle":
        return nearest_angle(value, estimate.value)
    return value


def nees_band(dof: int, runs: int, level: float = 0.95) -> tuple[float, float]:
    """Return the interval in which the mean NEES of consistent runs lies.

    The sum over independent runs follows chi² with dof · runs degrees of freedom:
    Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
    Navigation, section 5.4.

    Parameters
    ----------
    dof : int
        Number of components.
    runs : int
        Number of independent runs that the mean is taken over.
    level : float, default 0.95
        Probability that the mean lies inside.
    """
    total = float(dof * runs)
    tail = (1.0 - level) / 2.0
    return float(chdtri(total, 1.0 - tail)) / runs, float(chdtri(total, tail)) / runs


def paper_accuracy(estimates: Iterable[Estimate], truth: Mapping[str, ArrayLike]) -> float:
    """Return the mean of 100 (1 - |error / truth|) over the DVL's components, %.

    The components are those of misalignment, scale error and lever arm, seven with one
    scale; components whose truth is zero have no relative error and are omitted. This is
    the figure of merit of Luo et al. (2024).

    Parameters
    ----------
    estimates : iterable of Estimate
        Estimates; other parameters are ignored.
    truth : mapping of str to array_like
        True values by reported name, in reported units.

    Returns
    -------
    float
        Accuracy, %; nan if no component can be compared.
    """
    accuracies: list[float] = []
    for estimate in estimates:
        if estimate.name not in _PAPER_PARAMETERS:
            continue
        true_value = true_value_of(estimate, truth)
        if true_value is None:
            continue
        nonzero = true_value != 0.0
        relative = np.abs(estimate.value[nonzero] / true_value[nonzero] - 1.0)
        accuracies += (100.0 * (1.0 - relative)).tolist()
    return float(np.mean(accuracies)) if accuracies else float("nan")


def _nees(error: Array, covariance: Array) -> Array:
    """Return e' P^-1 e, (M,), of errors (M, n) and covariances (M, n, n)."""
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    z = error / std
    # Components in different units span so many decades that only their correlation
    # matrix can be factored without loss.
    correlation = covariance / (std[:, :, None] * std[:, None, :])
    weighted = np.linalg.solve(correlation, z[:, :, None])[:, :, 0]
    return np.asarray(np.sum(z * weighted, axis=1))


def nearest_angle(angle: Array, near: Array) -> Array:
    """Return angles, deg, with whole turns added that bring them nearest to others; nan stays."""
    turns = np.round((near - angle) / 360.0)
    return angle + 360.0 * np.where(np.isfinite(turns), turns, 0.0)


def nearest_rotation_vector(phi: Array, near: Array) -> Array:
    """Return the rotation vector (3,), deg, of the same rotation that is nearer to `near`.

    Near 180 deg, two vectors of opposite sign describe the same rotation.
    """
    angle = float(np.linalg.norm(phi))
    if angle == 0.0:
        return phi
    other = phi * (1.0 - 360.0 / angle)
    return other if np.linalg.norm(other - near) < np.linalg.norm(phi - near) else phi


def _reference_at(reference: Reference, time: Array) -> tuple[NDArray[np.intp], Reference]:
    """Return the indices (M,) of times that the reference covers, and the reference there."""
    t = reference.time
    left = np.searchsorted(t, time, side="right") - 1
    before, after = np.clip(left, 0, t.size - 1), np.clip(left + 1, 0, t.size - 1)
    nearest = np.where(np.abs(time - t[before]) <= np.abs(time - t[after]), before, after)
    coincident = np.abs(time - t[nearest]) <= _COINCIDENT_S
    between = ~coincident & (left >= 0) & (left < t.size - 1)
    if t.size < 4:
        between[:] = False
    else:
        first = np.clip(left - 1, 0, t.size - 4)
        short = np.diff(t) < _LONGEST_INTERVAL_S
        between &= short[first] & short[first + 1] & short[first + 2]

    epochs = np.flatnonzero(coincident | between)
    geodetic = reference.geodetic[nearest[epochs]]
    velocity = reference.velocity[nearest[epochs]]
    rph = reference.rph[nearest[epochs]]
    at = np.flatnonzero(between[epochs])
    if at.size:
        nodes = first[epochs[at], None] + np.arange(4)
        weights = _lagrange_weights(t[nodes] - t[nodes[:, :1]], time[epochs[at]] - t[nodes[:, 0]])
        # Relative to one node: longitudes may wrap, and geodetic radians have too few digits.
        origin = reference.geodetic[nodes[:, 0]]
        offset = reference.geodetic[nodes] - origin[:, None, :]
        offset[..., 1] = wrapped(offset[..., 1])
        geodetic[at] = origin + np.einsum("mk,mkc->mc", weights, offset)
        velocity[at] = np.einsum("mk,mkc->mc", weights, reference.velocity[nodes])
        # Roll, pitch and heading themselves wrap, and are not smooth at steep pitch.
        nRb = rotation_from_rph(reference.rph[nodes], "FRD")
        phi = log_so3(np.swapaxes(nRb[:, :1], 2, 3) @ nRb)
        turn = exp_so3(np.einsum("mk,mkc->mc", weights, phi))
        rph[at] = rph_from_rotation(nRb[:, 0] @ turn, "FRD")
    return epochs, Reference(time[epochs], geodetic, velocity, rph)


def _lagrange_weights(nodes: Array, at: Array) -> Array:
    """Return the weights (M, 4) of cubics through nodes (M, 4), evaluated at (M,)."""
    weights = np.ones(nodes.shape)
    for k in range(4):
        for j in range(4):
            if j != k:
                weights[:, k] *= (at - nodes[:, j]) / (nodes[:, k] - nodes[:, j])
    return weights
