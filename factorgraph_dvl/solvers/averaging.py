"""Sensors that average over a window although they are stated to measure in no time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.bound_observation import BoundObservation
from factorgraph_dvl.graph.clocks import parameters_of
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
# Relative size of an eigenvalue of information that is none.
_ROUNDING = 1e-9
# Share of a misfit that a window must explain. Chosen: more than any other cause can.
_SHARE = 0.5
# Standard deviations from which on a length, or a misfit, is one. Chosen: seldom by chance.
_CERTAIN = 3.0


def shown_windows(problem: Problem, minimum: Minimum) -> tuple[Parameter, ...]:
    """Return the lengths of windows that are taken as known and that the data contradict.

    None where another parameter of the sensor that is taken as known, as its clock, explains more,
    or where the window leaves most of a misfit: then the cause is another one.

    Parameters
    ----------
    problem, minimum : Problem or Minimum
        Problem, and its minimum.
    """
    known = {p.name: p for p in problem.all_parameters if not p.estimated and p.spec.plausible}
    out = []
    for bound, residual in zip(problem.bound, minimum.evaluation.residuals, strict=True):
        p = known.get(_length(bound))
        if p is None or not p.spec.usual or not bound.weight.any():
            continue
        own = [name for name in parameters_of(bound.observation) if name in known]
        found = _chi_squares(problem, bound, minimum, residual, own)
        if not found:
            continue
        fall = found[p.name]
        scatter = float(np.vdot(residual, residual)) / np.count_nonzero(bound.weight)
        most = max(_SHARE * _misfit(bound, residual), *found.values())
        if fall > _SHOWN * scatter and fall >= most:
            out.append(p)
    return tuple(out)


def _misfit(bound: BoundObservation, residual: Array) -> float:
    """Return the squares of residuals beyond what they differ by from one to the next.

    Zero where it may be chance.
    """
    used = bound.weight.all(axis=1)
    own = residual[used]
    if len(own) < 2:
        return 0.0
    noise = 0.5 * np.mean(np.diff(own, axis=0) ** 2, axis=0)
    beyond = float(np.sum(own**2 - noise))
    chance = float(np.sqrt(2.0 * np.sum(noise**2) * len(own)))
    return beyond if beyond > _CERTAIN * chance else 0.0


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


def _chi_squares(
    problem: Problem,
    bound: BoundObservation,
    minimum: Minimum,
    residual: Array,
    known: Sequence[str],
) -> dict[str, float]:
    """Return twice the fall of the cost by each of some known parameters.

    With J the whitened derivatives by one of them, A those by all variables, P the covariance of
    these and r the residuals, rᵀJ (JᵀJ - JᵀA P AᵀJ)⁻¹ Jᵀr: the score tests of `statistics.scores`,
    at the price of no elimination. Nothing where the window should not be longer.
    """
    evaluation = minimum.evaluation
    values, length = evaluation.parameters, _length(bound)
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
    lin = window.linearized(motion, values, [*wanted, *known], processes)
    columns = {name: window.weight[:, :, None] * lin.d_parameters[name] for name in known}
    by_known = np.concatenate(list(columns.values()), axis=2)
    score = -np.einsum("mdk,md->k", by_known, residual[some])
    parts = dict(zip(columns, _parts(columns.values()), strict=True))
    if score[parts[length]][0] <= 0.0:
        return {}
    rows, _ = window.jacobian(
        lin, slice(None), motion, evaluation.states, values, wanted, processes, {}
    )
    keys = window.keys_at(window.nodes(processes), processes, [problem.key(n) for n in wanted])
    by_variables = np.einsum("mdk,mdn->mkn", by_known, rows)
    edges = np.cumsum([0, *window.sizes(processes, own)])
    taken_up: dict[int, Array] = {}
    for variable, first, last in zip(keys.T, edges, edges[1:], strict=False):
        different, place = np.unique(variable, return_inverse=True)
        sums = np.zeros((different.size, by_known.shape[2], last - first))
        np.add.at(sums, place, by_variables[:, :, first:last])
        for key, each in zip(different.tolist(), sums, strict=True):
            taken_up[key] = taken_up.get(key, 0.0) + each
    information = minimum.square_root or factorized(problem, evaluation)[0]
    left = np.einsum("mdk,mdl->kl", by_known, by_known) - information.covariance_of([taken_up])
    # Of all measurements, by those that are tested.
    share = len(residual) / some.size
    out = {}
    for name, part in parts.items():
        step = np.linalg.lstsq(left[part, part], score[part], rcond=_ROUNDING)[0]
        out[name] = share * float(score[part] @ step)
    return out


def _parts(columns: Iterable[Array]) -> list[slice]:
    """Return the places of columns (M, d, n) side by side."""
    edges = np.cumsum([0, *(column.shape[2] for column in columns)]).tolist()
    return [slice(a, b) for a, b in pairwise(edges)]
