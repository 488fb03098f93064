"""A whole problem as factors that GTSAM's own optimisers take."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factorgraph_dvl.geometry.records import concatenated, rows_of
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.clocks import parameters_of
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.graph.sensor_factor import (
    AttachedMeasurements,
    NodeMeasurements,
    ObservationRows,
    at_first_node,
    measurement_factor,
)
from factorgraph_dvl.imu.propagation import Attachment
from factorgraph_dvl.imu.sensitivity import Sensitivity
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.sensors.parameters import Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import Linearization, Motion


def native_graph(problem: Problem) -> gtsam.NonlinearFactorGraph:
    """Return the nonlinear graph that a problem linearises in bulk.

    IMU factors with gravity per segment, walks of the biases and all priors are the problem's
    own. What was measured between a node and the next is one custom factor, with the weights
    that measurements have now; it depends on the nodes of their correlated errors as well.
    """
    imu_errors = problem.imu_errors
    graph = gtsam.NonlinearFactorGraph()
    replaced = [] if imu_errors is None else imu_errors.factors(problem.graph)
    for factor in replaced:
        graph.add(factor)
    for i in range(len(replaced), problem.graph.size()):
        graph.push_back(problem.graph.at(i))
    for process in problem.processes:
        _add_prior(graph, process)
    for k in range(problem.chain.segments.node_time.size):
        measured = _measurement_factor(problem, k)
        if measured is not None:
            graph.add(measured)
    return graph


def _measurement_factor(problem: Problem, k: int) -> gtsam.CustomFactor | None:
    """Return the factor of what was measured after node k, None if nothing was."""
    chain, imu_errors = problem.chain, problem.imu_errors
    rows: list[AttachedMeasurements] = []
    attachments: list[Attachment] = []
    sensitivities: list[Sensitivity] = []
    nodes: dict[str, int] = {}
    weights = []
    count = 0
    for o, at, weight in zip(
        problem.observations, problem.attachments, problem.weights, strict=True
    ):
        (index,) = np.nonzero((at.node == k) & (weight > 0.0).any(axis=1))
        if not index.size:
            continue
        # Where the measurements were bound, which is not where their clock puts them now.
        time = chain.segments.node_time[k] + at.tau[index]
        place = slice(count, count + index.size)
        own = ObservationRows(o, index)
        for process in problem.processes:
            if process.label == o.label:
                own = CorrelatedRows(o, index, process)
                nodes.update(own.nodes)
        rows.append(AttachedMeasurements(own, place, time))
        attachments.append(rows_of(at, index))
        weights.append(weight[index].ravel())
        if imu_errors is not None:
            sensitivities.append(rows_of(imu_errors.sensitivity(at), index))
        count += index.size
    if not rows:
        return None
    attachment = concatenated(attachments)
    used = {name for r in rows for name in parameters_of(r.observation)}
    if imu_errors is not None:
        used |= ERRORS.keys()
    parameters = tuple(p for p in problem.parameters if p.name in used)
    shared = [problem.key(p.name) for p in parameters]
    measured = NodeMeasurements(
        attachment=at_first_node(attachment),
        rows=tuple(rows),
        parameters=(*parameters, *_as_parameters(rows)),
        fixed=problem.prior_values(),
        gravity_n=chain.gravity_n[attachment.segment[:1]],
        earth_rate_n=chain.frame.earth_rate,
        clock_zero=problem.clock_zero,
        sensitivity=concatenated(sensitivities) if sensitivities else None,
    )
    every = [*shared, *nodes.values()]
    return measurement_factor(
        measured, np.concatenate(weights), keys.node(k), chain.bias_key(k), every
    )


@dataclass(frozen=True)
class CorrelatedRows(ObservationRows):
    """Some measurements of an observation with a correlated error, whose nodes are parameters.

    Parameters
    ----------
    process : Process
        The error.
    """

    process: Process

    @property
    def nodes(self) -> dict[str, int]:
        """Keys of the nodes that the measurements lie between, by name."""
        before, _ = self.process.place(self.time)
        every = range(int(before.min()), int(before.max()) + 2)
        return {_node_name(self.process, j): self.process.key(j) for j in every}

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of calibration parameters and nodes."""
        return (*self.whole.parameters, *self.nodes)

    def residual(self, motion: Motion, values: Mapping[str, Array]) -> Array:
        """Return predicted - measured, (K, d), the error included in what is predicted."""
        residual = super().residual(motion, values)
        return self.process.with_error(residual, self._at_nodes(values), self.time)

    def linearize(
        self, motion: Motion, values: Mapping[str, Array], wanted: Collection[str]
    ) -> Linearization:
        """Return the residual and its Jacobians."""
        lin = super().linearize(motion, values, wanted)
        nodes = self._at_nodes(values)
        gain = self.process.gain(nodes, self.time)[..., None]
        of_motion = {
            name: gain * each
            for name in ("d_theta", "d_p", "d_v", "d_omega")
            if (each := getattr(lin, name)) is not None
        }
        by_parameters = {name: gain * each for name, each in lin.d_parameters.items()}
        return replace(
            lin,
            **of_motion,
            residual=self.process.with_error(lin.residual, nodes, self.time),
            d_parameters=by_parameters | self._by_nodes(lin.residual),
        )

    def _at_nodes(self, values: Mapping[str, Array]) -> Array:
        """Return the nodes of the error, (J, size); zero where none is among the values."""
        out = self.process.zero
        for j in range(len(out)):
            out[j] = values.get(_node_name(self.process, j), out[j])
        return out

    def _by_nodes(self, residual: Array) -> dict[str, Array]:
        """Return the derivatives of the error with respect to each node, (K, d, size)."""
        before, _ = self.process.place(self.time)
        found = dict.fromkeys(self.nodes, np.zeros(()))
        for part, jacobian in enumerate(self.process.jacobians(residual, self.time)):
            for name in found:
                here = [_node_name(self.process, int(j) + part) == name for j in before]
                found[name] = found[name] + np.where(np.array(here)[:, None, None], jacobian, 0.0)
        return found


def _node_name(process: Process, j: int) -> str:
    return f"{process.name} {j}"


def _as_parameters(rows: Sequence[AttachedMeasurements]) -> Iterator[Parameter]:
    """Yield the nodes of correlated errors as parameters of a factor."""
    seen = set()
    for r in rows:
        if isinstance(r.observation, CorrelatedRows):
            sigma = np.ones(r.observation.process.size)
            for name in r.observation.nodes:
                if name not in seen:
                    seen.add(name)
                    spec = ParameterSpec(name, labels=("",) * sigma.size)
                    yield Parameter(spec, 0.0 * sigma, sigma)


def _add_prior(graph: gtsam.NonlinearFactorGraph, process: Process) -> None:
    """Add what is known of a correlated error beforehand, which is linear."""
    gaussian, values = gtsam.GaussianFactorGraph(), gtsam.Values()
    process.add_prior(gaussian, process.zero)
    for j, node in enumerate(process.zero):
        values.insert(process.key(j), node)
    graph.push_back(gtsam.LinearContainerFactor.ConvertLinearGraph(gaussian, values))
