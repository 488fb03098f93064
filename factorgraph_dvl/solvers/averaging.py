"""Sensors that average over a window, or are late, although they are stated not to be."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.bound_observation import BoundObservation
from factorgraph_dvl.graph.clocks import parameters_of
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.averaging import hidden_delay, is_window
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.solvers.known_parameters import evidence
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, factorized
from factorgraph_dvl.solvers.model import Estimated
from factorgraph_dvl.solvers.record_scores import (
    by_noise,
    of_whole,
    part_of,
    record_scores,
    record_sums_in_turn,
    squares_at,
    unexplained,
    window_part,
)
from factorgraph_dvl.statistics.scores import Score, Scores, places_of
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Share of the sensors that neither average nor are late for which a time is tried all the same.
# Chosen: each takes another solution; a window that is not tried leaves two standard deviations.
_BY_CHANCE = 0.05
# Share of a misfit that a window must explain. Chosen: more than any other cause can.
_SHARE = 0.5
# Standard deviations from which on a length is one. Chosen: seldom by chance.
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
        if not (found[cause] > shown * scatter and explains):
            continue
        test = tests.test([cause]) if share == 1.0 else _by_all(problem, bound, minimum, cause)
        if cause == _length(bound):
            test = _of_length(test)
        # What would not lower the objective is not tried: it takes another solution.
        if test.step[0] > 0.0 and evidence(known[cause], test) > 0.0:
            out[cause] = test.step if cause == _length(bound) else known[cause].mean + test.step
    return out


def _by_all(problem: Problem, bound: BoundObservation, minimum: Minimum, name: str) -> Score:
    """Return the test of one time by all measurements of a record."""
    evaluation, information = minimum.evaluation, _information(problem, minimum)
    unknown = {name: np.full(1, np.inf)}
    squares = None
    if name == _length(bound):
        squares = of_whole(name, squares_at(problem, bound, minimum))
    sums = record_sums_in_turn(problem, bound, evaluation, unknown, squares)
    if squares is not None:
        sums.score[:] -= by_noise(problem, bound, evaluation).sum()
    known = sums.square - information.covariance_of([sums.by_key])
    return Scores(places_of(unknown), sums.score, known, unknown[name]).test([name])


def _of_length(test: Score) -> Score:
    """Return the test of a length, s, by that of its square."""
    length = np.sqrt(np.maximum(test.step, 0.0))
    std = test.std / (2.0 * np.maximum(length, np.finfo(float).tiny))
    return replace(test, step=length, std=std)


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


def without_hidden(
    errors: Iterable[Finding], aids: Iterable[Aid], estimates: Iterable[Estimate]
) -> tuple[Finding, ...]:
    """Return errors in records less those of clocks that a window explains: see `hidden_delay`.

    Parameters
    ----------
    errors : iterable of Finding
        Errors in the records.
    aids : iterable of Aid
        Sensors that may average.
    estimates : iterable of Estimate
        What was estimated, windows among them.
    """
    found = {e.name: float(e.value[0]) for e in estimates if is_window(e.name)}
    lengths = {a.label: found[p.name] for a in aids for p in a.parameters() if p.name in found}
    return tuple(f for f in errors if not _delay(f) < hidden_delay(lengths.get(f.sensor, 0.0)))


def _delay(found: Finding) -> float:
    """Return by how much a clock is off, s; infinite where that is not what was found."""
    values = dict(found.message.values) if isinstance(found.message, Message) else {}
    size = values.get("size")
    return size if found.code == Code.CLOCK_OFFSET and isinstance(size, float) else np.inf


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
    evaluation, information = minimum.evaluation, _information(problem, minimum)
    count = bound.observation.time.size
    some = window_part(count)
    part, motion = part_of(problem, bound, some, evaluation)
    length = _length(bound)
    squares = {length: squares_at(problem, bound, minimum)[some]} if length in known else {}
    scores = record_scores(problem, part, evaluation, information, known, motion, squares)
    if length in known:
        noise = by_noise(problem, bound, evaluation)[some]
        scores.score[scores.places[length]] -= noise.sum()
    return scores, count / some.size


def _information(problem: Problem, minimum: Minimum) -> SquareRootInformation:
    """Return the information at a minimum, which may have been found without it."""
    return minimum.square_root or factorized(problem, minimum.evaluation)[0]
