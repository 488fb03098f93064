"""Parameters that are taken as known: would one of them explain what residuals do not fit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.clocks import parameters_of
from factorgraph_dvl.graph.observation_rows import ObservationRows
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.imu.sampling import apparent_gyro_scale
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.plausibility.clocks import LEAP_SECONDS
from factorgraph_dvl.plausibility.earlier_calibration import prior_against_data
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.imu import ERRORS, GYRO_SCALE, Imu
from factorgraph_dvl.sensors.parameters import UNITS, Parameter
from factorgraph_dvl.sensors.protocol import ObservationByRows
from factorgraph_dvl.solvers.change_along_trial import CHANGED, component_changes
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, factorized
from factorgraph_dvl.solvers.record_scores import record_scores
from factorgraph_dvl.solvers.sawtooth import sawtooths
from factorgraph_dvl.solvers.state_ranges import StateRanges, eliminated_by_ranges
from factorgraph_dvl.solvers.water_span import water_spans
from factorgraph_dvl.statistics.constancy import by_interval
from factorgraph_dvl.statistics.robust_weights import robust_scale
from factorgraph_dvl.statistics.scores import Score, Scores, scores
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Logarithm of the probability, shared among all tests, below which a misfit is no chance.
_LOG10_P = -6.0
# The same of a distortion of one record. Measured: axes of a DVL that are 0.5 degrees off in swell
# are 29 standard deviations at 1e-5, and none of 27 honest trials shows one.
_LOG10_P_OF_RECORD = -4.0
# Standard deviations of what is plausible that a parameter may be off. Chosen: beyond, it is not
# the cause.
_FAR = 4.0
# Standard deviations of its prior that a parameter must be off to be estimated without. Chosen: by
# chance it is seldom beyond three.
_OUTSIDE = 5.0
# Cost up to which a cause is as probable as the most probable one. Chosen: a likelihood of e^-4.
_TIE = 4.0
# Intervals whose scores show how much a misfit that a parameter does not explain scatters. Chosen:
# longer than what persists in a trial of minutes.
_INTERVALS = 20
# Least scale of residuals against what is stated. Chosen: records without noise have none.
_LEAST_SCALE = 0.5
# Share of the squares of a scale of the gyros that the wrong `sampling` may leave. Chosen: the
# motion between samples is known to some per cent, and the scale to ten.
_LEFT = 0.2
# Measurements of a sensor up to which parts of a trial evaluate all. Chosen: these cost nothing.
_FEW = 1000
# Trial, s, from which on tests are made. Chosen: shorter ones have rival minima.
_SHORTEST = 60.0


@dataclass(frozen=True)
class Explanation:
    """A parameter that was taken as known, and that the data say has another value.

    Parameters
    ----------
    parameter : Parameter
        Parameter as it was taken.
    score : Score
        Its test.
    others : tuple of str or Message
        Names of those that explain the misfit about as well, `imu.sampling` where that does, and
        changes along the trial that do.
    shape : Parameter, optional
        What a search found of it: the period of a sawtooth, or the span of water.
    """

    parameter: Parameter
    score: Score
    others: tuple[str | Message, ...]
    shape: Parameter | None = None

    @property
    def freed(self) -> tuple[Parameter, ...]:
        """The parameter, to be estimated, and its shape."""
        freed = wide(self.parameter, self.parameter.mean)
        return (freed,) if self.shape is None else (freed, self.shape)


def explanation(problem: Problem, minimum: Minimum, imu: Imu | None) -> Explanation | None:
    """Return what would explain most of a misfit; None if chance may have made it.

    None also where a change along the trial explains more.

    Parameters
    ----------
    problem : Problem
        What was minimised.
    minimum : Minimum
        Where it ended.
    imu : Imu
        The samples, as they are stated to be taken.
    """
    time = problem.chain.node_time
    if time[-1] - time[0] < _SHORTEST:
        return None
    evaluation, information = minimum.evaluation, minimum.information
    shapes = sawtooths(problem, evaluation) | water_spans(problem, evaluation, information)
    tests = _tests(problem, evaluation, information, shapes)
    asked = sum(p.spec.plausible is not None for p in problem.all_parameters)
    shared = np.log10(max(asked, 1))
    significant = [
        (p, test)
        for p, test in tests.values()
        if test.log10_p < _limit(p) - shared and _is_plausible(p, test)
    ]
    if not significant:
        return None
    same, at = with_scattered_noise(problem, evaluation, problem.all_parameters)
    changes = component_changes(same, at, factorized(same, at)[0])
    certain = [e for e in changes if e.change.chi2 > CHANGED**2]
    significant.sort(key=lambda each: -_evidence(*each))
    parameter, test = significant[0]
    # A change costs as one component does of what there are as many of as measurements.
    count = sum(int(np.count_nonzero(w)) for w in problem.weights)
    more = test.chi2 - _evidence(parameter, test) - float(np.log(count))
    fall = test.chi2 * test.scatter - more
    if any(e.change.chi2 > test.chi2 - more or e.change.fall > fall for e in certain):
        return None
    others: tuple[str | Message, ...] = tuple(
        p.name
        for p, t in significant[1:]
        if _evidence(parameter, test) - _evidence(p, t) < 2.0 * _TIE
    )
    others += tuple(
        message("unexplained_misfit.change", name=e.name, time=e.change.time)
        for e in certain
        if fall - e.change.fall < 2.0 * _TIE
    )
    if imu is not None and parameter.name == GYRO_SCALE and _is_sampling(test, imu):
        others = (*others, "imu.sampling")
    shape, _ = shapes.get(parameter.name, (None, 0))
    return Explanation(parameter, test, others, shape)


def _limit(p: Parameter) -> float:
    """Return the logarithm of the probability below which a parameter is no chance."""
    return _LOG10_P_OF_RECORD if p.spec.of_record else _LOG10_P


def _evidence(p: Parameter, test: Score) -> float:
    """Return what a parameter takes off the objective if it may be anything plausible."""
    return test.evidence(wide(p, p.mean).sigma)


def _is_sampling(scale: Score, imu: Imu) -> bool:
    """Whether a scale of the gyros is what the wrong sampling looks like."""
    left = scale.step - apparent_gyro_scale(imu)
    return bool(left @ left < _LEFT * scale.step @ scale.step)


def _tests_of_priors(
    problem: Problem, evaluation: Evaluation, information: SquareRootInformation
) -> dict[str, tuple[Parameter, Score]]:
    """Return tests of the priors of what is estimated for the sake of the others, by name.

    Of those only that the data put far outside.
    """
    out = {}
    for p in problem.parameters:
        if p.spec.plausible is None or p.joint is not None or not np.all(p.sigma > 0.0):
            continue
        if np.all(p.sigma >= p.spec.plausible * p.si):
            continue
        P = information.covariance_of([{problem.key(p.name): np.eye(p.mean.size)}])
        found = prior_against_data(p.mean, np.diag(p.sigma**2), evaluation.parameters[p.name], P)
        step = np.where(np.isfinite(found.std), found.value - p.mean, 0.0)
        if found.freedom and np.any(np.abs(step) > _OUTSIDE * p.sigma):
            out[p.name] = p, Score(found.statistic, found.freedom, step, found.std)
    return out


def _tests(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
    shapes: Mapping[str, tuple[Parameter, int]],
) -> dict[str, tuple[Parameter, Score]]:
    """Return tests of what is taken as known, within a prior or for certain, by name.

    Of sawtooths and spans of water, with those that a search found, by how many there were.
    """
    used = {
        name
        for o, weight in zip(problem.observations, problem.weights, strict=True)
        if weight.any()
        for name in (*parameters_of(o), *ERRORS)
    }
    known = [
        p
        for p in problem.all_parameters
        if not (p.estimated or p.spec.plausible is None or p.spec.usual or p.spec.of_record)
        and p.name in used
    ]
    known += _shown_by_records(problem, evaluation, information, shapes)
    out = _tests_of_priors(problem, evaluation, information)
    free = [*(p for p, _ in out.values()), *known]
    if not free:
        return {}
    ranges, columns = _freed(problem, evaluation, free, [p for p, _ in shapes.values()])
    found = scores(ranges.information.solution(), ranges.information, columns)
    out |= {p.name: (p, _searched(found.test([p.name]), p, shapes)) for p in known}
    if all(test.log10_p >= _limit(p) for p, test in out.values()):
        return out
    scatter = _scatter(problem.chain.node_time, ranges, columns, found)
    return {name: (p, test.divided(scatter[name])) for name, (p, test) in out.items()}


def _searched(test: Score, p: Parameter, shapes: Mapping[str, tuple[Parameter, int]]) -> Score:
    """Return a test as that of the best of all shapes, if its parameter has one."""
    return test.searched(shapes[p.name][1]) if p.name in shapes else test


def _shown_by_records(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
    shapes: Mapping[str, tuple[Parameter, int]],
) -> list[Parameter]:
    """Return the parameters of one record each that its rows ask for.

    With noise as residuals differ from one to the next. What looks like one of them by far is
    then tested with all others.
    """
    out: list[Parameter] = []
    if problem.chain.interpolates:
        return out
    scattered = _as_scattered(problem, evaluation)
    own_shapes = {p.name: p.mean for p, _ in shapes.values()}
    there = replace(evaluation, parameters={**evaluation.parameters, **own_shapes})
    known = {p.name: p for p in problem.all_parameters if p.spec.of_record and not p.estimated}
    for bound, at, motion in zip(
        problem.bound, evaluation.attached, evaluation.motions, strict=True
    ):
        label = bound.observation.label
        own = [known[name] for name in parameters_of(bound.observation) if name in known]
        if not (own and bound.weight.any()):
            continue
        here = replace(bound, attachment=at)
        priors = {p.name: wide(p, p.mean).sigma for p in own}
        found = record_scores(problem, here, there, information, priors, motion)
        ratio = scattered[label] / problem.noise_factors[label] if label in scattered else 1.0
        variance = float(np.mean(np.square(ratio)))
        for p in own:
            test = _searched(found.test([p.name]).divided(variance), p, shapes)
            if test.log10_p < _limit(p):
                out.append(p)
    return out


def _is_plausible(p: Parameter, test: Score) -> bool:
    """Whether a parameter can be as far from what it was taken to be."""
    return bool(np.all(np.abs(test.step) < _FAR * wide(p, p.mean).sigma))


def _chi_square(explanation: Explanation) -> Message:
    """Return how strong the evidence is, in brackets."""
    score = explanation.score
    return message("words.chi2", chi2=score.chi2, freedom=score.freedom)


def explanation_findings(
    freed: Sequence[Explanation], left: Explanation | None, evaluation: Evaluation
) -> tuple[Finding, ...]:
    """Return findings of parameters that were estimated instead, and of what is left."""
    out = [
        Finding(
            Code.ESTIMATED_INSTEAD,
            message(
                "estimated_instead.stated",
                name=e.parameter.name,
                stated=_numbers(e.parameter, e.parameter.mean),
                std=_uncertainty(e.parameter),
                chi2=_chi_square(e),
                value=_numbers(e.parameter, evaluation.parameters[e.parameter.name]),
                others=_leap_seconds(e.parameter, evaluation) or _shape(e) or _or(e),
            ),
            parameter=e.parameter.name,
        )
        for e in freed
    ]
    if left is not None:
        value = left.parameter.mean + left.score.step
        out.append(
            Finding(
                Code.UNEXPLAINED_MISFIT,
                message(
                    "unexplained_misfit.would_have_to_be",
                    name=left.parameter.name,
                    value=_numbers(left.parameter, value),
                    stated=_numbers(left.parameter, left.parameter.mean),
                    chi2=_chi_square(left),
                    others=_or(left),
                ),
                parameter=left.parameter.name,
            )
        )
    return tuple(out)


def _leap_seconds(p: Parameter, evaluation: Evaluation) -> Message | None:
    """Return that a clock is off by the leap seconds, None if it is not."""
    if not p.spec.stem.endswith("time_offset"):
        return None
    off = abs(float(evaluation.parameters[p.name][0]))
    return message("leap_seconds.estimated") if abs(off - LEAP_SECONDS) < 1.0 else None


def _shape(found: Explanation) -> Message | None:
    """Return what a parameter is that has a shape, None if it has none."""
    if found.shape is None:
        return None
    values = dict(zip(found.shape.spec.labels, found.shape.mean, strict=True))
    key = "sawtooth.estimated" if "period" in values else "water_span.estimated"
    return message(key, **values)


def _uncertainty(p: Parameter) -> Message:
    if not p.estimated:
        return message("estimated_instead.certain")
    return message("words.plus_minus", value=_numbers(p, p.sigma))


def _or(found: Explanation) -> Message | str:
    if not found.others:
        return ""
    return message("unexplained_misfit.others", names=found.others)


def _numbers(p: Parameter, value: Array) -> Message:
    """Return a value in the unit of files."""
    unit = UNITS[p.spec.unit].text
    if not unit:
        return message("words.numbers", values=value / p.si)
    return message("words.numbers_with_unit", values=value / p.si, unit=unit)


def wide(p: Parameter, mean: Array) -> Parameter:
    """Return a parameter that may be anything plausible around a mean."""
    assert p.spec.plausible is not None
    return replace(p, mean=mean, sigma=np.full(p.mean.size, p.spec.plausible * p.si))


def _freed(
    problem: Problem,
    evaluation: Evaluation,
    known: Sequence[Parameter],
    shapes: Iterable[Parameter],
) -> tuple[StateRanges, dict[str, tuple[int, Array]]]:
    """Return the problem with known parameters free, where it is, and their keys and priors.

    Its states are eliminated.
    """
    names = {p.name for p in known}
    others = {p.name: p for p in shapes}
    free = [
        wide(p, p.mean) if p.name in names else others.get(p.name, p)
        for p in problem.all_parameters
    ]
    ranges = eliminated_by_ranges(
        partial(
            with_scattered_noise,
            problem,
            evaluation,
            free,
            noise=_as_scattered(problem, evaluation),
        ),
        problem.chain,
        whole=bool(problem.processes),
    )
    return ranges, {p.name: (ranges.names[p.name], p.sigma) for p in free if p.name in names}


def with_scattered_noise(
    problem: Problem,
    evaluation: Evaluation,
    parameters: Sequence[Parameter],
    block: slice | None = None,
    *,
    noise: dict[str, Array] | None = None,
) -> tuple[Problem, Evaluation]:
    """Return a problem with other parameters where it is, and noise as residuals scatter.

    Of some segments only where a block of them is given; `noise` has its factors, if known.
    """
    values = evaluation.parameters
    chain, observations, robust = problem.chain, problem.observations, problem.robust_weights
    if block is not None:
        own = [
            np.flatnonzero((at.segment >= block.start) & (at.segment < block.stop))
            for at in evaluation.attached
        ]
        rows = {o.label: index for o, index in zip(observations, own, strict=True)}
        chain = chain.part(block)
        observations = tuple(
            o.some(index)
            if isinstance(o, ObservationByRows) and o.time.size > _FEW
            else ObservationRows(o, index)
            for o, index in zip(observations, own, strict=True)
            if index.size
        )
        robust = {label: weight[rows[label]] for label, weight in robust.items()}
    tilt = problem.tilt
    if tilt is not None:
        # It counts once, in the part that has the priors.
        first = block is None or block.start == 0
        estimated = [p for p in parameters if p.estimated]
        tilt = tilt.of(problem.parameters, estimated) if first else None
    test = Problem(
        chain,
        observations,
        parameters,
        start=problem.bound_at,
        clock_zero=problem.clock_zero,
        processes=problem.processes,
        tilt=tilt,
    )
    test.reject(problem.rejected)
    test.noise_factors = _as_scattered(problem, evaluation) if noise is None else noise
    test.robust_weights = robust
    test.long_run = problem.long_run
    at = test.evaluate(test.values(evaluation.states, test.prior_values() | values))
    return test, test.weighed(at)


def _scatter(
    node_time: Array,
    ranges: StateRanges,
    columns: Mapping[str, tuple[int, Array]],
    found: Scores,
) -> dict[str, float]:
    """Return how much more the scores of parts of the trial scatter than white noise makes them.

    Once each parameter has explained what it can. Scores of a misfit that it does not explain, as
    of correlated noise, go with each other for a while (White, Econometrica 48(4), 1980; Newey and
    West, Econometrica 55(3), 1987).
    """
    # In units of the wide priors.
    scaled = [{key: np.diag(1.0 / sigma)} for key, sigma in columns.values()]
    gain = np.linalg.inv(ranges.information.covariance_of(scaled))
    shared = {key: P @ gain for key, P in ranges.information.covariance_with(scaled).items()}
    edges = np.linspace(node_time[0], node_time[-1], _INTERVALS + 1)[1:-1]
    score, known = np.zeros((2, 1))
    for rows, following in ranges.rows(shared):
        of_range = by_interval(rows, following, edges)
        score, known = score + of_range[0], known + of_range[1]
    out = {}
    for name, place in found.places.items():
        own = known[:, place, place]
        total = own.sum(axis=0) + np.eye(own.shape[1])
        step = np.linalg.solve(total, score[:, place].sum(axis=0))
        left = score[:, place] - own @ step
        more = left.T @ left * _INTERVALS / (_INTERVALS - 1)
        out[name] = max(1.0, float(np.trace(np.linalg.solve(total, more))) / step.size)
    return out


def _as_scattered(problem: Problem, evaluation: Evaluation) -> dict[str, Array]:
    """Return factors on stated noise by what residuals differ from one to the next.

    That is noise alone, and no misfit; what is stated may be wrong by far.
    """
    out = {}
    for o, weight, residual in zip(
        problem.observations, problem.weights, evaluation.residuals, strict=True
    ):
        if o.label not in problem.noise_factors:
            continue
        scale = robust_scale(np.where(weight > 0.0, residual, np.nan), _LEAST_SCALE)
        for group in map(list, o.noise_groups):
            scale[group] = np.max(scale[group])
        out[o.label] = problem.noise_factors[o.label] * scale
    return out
