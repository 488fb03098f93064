"""The inertial part of the graph: IMU factors, walking biases, priors of the states."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, Self

import gtsam
import numpy as np

from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import (
    BodyAxes,
    exp_so3,
    inverse_right_jacobian,
    log_so3,
    rotation_from_rph,
    rph_jacobian,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.chain import FIRST_STATE, AtTrueTimes, StepRows
from factorgraph_dvl.graph.imu_errors import ImuErrors
from factorgraph_dvl.graph.keys import BIAS_SIZE, STATE_SIZE
from factorgraph_dvl.graph.node_jacobian import two_way_jacobian
from factorgraph_dvl.graph.priors import (
    PRIOR,
    ConstantsPrior,
    add_bias_prior,
    joint_linear_prior,
    loose_diagonal,
    square_root,
)
from factorgraph_dvl.graph.trajectory import EPOCH_ROUNDING, trajectory_between
from factorgraph_dvl.imu.gtsam_measurements import gtsam_measurements
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.imu.two_way import (
    TwoWay,
    TwoWayTransition,
    attach_two_way,
    motion_two_way,
    noise_averaged,
    noise_between,
    noise_curved,
    transition_two_way,
)
from factorgraph_dvl.sensors.imu import ERRORS, ImuSettings
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Linearization, Motion, Window
from factorgraph_dvl.trial import Trial

GYRO_NOISE = "gyro noise"
ACCEL_NOISE = "accelerometer noise"
GAP = "motion while the IMU is silent"
WALK = "random walk of {}"

# Standard deviations of a first state that nothing else determines, rad, m, m/s. Chosen: so large
# that they only keep an unaided chain from being singular.
_FREE_ATTITUDE = np.pi
_FREE_POSITION = 1e4
_FREE_VELOCITY = 1e2
# How a vessel may move while its IMU is silent: acceleration, m/s², turn rate, rad/s, and
# the sway that even the shortest gap allows, m and rad. Chosen: what ships do at most.
_GAP_ACCELERATION = 1.0
_GAP_TURN = 10.0 * DEG
_GAP_SWAY_M = 0.1
_GAP_SWAY_RAD = 10.0 * DEG
# Stands for a standard deviation of 0 in `initial`, rad or m. Chosen: far below what is measured.
_LEAST_STD = 1e-7
# Steps of an accelerometer and a gyro bias that do not walk while the other does, m/s² and rad/s.
# Chosen: regular, and below 0.1 µg and 0.001 deg/h in a day; with less, products with these rows
# are rounding errors.
LEAST_WALK = np.repeat([1e-9, 1e-11], 3)


@dataclass(frozen=True)
class InertialChain(AtTrueTimes):
    """The inertial part of a graph, common to every set of aiding sensors.

    Parameters
    ----------
    frame : LocalFrame
        Tangent frame n.
    segments : Segments
        Increments of the IMU between the nodes.
    gravity_n : ndarray, shape (S, 3)
        `LocalFrame.gravity_without_rotation` along the segments, m/s².
    biases : tuple of (Parameter, Parameter)
        Gyro and accelerometer bias, as their mean over the trial is reported.
    first_biases : tuple of (Parameter, Parameter)
        The same at the first node.
    imu : ImuSettings
        What is assumed of the IMU.
    graph : gtsam.NonlinearFactorGraph
        IMU factors, walks of the biases, priors of the states.
    """

    frame: LocalFrame
    segments: Segments
    gravity_n: Array
    biases: tuple[Parameter, Parameter]
    first_biases: tuple[Parameter, Parameter]
    imu: ImuSettings
    graph: gtsam.NonlinearFactorGraph
    interpolates: ClassVar[bool] = False
    step_source: ClassVar[str | None] = None

    @property
    def node_time(self) -> Array:
        """Times of the nodes, (K,), s."""
        return self.segments.node_time

    @property
    def count(self) -> int:
        """Number of segments."""
        return int(self.segments.first.size)

    @property
    def duration(self) -> float:
        """How long the motion is known, s."""
        return float(self.segments.duration.sum())

    @property
    def walking(self) -> bool:
        """Whether every node has a bias of its own."""
        return self.imu.bias_walks

    @property
    def bias_steps(self) -> Array:
        """Standard deviations of the steps of walking biases from node to node, SI, (S, 6).

        Of the accelerometers first, as in GTSAM's biases.
        """
        walks = [self.imu.accel_bias_walk_root_psd, self.imu.gyro_bias_walk_root_psd]
        root_time = np.sqrt(np.diff(self.segments.node_time))[:, None]
        return np.maximum(root_time * np.repeat(walks, 3), LEAST_WALK)

    @property
    def log_determinant(self) -> float:
        """Log det of the covariances of the IMU's noise and of the steps of walking biases.

        Up to what no factor on the noise of gyros or accelerometers changes.
        """
        imu = self.imu
        noise = np.log([imu.gyro_noise_root_psd, imu.accel_noise_root_psd])
        walks = float(np.log(self.bias_steps).sum()) if self.walking else 0.0
        return 2.0 * (self.count * float(noise @ [3.0, 6.0]) + walks)

    @property
    def middle(self) -> float:
        """Middle of the record, s."""
        return 0.5 * float(self.segments.node_time[0] + self.segments.node_time[-1])

    @property
    def constants(self) -> dict[int, int]:
        """Dimensions of the variables that all nodes share, by key: of biases that do not walk."""
        return {} if self.walking else {keys.bias(0): BIAS_SIZE}

    @property
    def sizes(self) -> list[int]:
        """Dimensions of the variables of a measurement."""
        return [STATE_SIZE, BIAS_SIZE, STATE_SIZE, *([BIAS_SIZE] if self.walking else [])]

    @cached_property
    def zeros(self) -> gtsam.Values:
        """States and biases of zero: they take GTSAM far longer to insert than to move."""
        out = gtsam.Values()
        state, bias = gtsam.NavState(), gtsam.imuBias.ConstantBias()
        n = self.segments.node_time.size
        # By the names of their arguments: without, all other kinds of values are tried first.
        # Measured: 0.13 s for 4800 states, and 0.04 s so.
        for k in range(n):
            out.insert(keys.node(k), nav_state=state)
        for k in range(n if self.walking else 1):
            out.insert(keys.bias(k), constant_bias=bias)
        return out

    def values(self, states: States) -> gtsam.Values:
        """Return GTSAM's values of states and biases."""
        step = gtsam.VectorValues()
        rows = np.hstack([log_so3(states.nRb), states.p_n, states.v_n])
        for k, row in enumerate(rows):
            step.insert(keys.node(k), row)
        rows = np.hstack([states.accel_bias, states.gyro_bias])
        for k, row in enumerate(rows if self.walking else rows[:1]):
            step.insert(keys.bias(k), row)
        return self.zeros.retract(step)

    def states(self, values: gtsam.Values) -> States:
        """Return states and biases as arrays."""
        return self._states(values, range(self.node_time.size))

    def from_node(self, nodes: IntArray) -> Self:
        """Return what carries the motion from a node (1,) to the next: they are the first two."""
        (k,) = nodes.tolist()
        seg = self.segments
        i = int(np.searchsorted(seg.origin, k))
        own = replace(
            seg.part(slice(i, i + 1)),
            origin=np.zeros(1, dtype=int),
            node_time=seg.node_time[k : k + 2],
            arc_nodes=np.array([[0, 1]]),
        )
        return replace(self, segments=own, gravity_n=self.gravity_n[i : i + 1])

    def _states(self, values: gtsam.Values, nodes: range) -> States:
        own = nodes if self.walking else [0]
        return states_of(
            [values.atNavState(keys.node(k)) for k in nodes],
            [values.atConstantBias(keys.bias(k)) for k in own],
        )

    def steps(self, states: States) -> Iterator[StepRows]:
        """Yield nothing: what ties the nodes is in `graph`."""
        yield from ()

    def covers(self, time: Array) -> BoolArray:
        """Whether the IMU recorded the motion at times (M,)."""
        return np.asarray(self.segments.increments.locate(time)[2])

    def attach(
        self,
        time: Array,
        shift: float = 0.0,
        window: Window | None = None,
        *,
        of_attitude: bool = False,
    ) -> TwoWay:
        """Return where times (M,) are attached to the chain; the nearest place if not covered."""
        return attach_two_way(self.segments, time, self.frame.earth_rate, window)

    def missing(self, at: TwoWay, lin: Linearization) -> Array | None:
        """Return the variance (M, d) that noise of the IMU leaves of what is predicted.

        None for positions and attitudes: it is below a millimetre there, and below the noise of
        the gyro over a second.
        """
        density = self._noise_density(lin)
        return None if density is None else noise_between(at)[:, None] * density

    def averaged(self, at: TwoWay, lin: Linearization, length: float) -> Array | None:
        """Return what windows of a length take from `missing`, (M, d); None where that is none."""
        density = self._noise_density(lin)
        return None if density is None else noise_averaged(at, length)[:, None] * density

    def curved(self, at: TwoWay, lin: Linearization, step: float) -> Array | None:
        """Return how far noise bends what is predicted towards the nodes, (M, d), in a step, s."""
        density = self._noise_density(lin)
        return None if density is None else noise_curved(at, step)[:, None] * density

    def _noise_density(self, lin: Linearization) -> Array | None:
        """Return the density (M, d) of the noise of what is predicted, per second."""
        if lin.d_v is None:
            return None
        out = self.imu.accel_noise_root_psd**2 * np.sum(lin.d_v**2, axis=2)
        if lin.d_theta is not None:
            out = out + self.imu.gyro_noise_root_psd**2 * np.sum(lin.d_theta**2, axis=2)
        return np.asarray(out)

    def motion(self, at: TwoWay, states: States) -> Motion:
        """Return the motion at M attached times, carried from the nodes on both sides."""
        return motion_two_way(at, states, self.gravity_n, self.frame.earth_rate)

    def transition(self, at: TwoWay, states: States, motion: Motion) -> TwoWayTransition:
        """Return the derivatives of the motion at attached times by the nodes on both sides."""
        return transition_two_way(at, states, motion, self.frame.earth_rate)

    def node_jacobian(self, lin: Linearization, transition: TwoWayTransition) -> Array:
        """Return the derivative of residuals by the variables of measurements, (M, d, n)."""
        return two_way_jacobian(lin, transition, walking=self.walking)

    def variables(self, nodes: IntArray) -> list[IntArray]:
        """Return the keys of the variables of measurements after nodes (M, 1), (M,) each."""
        node = nodes[:, 0]
        before = [keys.nodes(node), keys.bias(0) + self.walking * node]
        after = [keys.nodes(node + 1), keys.bias(0) + self.walking * (node + 1)]
        return [*before, *(after if self.walking else after[:1])]

    def add_prior(
        self,
        graph: gtsam.NonlinearFactorGraph,
        parameters: Sequence[Parameter],
        key_of: Mapping[str, int],
        constants_prior: ConstantsPrior | None,
    ) -> Sequence[Parameter]:
        """Add the prior of the biases; return the parameters whose priors it does not have.

        Parameters
        ----------
        graph : gtsam.NonlinearFactorGraph
            Added to.
        parameters : sequence of Parameter
            Those that are estimated.
        key_of : mapping of str to int
            Their keys.
        constants_prior : ConstantsPrior, optional
            Joint prior of biases and parameters, in place of their own.
        """
        if constants_prior is not None:
            graph.add(joint_linear_prior(constants_prior, self.bias_key(0), parameters, key_of))
            return ()
        joint = self.biases[0].joint
        with_biases = [p for p in parameters if p.joint and p.joint is joint]
        add_bias_prior(graph, self.first_biases, self.bias_key(0), with_biases, key_of)
        return [p for p in parameters if not p.joint or p.joint is not joint]

    def mean_constants(
        self, states: States
    ) -> Iterator[tuple[Parameter, Array, dict[int, Array]]]:
        """Yield each bias with its mean over the trial, in reported units, and its derivatives.

        These are by the variables of the graph, by key.
        """
        seg = self.segments
        weight = np.zeros(seg.node_time.size)
        weight[seg.origin] += seg.duration
        weight[seg.origin + 1] += seg.duration
        weight /= weight.sum()
        gyro, accel = self.biases
        for parameter, bias, first in ((gyro, states.gyro_bias, 3), (accel, states.accel_bias, 0)):
            select = np.eye(BIAS_SIZE)[first : first + 3] / parameter.si
            share = weight if self.walking else [1.0]
            functional = {keys.bias(k): w * select for k, w in enumerate(share)}
            yield parameter, weight @ bias / parameter.si, functional

    def trajectory(
        self, states: States, P: Array, body_axes: BodyAxes, rate_hz: float, after: float = -np.inf
    ) -> Trajectory:
        """Return the motion at a rate, with its covariance.

        Parameters
        ----------
        states : States
            States of the K nodes.
        P : ndarray, shape (K, 9, 9)
            Their covariances, in GTSAM's tangent space.
        body_axes : BodyAxes
            Axes of the body.
        rate_hz : float
            Epochs in a second.
        after : float, optional
            Time of the last epoch before those that are wanted, s.
        """
        time = self.segments.increments.ticks(rate_hz)
        time = time[time * rate_hz > after * rate_hz + EPOCH_ROUNDING]
        return trajectory_between(
            self.segments, states, P, self.gravity_n, self.frame, body_axes, time
        )

    def release(self) -> None:
        """Free what only binding measurements, and a trajectory with rates, need."""
        self.segments.increments.release()

    def sources(self, letters: str) -> dict[str, slice]:
        """Return the sources of noise of one of its factors, and which rows each has.

        In GTSAM's order of biases; rows of different sources are independent of each other.
        """
        gyro, accel = (p.name for p in self.biases)
        if letters.startswith("xxb"):
            # Whitened, the attitude comes first, and given the rest it is known by the gyros.
            return {GYRO_NOISE: slice(0, 3), ACCEL_NOISE: slice(3, 9)}
        if letters == "bb" or (letters == "b" and self.biases[0].joint is None):
            source = WALK if letters == "bb" else PRIOR
            return {source.format(accel): slice(0, 3), source.format(gyro): slice(3, 6)}
        if letters == "b":
            return {PRIOR.format(f"{gyro}, {accel}"): slice(None)}
        return {{"x": FIRST_STATE, "xx": GAP}[letters]: slice(None)}

    def assumed(self) -> dict[str, str]:
        """Return what is assumed of each of these sources, as text."""
        imu = self.imu
        gyro, accel = self.biases
        return {
            GYRO_NOISE: f"{imu.gyro_noise_deg_sqrt_h:.3g} deg/√h",
            ACCEL_NOISE: f"{imu.accel_noise_ug_sqrt_hz:.3g} µg/√Hz",
            WALK.format(gyro.name): f"{imu.gyro_bias_walk_deg_h_sqrt_h:.3g} deg/h/√h",
            WALK.format(accel.name): f"{imu.accel_bias_walk_ug_sqrt_h:.3g} µg/√h",
        }

    def errors(
        self, parameters: Sequence[Parameter], key_of: Mapping[str, int]
    ) -> ImuErrors | None:
        """Return the errors of the IMU among parameters; None if none is estimated.

        Parameters
        ----------
        parameters : sequence of Parameter
            Those that are estimated.
        key_of : mapping of str to int
            Their keys.
        """
        own = [p for p in parameters if p.name in ERRORS]
        return ImuErrors(self.segments, own, [key_of[p.name] for p in own]) if own else None

    def bias_key(self, k: int) -> int:
        """Return the key of the bias at node k."""
        return keys.bias(k if self.walking else 0)

    def part(self, block: slice) -> InertialChain:
        """Return the part of some segments in a row; states keep their keys.

        Its factors are those of these segments, and others whose first state is in `nodes_of` it.
        """
        count, nodes = self.count, self.nodes_of(block)
        graph = gtsam.NonlinearFactorGraph()
        for i in range(block.start, block.stop):
            graph.add(self.graph.at(i))
        for i in range(count, self.graph.size()):
            if keys.index_of(self.graph.at(i).keys()[0]) in nodes:
                graph.add(self.graph.at(i))
        out = replace(
            self,
            segments=self.segments.part(block),
            gravity_n=self.gravity_n[block],
            graph=graph,
        )
        # Of all states, which take long to insert.
        vars(out)["zeros"] = self.zeros
        return out

    def following(self, seg: Segments, gravity_n: Array, first: int) -> Self:
        """Return the chain of other segments, such as the next one: its nodes begin at `first`."""
        graph = gtsam.NonlinearFactorGraph()
        out = replace(self, segments=seg, gravity_n=gravity_n, graph=graph)
        _add_motion(out, first)
        return out

    def nodes_of(self, block: slice) -> range:
        """Return the nodes from the first of some segments to that of the segments after them."""
        origin, count = self.segments.origin, self.segments.node_time.size
        return range(int(origin[block.start]), int(np.append(origin, count)[block.stop]))

    def keys_of(self, nodes: Iterable[int]) -> list[int]:
        """Return the keys of the states at nodes, each with that of its bias where biases walk."""
        if not self.walking:
            return [keys.node(k) for k in nodes]
        return [key for k in nodes for key in (keys.node(k), keys.bias(k))]


