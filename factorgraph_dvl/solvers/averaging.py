"""Sensors that average over a window, or are late, although they are stated not to be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import ndtri

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.bound_observation import BoundObservation
from factorgraph_dvl.graph.clocks import parameters_of
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, factorized
from factorgraph_dvl.solvers.model import Estimated
from factorgraph_dvl.solvers.record_scores import by_square, record_scores, window_part
from factorgraph_dvl.statistics.scores import Scores

# Share of the sensors that neither average nor are late for which a time is tried all the same.
# Chosen: each takes another solution; a window that is not tried leaves two standard deviations.
_BY_CHANCE = 0.05
# Share of a misfit that a window must explain. Chosen: more than any other cause can.
_SHARE = 0.5
# Standard deviations from which on a length, or a misfit, is one. Chosen: seldom by chance.
_CERTAIN = 3.0


def shown_windows(problem: Problem, minimum: Minimum) -> dict[str, Array]:
    """Return lengths of windows, or delays, that the data contradict: about what they are, s.

    Of those that are taken as known. None where another parameter of the sensor that is taken as
    known, as its clock, explains more, or where most of a misfit is left: then the cause is
    another one.

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
    out: dict[str, Array] = {}
    for bound, residual in zip(problem.bound, minimum.evaluation.residuals, strict=True):
        observation = bound.observation
        own = {name: known[name] for name in parameters_of(observation) if name in known}
        usual = sum(p.spec.usual for p in own.values())
        if observation.clock is None or not usual or not bound.weight.any():
            continue
        # Nothing is known of them, whatever they are stated to be.
        unknown = {name: np.full(p.mean.size, np.inf) for name, p in own.items()}
        tests, share = _scores(problem, bound, minimum, unknown)
        found = {name: tests.test([name]).chi2 for name in own}
        # A clock and a delay beside it do the same to a record: the clock is what is stated.
        cause = max(own, key=lambda name: (found[name], known[name].spec.usual))
        if not known[cause].spec.usual or tests.score[tests.places[cause]][0] <= 0.0:
            continue
        scatter = float(np.vdot(residual, residual)) / np.count_nonzero(bound.weight)
        explains = share * found[cause] >= _SHARE * unexplained(bound, residual)
        # One-sided: lengths are above zero.
        shown = float(ndtri(1.0 - _BY_CHANCE / usual)) ** 2
        if found[cause] > shown * scatter and explains:
            step = tests.test([cause]).step
            out[cause] = np.sqrt(step) if cause == _length(bound) else known[cause].mean + step
    return out


def unexplained(bound: BoundObservation, residual: Array) -> float:
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


def averaging_findings(stated: Sequence[Parameter], at: Estimated) -> tuple[Finding, ...]:
    """Return findings of the times that are estimated although they were stated as known."""
    known = {p.name for p in stated if not p.estimated}
    found = {p.name: p for p in at.problem.parameters if p.spec.usual and p.name in known}
    out = []
    for bound in at.problem.bound:
        for name in parameters_of(bound.observation):
            p = found.get(name)
            if p is None:
                continue
            P = at.minimum.information.covariance_of([{at.problem.key(name): np.eye(1)}])
            length, std = float(at.values[name][0]), float(np.sqrt(P[0, 0]))
            # The data show the square of a window: its relative error is twice that of the length.
            certain = _CERTAIN * (2.0 if name == _length(bound) else 1.0)
            if length > certain * std:
                label = bound.observation.label
                key = "averaging.found" if name == _length(bound) else "averaging.late"
                text = message(key, sensor=label, length=length, std=std)
                out.append(Finding(Code.AVERAGING, text, sensor=label, parameter=name))
    return tuple(out)


def _length(bound: BoundObservation) -> str:
    """Return the name of the length of its window, empty if it has none."""
    return bound.observation.averaging or ""


def _scores(
    problem: Problem, bound: BoundObservation, minimum: Minimum, known: Mapping[str, Array]
) -> tuple[Scores, float]:
    """Return the scores of known parameters, the length of the window among them, of a record.

    Of many measurements, some, with how many each stands for. The square of the length stands in
    its place: it has a slope at 0.
    """
    evaluation = minimum.evaluation
    part, share = window_part(bound, evaluation)
    information = minimum.square_root or factorized(problem, evaluation)[0]
    length = _length(bound)
    squares = {length: by_square(problem, part, evaluation)} if length in known else {}
    return record_scores(problem, part, evaluation, information, known, derivatives=squares), share
