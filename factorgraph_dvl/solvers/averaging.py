"""Sensors that average over a window although they are stated to measure in no time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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
from factorgraph_dvl.solvers.record_scores import RecordScores, record_scores

# χ² of a length from which on it is estimated. Chosen: of sensors that do not average, one in
# twenty is beyond, and loses some precision; one that does is left with less than two standard
# deviations.
_SHOWN = 2.7
# Measurements that are tested, and in how many stretches. Chosen: a third of a second of work.
_ENOUGH, _STRETCHES = 5000, 20
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
    known = {
        p.name: p
        for p in problem.all_parameters
        if not (p.estimated or p.spec.plausible is None or p.spec.of_record)
    }
    out = []
    for bound, residual in zip(problem.bound, minimum.evaluation.residuals, strict=True):
        p = known.get(_length(bound))
        if p is None or not p.spec.usual or not bound.weight.any():
            continue
        own = [name for name in parameters_of(bound.observation) if name in known]
        tests = _scores(problem, bound, minimum, own)
        if tests.score[tests.places[p.name]][0] <= 0.0:
            continue
        share = len(residual) / _some_of(len(residual)).size
        found = {name: share * tests.test(name).chi2 for name in own}
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


def _scores(
    problem: Problem, bound: BoundObservation, minimum: Minimum, known: Sequence[str]
) -> RecordScores:
    """Return the scores of known parameters, the length of the window among them, of a record.

    Of many measurements, some.
    """
    evaluation = minimum.evaluation
    some = _some_of(bound.observation.time.size)
    window = replace(
        bound,
        observation=ObservationRows(bound.observation, some),
        attachment=None,
        usable=bound.usable[some],
        weight=bound.weight[some],
        averages=True,
    )
    window.attach(evaluation.parameters)
    information = minimum.square_root or factorized(problem, evaluation)[0]
    return record_scores(problem, window, evaluation, information, known)
