"""What every chain of nodes answers: the motion at any time, and its derivatives by the nodes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import gtsam
import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.elimination_order import Spans
from factorgraph_dvl.graph.imu_errors import ImuErrors
from factorgraph_dvl.graph.priors import ConstantsPrior
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Linearization, Motion, Window

# Sources of noise: the prior of the motion, and that of the first state.
MOTION = "acceleration between states"
FIRST_STATE = "prior of the first state"


@dataclass(frozen=True)
class StepRows:
    """Whitened rows from node to node: the prior of the motion.

    Parameters
    ----------
    source : str
        Where the noise comes from.
    components : tuple of str
        Names of the d rows of a step.
    first : int
        First of the M steps.
    residual : ndarray, shape (M, d)
        Residuals of unit noise.
    by_nodes : ndarray, shape (M, d, n)
        Derivatives by the variables of the nodes before and after, as `Chain.variables`.
    """

    source: str
    components: tuple[str, ...]
    first: int
    residual: Array
    by_nodes: Array


class ChainStates(Protocol):
    """States of the K nodes of a chain; each kind of chain has more beside these."""

    @property
    def nRb(self) -> Array:
        """Attitude, body to n, (K, 3, 3)."""

    @property
    def p_n(self) -> Array:
        """Position in n, (K, 3), m."""

    @property
    def v_n(self) -> Array:
        """Velocity over ground in n, (K, 3), m/s."""


class Chain(Protocol):
    """Nodes, what ties them to each other, and the motion in between.

    Each node has a navigation state, attitude, position and velocity, in one variable or two, and
    may have others.
    """

    @property
    def frame(self) -> LocalFrame:
        """Tangent frame n."""

    @property
    def clock(self) -> str | None:
        """Name of the time offset of the clock that the nodes have; None = true times."""

    @property
    def attitude_clock(self) -> str | None:
        """Name of the time offset of the clock that attitudes of nodes have, if another one."""

    def shift(self, parameters: Mapping[str, Array]) -> float:
        """Return by how much its clock of attitudes is late beside that of the nodes, s."""

    @property
    def node_time(self) -> Array:
        """Times of the nodes, (K,), s."""

    @property
    def count(self) -> int:
        """Number of its segments, of which `part` takes some."""

    @property
    def duration(self) -> float:
        """How long the motion is known, s."""

    @property
    def middle(self) -> float:
        """Middle of the record, s."""

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Its own factors, as far as GTSAM linearises them."""

    @property
    def constants(self) -> Mapping[int, int]:
        """Dimensions of the variables that all nodes share, by key."""

    @property
    def sizes(self) -> Sequence[int]:
        """Dimensions of the variables of a measurement, as `variables` has them."""

    def spans(self, parameters: Mapping[str, Array]) -> Sequence[Spans]:
        """Return the spans of time whose measurements depend on the variables of each node."""

    def part(self, block: slice) -> Chain:
        """Return the part of some segments in a row; states keep their keys."""

    def nodes_of(self, block: slice) -> range:
        """Return the nodes from the first of some segments to that of the segments after them."""

    def keys_of(self, nodes: Iterable[int]) -> list[int]:
        """Return the keys of the variables of nodes, node by node."""

    def values(self, states: Any) -> gtsam.Values:
        """Return GTSAM's values of states."""

    def states(self, values: gtsam.Values) -> Any:
        """Return states as arrays."""

    def states_around(self, values: gtsam.Values, nodes: IntArray) -> Any:
        """Return the states that measurements after nodes (c,) depend on."""

    def from_node(self, nodes: IntArray) -> Chain:
        """Return what carries the motion of measurements after nodes (c,), taken as the first."""

    def add_prior(
        self,
        graph: gtsam.NonlinearFactorGraph,
        parameters: Sequence[Parameter],
        key_of: Mapping[str, int],
        constants_prior: ConstantsPrior | None,
    ) -> Sequence[Parameter]:
        """Add the prior of its constants; return the parameters whose priors it does not have."""

    def mean_constants(self, states: Any) -> Iterator[tuple[Parameter, Array, dict[int, Array]]]:
        """Yield its own parameters with their means over the trial, and the derivatives of these.

        In reported units; derivatives by the variables of the graph, by key.
        """

    def release(self) -> None:
        """Free what only binding measurements needs."""

    def sources(self, letters: str) -> dict[str, slice]:
        """Return the sources of noise of one of its factors, and which rows each has.

        Parameters
        ----------
        letters : str
            Letters of the factor's variables.
        """

    def assumed(self) -> dict[str, str]:
        """Return what is assumed of each of these sources, as text."""

    def errors(
        self, parameters: Sequence[Parameter], key_of: Mapping[str, int]
    ) -> ImuErrors | None:
        """Return the errors of the IMU among parameters, None if there are none."""

    def covers(self, time: Array) -> BoolArray:
        """Whether the motion is known at times (M,)."""

    def attach(
        self,
        time: Array,
        shift: float = 0.0,
        window: Window | None = None,
        *,
        of_attitude: bool = False,
    ) -> Any:
        """Return where times (M,) are attached to the chain; the nearest place if not covered.

        Parameters
        ----------
        time : ndarray, shape (M,), s
            Times by the clock of the nodes.
        shift : float, default 0, s
            Shift of the clock of attitudes beside it.
        window : Window, optional
            Windows about the times, of measurements that are means. A chain without
            samples leaves it out.
        of_attitude : bool, default False
            Whether they are measurements of attitude alone: the track counts for nothing.
        """

    def missing(self, at: Any, lin: Linearization) -> Array | None:
        """Return the variance (M, d) of what is predicted at attached times given the nodes.

        None where these measurements are of nothing that varies between nodes.
        Where the motion between nodes is not recorded, or recorded with noise.
        """

    def averaged(self, at: Any, lin: Linearization, length: float) -> Array | None:
        """Return what means over windows of a length, s, take from that, (M, d).

        None of a chain without samples, which leaves windows out.
        """

    def curved(self, at: Any, lin: Linearization, step: float) -> Array | None:
        """Return how far it bends what is predicted within a step, s, (M, d); likewise.

        That is the covariance with twice itself less what it is a step before and after.
        """

    def motion(self, at: Any, states: Any) -> Motion:
        """Return the motion at M attached times."""

    def transition(self, at: Any, states: Any, motion: Motion) -> Any:
        """Return the derivatives of the motion at attached times by the nodes."""

    def node_jacobian(self, lin: Linearization, transition: Any) -> Array:
        """Return the derivative of residuals by the variables of measurements, (M, d, n)."""

    @property
    def step_source(self) -> str | None:
        """Source of the noise of `steps`; None where there are none."""

    @property
    def log_determinant(self) -> float:
        """Log det of the covariance of what ties the nodes, as far as models differ in it."""

    @property
    def interpolates(self) -> bool:
        """Whether the motion between nodes follows from both: at any time, without samples."""

    def steps(self, states: Any) -> Iterator[StepRows]:
        """Yield the whitened rows from node to node that are not in `graph`, some at a time."""

    def state_keys(self, k: int) -> list[int]:
        """Return the keys of the state of node k: of all, or of attitude and of the rest."""

    def nodes_at(self, at: Any) -> IntArray:
        """Return the nodes before M attached times, (M, c): of all, or of each part of states."""

    def variables(self, nodes: IntArray) -> list[IntArray]:
        """Return the keys of the variables of measurements after nodes (M, c), (M,) each.

        Of nodes (M, 1), all parts of states are those of the same node.
        """


