"""The chain of a trial without IMU: states of motion, tied to each other by their inertia."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import gtsam
import numpy as np

from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.records import concatenated
from factorgraph_dvl.geometry.rotations import BodyAxes, log_so3
from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.chain import StepRows
from factorgraph_dvl.graph.keys import RATE_SIZE, STATE_SIZE
from factorgraph_dvl.graph.priors import ConstantsPrior, loose_diagonal
from factorgraph_dvl.graph.smooth_motion import (
    Between,
    SmoothStates,
    Turns,
    interpolated,
    motion_steps,
    turns_of,
    variance_between,
)
from factorgraph_dvl.graph.trajectory import between, epochs_between, reported, tangent_in_n
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Linearization, Motion

# Source of noise of the prior of the motion.
MOTION = "acceleration between states"
FIRST_STATE = "prior of the first state"
# Names of the rows of a step.
_COMPONENTS = tuple(
    f"{kind} {axis}"
    for kind in ("turn", "shift", "angular acceleration", "acceleration")
    for axis in "xyz"
)
# Standard deviations of the first state, rad, m, m/s and rad/s. Chosen: they only keep the chain
# regular.
_FREE = np.repeat([np.pi, 1e5, 1e2, 1.0], 3)
# Nodes of a branch, as of the inertial chain.
_BRANCH = 128
# What rounding may add to a time, s.
_ROUNDING = 1e-6
# Share of the time between nodes by which a measurement may be beyond its own. Chosen: a clock
# that is nearly known moves less.
_STAYS = 0.05
# Steps whose rows are made at once. Chosen: some ten megabytes.
_CHUNK = 4096


@dataclass(frozen=True)
class Attached:
    """Where M times hang on the chain.

    Parameters
    ----------
    node : ndarray of int, shape (M,)
        Node before.
    segment : ndarray of int, shape (M,)
        The same: segments are from node to node.
    time, turned : ndarray, shape (M,), s
        Times by the clock of the nodes, and by that of their attitudes.
    """

    node: IntArray
    segment: IntArray
    time: Array
    turned: Array


@dataclass(frozen=True)
class ChainStates(SmoothStates):
    """States of the nodes, with what turns the body from one to the next.

    Parameters
    ----------
    time : ndarray, shape (K,), s
        Times of the nodes.
    """

    time: Array

    @cached_property
    def turns(self) -> Turns:
        """What turns the body from node to node."""
        return turns_of(self.time, self)


@dataclass(frozen=True)
class SmoothChain:
    """Nodes of a trial without IMU, and the prior of their motion.

    Parameters
    ----------
    frame : LocalFrame
        Tangent frame n.
    node_time : ndarray, shape (K,), s
        Times of the nodes, by `clock`.
    density : ndarray, shape (K - 1, 6)
        Power spectral densities of the acceleration between nodes, as of `motion_steps`.
    start : SmoothStates
        States about which the prior of the first is loose.
    nRt : ndarray, shape (K, 3, 3)
        Axes of the track to n: level, they turn with the heading but not with waves.
    clock : str, optional
        Name of the time offset of the clock that the nodes have; None = true times.
    attitude_clock : str, optional
        Name of the time offset of the clock that their attitudes have: measurements of attitude
        then stay where they are between nodes whatever the clocks.
    first_shift : float, default 0, s
        By how much that clock was late where both agree with the times of the nodes.
    resolution : float, default 0, s
        Interval of the densest record: a trajectory has no more epochs.
    block : slice, optional
        Steps whose prior it has, of a part; by default all.
    """

    frame: LocalFrame
    node_time: Array
    density: Array
    start: SmoothStates
    nRt: Array
    clock: str | None = None
    attitude_clock: str | None = None
    first_shift: float = 0.0
    resolution: float = 0.0
    block: slice | None = None
    interpolates: ClassVar[bool] = True
    step_source: ClassVar[str | None] = MOTION

    @property
    def count(self) -> int:
        """Number of its segments, from node to node."""
        return self.node_time.size - 1

    @property
    def duration(self) -> float:
        """How long the motion is known, s."""
        return float(self.node_time[-1] - self.node_time[0])

    @property
    def log_determinant(self) -> float:
        """Log det of the covariance of the steps, but for what their length makes it."""
        return 2.0 * float(np.log(self.density).sum())

    @property
    def middle(self) -> float:
        """Middle of the record, s."""
        return 0.5 * float(self.node_time[0] + self.node_time[-1])

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Prior of the first state."""
        graph = gtsam.NonlinearFactorGraph()
        if self.block is None or self.block.start == 0:
            s = self.start
            state = gtsam.NavState(gtsam.Rot3(s.nRb[0]), s.p_n[0], s.v_n[0])
            loose = loose_diagonal(_FREE[:STATE_SIZE])
            graph.add(gtsam.PriorFactorNavState(keys.node(0), state, loose))
            graph.addPriorVector(keys.rate(0), s.omega_b[0], loose_diagonal(_FREE[STATE_SIZE:]))
        return graph

    @property
    def constants(self) -> dict[int, int]:
        """Dimensions of the variables that all nodes share, by key: none."""
        return {}

    @property
    def sizes(self) -> list[int]:
        """Dimensions of the variables of a measurement."""
        return [STATE_SIZE, RATE_SIZE] * 2

    @property
    def joints(self) -> range:
        """Nodes between which branches lie: eliminated last, they leave each by itself."""
        return range(0, self.node_time.size, _BRANCH)

    def part(self, block: slice) -> SmoothChain:
        """Return the part of some steps in a row; states keep their keys."""
        out = replace(self, block=block)
        # Of all states, which take long to insert.
        vars(out)["zeros"] = self.zeros
        return out

    def nodes_of(self, block: slice) -> range:
        """Return the nodes from the first of some steps to that of the steps after them."""
        return range(block.start, block.stop + (block.stop == self.count))

    def keys_of(self, nodes: Iterable[int]) -> list[int]:
        """Return the keys of the states of nodes, each with that of its rates."""
        return [key for k in nodes for key in (keys.node(k), keys.rate(k))]

    def variables(self, node: IntArray) -> list[IntArray]:
        """Return the keys of the variables of measurements after nodes (M,), (M,) each."""
        return [first + k for k in (node, node + 1) for first in (keys.node(0), keys.rate(0))]

    @cached_property
    def zeros(self) -> gtsam.Values:
        """States and rates of zero: they take GTSAM far longer to insert than to move."""
        out, state = gtsam.Values(), gtsam.NavState()
        for k in range(self.node_time.size):
            out.insert(keys.node(k), nav_state=state)
            out.insert(keys.rate(k), np.zeros(RATE_SIZE))
        return out

    def values(self, states: SmoothStates) -> gtsam.Values:
        """Return GTSAM's values of states and rates."""
        step = gtsam.VectorValues()
        rows = np.hstack([log_so3(states.nRb), states.p_n, states.v_n])
        for k, (row, rate) in enumerate(zip(rows, states.omega_b, strict=True)):
            step.insert(keys.node(k), row)
            step.insert(keys.rate(k), rate)
        return self.zeros.retract(step)

    def states(self, values: gtsam.Values) -> ChainStates:
        """Return states as arrays."""
        return self._states(values, range(self.node_time.size))

    def states_around(self, values: gtsam.Values, k: int) -> ChainStates:
        """Return the states that measurements after node k depend on."""
        return self._states(values, range(k, k + 2))

    def from_node(self, k: int) -> SmoothChain:
        """Return what carries the motion from node k to the next, which then are the first two."""
        two = slice(k, k + 2)
        return replace(
            self,
            node_time=self.node_time[two],
            density=self.density[k : k + 1],
            nRt=self.nRt[two],
            block=None,
        )

    def _states(self, values: gtsam.Values, nodes: range) -> ChainStates:
        state, omega = np.empty((len(nodes), 5, 5)), np.empty((len(nodes), RATE_SIZE))
        for i, k in enumerate(nodes):
            # A matrix of GTSAM's is [nRb, p, v; 0, I].
            state[i] = values.atNavState(keys.node(k)).matrix()
            omega[i] = values.atVector(keys.rate(k))
        nRb, p_n, v_n = (state[:, :3, part].copy() for part in (slice(0, 3), 3, 4))
        some = slice(nodes.start, nodes.stop)
        return ChainStates(nRb, p_n, v_n, omega, self.node_time[some])

    def covers(self, time: Array) -> BoolArray:
        """Whether times (M,) are between the first node and the last but one.

        The last one is for attitudes, whose nodes may be earlier.
        """
        first, last = self.node_time[[0, -2]]
        return np.asarray((time >= first - _ROUNDING) & (time <= last + _ROUNDING))

    def shift(self, parameters: Mapping[str, Array]) -> float:
        """Return by how much its clock of attitudes is late beside that of the nodes, s."""
        if self.attitude_clock is None:
            return 0.0
        lag = 0.0 if self.clock is None else float(parameters[self.clock][0])
        return float(parameters[self.attitude_clock][0]) - lag - self.first_shift

    def attach(
        self,
        time: Array,
        shift: float = 0.0,
        *,
        turning: bool = False,
        before: Attached | None = None,
        window: float | None = None,
    ) -> Attached:
        """Return where times (M,) hang on the chain; those that are not covered, where nearest.

        A measurement that is hardly beyond the nodes it had `before` keeps them: its attitude is
        carried from other nodes than its position, so that the cost would jump there, by some
        thousandths, and a minimisation would end at the jump.
        """
        turned = time + shift
        by = turned if turning else time
        node = np.searchsorted(self.node_time, by, side="right") - 1
        node = np.clip(node, 0, self.count - 1)
        if before is not None:
            begin, end = self.node_time[before.node], self.node_time[before.node + 1]
            slack = _STAYS * (end - begin)
            node = np.where((by > begin - slack) & (by < end + slack), before.node, node)
        return Attached(node, node, time, turned)

    def missing(self, at: Attached, lin: Linearization) -> Array | None:
        """Return the variance (M, d) of what is predicted at attached times given the nodes.

        Without it, a measurement would count for more the nearer to a node, and so draw clocks.
        None for attitudes, by which the motion is known.
        """
        if lin.d_p is None and lin.d_v is None and lin.d_omega is None:
            return None
        begin, span = self.node_time[at.node], np.diff(self.node_time)[at.node]
        density, axes = self.density[at.node], self.nRt[at.node]
        out = np.zeros_like(lin.residual)
        for time, q, by_value, by_rate in (
            (at.turned, density[:, :3], lin.d_theta, lin.d_omega),
            (at.time, density[:, 3:], _turned(lin.d_p, axes), _turned(lin.d_v, axes)),
        ):
            of_value, of_both, of_rate = variance_between(time - begin, span)[..., None, None]
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
        return interpolated(states.turns, states.time, states, at.node, at.time, at.turned)

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
            turns = turns_of(self.node_time[nodes], some)
            found = motion_steps(turns, some, self.nRt[nodes], self.density[first:last])
            by_nodes = np.concatenate([found.before, found.after], axis=2)
            yield StepRows(MOTION, _COMPONENTS, first, found.residual, by_nodes)

    def add_prior(
        self,
        graph: gtsam.NonlinearFactorGraph,
        parameters: Sequence[Parameter],
        key_of: Mapping[str, int],
        constants_prior: ConstantsPrior | None,
    ) -> Sequence[Parameter]:
        """Add nothing: it has no constants; return all parameters."""
        return parameters

    def mean_constants(
        self, states: ChainStates
    ) -> Iterator[tuple[Parameter, Array, dict[int, Array]]]:
        """Yield nothing: it has no parameters of its own."""
        yield from ()

    def errors(self, parameters: Sequence[Parameter], key_of: Mapping[str, int]) -> None:
        """Return None: there is no IMU."""

    def trajectory(
        self,
        states: ChainStates,
        P: Array,
        body_axes: BodyAxes,
        rate_hz: float,
        lag: float = 0.0,
    ) -> Trajectory:
        """Return the motion at a rate, with its covariance.

        Parameters
        ----------
        states : ChainStates
            States of the K nodes.
        P : ndarray, shape (K, 9, 9)
            Their covariances at true times, in GTSAM's tangent space.
        body_axes : BodyAxes
            Axes of the body.
        rate_hz : float
            Epochs in a second, at most those of the densest record.
        lag : float, default 0, s
            By how much the clock of the nodes is late.
        """
        rate_hz = min(rate_hz, 1.0 / self.resolution if self.resolution else rate_hz)
        first, last = self.node_time[[0, -1]] - lag
        time = epochs_between(first, last, rate_hz)
        P_n = tangent_in_n(P, states.nRb)
        parts = []
        for i in range(0, max(time.size, 1), _CHUNK):
            some = time[i : i + _CHUNK]
            at = self.attach(some + lag)
            found = self.transition(at, states)
            span = np.diff(self.node_time)[at.node]
            fraction = (at.time - self.node_time[at.node]) / span
            covariance = between(P_n, at.node, fraction) + found.missing(self.density, self.nRt)
            parts.append(reported(some, found.motion, covariance, self.frame, body_axes))
        return parts[0] if len(parts) == 1 else concatenated(parts)

    def release(self) -> None:
        """Free nothing: nothing is kept for binding measurements."""

    def sources(self, letters: str) -> dict[str, slice]:
        """Return the sources of noise of one of its factors, and which rows each has."""
        return {FIRST_STATE: slice(None)}

    def assumed(self) -> dict[str, str]:
        """Return what is assumed of each of these sources, as text."""
        turning, moving = np.sqrt(np.median(self.density, axis=0)).reshape(2, 3)
        return {MOTION: f"{np.degrees(turning.max()):.2g} deg/s/√s, {moving.max():.2g} m/s/√s"}


def _turned(jacobian: Array | None, axes: Array) -> Array | None:
    """Return derivatives (M, d, 3) by vectors in n as those by vectors in other axes."""
    return None if jacobian is None else jacobian @ axes


_OF_STATE = ("nRb", "p_n", "v_n", "omega_b")
