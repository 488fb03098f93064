"""Parameters that are taken as known: would one of them explain what residuals do not fit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.clocks import parameters_of
from factorgraph_dvl.graph.keys import calibration as calibration_key
from factorgraph_dvl.graph.observation_rows import ObservationRows, some_of
from factorgraph_dvl.graph.problem import SAME_WEIGHT, Evaluation, Problem, Rows
from factorgraph_dvl.imu.sampling import apparent_gyro_scale
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.plausibility.clocks import LEAP_SECONDS
from factorgraph_dvl.plausibility.earlier_calibration import prior_against_data
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.dvl_distortion import FLEX_BY_TILT
from factorgraph_dvl.sensors.imu import ERRORS, GYRO_SCALE, Imu
from factorgraph_dvl.sensors.parameters import UNITS, XYZ, Parameter
from factorgraph_dvl.solvers.change_along_trial import (
    certain,
    component_changes,
    fall_where_free,
    largest,
)
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, factorized
from factorgraph_dvl.solvers.parameter_scores import ParameterScores, parameter_scores
from factorgraph_dvl.solvers.record_scores import record_scores
from factorgraph_dvl.solvers.sawtooth import sawtooths
from factorgraph_dvl.solvers.shape import Shape, Shapes, searched
from factorgraph_dvl.solvers.water_span import water_spans
from factorgraph_dvl.statistics.marginal_likelihood import (
    constants_of,
    gradient_by_name,
    with_states_at,
)
from factorgraph_dvl.statistics.robust_weights import robust_scale
from factorgraph_dvl.statistics.rows import rows_by_source
from factorgraph_dvl.statistics.scores import Score
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Logarithm of the probability, shared among all tests, below which a misfit is no chance.
_LOG10_P = -6.0
# The same of a distortion of one record. Measured: axes of a DVL that are 0.5 degrees off in swell
# are 29 standard deviations at 1e-5, and none of 27 honest trials shows one.
_LOG10_P_OF_RECORD = -4.0
# Standard deviations of what is plausible that a parameter may be off. Chosen: beyond, it is not
# the cause.
_FAR = 4.0
# Share of a vehicle's tilt that may be missing of a turn by all of it. Chosen: tilt sensors lag.
_WHOLE = 0.2
# Standard deviations of its prior that a parameter must be off to be estimated without. Chosen: by
# chance it is seldom beyond three.
_OUTSIDE = 5.0
# Cost up to which a cause is as probable as the most probable one. Chosen: a likelihood of e^-4.
_TIE = 4.0
# Segments whose rows are there at a time. Chosen: those of a quarter of an hour; where many
# parameters are free, they take 20 MB.
_LONGEST = 1_000
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
    tried : int
        Number of parameters of which it is the most probable.
    shape : Shape, optional
        What a search found of it: the period of a sawtooth, or the span of water.
    """

    parameter: Parameter
    score: Score
    others: tuple[str | Message, ...]
    tried: int
    shape: Shape | None = None

    @property
    def freed(self) -> tuple[Parameter, ...]:
        """The parameter, to be estimated, and its shape."""
        freed = wide(self.parameter, self.parameter.mean)
        return (freed,) if self.shape is None else (freed, self.shape.parameter)

    @property
    def price(self) -> float:
        """What the objective must fall by if it is estimated: each of these may by chance."""
        return 2.0 * float(np.log(self.tried)) + (0.0 if self.shape is None else self.shape.price)


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
    weighed = _weighed(problem, minimum)
    shapes = _shapes(problem, minimum)
    tests = _tests(problem, minimum, weighed, shapes)
    tried = max(sum(p.spec.plausible is not None for p in problem.all_parameters), 1)
    shared = np.log10(tried)
    significant = [
        (p, test)
        for p, test in tests.values()
        if test.log10_p < _limit(p) - shared and _is_plausible(p, test)
    ]
    if not significant:
        return None
    changes = component_changes(weighed.problem, weighed.evaluation, weighed.information)
    changed = certain(changes)
    significant.sort(key=lambda each: -evidence(*each))
    parameter, test = significant[0]
    # A change costs as one component does of what there are as many of as measurements.
    more = test.chi2 - evidence(parameter, test) - float(np.log(problem.used_count))
    fall = test.chi2 * test.scatter - more
    if any(e.change.chi2 > test.chi2 - more or e.change.fall > fall for e in changed):
        return None
    most = largest(changed)
    if most is not None and fall < fall_where_free(
        weighed.problem, weighed.evaluation, weighed.information, most, weighed.step
    ):
        return None
    others: tuple[str | Message, ...] = tuple(
        p.name
        for p, t in significant[1:]
        if evidence(parameter, test) - evidence(p, t) < 2.0 * _TIE
    )
    others += tuple(
        message("unexplained_misfit.change", name=e.name, time=e.change.time)
        for e in changed
        if fall - e.change.fall < 2.0 * _TIE
    )
    if imu is not None and parameter.name == GYRO_SCALE and _is_sampling(test, imu):
        others = (*others, "imu.sampling")
    return Explanation(parameter, test, others, tried, shapes.get(parameter.name))


