"""Measurements in a linear graph: one Jacobian factor per set of nodes, written in bulk.

All measurements of a kind are evaluated in one NumPy pass, because a Python callback per factor
would be slow and makes GTSAM's optimisers copy all values.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Any

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.bound_observation import BoundObservation, processes_of
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.factor_layout import CHUNK, Part, factor_layout
from factorgraph_dvl.graph.imu_errors import LinearImuFactors
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.graph.template import jacobian_template
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Linearization, Motion


@dataclass
class _Block:
    """Observations with the same variables: one factor per set of nodes for all of them.

    `parts` has, by observation, which of its rows go to which of the factors, and where.
    `matrices` and `vectors` are views into `factors` and live no longer than they do.
    """

    bound: list[BoundObservation]
    parameters: tuple[Parameter, ...]
    parts: list[list[Part]] = field(default_factory=list)
    factors: list[gtsam.JacobianFactor] = field(default_factory=list)
    matrices: list[Array] = field(default_factory=list)
    vectors: list[Array] = field(default_factory=list)


@dataclass(frozen=True)
class Evaluation:
    """Motion, residuals and cost at one set of values.

    Parameters
    ----------
    values : gtsam.Values
        Values of all variables, as GTSAM has them.
    states, parameters : object or dict of str to ndarray
        The same as arrays: states as the chain has them, parameters by name, rotations as
        matrices.
    attached, motions, residuals : list of Attached, of Motion or of ndarray
        Per observation: where it is attached to the chain; residuals whitened, (M, d).
    cost : float
        Half the sum of all squared whitened residuals.
    own_cost : float
        The part of it that is not of measurements.
    imu : LinearImuFactors, optional
        Native factors, linear there, where errors of the IMU are estimated.
    """

    values: gtsam.Values
    states: Any
    parameters: dict[str, Array]
    attached: list[Any]
    motions: list[Motion]
    residuals: list[Array]
    cost: float
    own_cost: float
    imu: LinearImuFactors | None = None


@dataclass(frozen=True)
class Rows:
    """Whitened rows of the linearised graph, in M items of d rows; each row has unit noise.

    Parameters
    ----------
    source : str
        Where the noise comes from.
    components : tuple of str
        Names of the d rows of an item.
    keys : ndarray, shape (M, k)
        Variables of each item.
    sizes : tuple of int
        Dimensions of the k variables.
    matrix : ndarray, shape (M, d, n)
        Jacobian with respect to these variables side by side.
    vector : ndarray, shape (M, d)
        Residual.
    begin : int, default 0
        Number of the first item among all of an observation.
    """

    source: str
    components: tuple[str, ...]
    keys: IntArray
    sizes: tuple[int, ...]
    matrix: Array
    vector: Array
    begin: int = 0


@dataclass(frozen=True)
class MeasurementFactors:
    """Factors of all measurements of a problem.

    Parameters
    ----------
    chain : Chain
        Nodes.
    bound : sequence of BoundObservation
        Observations, in the order of an evaluation.
    key_of : mapping of str to int
        Keys of the parameters that are estimated.
    blocks : sequence of _Block
        Observations with the same variables.
    """

    chain: Chain
    bound: Sequence[BoundObservation]
    key_of: Mapping[str, int]
    blocks: Sequence[_Block]

    @classmethod
    def of(
        cls,
        chain: Chain,
        bound: Sequence[BoundObservation],
        parameters: Sequence[Parameter],
        key_of: Mapping[str, int],
        processes: Sequence[Process],
    ) -> MeasurementFactors:
        """Return the factors of observations, which are laid out when they are written."""
        blocks: dict[tuple[tuple[str, ...], ...], _Block] = {}
        for each in bound:
            used = each.parameters(parameters)
            kind = (
                tuple(p.name for p in used),
                processes_of(each.observation, processes).names,
            )
            blocks.setdefault(kind, _Block([], used)).bound.append(each)
        return cls(chain, bound, key_of, list(blocks.values()))

    def written(
        self, evaluation: Evaluation, processes: Sequence[Process]
    ) -> Iterator[gtsam.JacobianFactor]:
        """Yield the factors at an evaluation; they are written in place at the next call."""
        self.follow(evaluation)
        for block in self.blocks:
            if not block.factors:
                self._lay_out(block, processes)
        self._fill(evaluation, processes)
        for block in self.blocks:
            yield from block.factors

    def follow(self, evaluation: Evaluation) -> None:
        """Attach measurements where their clocks are at an evaluation."""
        for block in self.blocks:
            for bound in block.bound:
                at = evaluation.attached[self.bound.index(bound)]
                before, bound.attachment = bound.attachment, at
                if before is None or not (
                    at is before
                    or np.array_equal(self.chain.nodes_at(at), self.chain.nodes_at(before))
                ):
                    block.parts, block.matrices, block.vectors, block.factors = [], [], [], []

    def _fill(self, evaluation: Evaluation, processes: Sequence[Process]) -> None:
        """Write the rows of measurements into their factors, some at a time."""
        observed = [(block, bound) for block in self.blocks for bound in block.bound]
        linear = [
            self._linearized(bound, block.parameters, evaluation, processes)
            for block, bound in observed
        ]
        of_all = (parts for block in self.blocks for parts in block.parts)
        for some in zip_longest(*of_all):
            transitions: dict[Hashable, Any] = {}
            for (block, bound), lin, part in zip(observed, linear, some, strict=True):
                if part is None:
                    continue
                matrix, vector = self._jacobian(
                    bound,
                    block.parameters,
                    lin,
                    part.measurements,
                    evaluation,
                    processes,
                    transitions,
                )
                matrix, vector = matrix.reshape(-1, matrix.shape[2]), -vector.ravel()
                for factor_index, there, here in part.places:
                    block.matrices[factor_index][there] = matrix[here]
                    block.vectors[factor_index][there] = vector[here]

    def release(self) -> None:
        """Free the factors; the next linearisation makes others."""
        for block in self.blocks:
            block.parts, block.matrices, block.vectors, block.factors = [], [], [], []

    def rows(self, evaluation: Evaluation, processes: Sequence[Process]) -> Iterator[Rows]:
        """Yield the rows of each observation, some at a time."""
        self.follow(evaluation)
        for block in self.blocks:
            for bound in block.bound:
                lin = self._linearized(bound, block.parameters, evaluation, processes)
                o, sizes = bound.observation, tuple(self._sizes(block, processes))
                nodes = bound.nodes(processes_of(o, processes))
                variables = self._keys_at(block, nodes, processes)
                for begin in range(0, max(len(lin.residual), 1), CHUNK):
                    some = slice(begin, begin + CHUNK)
                    matrix, vector = self._jacobian(
                        bound, block.parameters, lin, some, evaluation, processes, {}
                    )
                    yield Rows(
                        o.label, o.components, variables[some], sizes, matrix, vector, begin
                    )

    def rows_at(
        self,
        evaluation: Evaluation,
        parameters: Mapping[str, Array],
        processes: Sequence[Process],
    ) -> Iterator[Rows]:
        """Yield the rows of observations that depend on parameters, at values of these."""
        values = {**evaluation.parameters, **parameters}
        seen = [i for i, each in enumerate(self.bound) if parameters.keys() & each.names]
        attached, motions = (
            [each[i] for i in seen] for each in (evaluation.attached, evaluation.motions)
        )
        bound = [self.bound[i] for i in seen]
        if parameters.keys() & ERRORS.keys():
            motions = [
                each.motion(at, evaluation.states, values)
                for each, at in zip(bound, attached, strict=True)
            ]
        blocks = [
            replace(block, bound=[each for each in block.bound if each in bound])
            for block in self.blocks
        ]
        there = replace(evaluation, parameters=values, attached=attached, motions=motions)
        yield from replace(self, bound=bound, blocks=blocks).rows(there, processes)

    def _lay_out(self, block: _Block, processes: Sequence[Process]) -> None:
        """Make a block's factors for the nodes that its measurements depend on."""
        found = factor_layout(
            [b.nodes(processes_of(b.observation, processes)) for b in block.bound],
            [len(b.observation.components) for b in block.bound],
        )
        block.parts = found.parts
        sizes = self._sizes(block, processes)
        block.matrices, block.vectors, block.factors = [], [], []
        variables = self._keys_at(block, found.nodes, processes).tolist()
        for own, rows in zip(variables, found.rows, strict=True):
            factor = jacobian_template(own, sizes, rows)
            block.factors.append(factor)
            block.matrices.append(factor.getA())
            block.vectors.append(factor.getb())

    def _keys_at(self, block: _Block, nodes: IntArray, processes: Sequence[Process]) -> IntArray:
        """Return the variables of a block's measurements at nodes as they have them."""
        first = block.bound[0]
        shared = [self.key_of[p.name] for p in block.parameters]
        return first.keys_at(nodes, processes_of(first.observation, processes), shared)

    def _sizes(self, block: _Block, processes: Sequence[Process]) -> list[int]:
        """Return the dimensions of these variables."""
        first = block.bound[0]
        return first.sizes(processes_of(first.observation, processes), block.parameters)

    def _linearized(
        self,
        bound: BoundObservation,
        parameters: Sequence[Parameter],
        evaluation: Evaluation,
        processes: Sequence[Process],
    ) -> Linearization:
        """Return an observation linearised at an evaluation."""
        motion = evaluation.motions[self.bound.index(bound)]
        own = processes_of(bound.observation, processes)
        wanted = [p.name for p in parameters]
        return bound.linearized(motion, evaluation.parameters, wanted, own)

    def _jacobian(
        self,
        bound: BoundObservation,
        parameters: Sequence[Parameter],
        lin: Linearization,
        some: slice | IntArray,
        evaluation: Evaluation,
        processes: Sequence[Process],
        transitions: dict[Hashable, Any],
    ) -> tuple[Array, Array]:
        """Return the whitened Jacobian (M, d, n) and residual (M, d) of some measurements."""
        return bound.jacobian(
            lin,
            some,
            evaluation.motions[self.bound.index(bound)],
            evaluation.states,
            evaluation.parameters,
            [p.name for p in parameters],
            processes_of(bound.observation, processes),
            transitions,
        )
