"""Information of the data of each trial on the parameters that all trials share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.analysis.comparison.calibration_difference import same_branch
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.dvl import CALIBRATED
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.sensors.parameters import ParameterSpec
from factorgraph_dvl.solution import Calibration

# What stays as it was installed from one trial to the next; all other parameters, such as biases
# of the IMU, currents and clocks, are those of the day.
_INSTALLED = frozenset((*CALIBRATED, *ERRORS, "gnss_lever_arm_m", "star_mounting_deg"))
_BEAMS = ("beam_direction", "beam_scale_error")
# Share of the prior's variance along a direction that the data must remove to count there.
# Chosen: of less, the digits of calibration.json remain.
_LEAST_SHARE = 1e-6


@dataclass(frozen=True)
class Information:
    """What the data of N trials alone say of n components, as a Gaussian likelihood.

    Of a trial with the estimate x and the covariance P, the estimate x0 and covariance P0 before
    it: information P⁻¹ - P0⁻¹, and P⁻¹ x - P0⁻¹ x0 for the weighted value. Parameters of the day
    are marginalised with their priors; of a component that is fixed in a trial, or not in it,
    the information is zero.

    Parameters
    ----------
    names : tuple of str
        Names of the components, as in `covariance.order`.
    matrix : ndarray, shape (N, n, n)
        Information of the data.
    weighted : ndarray, shape (N, n)
        Information times value, relative to `origin`.
    square : ndarray, shape (N,)
        Value times information times value, relative to `origin`.
    rank : ndarray of int, shape (N,)
        Directions on which each trial informs.
    origin : ndarray, shape (n,)
        Where values begin.
    prior_mean, prior_std : ndarray, shape (n,)
        What was known of the components before any trial: the widest of the trials' priors.
    specs : tuple of ParameterSpec
        The parameters that the components belong to, in order.
    """

    names: tuple[str, ...]
    matrix: Array
    weighted: Array
    square: Array
    rank: np.ndarray
    origin: Array
    prior_mean: Array
    prior_std: Array
    specs: tuple[ParameterSpec, ...]

    def chosen(self, trials: Sequence[int] | np.ndarray) -> Information:
        """Return the information of some of the trials, by index or mask."""
        return Information(
            self.names,
            self.matrix[trials],
            self.weighted[trials],
            self.square[trials],
            self.rank[trials],
            self.origin,
            self.prior_mean,
            self.prior_std,
            self.specs,
        )


@dataclass(frozen=True)
class TrialCalibration:
    """The calibration of a trial, and the joint covariance that its prior had, if it had one.

    Parameters
    ----------
    calibration : Calibration
        Calibration as in calibration.json.
    prior_names : tuple of str, optional
        Components that an earlier calibration was the prior of.
    prior_covariance : ndarray, shape (m, m), optional
        Prior covariance of these, in reported units.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> fd.TrialCalibration(solution.calibration).prior_names
    ()
    """

    calibration: Calibration
    prior_names: tuple[str, ...] = ()
    prior_covariance: Array | None = None


def information_of(trials: Sequence[TrialCalibration]) -> Information:
    """Return what the data of trials say of the parameters that they share.

    Parameters
    ----------
    trials : sequence of TrialCalibration
        Trials with body axes and beams in common.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> fd.information_of([fd.TrialCalibration(solution.calibration)]).names[:2]
    ('misalignment_x_deg', 'misalignment_y_deg')
    """
    first = trials[0].calibration
    calibrations = [same_branch(t.calibration, first) for t in trials]
    specs: dict[str, ParameterSpec] = {}
    known: dict[str, tuple[float, float]] = {}
    for c in calibrations:
        for e in filter(_is_shared, c.estimates):
            for i, name in enumerate(e.component_names):
                mean, std = float(e.prior_value[i]), float(e.prior_std[i])
                if std > 0.0 and np.isfinite([mean, std]).all():
                    specs.setdefault(e.name, e.spec)
                    if std > known.get(name, (0.0, 0.0))[1]:
                        known[name] = mean, std
    names = tuple(known)
    prior_mean, prior_std = np.array(list(known.values())).reshape(-1, 2).T
    origin = _origin(calibrations, names, prior_mean)
    size = len(names)
    matrix, weighted = np.zeros((len(trials), size, size)), np.zeros((len(trials), size))
    square, rank = np.zeros(len(trials)), np.zeros(len(trials), dtype=int)
    for i, (trial, c) in enumerate(zip(trials, calibrations, strict=True)):
        own, P, P0, x, x0 = _parts(trial, c, names)
        if own:
            found = _data_alone(P, P0, x - x0, origin[own] - x0)
            matrix[i][np.ix_(own, own)], weighted[i][own], square[i], rank[i] = found
    return Information(
        names,
        matrix,
        weighted,
        square,
        rank,
        origin,
        prior_mean,
        prior_std,
        tuple(specs.values()),
    )


def _is_shared(e: Estimate) -> bool:
    return e.name in _INSTALLED or e.spec.stem.endswith(_BEAMS)


def _origin(calibrations: Sequence[Calibration], names: Sequence[str], prior: Array) -> Array:
    """Return the median of the values of each component: differences to it keep their digits."""
    values: dict[str, list[float]] = {name: [] for name in names}
    for c in calibrations:
        for e in c.estimates:
            for name, value in zip(e.component_names, e.value, strict=True):
                if name in values and np.isfinite(value):
                    values[name].append(float(value))
    return np.array(
        [np.median(values[n]) if values[n] else p for n, p in zip(names, prior, strict=True)]
    )


def _parts(
    trial: TrialCalibration, c: Calibration, names: Sequence[str]
) -> tuple[list[int], Array, Array, Array, Array]:
    """Return places among `names`, posterior and prior covariance, value and prior mean."""
    place = {name: i for i, name in enumerate(names)}
    own, rows, values, means, stds, found = [], [], [], [], [], []
    row = 0
    for e in c.estimates:
        for i, name in enumerate(e.component_names):
            free = e.prior_std[i] > 0.0 and e.std[i] > 0.0 and np.isfinite(e.value[i])
            if name in place and _is_shared(e) and free:
                own.append(place[name])
                rows.append(row)
                found.append(name)
                values.append(float(e.value[i]))
                means.append(float(e.prior_value[i]))
                stds.append(float(e.prior_std[i]))
            row += 1
    P0 = np.diag(np.square(stds))
    joint = [n for n in trial.prior_names if n in found]
    if trial.prior_covariance is not None and joint:
        at = [found.index(n) for n in joint]
        of = [trial.prior_names.index(n) for n in joint]
        P0[np.ix_(at, at)] = trial.prior_covariance[np.ix_(of, of)]
    return own, c.covariance[np.ix_(rows, rows)], P0, np.array(values), np.array(means)


def _data_alone(
    P: Array, P0: Array, step: Array, origin: Array
) -> tuple[Array, Array, float, int]:
    """Return information, weighted value, square and rank of the data without the prior.

    In units of the prior, with P0 = S Sᵀ and S⁻¹ P S⁻ᵀ = U diag(m) Uᵀ, the data have the
    information 1/m - 1 along U, and the value z / (1 - m) with z = Uᵀ S⁻¹ (x - x0).

    Parameters
    ----------
    P, P0 : ndarray, shape (n, n)
        Posterior and prior covariance.
    step : ndarray, shape (n,)
        Posterior less prior mean.
    origin : ndarray, shape (n,)
        Less prior mean.
    """
    scale = np.sqrt(np.diag(P0))
    variance, directions = np.linalg.eigh(P0 / np.outer(scale, scale))
    known = variance > 1e-12
    root = scale[:, None] * directions[:, known] * np.sqrt(variance[known])
    inverse = np.linalg.pinv(root)
    m, turn = np.linalg.eigh(inverse @ P @ inverse.T)
    informed = (m > 0.0) & (m < 1.0 - _LEAST_SHARE)
    m, axes = m[informed], (inverse.T @ turn)[:, informed]
    gain = 1.0 / m - 1.0
    off = axes.T @ step / (1.0 - m) - axes.T @ origin
    return (axes * gain) @ axes.T, axes @ (gain * off), float(gain @ off**2), int(m.size)
