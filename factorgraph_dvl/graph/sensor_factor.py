"""All measurements between one node and the next as one nonlinear factor.

iSAM2 linearises factors one by one, so each is a callback into Python: one for a node, not
one for a measurement.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import gtsam
import numpy as np

from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.bound_observation import BoundObservation, Processes
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.clocks import time_on_chain
from factorgraph_dvl.graph.forward_chain import ForwardChain
from factorgraph_dvl.graph.imu_errors import ImuErrors
from factorgraph_dvl.graph.keys import BIAS_SIZE, STATE_SIZE
from factorgraph_dvl.graph.native_graph import custom_factor
from factorgraph_dvl.graph.observation_rows import ObservationRows
from factorgraph_dvl.graph.priors import prior_mean, value_at
from factorgraph_dvl.imu.preintegration import Preintegration
from factorgraph_dvl.imu.propagation import Attachment, States
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Motion, Observation

# What rounding may take off a time, s.
_ROUNDING = 1e-6
# Their errors are added by those who have them.
_NO_PROCESSES = Processes(None, ())


@dataclass(frozen=True)
class NodeMeasurements:
    """What was measured between a node and the next.

    Parameters
    ----------
    bound : tuple of BoundObservation
        The measurements, tied to a chain of which the node is the first.
    parameters : tuple of Parameter
        Those that are estimated and that the measurements depend on.
    fixed : mapping of str to ndarray
        Values of those that are not.
    """

    bound: tuple[BoundObservation, ...]
    parameters: tuple[Parameter, ...]
    fixed: Mapping[str, Array]
    # What hangs at the times of the last evaluation.
    _attached: dict[tuple[bytes, ...], list[Attachment]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        bound: Sequence[BoundObservation],
        estimated: Sequence[Parameter],
        fixed: Mapping[str, Array],
    ) -> NodeMeasurements:
        """Return measurements with those of all estimated parameters that they depend on."""
        used = {name for b in bound for name in b.names}
        return cls(tuple(bound), tuple(p for p in estimated if p.name in used), fixed)

    def attach(self, values: Mapping[str, Array]) -> list[Attachment]:
        """Attach measurements by clocks as they are; those of one time share what they depend on.

        Few times take as long as a single one: all at once.
        """
        times = [b.times(values) for b in self.bound]
        when = tuple(time.tobytes() for time in times)
        if when not in self._attached:
            chain, count = self.bound[0].chain, 0
            whole = chain.attach(np.concatenate(times))
            found: dict[bytes, Attachment] = {}
            for time in times:
                found.setdefault(time.tobytes(), rows_of(whole, slice(count, count + time.size)))
                count += time.size
            self._attached.clear()
            self._attached[when] = [found[each] for each in when]
        out = self._attached[when]
        if self.bound[0].errors is not None:
            self.bound[0].errors.attach(out)
        for b, at in zip(self.bound, out, strict=True):
            b.attachment = at
        return out

    def motions(self, states: States, values: Mapping[str, Array]) -> list[Motion]:
        """Return the motion at the true times of each kind; those of one time share it."""
        values = {**self.fixed, **values}
        computed: dict[Attachment, Motion] = {}
        out = []
        for b, at in zip(self.bound, self.attach(values), strict=True):
            if at not in computed:
                computed[at] = b.motion(at, states, values)
            out.append(computed[at])
        return out

    def linearize(
        self, states: States, values: Mapping[str, Array]
    ) -> tuple[Array, Array, list[Motion]]:
        """Return residuals (R,), their Jacobian (R, 15 + n), and the motions.

        Columns: variables of the chain, as it has them, then the parameters.
        """
        values = {**self.fixed, **values}
        motions = self.motions(states, values)
        transitions: dict[Hashable, Any] = {}
        every = tuple((p.name, p.mean.size) for p in self.parameters)
        residuals, matrices = [], []
        for b, motion in zip(self.bound, motions, strict=True):
            wanted = [p.name for p in b.parameters(self.parameters)]
            lin = b.linearized(motion, values, wanted, _NO_PROCESSES)
            own, residual = b.jacobian(
                lin, slice(None), motion, states, values, wanted, _NO_PROCESSES, transitions
            )
            size, columns = _columns(sum(b.chain.sizes), every, tuple(wanted))
            matrix = np.zeros((residual.size, size))
            matrix[:, columns] = own.reshape(residual.size, -1)
            residuals.append(residual.ravel())
            matrices.append(matrix)
        return np.concatenate(residuals), np.concatenate(matrices), motions

    def sigma(
        self,
        motions: Sequence[Motion],
        values: Mapping[str, Array],
        factors: Mapping[str, Array],
    ) -> Array:
        """Return the standard deviations, (R,), at motions of each kind.

        `factors` (d,) multiply those that sensors state for their own noise, by label.
        """
        values = {**self.fixed, **values}
        each = (
            b.observation.sigma(motion, values, factors.get(b.observation.label, 1.0))
            for b, motion in zip(self.bound, motions, strict=True)
        )
        return np.concatenate([sigma.ravel() for sigma in each])


@lru_cache
def _columns(
    first: int, every: tuple[tuple[str, int], ...], wanted: tuple[str, ...]
) -> tuple[int, IntArray]:
    """Return the number of columns, and those of the chain and of some parameters."""
    ends = np.cumsum([first, *(size for _, size in every)]).tolist()
    own = [np.arange(first)]
    own += [
        np.arange(a, b)
        for (name, _), a, b in zip(every, ends[:-1], ends[1:], strict=True)
        if name in wanted
    ]
    return ends[-1], np.concatenate(own)


def bind(
    chain: Chain,
    observations: Sequence[Observation],
    parameters: Sequence[Parameter],
    key_of: Mapping[str, int],
    clock_zero: float,
) -> tuple[list[BoundObservation], ImuErrors | None]:
    """Tie what was measured in a chain to it.

    Parameters
    ----------
    chain : Chain
        Chain that covers the measurements.
    observations : sequence of Observation
        What was measured.
    parameters : sequence of Parameter
        Those that are estimated.
    key_of : mapping of str to int
        Their keys.
    clock_zero : float
        Reference time of the clock offsets, s.

    Returns
    -------
    bound : list of BoundObservation
        The measurements, with a weight of one.
    errors : ImuErrors or None
        Errors of the IMU among the parameters.
    """
    errors = chain.errors(parameters, key_of)
    bound = []
    for o in observations:
        count = o.time.size
        usable, weight = np.ones(count, dtype=bool), np.ones((count, len(o.components)))
        bound.append(BoundObservation(o, chain, None, usable, weight, clock_zero, errors))
    return bound, errors


@dataclass(frozen=True)
class Linearized:
    """Residual (R,) and Jacobian (R, 15 + n) of measurements, and where they were computed.

    Parameters
    ----------
    state, bias : gtsam.NavState or gtsam.imuBias.ConstantBias
        State and bias of the node.
    values : mapping of str to ndarray
        Values of the parameters.
    residual, jacobian : ndarray
        Residual and Jacobian that `NodeMeasurements.linearize` returns.
    """

    state: gtsam.NavState
    bias: gtsam.imuBias.ConstantBias
    values: Mapping[str, Array]
    residual: Array
    jacobian: Array

    def is_at(
        self,
        state: gtsam.NavState,
        bias: gtsam.imuBias.ConstantBias,
        values: Mapping[str, Array],
    ) -> bool:
        """Whether it was computed at this very state and these values."""
        if not (self.state.equals(state, 0.0) and self.bias.equals(bias, 0.0)):
            return False
        # Bytes of few numbers take less time to compare.
        return all(self.values[name].tobytes() == at.tobytes() for name, at in values.items())


def measurement_factor(
    measured: NodeMeasurements,
    weight: Array,
    node_key: int,
    bias_key: int,
    parameter_keys: Sequence[int],
    first: Linearized | None = None,
    errors: Mapping[int, Array] | None = None,
) -> gtsam.CustomFactor:
    """Return the factor of what was measured after a node; zero error where it is predicted.

    Parameters
    ----------
    measured : NodeMeasurements
        Rows R in all.
    weight : ndarray, shape (R,)
        Inverse standard deviations; 0 = not used.
    node_key, bias_key, parameter_keys : int or sequence of int
        Keys of the variables, parameters as in `measured`.
    first : Linearized, optional
        Where GTSAM will linearise first.
    errors : mapping of int to ndarray, optional
        Derivatives (R, n) of the residuals by vectors that add to them, by their keys.
    """
    kept = [first] if first is not None else []
    added = [] if errors is None else [*errors.items()]
    every = [node_key, bias_key, *parameter_keys, *(key for key, _ in added)]
    sizes = [STATE_SIZE, BIAS_SIZE, *(p.mean.size for p in measured.parameters)]
    sizes += [gain.shape[1] for _, gain in added]
    if len(every) != len(sizes):
        raise ValueError(f"{len(parameter_keys)} keys for {len(measured.parameters)} parameters")

    def linearize(at: gtsam.Values) -> tuple[Array, Array]:
        state, bias = at.atNavState(node_key), at.atConstantBias(bias_key)
        values = {
            p.name: value_at(at, key, p)
            for p, key in zip(measured.parameters, parameter_keys, strict=True)
        }
        once = kept.pop() if kept else None
        if once is not None and once.is_at(state, bias, values):
            residual, matrix = once.residual, once.jacobian
        else:
            residual, matrix, _ = measured.linearize(state_of(state, bias), values)
        for key, gain in added:
            residual, matrix = residual + gain @ at.atVector(key), np.hstack([matrix, gain])
        return weight * residual, weight[:, None] * matrix

    return custom_factor(every, sizes, weight.size, linearize)


def state_of(state: gtsam.NavState, bias: gtsam.imuBias.ConstantBias) -> States:
    """Return GTSAM's state and bias as the states of a single node."""
    matrix, vector = state.matrix()[None], bias.vector()
    return States(
        matrix[:, :3, :3],
        matrix[:, :3, 3],
        matrix[:, :3, 4],
        gyro_bias=vector[None, 3:],
        accel_bias=vector[None, :3],
    )


