"""A whole problem as factors that GTSAM's own optimisers take."""

from __future__ import annotations

import gtsam
import numpy as np

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.clocks import parameters_of
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.sensor_factor import (
    NodeMeasurements,
    ObservationRows,
    Rows,
    at_first_node,
    concatenated,
    measurement_factor,
    sliced,
)
from factorgraph_dvl.imu.propagation import Attachment
from factorgraph_dvl.imu.sensitivity import Sensitivity
from factorgraph_dvl.sensors.imu import ERRORS


def native_graph(problem: Problem) -> gtsam.NonlinearFactorGraph:
    """Return the nonlinear graph that a problem linearises in bulk.

    IMU factors with gravity per segment, walks of the biases and all priors are the problem's
    own. What was measured between a node and the next is one custom factor, with the weights
    that measurements have now.

    Raises
    ------
    ConfigError
        If the problem has correlated errors, whose nodes such a factor does not know.
    """
    if problem.processes:
        names = ", ".join(p.label for p in problem.processes)
        raise ConfigError(
            f"the noise of {names} is correlated, which factors of GTSAM cannot express here",
            hint="State white noise in the trial: `noise: stated` and no correlation times",
        )
    imu_errors = problem.imu_errors
    graph = gtsam.NonlinearFactorGraph()
    replaced = [] if imu_errors is None else imu_errors.factors(problem.graph)
    for factor in replaced:
        graph.add(factor)
    for i in range(len(replaced), problem.graph.size()):
        graph.push_back(problem.graph.at(i))
    for k in range(problem.chain.segments.node_time.size):
        measured = _measurement_factor(problem, k)
        if measured is not None:
            graph.add(measured)
    return graph


def _measurement_factor(problem: Problem, k: int) -> gtsam.CustomFactor | None:
    """Return the factor of what was measured after node k, None if nothing was."""
    chain, imu_errors = problem.chain, problem.imu_errors
    rows: list[Rows] = []
    attachments: list[Attachment] = []
    sensitivities: list[Sensitivity] = []
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
        rows.append(Rows(ObservationRows(o, index), place, time))
        attachments.append(sliced(at, index))
        weights.append(weight[index].ravel())
        if imu_errors is not None:
            sensitivities.append(sliced(imu_errors.sensitivity(at), index))
        count += index.size
    if not rows:
        return None
    attachment = concatenated(attachments)
    used = {name for r in rows for name in parameters_of(r.observation)}
    if imu_errors is not None:
        used |= ERRORS.keys()
    parameters = tuple(p for p in problem.parameters if p.name in used)
    measured = NodeMeasurements(
        attachment=at_first_node(attachment),
        rows=tuple(rows),
        parameters=parameters,
        fixed=problem.prior_values(),
        gravity_n=chain.gravity_n[attachment.segment[:1]],
        earth_rate_n=chain.frame.earth_rate,
        clock_zero=problem.clock_zero,
        sensitivity=concatenated(sensitivities) if sensitivities else None,
    )
    shared = [problem.key(p.name) for p in parameters]
    return measurement_factor(
        measured, np.concatenate(weights), keys.node(k), chain.bias_key(k), shared
    )