class AtTrueTimes:
    """What chains have in common whose nodes are at true times, and states one variable each."""

    clock: ClassVar[str | None] = None
    attitude_clock: ClassVar[str | None] = None

    def shift(self, parameters: Mapping[str, Array]) -> float:
        """Return 0: attitudes are at the times of the nodes."""
        return 0.0

    def spans(self: Chain, parameters: Mapping[str, Array]) -> list[Spans]:
        """Return the spans of time whose measurements depend on the variables of each node."""
        return [Spans([self.keys_of([k]) for k in range(self.node_time.size)], self.node_time)]

    def state_keys(self, k: int) -> list[int]:
        """Return the key of the state of node k."""
        return [keys.node(k)]

    def nodes_at(self, at: Any) -> IntArray:
        """Return the nodes before attached times, (M, 1)."""
        return np.asarray(at.node)[:, None]

    def states_around(self, values: gtsam.Values, nodes: IntArray) -> Any:
        """Return the states that measurements after a node (1,) depend on: of it and the next."""
        (k,) = nodes.tolist()
        return self._states(values, range(k, k + 2))

    def _states(self, values: gtsam.Values, nodes: range) -> Any:
        """Return the states of some nodes in a row."""
        raise NotImplementedError


class WithoutImu:
    """What chains have in common whose nodes are tied by white acceleration, and by nothing else.

    They have `node_time`, (K,), s.
    """

    node_time: Array
    interpolates: ClassVar[bool] = True
    step_source: ClassVar[str | None] = MOTION
    first_state: ClassVar[str] = FIRST_STATE

    @property
    def count(self) -> int:
        """Number of its segments, from node to node."""
        return self.node_time.size - 1

    @property
    def duration(self) -> float:
        """How long the motion is known, s."""
        return float(self.node_time[-1] - self.node_time[0])

    @property
    def middle(self) -> float:
        """Middle of the record, s."""
        return 0.5 * float(self.node_time[0] + self.node_time[-1])

    @property
    def constants(self) -> dict[int, int]:
        """Dimensions of the variables that all nodes share, by key: none."""
        return {}

    def nodes_of(self, block: slice) -> range:
        """Return the nodes from the first of some steps to that of the steps after them."""
        return range(block.start, block.stop + (block.stop == self.count))

    def averaged(self, at: Any, lin: Linearization, length: float) -> None:
        """Return nothing: without samples there is nothing to average."""

    def curved(self, at: Any, lin: Linearization, step: float) -> None:
        """Return nothing, likewise."""

    def add_prior(
        self,
        graph: gtsam.NonlinearFactorGraph,
        parameters: Sequence[Parameter],
        key_of: Mapping[str, int],
        constants_prior: ConstantsPrior | None,
    ) -> Sequence[Parameter]:
        """Add nothing: it has no constants; return all parameters."""
        return parameters

    def mean_constants(self, states: Any) -> Iterator[tuple[Parameter, Array, dict[int, Array]]]:
        """Yield nothing: it has no parameters of its own."""
        yield from ()

    def errors(self, parameters: Sequence[Parameter], key_of: Mapping[str, int]) -> None:
        """Return None: there is no IMU."""

    def release(self) -> None:
        """Free nothing: nothing is kept for binding measurements."""

    def sources(self, letters: str) -> dict[str, slice]:
        """Return the sources of noise of one of its factors, and which rows each has."""
        return {self.first_state: slice(None)}