def sensor_factor(
    observation: Observation,
    parameters: Sequence[Parameter],
    chain: Preintegration,
    k: int,
    keys: Mapping[str, int],
    values: gtsam.Values,
    *,
    clock_zero: float = 0.0,
) -> gtsam.CustomFactor:
    """Return a factor of what a sensor measured between node k and the next.

    Its variables are the `NavState` at node k, the `ConstantBias` of the IMU, and those
    calibration parameters that have a key: a `Rot3` for a rotation, else a vector, SI. It works
    in any graph, and GTSAM's own optimisers and `Marginals` take it. The other parameters are
    fixed at their prior means. Each measurement counts as instantaneous.

    Parameters
    ----------
    observation : Observation
        Measurements of a sensor, as its `observations` returns them, at any times.
    parameters : sequence of Parameter
        Parameters of the sensor, as its `parameters` returns them.
    chain : Preintegration
        What the IMU saw between the nodes.
    k : int
        Node.
    keys : mapping of str to int
        Keys of the state, `state`, of the bias, `bias`, and of parameters by name.
    values : gtsam.Values
        Approximate values of these variables. Standard deviations are taken there.
    clock_zero : float, optional
        Reference time of the clock offsets, s.

    Raises
    ------
    ValueError
        If nothing was measured there; see `measured_nodes`.
    KeyError
        If a parameter that has a key is none of the sensor's.

    Warns
    -----
    UserWarning
        If the sensor averages over a window, which the factor leaves out.

    Examples
    --------
    A DVL 2 m ahead of an IMU that turns at 0.1 rad/s about the vertical, in axes right, forward,
    up, moves at 0.2 m/s to the left:

    >>> import gtsam, numpy as np
    >>> import factorgraph_dvl as fd
    >>> from gtsam.symbol_shorthand import B, L, X
    >>> frame = fd.LocalFrame(np.radians(36.0), np.radians(121.0), 0.0)
    >>> time = np.arange(1, 201) / 100.0
    >>> gyro = np.tile([0.0, 0.0, 0.1], (200, 1))
    >>> force = np.tile([0.0, 0.0, 9.8], (200, 1))
    >>> imu = fd.Imu(fd.ImuSettings(grade="tactical"), time, gyro, force)
    >>> chain = fd.preintegrate(imu, [0.0, 1.0, 2.0], frame)
    >>> dvl = fd.Dvl(fd.DvlSettings(), np.array([0.0]), np.zeros((1, 3)), np.full((1, 3), 0.1))
    >>> (velocity,) = dvl.observations(frame, "RFU")
    >>> values = gtsam.Values()
    >>> values.insert(X(0), gtsam.NavState())
    >>> values.insert(B(0), gtsam.imuBias.ConstantBias())
    >>> values.insert(L(0), np.array([0.0, 2.0, 0.0]))
    >>> keys = {"state": X(0), "bias": B(0), "lever_arm_m": L(0)}
    >>> factor = fd.sensor_factor(velocity, dvl.parameters(), chain, 0, keys, values)
    >>> (0.1 * factor.unwhitenedError(values)).round(3) + 0.0
    array([-0.2,  0. ,  0. ])
    """
    unknown = set(keys) - {"state", "bias", *(p.name for p in parameters)}
    if unknown:
        raise KeyError(f"{', '.join(sorted(unknown))}: no parameter of the sensor")
    fixed = {p.name: prior_mean(p) for p in parameters}
    if np.any(fixed.get(observation.averaging or "", 0.0)):
        text = f"{observation.label}: the factor leaves out the window over which it averages"
        warnings.warn(text, stacklevel=2)
    free = tuple(p for p in parameters if p.name in keys)
    given = {**fixed, **{p.name: value_at(values, keys[p.name], p) for p in free}}
    node = nodes_before(observation, chain, given, clock_zero)
    (index,) = np.nonzero(node == k)
    if not index.size:
        raise ValueError(f"{observation.label} has no measurement between node {k} and the next")
    some = ObservationRows(observation, index)
    bound, _ = bind(_inertial(chain).from_node(np.array([k])), [some], (), {}, clock_zero)
    measured = NodeMeasurements(tuple(bound), free, fixed)
    states = state_of(values.atNavState(keys["state"]), values.atConstantBias(keys["bias"]))
    weight = 1.0 / measured.sigma(measured.motions(states, given), given, {})
    shared = [keys[p.name] for p in free]
    return measurement_factor(measured, weight, keys["state"], keys["bias"], shared)