def _shapes(problem: Problem, minimum: Minimum) -> Shapes:
    """Return what searches find, where an IMU ties the motion."""
    if problem.chain.interpolates:
        return {}
    evaluation = minimum.evaluation
    found = sawtooths(problem, evaluation)
    return found | water_spans(problem, evaluation, minimum.information)


def _limit(p: Parameter) -> float:
    """Return the logarithm of the probability below which a parameter is no chance."""
    return _LOG10_P_OF_RECORD if p.spec.of_record else _LOG10_P


def evidence(p: Parameter, test: Score) -> float:
    """Return what a parameter takes off the objective if it may be anything plausible."""
    return test.evidence(wide(p, p.mean).sigma)


def is_needless(p: Parameter, problem: Problem, minimum: Minimum) -> bool:
    """Whether the objective is lower without a parameter that was stated for certain.

    It is estimated instead: as more is known, another one may explain what it did.

    Parameters
    ----------
    p : Parameter
        Parameter as it was stated.
    problem, minimum : Problem or Minimum
        Problem that estimates it, and its minimum.
    """
    value = minimum.evaluation.parameters[p.name]
    if p.estimated or value.shape != p.mean.shape:
        return False
    P = minimum.information.covariance_of([{problem.key(p.name): np.eye(value.size)}])
    step, std = value - p.mean, np.sqrt(np.diag(P))
    test = Score(float(step @ np.linalg.solve(P, step)), value.size, step, std)
    return evidence(p, test) < 0.0


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


@dataclass(frozen=True)
class _Weighed:
    """A problem where it is, with what it is weighed by.

    The step leads to its minimum, if it is not there. Ratios are those of what residuals scatter
    by, where it is weighed otherwise.
    """

    problem: Problem
    evaluation: Evaluation
    information: SquareRootInformation
    step: gtsam.VectorValues | None
    ratios: dict[str, Array]


def _weighed(problem: Problem, minimum: Minimum) -> _Weighed:
    """Return a problem at its minimum: by what residuals scatter, if that is far from its weights.

    Where one sensor does not fit, what its residuals have of the misfit would count as much as
    what the others know.
    """
    evaluation = minimum.evaluation
    ratios = _ratios(problem, evaluation)
    if not any(np.any(np.abs(ratio - 1.0) > SAME_WEIGHT) for ratio in ratios.values()):
        return _Weighed(problem, evaluation, minimum.information, None, ratios)
    same, at = with_scattered_noise(problem, evaluation, problem.all_parameters)
    return _Weighed(same, at, *factorized(same, at), {})


def _tests(
    problem: Problem,
    minimum: Minimum,
    weighed: _Weighed,
    shapes: Shapes,
) -> dict[str, tuple[Parameter, Score]]:
    """Return tests of what is taken as known, within a prior or for certain, by name.

    Sawtooths and spans of water are those that a search found, among as many as there were.
    """
    evaluation, information = minimum.evaluation, minimum.information
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
    of_priors = [p for p, _ in out.values()]
    if not known and not of_priors:
        return {}
    at, ratios = weighed.evaluation, weighed.ratios
    found_shapes = [shape.parameter for shape in shapes.values()]
    free = freed(weighed.problem, at, weighed.information, known, weighed.step, found_shapes)
    out |= {p.name: (p, searched(free.scores.test([p.name]), p.name, shapes)) for p in known}
    # Scores scatter by no less than this.
    least = min([1.0, *(float(np.min(ratio)) ** 2 for ratio in ratios.values())])
    if all(test.divided(least).log10_p >= _limit(p) for p, test in out.values()):
        return out
    others = {p.name: (problem.key(p.name), wide(p, p.mean).sigma) for p in of_priors}
    found, scatter = free.scattered(problem.chain.node_time, ratios, others)
    out |= {p.name: (p, searched(found.test([p.name]), p.name, shapes)) for p in known}
    return {name: (p, test.divided(scatter[name])) for name, (p, test) in out.items()}


