"""The calibration at one moment, in the parametrisation in which it is reported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.estimates import Estimate, as_estimates
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.keys import BIAS_SIZE
from factorgraph_dvl.graph.priors import (
    after_step,
    local_coordinates,
    places,
    prior_mean,
    prior_root,
)
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solvers.reported import in_order, in_unit


@dataclass(frozen=True)
class CalibrationEstimate:
    """The calibration at one moment.

    Parameters
    ----------
    estimates : tuple of Estimate
        Estimates as in a solution.
    covariance : ndarray, shape (P, P)
        Joint covariance of all their components, in reported units.
    """

    estimates: tuple[Estimate, ...]
    covariance: Array


class CalibrationReport:
    """Reports calibrations: the order, and what is not estimated, never change.

    Parameters
    ----------
    parameters : sequence of Parameter
        All parameters, those that are not estimated included.
    *biases : Parameter
        Gyro bias and accelerometer bias, of a trial with an IMU.
    """

    def __init__(self, parameters: Sequence[Parameter], *biases: Parameter) -> None:
        self._free = [p for p in parameters if p.estimated]
        rows = in_order([*biases, *parameters], lambda p: p)
        self._parameters = tuple(rows)
        # GTSAM has that of the accelerometer first.
        self._biases = biases[::-1]
        columns = places([*self._biases, *self._free])
        place, size = places(rows), sum(p.mean.size for p in rows)
        self._values = np.empty(size)
        # Of all components by the tangent space of those that are estimated; rotations come later.
        free = sum(p.mean.size for p in [*self._biases, *self._free])
        self._derivative = np.zeros((size, free))
        self._varying: list[tuple[Parameter, slice, slice]] = []
        for p in rows:
            own = place[p.name]
            if not p.estimated:
                self._values[own] = in_unit(p, prior_mean(p)).value
                continue
            self._varying.append((p, own, columns[p.name]))
            self._derivative[own, columns[p.name]] = np.eye(p.mean.size) / p.si
        self._exact = np.concatenate([np.empty(0, bool), *(p.sigma == 0.0 for p in rows)])

    def at(
        self, values: Mapping[str, Array], bias: Array, P: Array, undetermined: Array
    ) -> CalibrationEstimate:
        """Return a calibration as reported.

        Parameters
        ----------
        values : mapping of str to ndarray
            Values of the parameters, SI; rotations as matrices.
        bias : ndarray, shape (6,) or (0,)
            Accelerometer bias and gyro bias, SI.
        P : ndarray, shape (6 + n, 6 + n) or (n, n)
            Joint covariance of accelerometer bias, gyro bias and the estimated parameters, in
            GTSAM's tangent space, SI.
        undetermined : ndarray, shape (n, h)
            Directions that are not observable, as `undetermined_directions` returns them: the
            prior is reported there.

        Returns
        -------
        CalibrationEstimate
            Estimates and joint covariance in reported units.
        """
        if undetermined.size:
            values, P = _at_prior(self._free, values, P, undetermined)
        values = {**values}
        for name, own in places(self._biases).items():
            values[name] = bias[own]
        found, derivative = self._values.copy(), self._derivative.copy()
        for p, own, columns in self._varying:
            if p.spec.kind == "vector":
                found[own] = values[p.name] / p.si
            else:
                row = in_unit(p, values[p.name])
                found[own], derivative[own, columns] = row.value, row.derivative
        covariance = derivative @ P @ derivative.T
        covariance[self._exact] = covariance[:, self._exact] = 0.0
        return CalibrationEstimate(as_estimates(self._parameters, found, covariance), covariance)


def _at_prior(
    free: Sequence[Parameter], values: Mapping[str, Array], P: Array, fixed: Array
) -> tuple[dict[str, Array], Array]:
    """Return values and covariance with some directions fixed at the prior's mean.

    Along them the covariance is the prior's. Fixing a direction must not make the biases better
    known, so theirs stays as it is.
    """
    root = prior_root(free)
    A = np.zeros((fixed.shape[1], P.shape[0]))
    A[:, BIAS_SIZE:] = fixed.T @ np.linalg.inv(root)
    off = np.concatenate([local_coordinates(p, values[p.name], prior_mean(p)) for p in free])
    gain = np.linalg.solve(A @ P @ A.T, A @ P).T
    step = -gain @ (A[:, BIAS_SIZE:] @ off)
    given = P - gain @ A @ P
    given[BIAS_SIZE:, BIAS_SIZE:] += root @ fixed @ fixed.T @ root.T
    given[:BIAS_SIZE, :BIAS_SIZE] = P[:BIAS_SIZE, :BIAS_SIZE]
    return after_step(free, values, step[BIAS_SIZE:]), given