def _inertial(chain: Preintegration) -> ForwardChain:
    """Return the chain of a preintegration, without its factors."""
    biases = chain.imu.parameters(0.0)
    graph = gtsam.NonlinearFactorGraph()
    return ForwardChain(
        chain.frame, chain.segments, chain.gravity_n, biases, biases, chain.imu.settings, graph
    )


def measured_nodes(
    observation: Observation,
    parameters: Sequence[Parameter],
    chain: Preintegration,
    *,
    clock_zero: float = 0.0,
) -> list[int]:
    """Return the nodes after which a sensor measured something, for `sensor_factor`.

    Parameters
    ----------
    observation : Observation
        Measurements of a sensor.
    parameters : sequence of Parameter
        Its parameters.
    chain : Preintegration
        What the IMU saw between the nodes.
    clock_zero : float, optional
        Reference time of the clock offsets, s.

    Examples
    --------
    >>> import numpy as np
    >>> import factorgraph_dvl as fd
    >>> trial = fd.simulate("examples/short.yaml", seed=1)
    >>> frame = trial.frame()
    >>> chain = fd.preintegrate(trial.imu, np.arange(10.0, 15.0), frame)
    >>> (velocity,) = trial.dvl.observations(frame, trial.body_axes)
    >>> fd.measured_nodes(velocity, trial.dvl.parameters(), chain)
    [0, 1, 2, 3]
    """
    fixed = {p.name: prior_mean(p) for p in parameters}
    node = nodes_before(observation, chain, fixed, clock_zero)
    return [int(k) for k in np.unique(node) if k >= 0]


def nodes_before(
    observation: Observation, chain: Preintegration, values: Mapping[str, Array], clock_zero: float
) -> IntArray:
    """Return the nodes before measurements (M,), -1 outside the chain."""
    time = time_on_chain(observation, values, clock_zero, None)
    inside = (time > chain.time[0] - _ROUNDING) & (time < chain.time[-1] + _ROUNDING)
    return np.where(inside, _inertial(chain).attach(time).node, -1)
