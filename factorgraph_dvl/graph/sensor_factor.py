"""All measurements between one node and the next as one nonlinear factor.

iSAM2 linearises factors one by one, so each is a callback into Python: one for a node, not
one for a measurement.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import gtsam
import numpy as np

from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.clocks import linearized, parameters_of, true_time
from factorgraph_dvl.graph.keys import BIAS_SIZE, STATE_SIZE
from factorgraph_dvl.graph.priors import places, prior_mean, value_at
from factorgraph_dvl.imu.preintegration import Preintegration
from factorgraph_dvl.imu.propagation import (
    Attachment,
    States,
    Transition,
    attach_inside,
    extrapolated,
    motion_at,
    with_bias,
)
from factorgraph_dvl.imu.sensitivity import Sensitivity, by_errors, corrected, elements
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import (
    ExpectedCorrelation,
    Linearization,
    Motion,
    Observation,
    ScaleWalk,
    SensorClock,
)

# What rounding may take off a time, s.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class ObservationRows:
    """Some measurements of an observation, as an observation.

    Parameters
    ----------
    whole : Observation
        M measurements.
    index : ndarray of int, shape (K,)
        Which of them.
    """

    whole: Observation
    index: IntArray

    @property
    def label(self) -> str:
        """Name of the measurement, for people."""
        return self.whole.label

    @property
    def unit(self) -> str:
        """Unit of the residual."""
        return self.whole.unit

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the d components."""
        return self.whole.components

    @property
    def time(self) -> Array:
        """Times as in the record, (K,), s."""
        return self.whole.time[self.index]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the calibration parameters that it depends on."""
        return self.whole.parameters

    @property
    def gate(self) -> float | None:
        """Standard deviations from which on a measurement is an echo."""
        return self.whole.gate

    @property
    def noise_groups(self) -> tuple[tuple[int, ...], ...]:
        """Components that share a factor on their stated standard deviation."""
        return self.whole.noise_groups

    @property
    def correlated(self) -> ExpectedCorrelation | None:
        """What is known beforehand of noise that persists."""
        return self.whole.correlated

    @property
    def scale_walk(self) -> ScaleWalk | None:
        """How its scale walks."""
        return self.whole.scale_walk

    @property
    def independent(self) -> bool:
        """Whether components are measured apart."""
        return self.whole.independent

    @property
    def clock(self) -> SensorClock | None:
        """Clock of the sensor."""
        return self.whole.clock

    def sigma(
        self, motion: Motion, values: Mapping[str, Array], factor: Array | float = 1.0
    ) -> Array:
        """Return the standard deviations, (K, d)."""
        whole = self.whole.sigma(self._embedded(motion), values, factor)
        return np.asarray(whole[self.index])

    def residual(self, motion: Motion, values: Mapping[str, Array]) -> Array:
        """Return predicted - measured, (K, d)."""
        return self.whole.residual(self._embedded(motion), values)[self.index]

    def linearize(
        self, motion: Motion, values: Mapping[str, Array], wanted: Collection[str]
    ) -> Linearization:
        """Return the residual and its Jacobians."""
        return self.whole.linearize(self._embedded(motion), values, wanted).some(self.index)

    def _embedded(self, motion: Motion) -> Motion:
        """Return a motion at all M times: what the others see does not matter."""
        source = np.zeros(self.whole.time.size, dtype=int)
        source[self.index] = np.arange(self.index.size)
        return rows_of(motion, source)


@dataclass(frozen=True)
class AttachedMeasurements:
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
    rows : tuple of AttachedMeasurements
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
    sensitivity : Sensitivity, optional
        Of the attachment to the errors of the IMU among the parameters.
    """

    attachment: Attachment
    rows: tuple[AttachedMeasurements, ...]
    parameters: tuple[Parameter, ...]
    fixed: Mapping[str, Array]
    gravity_n: Array
    earth_rate_n: Array
    clock_zero: float = 0.0
    sensitivity: Sensitivity | None = None

    def corrected(self, values: Mapping[str, Array]) -> Attachment:
        """Return the attachment without the errors of the IMU."""
        if self.sensitivity is None:
            return self.attachment
        sizes = np.concatenate([values[p.name] for p in self._imu_errors])
        return corrected(self.attachment, self.sensitivity, elements(self._imu_errors), sizes)

    def attachment_of(self, rows: AttachedMeasurements) -> Attachment:
        """Return the attachment of measurements of one kind."""
        return rows_of(self.attachment, rows.at)

    @cached_property
    def _imu_errors(self) -> list[Parameter]:
        """The errors of the IMU among the parameters."""
        return [p for p in self.parameters if p.name in ERRORS]

    @cached_property
    def _place(self) -> dict[str, slice]:
        """Place of each parameter among the components of all."""
        return places(self.parameters)

    @cached_property
    def wanted(self) -> list[list[str]]:
        """Names of the parameters that each kind depends on."""
        used = [parameters_of(r.observation) for r in self.rows]
        return [[name for name in self._place if name in each] for each in used]

    def motions(self, states: States, values: Mapping[str, Array]) -> tuple[Motion, list[Motion]]:
        """Return the motion at all times as attached, and at the true times of each kind."""
        motion = motion_at(self.corrected(values), states, self.gravity_n, self.earth_rate_n)
        return motion, self._at_true_times(motion, values)

    def _at_true_times(self, motion: Motion, values: Mapping[str, Array]) -> list[Motion]:
        out: list[Motion] = []
        part, at = motion, slice(0, self.attachment.tau.size)
        for r in self.rows:
            if r.at != at:
                part, at = rows_of(motion, r.at), r.at
            clock = r.observation.clock
            # A clock that is not estimated stays as it was when the times were attached.
            if clock is not None and not self._place.keys().isdisjoint(clock.names):
                late = true_time(r.observation, values, self.clock_zero) - r.time
                out.append(extrapolated(part, late))
            else:
                out.append(part)
        return out

    def linearize(
        self, states: States, values: Mapping[str, Array]
    ) -> tuple[Array, Array, list[Motion]]:
        """Return residuals (R,), their Jacobian (R, 15 + n), and the motions.

        Columns: attitude, position, velocity of the node in GTSAM's tangent space,
        accelerometer and gyro bias, then the parameters.
        """
        values = {**self.fixed, **values}
        at, rate = self.corrected(values), self.earth_rate_n
        increments = with_bias(at, states)
        motion = motion_at(at, states, self.gravity_n, rate, increments)
        motions = self._at_true_times(motion, values)
        transition = Transition(at, states, motion, rate, increments)
        first, size = STATE_SIZE + BIAS_SIZE, sum(p.mean.size for p in self.parameters)
        residuals, matrices = [], []
        for r, own, wanted in zip(self.rows, motions, self.wanted, strict=True):
            lin = linearized(r.observation, own, values, wanted, self.clock_zero)
            matrix = np.zeros((*lin.residual.shape, first + size))
            matrix[:, :, :first] = lin.by_motion @ transition.whole[r.at]
            by_parameters = matrix[:, :, first:]
            for name, jacobian in lin.d_parameters.items():
                if name in self._place:
                    by_parameters[:, :, self._place[name]] = jacobian
            if self.sensitivity is not None:
                part = Transition(rows_of(at, r.at), states, rows_of(motion, r.at), rate)
                of_errors = by_errors(
                    lin, part, rows_of(self.sensitivity, r.at), elements(self._imu_errors)
                )
                columns = np.concatenate([np.r_[self._place[p.name]] for p in self._imu_errors])
                by_parameters[:, :, columns] = of_errors
            residuals.append(lin.residual.ravel())
            matrices.append(matrix.reshape(-1, first + size))
        return np.concatenate(residuals), np.concatenate(matrices), motions

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
            r.observation.sigma(motion, values, factors.get(r.observation.label, 1.0))
            for r, motion in zip(self.rows, motions, strict=True)
        )
        return np.concatenate([sigma.ravel() for sigma in each])