def inertial_chain(trial: Trial, frame: LocalFrame, seg: Segments, start: States) -> InertialChain:
    """Return the inertial part of the graph, with gravity at the positions of `start`."""
    middle = 0.5 * (start.p_n[seg.origin] + start.p_n[seg.origin + 1])
    gravity_n = frame.gravity_without_rotation(middle)
    settings = trial.inertial.settings
    graph = gtsam.NonlinearFactorGraph()
    first, mean = (trial.inertial.parameters(t) for t in (0.0, float(seg.duration.sum())))
    chain = InertialChain(frame, seg, gravity_n, mean, first, settings, graph)
    _add_motion(chain)
    for a, (begin, _) in enumerate(seg.arc_nodes):
        state, root = _state_prior(trial, frame, seg, start, int(begin), is_first=a == 0)
        graph.add(gtsam.PriorFactorNavState(keys.node(int(begin)), state, square_root(root)))
    for (_, last), (begin, _) in pairwise(seg.arc_nodes):
        graph.add(_gap_factor(int(last), int(begin), seg.node_time))
    return chain


def _add_motion(chain: InertialChain, first: int = 0) -> None:
    """Add the IMU factors and the walks of the biases; `first` is the index of the first node."""
    seg, graph = chain.segments, chain.graph
    pims = gtsam_measurements(seg, chain.imu, chain.gravity_n, chain.frame.earth_rate)
    for k, pim in zip((first + seg.origin).tolist(), pims, strict=True):
        graph.add(gtsam.GalileanImuFactor2(keys.node(k), keys.node(k + 1), chain.bias_key(k), pim))
    if chain.walking:
        for k, walk in enumerate(chain.bias_steps, start=first):
            graph.add(
                gtsam.BetweenFactorConstantBias(
                    keys.bias(k),
                    keys.bias(k + 1),
                    gtsam.imuBias.ConstantBias(),
                    loose_diagonal(walk),
                )
            )


