"""Two trajectories over time: against each other, and each against a reference."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.analysis.comparison.calibration_difference import (
    Kind,
    Side,
    std_of_difference,
)
from factorgraph_dvl.analysis.error_statistics import TrajectoryErrors, VectorErrors, motion_errors
from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.trial import Reference

COMPONENTS = (
    *("e_m", "n_m", "u_m"),
    *("vel_e_m_s", "vel_n_m_s", "vel_u_m_s"),
    *("roll_deg", "pitch_deg", "heading_deg"),
)
# Share of a normal distribution within two standard deviations.
TWO_SIGMA_SHARE = 0.954
_OTHER: dict[Side | None, Side | None] = {"A": "B", "B": "A", None: None}
_REPORTED = np.repeat([1.0, 1.0, 1.0 / DEG], 3)


@dataclass(frozen=True)
class Spread:
    """Size of a component over time, in its unit and in standard deviations.

    Parameters
    ----------
    name : str
        One of `COMPONENTS`.
    rms, largest : float
        RMS and maximum of the absolute value.
    time_of_largest : float
        Time of the maximum, s.
    rms_sigmas, largest_sigmas : float
        RMS and maximum of the absolute value over its standard deviation.
    within_2_sigma : float
        Share of epochs within two standard deviations.
    """

    name: str
    rms: float
    largest: float
    time_of_largest: float
    rms_sigmas: float
    largest_sigmas: float
    within_2_sigma: float


@dataclass(frozen=True)
class MotionDifference:
    """Trajectory A - trajectory B at the epochs that both have.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Common epochs.
    difference : ndarray, shape (M, 9)
        Difference of each of `COMPONENTS`, in reported units.
    std : ndarray, shape (M, 9)
        Standard deviation of the difference; nan where unknown.
    kinds : tuple of Kind
        Kind of that standard deviation, for each component.
    """

    time: Array
    difference: Array
    std: Array
    kinds: tuple[Kind, ...]

    @property
    def spreads(self) -> tuple[Spread, ...]:
        """Size of every component over time."""
        return _spreads(self.time, self.difference, self.std)


def compare_motions(
    a: Trajectory, b: Trajectory, efficient: Side | None = None
) -> MotionDifference | None:
    """Return the differences of two trajectories; None if no epochs are common.

    Epochs within 1 µs of one another are compared directly. At other epochs the denser
    trajectory is interpolated, as in `trajectory_errors`.

    Parameters
    ----------
    a, b : Trajectory
        The trajectories.
    efficient : Side, optional
        The result whose errors are uncorrelated with the difference; None = neither.
    """
    if a.time.size == 0 or b.time.size == 0:
        return None
    if _interval(a) < _interval(b):
        swapped = compare_motions(b, a, _OTHER[efficient])
        return None if swapped is None else replace(swapped, difference=-swapped.difference)
    errors = motion_errors(a, Reference(b.time, b.geodetic, b.velocity, b.rph))
    if errors.time.size == 0:
        return None
    after = np.clip(np.searchsorted(b.time, errors.time), 1, max(b.time.size - 1, 1))
    nearer = errors.time - b.time[after - 1] < b.time[after % b.time.size] - errors.time
    of_b = np.where(nearer, after - 1, after % b.time.size)
    std_a = _std(a)[errors.epochs]
    std_b = _std(b)[of_b]
    upper, hausman = std_of_difference(std_a, std_b, efficient)
    # One kind each for position, velocity and attitude: a band that changes its meaning in
    # time would look like a change of accuracy.
    vectors = (bool(np.isfinite(hausman[:, i : i + 3]).all()) for i in (0, 3, 6))
    sharp = [kind for kind in vectors for _ in range(3)]
    known = [bool(np.isfinite(column).any()) for column in upper.T]
    kinds: tuple[Kind, ...] = tuple(
        "Hausman" if s else "upper bound" if k else "none"
        for s, k in zip(sharp, known, strict=True)
    )
    return MotionDifference(errors.time, _joined(errors), np.where(sharp, hausman, upper), kinds)


def error_spreads(errors: TrajectoryErrors) -> tuple[Spread, ...]:
    """Return the errors of a trajectory over time, component by component."""
    std = np.hstack([v.std for v in _vectors(errors)]) * _REPORTED
    return _spreads(errors.time, _joined(errors), std)


def mean_nees(errors: TrajectoryErrors) -> Array:
    """Return the mean NEES of position, velocity and attitude, (3,); 3 if consistent.

    Only standard deviations are used, because a trajectory read from a file has no
    correlations. The expected mean is 3 without them too.
    """
    share = [np.sum((v.error / _nonzero(v.std)) ** 2, axis=1) for v in _vectors(errors)]
    return np.array([float(s.mean()) for s in share])


def joined_errors(errors: TrajectoryErrors) -> tuple[Array, Array]:
    """Return errors and standard deviations, (M, 9) each, `COMPONENTS` in reported units."""
    return _joined(errors), np.hstack([v.std for v in _vectors(errors)]) * _REPORTED


def _vectors(errors: TrajectoryErrors) -> tuple[VectorErrors, VectorErrors, VectorErrors]:
    return errors.position, errors.velocity, errors.attitude


def _joined(errors: TrajectoryErrors) -> Array:
    return np.hstack([v.error for v in _vectors(errors)]) * _REPORTED


def _std(trajectory: Trajectory) -> Array:
    std = (trajectory.position_std, trajectory.velocity_std, trajectory.rph_std)
    return np.hstack(std) * _REPORTED


def _interval(trajectory: Trajectory) -> float:
    time = trajectory.time
    return float(np.median(np.diff(time))) if time.size > 1 else float("inf")


def _nonzero(std: Array) -> Array:
    return np.where(std > 0.0, std, np.nan)


def _spreads(time: Array, value: Array, std: Array) -> tuple[Spread, ...]:
    out = []
    normalised = np.abs(value) / _nonzero(std)
    for i, name in enumerate(COMPONENTS):
        size, z = np.abs(value[:, i]), normalised[:, i]
        z = z[np.isfinite(z)]
        at = int(np.argmax(size))
        out.append(
            Spread(
                name=name,
                rms=_rms(size),
                largest=float(size[at]),
                time_of_largest=float(time[at]),
                rms_sigmas=_rms(z),
                largest_sigmas=float(z.max()) if z.size else float("nan"),
                within_2_sigma=float((z <= 2.0).mean()) if z.size else float("nan"),
            )
        )
    return tuple(out)


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