def _shown_by_records(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
    shapes: Shapes,
) -> list[Parameter]:
    """Return the parameters of one record each that its rows ask for.

    With noise as residuals differ from one to the next. What looks like one of them by far is
    then tested with all others.
    """
    out: list[Parameter] = []
    if problem.chain.interpolates:
        return out
    ratios = _ratios(problem, evaluation)
    there = _with_shapes(evaluation, [shape.parameter for shape in shapes.values()])
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
        variance = float(np.mean(np.square(ratios.get(label, 1.0))))
        for p in own:
            test = searched(found.test([p.name]).divided(variance), p.name, shapes)
            if test.log10_p < _limit(p):
                out.append(p)
    return out


def _is_plausible(p: Parameter, test: Score) -> bool:
    """Whether a parameter can be as far from what it was taken to be."""
    most = _FAR * wide(p, p.mean).sigma
    if p.name == FLEX_BY_TILT:
        # Of a DVL that takes its tilt out of its velocities.
        most = np.maximum(most, 1.0 + _WHOLE)
    return bool(np.all(np.abs(test.step) < most))


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
                axes=_axes(e),
                others=_leap_seconds(e.parameter, evaluation)
                or _levelled(e.parameter, evaluation)
                or _shape(e)
                or _or(e),
                stated_by=_key(e.parameter),
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


def _axes(found: Explanation) -> Message | str:
    """Return which components the values of a parameter are, in brackets."""
    spec = found.parameter.spec
    # The words of a shape say so.
    if spec.size == 1 or spec.labels == XYZ or found.shape is not None:
        return ""
    return message("words.in_brackets", words=list(spec.labels))


def _key(p: Parameter) -> Message | str:
    """Return which key of trial.yaml has the standard deviation of a parameter."""
    section, _, key = p.spec.key.partition(": ")
    return message("estimated_instead.key", section=section, std=key) if key else ""


def _leap_seconds(p: Parameter, evaluation: Evaluation) -> Message | None:
    """Return that a clock is off by the leap seconds, None if it is not."""
    if not p.spec.stem.endswith("time_offset"):
        return None
    off = abs(float(evaluation.parameters[p.name][0]))
    return message("leap_seconds.estimated") if abs(off - LEAP_SECONDS) < 1.0 else None


def _levelled(p: Parameter, evaluation: Evaluation) -> Message | None:
    """Return that a DVL takes its tilt out of its velocities, None if it does not."""
    if p.name != FLEX_BY_TILT:
        return None
    turns = evaluation.parameters[p.name].reshape(3, 2)
    # All of it, about x by the tilt along y, and about y by that along x.
    across = turns[0, 1], turns[1, 0]
    whole = all(abs(abs(turn) - 1.0) < _WHOLE for turn in across) and across[0] * across[1] < 0.0
    return message("estimated_instead.levelled") if whole else None


def _shape(found: Explanation) -> Message | None:
    """Return what a parameter is that has a shape, None if it has none."""
    if found.shape is None:
        return None
    p = found.shape.parameter
    values = dict(zip(p.spec.labels, p.mean, strict=True))
    key = "estimated_instead.sawtooth" if "period" in values else "estimated_instead.in_water"
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


def freed(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
    known: Sequence[Parameter],
    step: gtsam.VectorValues | None = None,
    shapes: Sequence[Parameter] = (),
) -> ParameterScores:
    """Return the scores of parameters that a problem takes as known, as it is weighed.

    Parameters
    ----------
    problem, evaluation, information : Problem or Evaluation or SquareRootInformation
        Problem, where it is, and the information there.
    known : sequence of Parameter
        The parameters.
    step : gtsam.VectorValues, optional
        Step to the minimum, if it is not there.
    shapes : sequence of Parameter, optional
        Shapes of some of them, as a search found them.
    """
    names = {p.name for p in known}
    found = {shape.name: shape for shape in shapes}
    fixed = [found.get(p.name, p) for p in problem.all_parameters if not p.estimated]
    evaluation = _with_shapes(evaluation, shapes)
    # Those that are estimated come first, and keep their keys.
    every = [*problem.parameters, *(wide(p, p.mean) if p.name in names else p for p in fixed)]
    columns = {
        p.name: (calibration_key(i, p.mean.size), p.sigma)
        for i, p in enumerate(p for p in every if p.estimated)
        if p.name in names
    }
    candidates = {key for key, _ in columns.values()}
    shared = {*problem.chain.constants, *(problem.key(p.name) for p in problem.parameters)}

    def parts() -> Iterator[tuple[Problem, Iterator[Rows]]]:
        for number, block in enumerate(_blocks(problem)):
            part, at = with_parameters(problem, evaluation, every, block)
            # Priors of the candidates are none of the data; those of what all parts share count
            # once.
            left_out = candidates | shared if number else candidates
            yield (
                part,
                (
                    rows
                    for rows in rows_by_source(part, at)
                    if not left_out.issuperset(rows.keys[0].tolist())
                ),
            )

    out = parameter_scores(parts, columns, information, step)
    if not problem.chain.interpolates:
        return out
    test, at = with_parameters(problem, evaluation, every)
    slopes = _slopes(test, at, information.given(constants_of(problem)), columns)
    return replace(out, scores=out.scores.with_slopes(slopes))


