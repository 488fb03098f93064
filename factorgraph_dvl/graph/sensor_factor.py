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
import msgspec
import numpy as np

from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.bound_observation import BoundObservation, Processes, covers_windows
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.clocks import time_on_chain
from factorgraph_dvl.graph.imu_errors import ImuErrors
from factorgraph_dvl.graph.inertial_chain import InertialChain, states_of
from factorgraph_dvl.graph.native_graph import custom_factor
from factorgraph_dvl.graph.observation_rows import ObservationRows
from factorgraph_dvl.graph.priors import prior_mean, value_at
from factorgraph_dvl.imu.gtsam_measurements import Preintegration
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.imu.two_way import TwoWay
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
    _attached: dict[tuple[Hashable, ...], list[TwoWay]] = field(default_factory=dict)

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

    def attach(self, values: Mapping[str, Array]) -> list[TwoWay]:
        """Attach measurements by clocks as they are; those of one time share what they depend on.

        Few times take as long as a single one: all of the same window at once.
        """
        places = [(b.times(values), b.window(values)) for b in self.bound]
        when = tuple((time.tobytes(), window) for time, window in places)
        if when not in self._attached:
            chain, found = self.bound[0].chain, dict[Hashable, TwoWay]()
            for window in {window for _, window in places}:
                own = {time.tobytes(): time for time, each in places if each == window}
                whole, count = chain.attach(np.concatenate([*own.values()]), window=window), 0
                for key, time in own.items():
                    found[key, window] = rows_of(whole, slice(count, count + time.size))
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
        computed: dict[TwoWay, Motion] = {}
        out = []
        for b, at in zip(self.bound, self.attach(values), strict=True):
            if at not in computed:
                computed[at] = b.motion(at, states, values)
            out.append(computed[at])
        return out

    def linearize(
        self, states: States, values: Mapping[str, Array]
    ) -> tuple[Array, Array, list[Motion], Array]:
        """Return residuals (R,), their Jacobian (R, c + n), the motions, and missing variance.

        Columns: variables of the chain, as it has them, then the parameters. The variance (R,) is
        what is missing between the nodes.
        """
        values = {**self.fixed, **values}
        motions = self.motions(states, values)
        transitions: dict[Hashable, Any] = {}
        every = tuple((p.name, p.mean.size) for p in self.parameters)
        residuals, matrices, variances = [], [], []
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
            missing = b.chain.missing(b.attachment, lin)
            variances.append(np.zeros(residual.size) if missing is None else missing.ravel())
        return (
            np.concatenate(residuals),
            np.concatenate(matrices),
            motions,
            np.concatenate(variances),
        )

    def sigma(
        self,
        motions: Sequence[Motion],
        missing: Array,
        values: Mapping[str, Array],
        factors: Mapping[str, Array],
    ) -> Array:
        """Return the standard deviations, (R,), at motions of each kind; infinite beyond the IMU.

        `missing` (R,) is added to the variance; `factors` (d,), or (2, d) by part, multiply what
        sensors state for their own noise, by label.
        """
        values = {**self.fixed, **values}
        each = (
            b.observation.sigma(motion, values, factors.get(b.observation.label, 1.0))
            for b, motion in zip(self.bound, motions, strict=True)
        )
        out = np.sqrt(np.concatenate([sigma.ravel() for sigma in each]) ** 2 + missing)
        covered = []
        for b in self.bound:
            inside = covers_windows(b.chain, b.observation, b.times(values), values)
            covered.append(inside.repeat(b.weight.shape[1]))
        return np.where(np.concatenate(covered), out, np.inf)


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
        averages = o.averaging in key_of
        bound.append(
            BoundObservation(o, chain, None, usable, weight, clock_zero, errors, averages)
        )
    return bound, errors


@dataclass(frozen=True)
class Linearized:
    """Residual (R,) and Jacobian (R, c + n) of measurements, and where they were computed.

    Parameters
    ----------
    states : States
        States of both nodes.
    values : mapping of str to ndarray
        Values of the parameters.
    residual, jacobian : ndarray
        Residual and Jacobian that `NodeMeasurements.linearize` returns.
    """

    states: States
    values: Mapping[str, Array]
    residual: Array
    jacobian: Array

    def is_at(self, states: States, values: Mapping[str, Array]) -> bool:
        """Whether it was computed at these very states and values."""
        own = (*vars(self.states).values(), *(self.values[name] for name in values))
        # Bytes of few numbers take less time to compare.
        return all(
            a.tobytes() == b.tobytes()
            for a, b in zip(own, (*vars(states).values(), *values.values()), strict=True)
        )


