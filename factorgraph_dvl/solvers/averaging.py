"""Sensors that average over a window although they are stated to measure in no time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.bound_observation import BoundObservation
from factorgraph_dvl.graph.observation_rows import ObservationRows
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, factorized
from factorgraph_dvl.solvers.model import Estimated

# χ² of a length from which on it is estimated. Chosen: of sensors that do not average, one in
# twenty is beyond, and loses some precision; one that does is left with less than two standard
# deviations.
_SHOWN = 2.7
# Measurements that are tested, and in how many stretches. Chosen: a third of a second of work.
_ENOUGH, _STRETCHES = 5000, 20
# Standard deviations from which on a length is one. Chosen: seldom by chance.
_CERTAIN = 3.0


def shown_windows(problem: Problem, minimum: Minimum) -> tuple[Parameter, ...]:
    """Return the lengths of windows that are taken as known and that the data contradict.

    Parameters
    ----------
    problem, minimum : Problem or Minimum
        At its minimum.
    """
    known = {p.name: p for p in problem.all_parameters if not p.estimated and p.spec.usual}
    out = []
    for bound, residual in zip(problem.bound, minimum.evaluation.residuals, strict=True):
        p = known.get(_length(bound))
        if p is None or not bound.weight.any():
            continue
        if _chi_square(problem, bound, minimum, residual) > _SHOWN:
            out.append(p)
    return tuple(out)


def _some_of(count: int) -> IntArray:
    """Return which of so many measurements are tested: of many, some stretches."""
    if count <= _ENOUGH:
        return np.arange(count)
    length = _ENOUGH // _STRETCHES
    first = np.linspace(0, count - length, _STRETCHES).astype(int)
    return (first[:, None] + np.arange(length)).ravel()


def averaging_findings(stated: Sequence[Parameter], at: Estimated) -> tuple[Finding, ...]:
    """Return findings of the lengths that are estimated although they were stated as known."""
    known = {p.name for p in stated if not p.estimated}
    lengths = {p.name: p for p in at.problem.parameters if p.spec.usual and p.name in known}
    out = []
    for bound in at.problem.bound:
        p = lengths.get(_length(bound))
        if p is None:
            continue
        P = at.minimum.information.covariance_of([{at.problem.key(p.name): np.eye(1)}])
        length, std = float(at.values[p.name][0]), float(np.sqrt(P[0, 0]))
        if length > _CERTAIN * std:
            label = bound.observation.label
            text = message("averaging.found", sensor=label, length=length, std=std)
            out.append(Finding(Code.AVERAGING, text, sensor=label, parameter=p.name))
    return tuple(out)


def _length(bound: BoundObservation) -> str:
    """Return the name of the length of its window, empty if it has none."""
    return bound.observation.averaging or ""


def _chi_square(
    problem: Problem, bound: BoundObservation, minimum: Minimum, residual: Array
) -> float:
    """Return twice the fall of the cost by a longer window, as residuals scatter.

    With j the whitened derivatives by the length, A those by all variables and P the covariance of
    these, (jᵀr)² / (jᵀj - jᵀA P Aᵀj): the score test of `statistics.scores`, of one parameter.
    """
    evaluation = minimum.evaluation
    values, name = evaluation.parameters, _length(bound)
    some = _some_of(len(residual))
    window = replace(
        bound,
        observation=ObservationRows(bound.observation, some),
        attachment=None,
        usable=bound.usable[some],
        weight=bound.weight[some],
        averages=True,
    )
    window.attach(values)
    motion = window.motion(window.attachment, evaluation.states, values)
    own, processes = bound.parameters(problem.parameters), problem.processes_of(bound)
    wanted = [p.name for p in own]
    lin = window.linearized(motion, values, [*wanted, name], processes)
    column = window.weight * lin.d_parameters[name][:, :, 0]
    score = -float(np.vdot(column, residual[some]))
    if score <= 0.0:
        return 0.0
    information = minimum.square_root or factorized(problem, evaluation)[0]
    rows, _ = window.jacobian(
        lin, slice(None), motion, evaluation.states, values, wanted, processes, {}
    )
    keys = window.keys_at(window.nodes(processes), processes, [problem.key(n) for n in wanted])
    by_variables = np.einsum("md,mdn->mn", column, rows)
    edges = np.cumsum([0, *window.sizes(processes, own)])
    taken_up: dict[int, Array] = {}
    for variable, first, last in zip(keys.T, edges, edges[1:], strict=False):
        different, place = np.unique(variable, return_inverse=True)
        sums = np.zeros((different.size, last - first))
        np.add.at(sums, place, by_variables[:, first:last])
        for key, each in zip(different.tolist(), sums, strict=True):
            taken_up[key] = taken_up.get(key, 0.0) + each[None]
    left = float(np.vdot(column, column)) - float(information.covariance_of([taken_up])[0, 0])
    scatter = float(np.vdot(residual, residual)) / np.count_nonzero(bound.weight)
    return score**2 / left / scatter if left > 0.0 else 0.0