def _slopes(
    problem: Problem,
    evaluation: Evaluation,
    given: SquareRootInformation,
    columns: Mapping[str, tuple[int, Array]],
) -> dict[str, Array]:
    """Return half the gradient of log det of the states' information by parameters, by name.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Problem in which they are free, and where it is.
    given : SquareRootInformation
        Information on the states given the constants.
    columns : mapping of str to tuple of (int, ndarray)
        The parameters: that of `ParameterScores`.
    """
    with_states = with_states_at(problem, evaluation, given)
    wide = {name: sigma for name, (_, sigma) in columns.items()}
    found = gradient_by_name(problem, evaluation, with_states, wide)
    return {name: 0.5 * slope for name, slope in found.items()}


def _with_shapes(evaluation: Evaluation, shapes: Sequence[Parameter]) -> Evaluation:
    """Return an evaluation with the shapes that a search found; what has them is zero there."""
    return replace(evaluation, parameters=evaluation.parameters | {p.name: p.mean for p in shapes})


def _blocks(problem: Problem) -> list[slice | None]:
    """Return segments whose rows are there at a time, None for all of them."""
    count = problem.chain.count
    parts = 1 if problem.processes else -(-count // _LONGEST)
    if parts == 1:
        return [None]
    edges = np.linspace(0, count, parts + 1).astype(int)
    return [slice(a, b) for a, b in pairwise(edges.tolist())]


def _ratios(problem: Problem, evaluation: Evaluation) -> dict[str, Array]:
    """Return by what residuals differ from one to the next, over what they are weighed by."""
    scattered = _as_scattered(problem, evaluation)
    return {label: noise / problem.noise_factors[label] for label, noise in scattered.items()}


def with_scattered_noise(
    problem: Problem, evaluation: Evaluation, parameters: Sequence[Parameter]
) -> tuple[Problem, Evaluation]:
    """Return a problem with other parameters where it is, and noise as residuals scatter."""
    test, at = with_parameters(problem, evaluation, parameters)
    test.noise_factors = _as_scattered(problem, evaluation)
    return test, test.weighed(at)


def with_parameters(
    problem: Problem,
    evaluation: Evaluation,
    parameters: Sequence[Parameter],
    block: slice | None = None,
) -> tuple[Problem, Evaluation]:
    """Return a problem with other parameters where it is, and as it is weighed.

    Of some segments only where a block of them is given.
    """
    values = evaluation.parameters
    chain, observations, robust = problem.chain, problem.observations, problem.robust_weights
    weights = dict(zip((o.label for o in observations), problem.weights, strict=True))
    if block is not None:
        own = [
            np.flatnonzero((at.segment >= block.start) & (at.segment < block.stop))
            for at in evaluation.attached
        ]
        rows = {o.label: index for o, index in zip(observations, own, strict=True)}
        chain = chain.part(block)
        observations = tuple(
            some_of(o, index) if o.time.size > _FEW else ObservationRows(o, index)
            for o, index in zip(observations, own, strict=True)
            if index.size
        )
        robust = {label: weight[rows[label]] for label, weight in robust.items()}
        weights = {label: weight[rows[label]] for label, weight in weights.items()}
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
    test.noise_factors = problem.noise_factors
    test.noise_growth = problem.noise_growth
    test.robust_weights = robust
    test.long_run = problem.long_run
    if block is None:
        test.attach_as(problem, evaluation)
    for bound in test.bound:
        bound.weight = weights[bound.observation.label]
    return test, test.evaluate(test.values(evaluation.states, test.prior_values() | values))


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