def _state_prior(
    trial: Trial, frame: LocalFrame, seg: Segments, start: States, k: int, *, is_first: bool
) -> tuple[gtsam.NavState, Array]:
    """Return mean and square-root information of an arc's first state."""
    nRb, p_n = start.nRb[k], start.p_n[k]
    root = np.diag(1.0 / np.repeat([_FREE_ATTITUDE, _FREE_POSITION, _FREE_VELOCITY], 3))
    # The first mean sample ends where `initial` holds; the first node is where it begins.
    phi, dv = (each[0] for each in seg.increments.over(np.zeros(1, dtype=int)))
    back = exp_so3(-phi) if seg.increments.averaged else np.eye(3)
    if is_first and trial.initial_attitude is not None:
        rph = trial.initial_attitude.rph
        nRb = rotation_from_rph(rph, trial.body_axes) @ back
        std = np.maximum(trial.initial_attitude.std, _LEAST_STD)
        root[:3, :3] = rph_jacobian(rph, trial.body_axes) @ back / std[:, None]
    if is_first and trial.initial_position is not None:
        p_n = frame.position(*trial.initial_position.geodetic)
        if seg.increments.averaged:
            p_n = p_n - start.v_n[k] * seg.increments.dt[0]
        std = np.maximum(trial.initial_position.std, _LEAST_STD)
        root[3:6, 3:6] = nRb / std[:, None]
    v_n = start.v_n[k]
    if is_first and trial.initial_velocity is not None:
        v_n = trial.initial_velocity.velocity
        if seg.increments.averaged:
            v_n = v_n - nRb @ dv - frame.gravity(p_n) * seg.increments.dt[0]
        std = np.maximum(trial.initial_velocity.std, _LEAST_STD)
        root[6:9, 6:9] = nRb / std[:, None]
    return gtsam.NavState(gtsam.Rot3(nRb), p_n, v_n), root


