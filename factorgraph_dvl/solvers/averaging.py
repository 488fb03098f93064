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
    by_lengths,
    by_noise,
    part_of,
    record_scores,
    squares_at,
    unexplained,
    window_part,
)
from factorgraph_dvl.statistics.scores import Score, Scores
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Share of the sensors that neither average nor are late for which a time is tried all the same.
# Chosen: each takes another solution; a window that is not tried leaves two standard deviations.
_BY_CHANCE = 0.05
# Share of a misfit that a window must explain. Chosen: more than any other cause can.
_SHARE = 0.5
# Share of the fall at the best factor on a mean that the mean itself must have, where the
# shortest mean that is tried has less. Measured: 0.98 and more of windows, 0.8 and less of others.
_SHAPE = 0.95
# Standard deviations from which on a length is one. Chosen: seldom by chance.
_CERTAIN = 3.0


def shown_windows(problem: Problem, minimum: Minimum) -> dict[str, Array]:
    """Return lengths of windows, or delays, that the data contradict: about what they are, s.

    Of those that are taken as known, what explains most first. None where another parameter of
    the sensor that is taken as known, as its clock, explains more, or where most of a misfit is
    left: then the cause is another one. A length that others do not fit as well is one anyway.

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
    out: dict[str, tuple[float, Array]] = {}
    for bound, residual in zip(problem.bound, minimum.evaluation.residuals, strict=True):
        observation = bound.observation
        own = {name: known[name] for name in parameters_of(observation) if name in known}
        usual = sum(p.spec.usual for p in own.values())
        if observation.clock is None or not usual or not bound.weight.any():
            continue
        # Nothing is known of them, whatever they are stated to be.
        unknown = {name: np.full(p.mean.size, np.inf) for name, p in own.items()}
        scores, share = _scores(problem, bound, minimum, unknown)
        tests = {name: scores.test([name]) for name in own}
        scatter = float(np.vdot(residual, residual)) / np.count_nonzero(bound.weight)
        # One-sided: lengths are above zero.
        shown = scatter * float(ndtri(1.0 - _BY_CHANCE / usual)) ** 2
        length, certain = _length(bound), False
        if length in own and tests[length].step[0] > 0.0 and tests[length].chi2 > shown:
            tests[length], certain = _of_length(problem, bound, minimum, tests[length], scatter)
        # A clock and a delay beside it do the same to a record: the clock is what is stated.
        cause = max(own, key=lambda name: (tests[name].chi2, known[name].spec.usual))
        cause = length if certain else cause
        test = tests[cause]
        if not (known[cause].spec.usual and test.step[0] > 0.0 and test.chi2 > shown):
            continue
        explains = share * test.chi2 >= _SHARE * unexplained(bound, residual)
        # What would not lower the objective is not tried: it takes another solution.
        if (certain or explains) and evidence(known[cause], test) > 0.0:
            out[cause] = share * test.chi2, known[cause].mean + test.step
    return {name: out[name][1] for name in sorted(out, key=lambda name: -out[name][0])}


def _of_length(
    problem: Problem,
    bound: BoundObservation,
    minimum: Minimum,
    test: Score,
    scatter: float,
) -> tuple[Score, bool]:
    """Return the test of a length, s, by that of its square, and whether no other fits as well.

    Means over lengths of the same order that fit better than the square says take its place. The
    scatter is the variance of residuals over that of stated noise.
    """
    length = np.sqrt(test.step)
    found = replace(test, step=length, std=test.std / (2.0 * length))
    evaluation, information = minimum.evaluation, _information(problem, minimum)
    some = window_part(bound.observation.time.size)
    part, motion = part_of(problem, bound, some, evaluation)
    lengths, means = by_lengths(problem, part, motion, evaluation, float(length[0]))
    unknown = {_length(bound): np.full(lengths.size, np.inf)}
    derivatives = {_length(bound): means}
    scores = record_scores(problem, part, evaluation, information, unknown, motion, derivatives)
    lin = part.by_motion(motion, evaluation.parameters, problem.processes_of(part))
    noise = np.array(
        [part.averaged_noise(part.attachment, lin, each, part.weight) for each in lengths]
    )
    score, known = scores.score - 0.5 * noise, np.diag(scores.information)
    fall = 2.0 * score - known
    # That of a factor on each mean.
    shown = (score > 0.0) & (known > 0.0)
    most = np.divide(score**2, known, out=np.zeros_like(score), where=shown)
    best = int(np.argmax(fall))
    # The data show the square of a window: its relative error is twice that of the length.
    least = max((1.0 - _SHAPE) * fall[best], (2.0 * _CERTAIN) ** 2 * scatter)
    certain = fall[best] - most[0] > least and fall[best] > _SHAPE * np.max(most)
    if fall[best] > test.chi2:
        found = replace(found, chi2=float(fall[best]), step=lengths[best : best + 1])
    return found, bool(certain)


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


def noise_of_means(findings: Iterable[Finding], windows: Iterable[Finding]) -> list[Finding]:
    """Return findings of which less noise than stated is a note where it is that of means.

    Parameters
    ----------
    findings : iterable of Finding
        Findings of residuals.
    windows : iterable of Finding
        Those of `averaging_findings`.
    """
    averaging = {f.sensor for f in windows if f.code == Code.AVERAGING and is_window(f.parameter)}
    return [
        replace(f, severity="note")
        if f.code == Code.SMALL_RESIDUALS and f.sensor in averaging
        else f
        for f in findings
    ]


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