def measurement_factor(
    measured: NodeMeasurements,
    weight: Array,
    nodes: Sequence[int],
    parameter_keys: Sequence[int],
    first: Linearized | None = None,
    errors: Mapping[int, Array] | None = None,
) -> gtsam.CustomFactor:
    """Return the factor of what was measured between two nodes; zero error where it is predicted.

    Parameters
    ----------
    measured : NodeMeasurements
        Rows R in all.
    weight : ndarray, shape (R,)
        Inverse standard deviations; 0 = not used.
    nodes, parameter_keys : sequence of int
        Keys of the variables of the chain, as it has them, and of parameters as in `measured`.
    first : Linearized, optional
        Where GTSAM will linearise first.
    errors : mapping of int to ndarray, optional
        Derivatives (R, n) of the residuals by vectors that add to them, by their keys.
    """
    kept = [first] if first is not None else []
    added = [] if errors is None else [*errors.items()]
    every = [*nodes, *parameter_keys, *(key for key, _ in added)]
    sizes = [*measured.bound[0].chain.sizes, *(p.mean.size for p in measured.parameters)]
    sizes += [gain.shape[1] for _, gain in added]
    if len(every) != len(sizes):
        raise ValueError(f"{len(parameter_keys)} keys for {len(measured.parameters)} parameters")

    def linearize(at: gtsam.Values) -> tuple[Array, Array]:
        states = states_at(at, nodes)
        values = {
            p.name: value_at(at, key, p)
            for p, key in zip(measured.parameters, parameter_keys, strict=True)
        }
        once = kept.pop() if kept else None
        if once is not None and once.is_at(states, values):
            residual, matrix = once.residual, once.jacobian
        else:
            residual, matrix, *_ = measured.linearize(states, values)
        for key, gain in added:
            residual, matrix = residual + gain @ at.atVector(key), np.hstack([matrix, gain])
        return weight * residual, weight[:, None] * matrix

    return custom_factor(every, sizes, weight.size, linearize)


def states_at(values: gtsam.Values, nodes: Sequence[int]) -> States:
    """Return the states of two nodes: keys of state and bias of each, or of a bias of both."""
    biases = [values.atConstantBias(key) for key in nodes[1::2]]
    return states_of([values.atNavState(key) for key in nodes[::2]], biases)


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

    Its variables are the `NavState` at both nodes, the `ConstantBias` of the IMU, and those
    calibration parameters that have a key: a `Rot3` for a rotation, else a vector, SI. It works
    in any graph, and GTSAM's own optimisers and `Marginals` take it. The other parameters are
    fixed at their prior means. `Problem` has the same factors, but for windows: here each
    measurement counts as instantaneous.

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
        Keys of both states, `state` and `state_after`, of the bias, `bias`, of that at the node
        after, `bias_after`, where the IMU's biases walk and have one there, and of parameters by
        name.
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
    >>> values.insert(X(1), gtsam.NavState(gtsam.Rot3.Rz(0.1), np.zeros(3), np.zeros(3)))
    >>> values.insert(B(0), gtsam.imuBias.ConstantBias())
    >>> values.insert(L(0), np.array([0.0, 2.0, 0.0]))
    >>> keys = {"state": X(0), "state_after": X(1), "bias": B(0), "lever_arm_m": L(0)}
    >>> factor = fd.sensor_factor(velocity, dvl.parameters(), chain, 0, keys, values)
    >>> (0.1 * factor.unwhitenedError(values)).round(3) + 0.0
    array([-0.2,  0. ,  0. ])
    """
    own = ["state", "bias", "state_after", *(["bias_after"] if "bias_after" in keys else [])]
    unknown = set(keys) - {*own, *(p.name for p in parameters)}
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
    local = _inertial(chain, walking="bias_after" in keys).from_node(np.array([k]))
    bound, _ = bind(local, [ObservationRows(observation, index)], (), {}, clock_zero)
    measured = NodeMeasurements(tuple(bound), free, fixed)
    nodes = [keys[name] for name in own]
    _, _, motions, missing = measured.linearize(states_at(values, nodes), given)
    weight = 1.0 / measured.sigma(motions, missing, given, {})
    return measurement_factor(measured, weight, nodes, [keys[p.name] for p in free])


def _inertial(chain: Preintegration, *, walking: bool) -> InertialChain:
    """Return the chain of a preintegration, without its factors."""
    biases, graph = chain.imu.parameters(0.0), gtsam.NonlinearFactorGraph()
    imu = chain.imu.settings
    if not walking:
        imu = msgspec.structs.replace(
            imu, gyro_bias_walk_deg_h_sqrt_h=0.0, accel_bias_walk_ug_sqrt_h=0.0
        )
    return InertialChain(chain.frame, chain.segments, chain.gravity_n, biases, biases, imu, graph)


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
    return np.where(inside, _inertial(chain, walking=False).attach(time).node, -1)
