"""The inertial part of the graph: IMU factors, walking biases, priors of the states."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import gtsam
import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import (
    exp_so3,
    inverse_right_jacobian,
    log_so3,
    rotation_from_rph,
    rph_jacobian,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.imu.preintegration import Segments, gtsam_measurements
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.trial import Trial

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
# Nodes of a branch. Measured: the time that GTSAM takes for a single one grows with the square of
# its length; for 19,200 nodes it is 1.4 s in one branch, and 0.4 s in branches of 32 or of 128.
_BRANCH = 128
# Steps of an accelerometer and a gyro bias that do not walk while the other does, m/s² and rad/s.
# Chosen: regular, and below 0.1 µg and 0.001 deg/h in a day; with less, products with these rows
# are rounding errors.
LEAST_WALK = np.repeat([1e-9, 1e-11], 3)


@dataclass(frozen=True)
class Chain:
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
    def middle(self) -> float:
        """Middle of the record, s."""
        return 0.5 * float(self.segments.node_time[0] + self.segments.node_time[-1])

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

    def bias_key(self, k: int) -> int:
        """Return the key of the bias at node k."""
        return keys.bias(k if self.walking else 0)

    def part(self, block: slice) -> Chain:
        """Return the part of some segments in a row; states keep their keys.

        Its factors are those of these segments, and others whose first state is in `nodes_of` it.
        """
        count, nodes = self.segments.first.size, self.nodes_of(block)
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

    def nodes_of(self, block: slice) -> range:
        """Return the nodes from the first of some segments to that of the segments after them."""
        origin, count = self.segments.origin, self.segments.node_time.size
        return range(int(origin[block.start]), int(np.append(origin, count)[block.stop]))

    @property
    def joints(self) -> range:
        """Nodes between which branches lie: eliminated last, they leave each by itself."""
        return range(0, self.segments.node_time.size, _BRANCH)

    def keys_of(self, nodes: Iterable[int]) -> list[int]:
        """Return the keys of the states at nodes, each with that of its bias where biases walk."""
        if not self.walking:
            return [keys.node(k) for k in nodes]
        return [key for k in nodes for key in (keys.node(k), keys.bias(k))]


def inertial_chain(trial: Trial, frame: LocalFrame, seg: Segments, start: States) -> Chain:
    """Return the inertial part of the graph, with gravity at the positions of `start`."""
    middle = 0.5 * (start.p_n[seg.origin] + start.p_n[seg.origin + 1])
    gravity_n = frame.gravity_without_rotation(middle)
    settings = trial.inertial.settings
    graph = gtsam.NonlinearFactorGraph()
    first, mean = (trial.inertial.parameters(t) for t in (0.0, float(seg.duration.sum())))
    chain = Chain(frame, seg, gravity_n, mean, first, settings, graph)
    pims = gtsam_measurements(seg, settings, gravity_n, frame.earth_rate)
    for k, pim in zip(seg.origin.tolist(), pims, strict=True):
        graph.add(gtsam.GalileanImuFactor2(keys.node(k), keys.node(k + 1), chain.bias_key(k), pim))
    if chain.walking:
        for k, walk in enumerate(chain.bias_steps):
            graph.add(
                gtsam.BetweenFactorConstantBias(
                    keys.bias(k),
                    keys.bias(k + 1),
                    gtsam.imuBias.ConstantBias(),
                    loose_diagonal(walk),
                )
            )
    for a, (begin, _) in enumerate(seg.arc_nodes):
        state, root = _state_prior(trial, frame, seg, start, int(begin), is_first=a == 0)
        graph.add(gtsam.PriorFactorNavState(keys.node(int(begin)), state, square_root(root)))
    for (_, last), (begin, _) in pairwise(seg.arc_nodes):
        graph.add(_gap_factor(int(last), int(begin), seg.node_time))
    return chain


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


def square_root(root: Array) -> gtsam.noiseModel.Gaussian:
    """Return a noise model from square-root information (n, n), not squared on the way."""
    return gtsam.noiseModel.Gaussian.SqrtInformation(np.linalg.qr(root, mode="r"), False)


def loose_diagonal(sigmas: Array) -> gtsam.noiseModel.Diagonal:
    """Return a diagonal noise model that stays one.

    GTSAM's default takes a sigma below 1e-8, as of a good gyro's bias, for a constraint.
    """
    return gtsam.noiseModel.Diagonal.Sigmas(sigmas, False)
