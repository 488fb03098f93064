"""Errors of the IMU that grow with rate and force, as parameters of the graph.

GTSAM's IMU factors have no variables for them. Their prediction of a state moves linearly
with the errors, so the errors get columns of their own in the linear factors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.keys import BIAS_SIZE, STATE_SIZE
from factorgraph_dvl.graph.template import jacobian_template
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.imu.sensitivity import (
    Sensitivity,
    at_errors,
    by_errors,
    carried_back_by,
    corrected_two_way,
    elements,
    predicted,
    sensitivities,
)
from factorgraph_dvl.imu.two_way import shares
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
        Jacobian of the IMU factors: states, bias, errors.
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
    """

    def __init__(
        self,
        segments: Segments,
        parameters: Sequence[Parameter],
        keys: Sequence[int],
    ) -> None:
        self.parameters = tuple(parameters)
        self.names = tuple(p.name for p in parameters)
        self.key_of = dict(zip(self.names, keys, strict=True))
        self._keys = list(keys)
        self._sizes = [p.mean.size for p in parameters]
        self._segments = segments
        self._elements = elements(parameters)
        self._of_ends: Sensitivity | None = None
        # For as long as something hangs there.
        self._by: WeakKeyDictionary[Any, Sensitivity] = WeakKeyDictionary()
        self._factors: list[gtsam.JacobianFactor] = []

    def vector(self, parameters: Mapping[str, Array]) -> Array:
        """Return the errors among parameters, (n,), SI."""
        return np.concatenate([parameters[name] for name in self.names])

    def ends(self, parameters: Mapping[str, Array]) -> Array:
        """Return by how much the predicted states at the ends of segments move, (S, 9)."""
        return np.asarray(self._ends @ self.vector(parameters))

    def attach(self, attachments: Sequence[Any]) -> None:
        """Find how what is integrated up to attached times moves, of all of them at once."""
        new = [at for at in {id(at): at for at in attachments}.values() if at not in self._by]
        if new or self._of_ends is None:
            forward = [at.forward for at in new]
            self._of_ends, found = sensitivities(self._segments, self._elements, forward)
            self._by.update(zip(new, found, strict=True))

    @cached_property
    def _ends(self) -> Array:
        """Derivatives of the predicted states at the ends of segments, (S, 9, n)."""
        if self._of_ends is None:
            self.attach(())
        assert self._of_ends is not None
        return predicted(self._segments, self._of_ends)

    def sensitivity(self, at: Any) -> Sensitivity:
        """Return how what is integrated from the nodes before moves with the errors."""
        self.attach([at])
        return self._by[at]

    def without(self, at: Any, by: Sensitivity, errors: Array) -> Any:
        """Return an attachment without the errors (n,), which move it by its sensitivity."""
        assert self._of_ends is not None
        return corrected_two_way(at, by, self._of_ends, self._segments, self._elements, errors)

    def columns(
        self, lin: Linearization, transition: Any, by: Sensitivity, errors: Array
    ) -> dict[str, Array]:
        """Return derivatives of measurements by the errors (n,) there, (M, d, n_i) by name."""
        assert self._of_ends is not None
        by, ends = (at_errors(each, errors) for each in (by, self._of_ends))
        back = carried_back_by(transition.at, by, ends)
        ahead, behind = shares(lin, transition)
        every = by_errors(ahead, transition.forward, by, self._elements)
        every = every + by_errors(behind, transition.backward, back, self._elements)
        parts = np.split(every, np.cumsum(self._sizes)[:-1], axis=2)
        return dict(zip(self.names, parts, strict=True))

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