@dataclass(frozen=True)
class Linearized:
    """Residual (R,) and Jacobian (R, 15 + n) of measurements, and where they were computed.

    Parameters
    ----------
    state, bias : gtsam.NavState or gtsam.imuBias.ConstantBias
        Of the node.
    values : mapping of str to ndarray
        Of the parameters.
    residual, jacobian : ndarray
        As `NodeMeasurements.linearize` returns them.
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
    errors : mapping of int to ndarray, optional
        Derivatives (R, n) of the residuals by vectors that add to them, by their keys.
    """
    kept = [first] if first is not None else []
    every = [node_key, bias_key, *parameter_keys]
    added = [] if errors is None else [*errors.items()]
    sizes = [STATE_SIZE, BIAS_SIZE, *(p.mean.size for p in measured.parameters)]
    edges = list(accumulate(sizes, initial=0))
    rows = weight.size
    if len(every) != len(sizes):
        raise ValueError(f"{len(parameter_keys)} keys for {len(measured.parameters)} parameters")

    def error(this: gtsam.CustomFactor, at: gtsam.Values, jacobians: list[Array] | None) -> Array:
        state, bias = at.atNavState(node_key), at.atConstantBias(bias_key)
        values = {
            p.name: at.atRot3(key).matrix() if p.rotation else at.atVector(key)
            for p, key in zip(measured.parameters, parameter_keys, strict=True)
        }
        error = sum((gain @ at.atVector(key) for key, gain in added), start=np.zeros(rows))
        if jacobians is None:
            return weight * (measured.residuals(state_of(state, bias), values) + error)
        once = kept.pop() if kept else None
        if once is not None and once.is_at(state, bias, values):
            residual, matrix = once.residual, once.jacobian
        else:
            residual, matrix, _ = measured.linearize(state_of(state, bias), values)
        if matrix.shape != (rows, edges[-1]) or len(jacobians) != len(sizes) + len(added):
            raise ValueError(f"Jacobian of shape {matrix.shape}, expected {(rows, edges[-1])}")
        matrix = matrix * weight[:, None]
        for i in range(len(sizes)):
            jacobians[i] = np.asfortranarray(matrix[:, edges[i] : edges[i + 1]])
        for i, (_, gain) in enumerate(added, start=len(sizes)):
            jacobians[i] = np.asfortranarray(weight[:, None] * gain)
        return weight * (residual + error)

    every += [key for key, _ in added]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), every, error)


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
    fixed at their prior means.

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
        Time at which the offsets of clocks hold, s.

    Raises
    ------
    ValueError
        If nothing was measured there; see `measured_nodes`.
    KeyError
        If a parameter that has a key is none of the sensor's.

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
    free = tuple(p for p in parameters if p.name in keys)
    given = {**fixed, **{p.name: value_at(values, keys[p.name], p) for p in free}}
    node, attachment = attached_rows(observation, chain, given, clock_zero)
    (index,) = np.nonzero(node == k)
    if not index.size:
        raise ValueError(f"{observation.label} has no measurement between node {k} and the next")
    own = ObservationRows(observation, index)
    measured = NodeMeasurements(
        attachment=at_first_node(rows_of(attachment, index)),
        rows=(AttachedMeasurements(own, slice(0, index.size), true_time(own, given, clock_zero)),),
        parameters=free,
        fixed=fixed,
        gravity_n=chain.gravity_n[k : k + 1],
        earth_rate_n=chain.frame.earth_rate,
        clock_zero=clock_zero,
    )
    states = state_of(values.atNavState(keys["state"]), values.atConstantBias(keys["bias"]))
    _, motions = measured.motions(states, given)
    weight = 1.0 / measured.sigma(motions, given, {})
    shared = [keys[p.name] for p in free]
    return measurement_factor(measured, weight, keys["state"], keys["bias"], shared)


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
        Time at which the offsets of clocks hold, s.

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
    node, _ = attached_rows(observation, chain, fixed, clock_zero)
    return [int(k) for k in np.unique(node) if k >= 0]


def attached_rows(
    observation: Observation, chain: Preintegration, values: Mapping[str, Array], clock_zero: float
) -> tuple[IntArray, Attachment]:
    """Return the nodes before measurements (M,), -1 outside the chain, and their attachment."""
    time = true_time(observation, values, clock_zero)
    attachment, _ = attach_inside(chain.segments, time, chain.frame.earth_rate)
    inside = (time > chain.time[0] - _ROUNDING) & (time < chain.time[-1] + _ROUNDING)
    return np.where(inside, attachment.node, -1), attachment


def at_first_node(attachment: Attachment) -> Attachment:
    """Return the attachment of measurements after one node as if it were the first."""
    first = np.zeros(attachment.node.size, dtype=int)
    return replace(attachment, node=first, segment=first)
