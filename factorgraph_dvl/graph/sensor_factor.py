"""All measurements between one node and the next as one nonlinear factor.

iSAM2 linearises factors one by one, so each is a callback into Python: one for a node, not
one for a measurement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import cast

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.clocks import linearized, parameters_of, true_time
from factorgraph_dvl.graph.keys import BIAS_SIZE, STATE_SIZE
from factorgraph_dvl.graph.problem import node_jacobian
from factorgraph_dvl.imu.propagation import Attachment, States, Transition, extrapolated, motion_at
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Motion, Observation


@dataclass(frozen=True)
class Rows:
    """Measurements of one kind, tied to a node.

    Parameters
    ----------
    observation : Observation
        M measurements.
    at : slice
        Slice of the node's attachment.
    time : ndarray, shape (M,)
        Times for which they were attached, s.
    """

    observation: Observation
    at: slice
    time: Array


@dataclass(frozen=True)
class NodeMeasurements:
    """What was measured between a node and the next.

    Parameters
    ----------
    attachment : Attachment
        Of all measurement times, to a node that counts as the first.
    rows : tuple of Rows
        The measurements.
    parameters : tuple of Parameter
        Those that are estimated and that the measurements depend on.
    fixed : mapping of str to ndarray
        Values of those that are not.
    gravity_n : ndarray, shape (1, 3)
        `LocalFrame.gravity_without_rotation`, m/s².
    earth_rate_n : ndarray, shape (3,), rad/s
        Earth rate in n.
    clock_zero : float, optional
        When the offsets of clocks hold, s.
    """

    attachment: Attachment
    rows: tuple[Rows, ...]
    parameters: tuple[Parameter, ...]
    fixed: Mapping[str, Array]
    gravity_n: Array
    earth_rate_n: Array
    clock_zero: float = 0.0

    def attachment_of(self, rows: Rows) -> Attachment:
        """Return the attachment of measurements of one kind."""
        a = self.attachment
        return Attachment(**{f.name: getattr(a, f.name)[rows.at] for f in fields(a)})

    def motions(self, states: States, values: Mapping[str, Array]) -> tuple[Motion, list[Motion]]:
        """Return the motion at all times as attached, and at the true times of each kind."""
        motion = motion_at(self.attachment, states, self.gravity_n, self.earth_rate_n)
        out = []
        for r in self.rows:
            part = _part(motion, r.at) if len(self.rows) > 1 else motion
            late = true_time(r.observation, values, self.clock_zero) - r.time
            out.append(extrapolated(part, late))
        return motion, out

    def linearize(
        self, states: States, values: Mapping[str, Array]
    ) -> tuple[Array, Array, list[Motion]]:
        """Return residuals (R,), their Jacobian (R, 15 + n), and the motions.

        Columns: attitude, position, velocity of the node in GTSAM's tangent space,
        accelerometer and gyro bias, then the parameters.
        """
        values = {**self.fixed, **values}
        motion, motions = self.motions(states, values)
        transition = Transition(self.attachment, states, motion, self.earth_rate_n)
        width = STATE_SIZE + BIAS_SIZE + sum(p.mean.size for p in self.parameters)
        residuals, jacobians = [], []
        for r, own in zip(self.rows, motions, strict=True):
            used = parameters_of(r.observation)
            wanted = [p.name for p in self.parameters if p.name in used]
            lin = linearized(r.observation, own, values, wanted, self.clock_zero)
            m, d = lin.residual.shape
            matrix = np.zeros((m, d, width))
            matrix[:, :, : STATE_SIZE + BIAS_SIZE] = node_jacobian(
                lin, cast(Transition, _Window(transition, r.at))
            )
            column = STATE_SIZE + BIAS_SIZE
            for p in self.parameters:
                if p.name in wanted:
                    matrix[:, :, column : column + p.mean.size] = lin.d_parameters[p.name]
                column += p.mean.size
            residuals.append(lin.residual.ravel())
            jacobians.append(matrix.reshape(m * d, width))
        return np.concatenate(residuals), np.concatenate(jacobians), motions

    def residuals(self, states: States, values: Mapping[str, Array]) -> Array:
        """Return the residuals, (R,)."""
        values = {**self.fixed, **values}
        _, motions = self.motions(states, values)
        return np.concatenate(
            [
                r.observation.residual(motion, values).ravel()
                for r, motion in zip(self.rows, motions, strict=True)
            ]
        )

    def sigma(self, motions: Sequence[Motion], values: Mapping[str, Array]) -> Array:
        """Return the standard deviations, (R,), at motions of each kind."""
        values = {**self.fixed, **values}
        return np.concatenate(
            [
                np.broadcast_to(
                    r.observation.sigma(motion, values),
                    (r.time.size, len(r.observation.components)),
                ).ravel()
                for r, motion in zip(self.rows, motions, strict=True)
            ]
        )


@dataclass(frozen=True)
class Linearized:
    """Residual (R,) and Jacobian (R, 15 + n) of measurements, and where they were computed.

    Parameters
    ----------
    states, values : States or mapping of str to ndarray
        Of the node and the parameters.
    residual, jacobian : ndarray
        As `NodeMeasurements.linearize` returns them.
    """

    states: States
    values: Mapping[str, Array]
    residual: Array
    jacobian: Array

    def is_at(self, states: States, values: Mapping[str, Array]) -> bool:
        """Whether it was computed at these very states and values."""
        same = all(
            np.array_equal(getattr(self.states, f.name), getattr(states, f.name))
            for f in fields(States)
        )
        return same and all(np.array_equal(self.values[name], v) for name, v in values.items())


class _Window:
    """A slice of a transition: what `node_jacobian` asks for, of some times only."""

    def __init__(self, transition: Transition, at: slice) -> None:
        self._transition = transition
        self._at = at

    def __getattr__(self, name: str) -> Array:
        return np.asarray(getattr(self._transition, name)[self._at])


def measurement_factor(
    measured: NodeMeasurements,
    weight: Array,
    node_key: int,
    bias_key: int,
    parameter_keys: Sequence[int],
    first: Linearized | None = None,
) -> gtsam.CustomFactor:
    """Return the factor of what was measured after a node; zero error where it is predicted.

    The one adapter between the sensors' equations and GTSAM: GTSAM crashes if a callback
    leaves a Jacobian unfilled or of another shape, so shapes are checked here.

    Parameters
    ----------
    measured : NodeMeasurements
        Rows R in all.
    weight : ndarray, shape (R,)
        Inverse standard deviations; 0 = not used.
    node_key, bias_key, parameter_keys : int or sequence of int
        Of the variables, parameters as in `measured`.
    first : Linearized, optional
        Where GTSAM will linearise first.
    """
    kept = [first] if first is not None else []
    every = [node_key, bias_key, *parameter_keys]
    sizes = [STATE_SIZE, BIAS_SIZE, *(p.mean.size for p in measured.parameters)]
    edges = np.cumsum([0, *sizes])
    rows = weight.size
    if len(every) != len(sizes):
        raise ValueError(f"{len(parameter_keys)} keys for {len(measured.parameters)} parameters")

    def error(this: gtsam.CustomFactor, at: gtsam.Values, jacobians: list[Array] | None) -> Array:
        states = state_of(at.atNavState(node_key), at.atConstantBias(bias_key))
        values = {
            p.name: at.atRot3(key).matrix() if p.rotation else at.atVector(key)
            for p, key in zip(measured.parameters, parameter_keys, strict=True)
        }
        if jacobians is None:
            return weight * measured.residuals(states, values)
        once = kept.pop() if kept else None
        if once is not None and once.is_at(states, values):
            residual, matrix = once.residual, once.jacobian
        else:
            residual, matrix, _ = measured.linearize(states, values)
        if matrix.shape != (rows, edges[-1]) or len(jacobians) != len(sizes):
            raise ValueError(f"Jacobian of shape {matrix.shape}, expected {(rows, edges[-1])}")
        matrix = matrix * weight[:, None]
        for i in range(len(sizes)):
            jacobians[i] = np.asfortranarray(matrix[:, edges[i] : edges[i + 1]])
        return weight * residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), every, error)


def state_of(state: gtsam.NavState, bias: gtsam.imuBias.ConstantBias) -> States:
    """Return GTSAM's state and bias as the states of a single node."""
    vector = bias.vector()
    return States(
        state.attitude().matrix()[None],
        state.position()[None],
        state.velocity()[None],
        gyro_bias=vector[None, 3:],
        accel_bias=vector[None, :3],
    )


def _part(motion: Motion, at: slice) -> Motion:
    return Motion(**{f.name: getattr(motion, f.name)[at] for f in fields(motion)})
