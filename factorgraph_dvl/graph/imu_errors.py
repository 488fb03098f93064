"""Errors of the IMU that grow with rate and force, as parameters of the graph.

GTSAM's IMU factors have no variables for them. Their prediction of a state moves linearly
with the errors, so the errors get columns of their own in the linear factors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import gtsam
import numpy as np

from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.keys import BIAS_SIZE, STATE_SIZE
from factorgraph_dvl.graph.template import jacobian_template
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.imu.propagation import Attachment, Transition
from factorgraph_dvl.imu.sensitivity import (
    Sensitivity,
    by_errors,
    corrected,
    elements,
    moved,
    predicted,
    sensitivities,
)
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Linearization


@dataclass(frozen=True)
class LinearImuFactors:
    """GTSAM's factors, linear at some values, with columns for the errors of the IMU.

    Parameters
    ----------
    native : gtsam.GaussianFactorGraph
        All native factors as GTSAM linearises them, the S IMU factors first.
    jacobian : ndarray, shape (S, 9, 24 + n)
        Of the IMU factors: states, bias, errors.
    rhs : ndarray, shape (S, 9)
        Right-hand side of the IMU factors.
    more_cost : float
        What the errors add to the cost of the native factors.
    """

    native: gtsam.GaussianFactorGraph
    jacobian: Array
    rhs: Array
    more_cost: float


class ImuErrors:
    """Errors of the IMU in a graph.

    Parameters
    ----------
    segments : Segments
        Increments of the IMU between the nodes.
    parameters : sequence of Parameter
        Errors that are estimated.
    keys : sequence of int
        Their keys.
    attachments : sequence of Attachment
        Where measurements hang on the chain.
    """

    def __init__(
        self,
        segments: Segments,
        parameters: Sequence[Parameter],
        keys: Sequence[int],
        attachments: Sequence[Attachment],
    ) -> None:
        self.names = tuple(p.name for p in parameters)
        self._keys = list(keys)
        self._sizes = [p.mean.size for p in parameters]
        self._segments = segments
        self._elements = elements(parameters)
        unique = {id(at): at for at in attachments}
        whole, found = sensitivities(segments, self._elements, list(unique.values()))
        self._whole = whole
        self._ends = predicted(segments, whole)
        self._by: dict[int, Sensitivity] = dict(zip(unique, found, strict=True))
        self._factors: list[gtsam.JacobianFactor] = []

    def vector(self, parameters: Mapping[str, Array]) -> Array:
        """Return the errors among parameters, (n,), SI."""
        return np.concatenate([parameters[name] for name in self.names])

    def ends(self, parameters: Mapping[str, Array]) -> Array:
        """Return by how much the predicted states at the ends of segments move, (S, 9)."""
        return np.asarray(self._ends @ self.vector(parameters))

    def corrected(self, at: Attachment, bound: Attachment, errors: Array) -> Attachment:
        """Return an attachment without the errors; `bound` is where it was bound."""
        by = self._by[id(bound)]
        if at is not bound:
            by = moved(self._segments, at, bound, by, self._whole)
        return self.without(at, by, errors)

    def without(self, at: Attachment, by: Sensitivity, errors: Array) -> Attachment:
        """Return an attachment without the errors (n,), which move it by its sensitivity."""
        return corrected(at, by, self._elements, errors)

    def columns(
        self, lin: Linearization, transition: Transition, by: Sensitivity
    ) -> dict[str, Array]:
        """Return derivatives of measurements with respect to the errors, (M, d, n_i) by name."""
        every = by_errors(lin, transition, by, self._elements)
        parts = np.split(every, np.cumsum(self._sizes)[:-1], axis=2)
        return dict(zip(self.names, parts, strict=True))

    def at(self, attachment: Attachment, bound: Attachment) -> ImuErrors:
        """Return the errors where measurements at `bound` have another attachment."""
        out = copy(self)
        out._by = {**self._by, id(attachment): self._by[id(bound)]}
        return out

    def linearized(self, native: gtsam.GaussianFactorGraph, errors: Array) -> LinearImuFactors:
        """Return native factors with what errors (n,) change in those of the IMU.

        The predicted state at the end of a segment moves by D e, and with it the residual by
        -A_j D e, where A_j is its Jacobian with respect to the state there.
        """
        count = self._ends.shape[0]
        whole = np.array([native.at(k).augmentedJacobian() for k in range(count)])
        columns = -whole[:, :, STATE_SIZE : 2 * STATE_SIZE] @ self._ends
        change = columns @ errors
        rhs = whole[:, :, -1]
        more_cost = 0.5 * float(np.sum(change * (change - 2.0 * rhs)))
        jacobian = np.concatenate([whole[:, :, :-1], columns], axis=2)
        return LinearImuFactors(native, jacobian, rhs - change, more_cost)

    def sensitivity(self, bound: Attachment) -> Sensitivity:
        """Return how what is integrated up to measurements moves with the errors."""
        return self._by[id(bound)]

    def of_rows(self, bound: Attachment, rows: Attachment, some: IntArray) -> ImuErrors:
        """Return the same for some measurements (K,) of those that are bound, with `rows`."""
        out = copy(self)
        out._by = {id(rows): rows_of(self._by[id(bound)], some)}
        return out

    def factors(self, graph: gtsam.NonlinearFactorGraph) -> list[gtsam.CustomFactor]:
        """Return the IMU factors, which a graph begins with, as they depend on the errors."""
        return [
            _with_errors(graph.at(k), end, self._keys, self._sizes)
            for k, end in enumerate(self._ends)
        ]

    def release(self) -> None:
        """Free the factors that `filled` writes; its next call makes others."""
        self._factors = []

    def filled(self, linear: LinearImuFactors) -> gtsam.GaussianFactorGraph:
        """Return the native part of the Gaussian graph; written in place at the next call."""
        count = len(linear.jacobian)
        if not self._factors:
            sizes = [STATE_SIZE, STATE_SIZE, BIAS_SIZE, *self._sizes]
            self._factors = [
                jacobian_template([*linear.native.at(k).keys(), *self._keys], sizes, STATE_SIZE)
                for k in range(count)
            ]
        out = gtsam.GaussianFactorGraph()
        for k, factor in enumerate(self._factors):
            factor.getA()[...] = linear.jacobian[k]
            factor.getb()[...] = linear.rhs[k]
            out.push_back(factor)
        for k in range(count, linear.native.size()):
            out.push_back(linear.native.at(k))
        return out


def _with_errors(
    native: gtsam.NonlinearFactor, ends: Array, error_keys: Sequence[int], sizes: Sequence[int]
) -> gtsam.CustomFactor:
    """Return an IMU factor whose predicted state moves by `ends` (9, n) times the errors.

    Zero error where the state at the end is the predicted one less that.
    """
    edges = np.cumsum([0, STATE_SIZE, STATE_SIZE, BIAS_SIZE, *sizes])

    def error(this: gtsam.CustomFactor, at: gtsam.Values, jacobians: list[Array] | None) -> Array:
        whole = native.linearize(at).augmentedJacobian()
        columns = -whole[:, STATE_SIZE : 2 * STATE_SIZE] @ ends
        errors = np.concatenate([at.atVector(key) for key in error_keys])
        if jacobians is not None:
            every = np.concatenate([whole[:, :-1], columns], axis=1)
            for i in range(edges.size - 1):
                jacobians[i] = np.asfortranarray(every[:, edges[i] : edges[i + 1]])
        return np.asarray(columns @ errors - whole[:, -1])

    unit = gtsam.noiseModel.Unit.Create(STATE_SIZE)
    return gtsam.CustomFactor(unit, [*native.keys(), *error_keys], error)
