"""The chain of a trial without IMU: states of motion, tied to each other by their inertia."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import log_so3
from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.chain import MOTION, StepRows, WithoutImu
from factorgraph_dvl.graph.elimination_order import Spans
from factorgraph_dvl.graph.priors import loose_diagonal
from factorgraph_dvl.graph.smooth_motion import (
    Between,
    Place,
    SmoothStates,
    Turns,
    interpolated,
    motion_steps,
    place_of,
    turns_of,
    variance_between,
)
from factorgraph_dvl.sensors.protocol import Linearization, Motion, Window

# Names of the rows of a step.
_COMPONENTS = tuple(
    f"{kind} {axis}"
    for kind in ("turn", "shift", "angular acceleration", "acceleration")
    for axis in "xyz"
)
# Standard deviations of the first state, rad, rad/s, m and m/s. Chosen: they only keep the chain
# regular.
_FREE = np.repeat([np.pi, 1.0, 1e5, 1e2], 3)
# Dimensions of attitude, rates and track, which is position and velocity in n.
_TURN, _RATE, _TRACK = 3, 3, 6
# Difference of times, s, without measurements in between. Chosen: what rounding makes.
_SAME_TIME = 1e-6
# What rounding may add to a time, s.
_ROUNDING = 1e-6
# Steps whose rows are made at once. Chosen: some ten megabytes.
_CHUNK = 4096


@dataclass(frozen=True)
class Attached:
    """Where M times are attached to the chain.

    Parameters
    ----------
    place, turned : Place
        Where position and velocity are between nodes, and where attitude and rate are.
    """

    place: Place
    turned: Place

    @property
    def segment(self) -> IntArray:
        """The segment from node to node that each is in; the first of two, (M,)."""
        return np.minimum(self.place.node, self.turned.node)


@dataclass(frozen=True)
class ChainStates(SmoothStates):
    """States of the nodes, with what turns the body from one to the next.

    Parameters
    ----------
    time : ndarray, shape (K,), s
        Times of the attitudes of the nodes.
    """

    time: Array

    @cached_property
    def turns(self) -> Turns:
        """What turns the body from node to node."""
        return turns_of(self.time, self)


@dataclass(frozen=True)
class SmoothChain(WithoutImu):
    """Nodes of a trial without IMU, and the prior of their motion.

    Position and velocity of a node are at its time by one clock, attitude and rate at another by
    the clock of attitudes: a measurement is attached to the nodes on both sides by each clock, and
    may pass nodes of either as clocks move.

    Parameters
    ----------
    frame : LocalFrame
        Tangent frame n.
    node_time : ndarray, shape (K,), s
        Times of the nodes, by `clock`.
    attitude_time : ndarray, shape (K,), s
        Times of their attitudes and rates, by `attitude_clock`; as far from each other.
    density : ndarray, shape (K - 1, 6)
        Power spectral densities of the acceleration between nodes, as of `motion_steps`.
    start : SmoothStates
        States about which the prior of the first is loose.
    nRt : ndarray, shape (K, 3, 3)
        Axes of the track to n: level, they turn with the heading but not with waves.
    attitude_clock : str
        Name of the time offset of the clock that their attitudes have: measurements of attitude
        then stay where they are between nodes whatever the clocks.
    clock : str, optional
        Name of the time offset of the clock that the nodes have; None = true times.
    resolution : float, default 0, s
        Interval of the densest record: a trajectory has no more epochs.
    block : slice, optional
        Steps whose prior it has, of a part; by default all.
    """

    frame: LocalFrame
    node_time: Array
    attitude_time: Array
    density: Array
    start: SmoothStates
    nRt: Array
    attitude_clock: str
    clock: str | None = None
    resolution: float = 0.0
    block: slice | None = None

    @property
    def attitude_shift(self) -> float:
        """Times of attitudes less those of the nodes, s."""
        return float(self.attitude_time[0] - self.node_time[0])

    @property
    def log_determinant(self) -> float:
        """Log det of the covariance of the steps, but for what their length makes it."""
        return 2.0 * float(np.log(self.density).sum())

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Prior of the first state."""
        graph = gtsam.NonlinearFactorGraph()
        if self.block is None or self.block.start == 0:
            s = self.start
            turn, rate, track = (
                loose_diagonal(each) for each in np.split(_FREE, [_TURN, _TURN + _RATE])
            )
            graph.add(gtsam.PriorFactorRot3(keys.attitude(0), gtsam.Rot3(s.nRb[0]), turn))
            graph.addPriorVector(keys.rate(0), s.omega_b[0], rate)
            graph.addPriorVector(keys.node(0), np.append(s.p_n[0], s.v_n[0]), track)
        return graph

    @property
    def sizes(self) -> list[int]:
        """Dimensions of the variables of a measurement."""
        return [_TURN, _RATE, _TURN, _RATE, _TRACK, _TRACK]

    def part(self, block: slice) -> SmoothChain:
        """Return the part of some steps in a row; states keep their keys."""
        out = replace(self, block=block)
        # Of all states, which take long to insert.
        vars(out)["zeros"] = self.zeros
        return out

    def keys_of(self, nodes: Iterable[int]) -> list[int]:
        """Return the keys of the attitudes of nodes, each with those of its rates and track."""
        return [key for k in nodes for key in (keys.attitude(k), keys.rate(k), keys.node(k))]

    def spans(self, parameters: Mapping[str, Array]) -> list[Spans]:
        """Return the spans of time whose measurements depend on attitudes and track of nodes."""
        every, time = range(self.node_time.size), self.node_time
        late = self.attitude_shift - self.shift(parameters)
        turns = Spans(
            [[keys.attitude(k), keys.rate(k)] for k in every],
            time if abs(late) < _SAME_TIME else time + late,
        )
        return [turns, Spans([[keys.node(k)] for k in every], time)]

    def state_keys(self, k: int) -> list[int]:
        """Return the keys of attitude, and of position and velocity, of node k."""
        return [keys.attitude(k), keys.node(k)]

    def nodes_at(self, at: Attached) -> IntArray:
        """Return the nodes before attached times, of the track and of the attitude, (M, 2)."""
        return np.column_stack([at.place.node, at.turned.node])

    def variables(self, nodes: IntArray) -> list[IntArray]:
        """Return the keys of the variables of measurements after nodes, (M,) each.

        Nodes (M, 2) are those of `nodes_at`, or (M, 1) where both are the same.
        """
        node, turned = nodes[:, 0], nodes[:, -1]
        of_turn = [
            first + k for k in (turned, turned + 1) for first in (keys.attitude(0), keys.rate(0))
        ]
        return [*of_turn, keys.nodes(node), keys.nodes(node + 1)]

    @cached_property
    def zeros(self) -> gtsam.Values:
        """States and rates of zero: they take GTSAM far longer to insert than to move."""
        out, turn = gtsam.Values(), gtsam.Rot3()
        for k in range(self.node_time.size):
            out.insert(keys.attitude(k), rot3=turn)
            out.insert(keys.rate(k), np.zeros(_RATE))
            out.insert(keys.node(k), np.zeros(_TRACK))
        return out

    def values(self, states: SmoothStates) -> gtsam.Values:
        """Return GTSAM's values of states and rates."""
        step = gtsam.VectorValues()
        tracks = np.hstack([states.p_n, states.v_n])
        rows = zip(log_so3(states.nRb), states.omega_b, tracks, strict=True)
        for k, (turn, rate, track) in enumerate(rows):
            step.insert(keys.attitude(k), turn)
            step.insert(keys.rate(k), rate)
            step.insert(keys.node(k), track)
        return self.zeros.retract(step)

    def states(self, values: gtsam.Values) -> ChainStates:
        """Return states as arrays."""
        every = range(self.node_time.size)
        return self._states(values, every, every)

    def states_around(self, values: gtsam.Values, nodes: IntArray) -> ChainStates:
        """Return the states that measurements after nodes (2,) or (1,) depend on."""
        node, turned = int(nodes[0]), int(nodes[-1])
        return self._states(values, range(node, node + 2), range(turned, turned + 2))

    def from_node(self, nodes: IntArray) -> SmoothChain:
        """Return what carries the motion from nodes (2,) or (1,) to the next: the first two."""
        node, turned = int(nodes[0]), int(nodes[-1])
        two = slice(node, node + 2)
        return replace(
            self,
            node_time=self.node_time[two],
            attitude_time=self.attitude_time[turned : turned + 2],
            density=np.append(self.density[turned, :3], self.density[node, 3:])[None],
            nRt=self.nRt[two],
            block=None,
        )

    def _states(self, values: gtsam.Values, nodes: range, turned: range) -> ChainStates:
        nRb, omega = np.empty((len(turned), 3, 3)), np.empty((len(turned), _RATE))
        track = np.empty((len(nodes), _TRACK))
        for i, k in enumerate(turned):
            nRb[i] = values.atRot3(keys.attitude(k)).matrix()
            omega[i] = values.atVector(keys.rate(k))
        for i, k in enumerate(nodes):
            track[i] = values.atVector(keys.node(k))
        p_n, v_n = track[:, :3].copy(), track[:, 3:].copy()
        time = self.attitude_time[turned.start : turned.stop]
        return ChainStates(nRb, p_n, v_n, omega, time)

    def covers(self, time: Array) -> BoolArray:
        """Whether times (M,) are between the first node and the last but one.

        The last one is for attitudes, whose nodes may be earlier.
        """
        first, last = self.node_time[[0, -2]]
        return np.asarray((time >= first - _ROUNDING) & (time <= last + _ROUNDING))

    def shift(self, parameters: Mapping[str, Array]) -> float:
        """Return by how much its clock of attitudes is late beside that of the nodes, s."""
        lag = 0.0 if self.clock is None else float(parameters[self.clock][0])
        return float(parameters[self.attitude_clock][0]) - lag

    def attach(
        self,
        time: Array,
        shift: float = 0.0,
        window: Window | None = None,
        *,
        of_attitude: bool = False,
    ) -> Attached:
        """Return where times (M,) are attached to the chain; the nearest place if not covered."""
        turned = place_of(time + shift, self.attitude_time)
        if not of_attitude:
            return Attached(place_of(time, self.node_time), turned)
        # By the same nodes of the track: others would only fill the information matrix.
        return Attached(replace(turned, tau=time - self.node_time[turned.node]), turned)

    def missing(self, at: Attached, lin: Linearization) -> Array | None:
        """Return the variance (M, d) of what is predicted at attached times given the nodes.

        Without it, a measurement would count for more the nearer to a node, and so draw clocks.
        None for attitudes, by which the motion is known.
        """
        if lin.d_p is None and lin.d_v is None and lin.d_omega is None:
            return None
        axes = self.nRt[at.place.node]
        turning, moving = self.density[at.turned.node, :3], self.density[at.place.node, 3:]
        out = np.zeros_like(lin.residual)
        for place, q, by_value, by_rate in (
            (at.turned, turning, lin.d_theta, lin.d_omega),
            (at.place, moving, _turned(lin.d_p, axes), _turned(lin.d_v, axes)),
        ):
            variances = variance_between(place.tau, place.span)
            of_value, of_both, of_rate = variances[..., None, None]
            variance = np.zeros((*out.shape, 3))
            if by_value is not None:
                variance = variance + of_value * by_value**2
            if by_rate is not None:
                variance = variance + of_rate * by_rate**2
            if by_value is not None and by_rate is not None:
                variance = variance + 2.0 * of_both * by_value * by_rate
            out += np.sum(variance * q[:, None, :], axis=2)
        return out

    def motion(self, at: Attached, states: ChainStates) -> Motion:
        """Return the motion at M attached times."""
        return self.transition(at, states).motion

    def transition(
        self, at: Attached, states: ChainStates, motion: Motion | None = None
    ) -> Between:
        """Return the motion at attached times, from which derivatives by the nodes follow."""
        return interpolated(states.turns, states, at.place, at.turned)

    def node_jacobian(self, lin: Linearization, transition: Between) -> Array:
        """Return the derivative of residuals by the variables of measurements, (M, d, 24)."""
        return transition.by_nodes(lin)

    def steps(self, states: ChainStates) -> Iterator[StepRows]:
        """Yield the whitened rows of the prior of the motion, some at a time."""
        block = slice(0, self.count) if self.block is None else self.block
        for first in range(block.start, block.stop, _CHUNK):
            last = min(first + _CHUNK, block.stop)
            nodes = slice(first, last + 1)
            some = SmoothStates(*(getattr(states, name)[nodes] for name in _OF_STATE))
            turns = turns_of(self.attitude_time[nodes], some)
            found = motion_steps(turns, some, self.nRt[nodes], self.density[first:last])
            of_turn = slice(0, _TURN + _RATE), slice(_TURN + _RATE, None)
            by_nodes = np.concatenate(
                [each[:, :, own] for own in of_turn for each in (found.before, found.after)],
                axis=2,
            )
            yield StepRows(MOTION, _COMPONENTS, first, found.residual, by_nodes)

    def assumed(self) -> dict[str, str]:
        """Return what is assumed of each of these sources, as text."""
        turning, moving = np.sqrt(np.median(self.density, axis=0)).reshape(2, 3)
        return {MOTION: f"{np.degrees(turning.max()):.2g} deg/s/√s, {moving.max():.2g} m/s/√s"}


def _turned(jacobian: Array | None, axes: Array) -> Array | None:
    """Return derivatives (M, d, 3) by vectors in n as those by vectors in other axes."""
    return None if jacobian is None else jacobian @ axes


_OF_STATE = ("nRb", "p_n", "v_n", "omega_b")


def far_apart(first: float, own: Array, longest: float) -> Array:
    """Return a time, s, and those after it that are half the longest step apart, or more."""
    kept = [first]
    for t in own.tolist():
        if t - kept[-1] > 0.5 * longest:
            kept.append(t)
    return np.array(kept)


def without_long_steps(edges: Array, longest: float) -> Array:
    """Return times (M,), s, with others in between where steps are too long."""
    wide = np.flatnonzero(np.diff(edges) > longest)
    more = [
        np.linspace(edges[i], edges[i + 1], int(np.ceil((edges[i + 1] - edges[i]) / longest)) + 1)
        for i in wide
    ]
    every = np.unique(np.concatenate([edges, *more]))
    return np.asarray(every[np.concatenate([[True], np.diff(every) > 1e-3])])