def _gap_factor(before: int, after: int, node_time: Array) -> gtsam.CustomFactor:
    """Return a factor across a gap of the IMU: a vehicle does not jump.

    Zero error where the velocity is the same on both sides, the displacement is the mean
    velocity times the gap, and the attitude is the same; standard deviations from the
    acceleration and the turn rate of a vessel.
    """
    gap = float(node_time[after] - node_time[before])
    velocity = _GAP_ACCELERATION * gap
    position = _GAP_ACCELERATION * gap**2 / 8.0 + _GAP_SWAY_M
    attitude = min(_GAP_TURN * gap + _GAP_SWAY_RAD, _FREE_ATTITUDE)
    sigma = np.repeat([attitude, position, velocity], 3)
    node_keys = [keys.node(before), keys.node(after)]

    def error(this: gtsam.CustomFactor, at: gtsam.Values, jacobians: list[Array] | None) -> Array:
        a, b = (at.atNavState(key) for key in node_keys)
        Ra, Rb = a.attitude().matrix(), b.attitude().matrix()
        turn = log_so3(Ra.T @ Rb)
        if jacobians is not None:
            by_a, by_b = np.zeros((9, 9), order="F"), np.zeros((9, 9), order="F")
            by_b[:3, :3] = inverse_right_jacobian(turn)
            by_a[:3, :3] = -by_b[:3, :3] @ Rb.T @ Ra
            by_a[3:6, 3:6], by_a[3:6, 6:] = -Ra, -0.5 * gap * Ra
            by_b[3:6, 3:6], by_b[3:6, 6:] = Rb, -0.5 * gap * Rb
            by_a[6:, 6:], by_b[6:, 6:] = -Ra, Rb
            jacobians[0], jacobians[1] = by_a, by_b
        mean_velocity = 0.5 * (a.velocity() + b.velocity())
        shift = b.position() - a.position() - gap * mean_velocity
        return np.concatenate([turn, shift, b.velocity() - a.velocity()])

    return gtsam.CustomFactor(loose_diagonal(sigma), node_keys, error)


def states_of(
    states: Sequence[gtsam.NavState], biases: Sequence[gtsam.imuBias.ConstantBias]
) -> States:
    """Return GTSAM's states of some nodes, with the bias of each or the one of all, as arrays."""
    # A matrix of GTSAM's is [nRb, p, v; 0, I]: one call takes less than one for each part.
    matrix = np.array([state.matrix() for state in states])
    bias = np.array([each.vector() for each in biases])
    if len(bias) < len(matrix):
        bias = bias.repeat(len(matrix), axis=0)
    nRb, p_n, v_n = (matrix[:, :3, part].copy() for part in (slice(0, 3), 3, 4))
    return States(nRb, p_n, v_n, gyro_bias=bias[:, 3:], accel_bias=bias[:, :3])
