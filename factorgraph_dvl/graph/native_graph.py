"""A whole problem as factors that GTSAM's own optimisers take."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.bound_observation import BoundObservation, Processes
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.imu_errors import ImuErrors
from factorgraph_dvl.graph.priors import Tilt, value_at
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.sensors.parameters import Parameter


class WholeProblem(Protocol):
    """What is read of a problem."""

    graph: gtsam.NonlinearFactorGraph
    chain: Chain
    parameters: tuple[Parameter, ...]
    processes: tuple[Process, ...]
    tilt: Tilt | None

    @property
    def bound(self) -> tuple[BoundObservation, ...]:
        """The observations as they are tied to the chain."""

    @property
    def imu_errors(self) -> ImuErrors | None:
        """Errors of the IMU that are estimated, None if there are none."""

    def key(self, name: str) -> int:
        """Return the key of a parameter."""

    def processes_of(self, bound: BoundObservation) -> Processes:
        """Return the correlated errors of measurements."""

    def prior_values(self) -> dict[str, Array]:
        """Return the values of all parameters before the trial."""


def native_graph(problem: WholeProblem) -> gtsam.NonlinearFactorGraph:
    """Return the nonlinear graph that a problem linearises in bulk.

    Factors from node to node, with gravity per segment where there is an IMU, and all priors are
    the problem's own. Each measurement is one custom factor, with the weights that it has now; it
    depends on the nodes of its correlated error as well.
    """
    imu_errors = problem.imu_errors
    graph = gtsam.NonlinearFactorGraph()
    replaced = [] if imu_errors is None else imu_errors.factors(problem.graph)
    for factor in replaced:
        graph.add(factor)
    for i in range(len(replaced), problem.graph.size()):
        graph.push_back(problem.graph.at(i))
    if problem.tilt is not None:
        keys = {p.name: problem.key(p.name) for p in problem.parameters}
        graph.add(problem.tilt.factor(problem.parameters, keys))
    for process in problem.processes:
        _add_prior(graph, process)
    for factor in _step_factors(problem):
        graph.add(factor)
    for bound in problem.bound:
        for i in np.flatnonzero((bound.weight > 0.0).any(axis=1)).tolist():
            graph.add(_measurement_factor(problem, bound, i))
    return graph


# Returns residual and Jacobian at values of all variables.
_Linearize = Callable[[gtsam.Values], tuple[Array, Array]]


def custom_factor(
    every: Sequence[int], sizes: Sequence[int], rows: int, linearize: _Linearize
) -> gtsam.CustomFactor:
    """Return a custom factor of unit noise; shapes are checked, as GTSAM crashes by wrong ones."""
    edges = np.cumsum([0, *sizes])

    def error(this: gtsam.CustomFactor, at: gtsam.Values, jacobians: list[Array] | None) -> Array:
        residual, matrix = linearize(at)
        if jacobians is not None:
            if matrix.shape != (rows, edges[-1]):
                raise ValueError(f"Jacobian of shape {matrix.shape}, expected {(rows, edges[-1])}")
            for i in range(len(every)):
                jacobians[i] = np.asfortranarray(matrix[:, edges[i] : edges[i + 1]])
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), list(every), error)


def _measurement_factor(
    problem: WholeProblem, bound: BoundObservation, i: int
) -> gtsam.CustomFactor:
    """Return the factor of one measurement."""
    single = bound.single(i)
    processes, parameters = problem.processes_of(bound), bound.parameters(problem.parameters)
    shared = [problem.key(p.name) for p in parameters]
    every = bound.keys_at(bound.nodes(processes)[[i]], processes, shared)[0].tolist()
    wanted = [p.name for p in parameters]
    nodes = problem.chain.nodes_at(bound.attachment)[i]
    rows = bound.weight.shape[1]
    parameters_at = _parameters_at(problem, every)

    def linearize(at: gtsam.Values) -> tuple[Array, Array]:
        values = parameters_at(at)
        states = problem.chain.states_around(at, nodes)
        single.attach(values)
        motion = single.motion(single.attachment, states, values)
        lin = single.linearized(motion, values, wanted, processes)
        matrix, residual = single.jacobian(
            lin, slice(None), motion, states, values, wanted, processes, {}
        )
        return residual[0], matrix[0]

    return custom_factor(every, bound.sizes(processes, parameters), rows, linearize)


def _step_factors(problem: WholeProblem) -> Iterator[gtsam.CustomFactor]:
    """Yield the factors from node to node that GTSAM does not have, one for each step."""
    chain = problem.chain
    for k in range(chain.count if chain.interpolates else 0):
        every = [int(each[0]) for each in chain.variables(np.array([[k]]))]
        yield _step_factor(chain, k, every)


def _step_factor(chain: Chain, k: int, every: Sequence[int]) -> gtsam.CustomFactor:
    node = np.array([k])
    local = chain.from_node(node)

    def linearize(at: gtsam.Values) -> tuple[Array, Array]:
        (step,) = local.steps(chain.states_around(at, node))
        return step.residual[0], step.by_nodes[0]

    return custom_factor(every, chain.sizes, sum(chain.sizes) // 2, linearize)


def _parameters_at(
    problem: WholeProblem, every: Sequence[int]
) -> Callable[[gtsam.Values], Mapping[str, Array]]:
    """Return a function of values to all parameters, the others than of some keys as zero."""
    own = set(every)
    fixed = problem.prior_values()
    estimated = [p for p in problem.parameters if problem.key(p.name) in own]
    nodes = {
        process: [j for j in range(process.time.size) if process.key(j) in own]
        for process in problem.processes
    }

    def at(values: gtsam.Values) -> Mapping[str, Array]:
        out = fixed | {p.name: value_at(values, problem.key(p.name), p) for p in estimated}
        for process, some in nodes.items():
            errors = process.zero
            for j in some:
                errors[j] = values.atVector(process.key(j))
            out[process.name] = errors
        return out

    return at


def _add_prior(graph: gtsam.NonlinearFactorGraph, process: Process) -> None:
    """Add the prior of a correlated error, which is linear."""
    gaussian, values = gtsam.GaussianFactorGraph(), gtsam.Values()
    process.add_prior(gaussian, process.zero)
    for j, node in enumerate(process.zero):
        values.insert(process.key(j), node)
    graph.push_back(gtsam.LinearContainerFactor.ConvertLinearGraph(gaussian, values))
