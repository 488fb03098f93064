"""Findings of parameters that are not the same all along a trial."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.bound_observation import BoundObservation
from factorgraph_dvl.graph.clocks import parameters_of
from factorgraph_dvl.graph.problem import Evaluation, Problem, Rows
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import is_far_from_prior
from factorgraph_dvl.sensors.imu import BIASES, ERRORS
from factorgraph_dvl.sensors.parameters import UNITS, Parameter
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.solvers.calibration import reported
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.record_scores import in_all, record_sums_in_turn, scores_of
from factorgraph_dvl.statistics.constancy import Change, changes
from factorgraph_dvl.statistics.rows import rows_by_source, rows_with_times
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Standard deviations from which on a change is one. Chosen: the probability by chance is below
# 1e-4 although each of hundreds of times may be the one.
CHANGED = 5.0
# Cost up to which a change is as probable as the most probable one. Chosen: a likelihood of e^-4.
_TIE = 4.0
# Name of a change of a parameter, beside the parameter itself.
_CHANGE = "change"
# Name of what a minimum keeps.
_CHANGES = "changes along the trial"


@dataclass(frozen=True)
class ComponentChange:
    """The most probable change of a component of a parameter.

    Parameters
    ----------
    name : str
        Name of the component.
    parameter : Parameter
        Parameter of the component.
    change : Change
        Its test, in reported units; its shifts are those of the components that are tested.
    """

    name: str
    parameter: Parameter
    change: Change


def component_changes(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
    every: Iterable[Rows] | None = None,
) -> list[ComponentChange]:
    """Return the most probable change of each component.

    Errors of the IMU are left out, and what a search finds for part of a trial.

    Parameters
    ----------
    problem : Problem
        What was minimised.
    evaluation : Evaluation
        Its minimum.
    information : SquareRootInformation
        Information there.
    every : iterable of Rows, optional
        All rows of the graph that is linearised there, if something else needs them, too.
    """
    chain, own = problem.chain, problem.chain.constants
    # Biases that walk, and what processes vary, change anyway.
    varying = {process.parameter for process in problem.processes}
    varying |= {walk.parameter for p in problem.processes if (walk := p.free_walk) is not None}
    constant = {
        *(name for name in problem.columns if name not in varying),
        *(
            p.name
            for p, _, by in chain.mean_constants(evaluation.states)
            if by.keys() <= own.keys()
        ),
    }
    rows = [
        (p, derivatives)
        for p, _, derivatives in reported(problem, evaluation)
        if derivatives is not None and p.name in constant and np.all(p.sigma > 0.0)
    ]
    if not rows:
        return []
    functionals = [derivatives for _, derivatives in rows]
    of_component = [(name, p) for p, _ in rows for name in p.component_names]
    time, tilt = chain.node_time, problem.tilt
    tests = changes(
        rows_with_times(problem, rows_by_source(problem, evaluation) if every is None else every),
        information.covariance_with(functionals),
        information.covariance_of(functionals),
        (float(time[0]), float(time[-1])),
        {problem.key(n): tilt.gradient[own] for n, own in problem.columns.items()} if tilt else {},
    )
    allowed = np.concatenate([p.sigma / p.si for p, _ in rows])
    kept = [not (p.name in ERRORS or p.spec.searched) for _, p in of_component]
    return [
        ComponentChange(name, p, replace(test.within(float(sigma)), shift=test.shift[kept]))
        for (name, p), test, sigma, is_kept in zip(of_component, tests, allowed, kept, strict=True)
        if is_kept
    ]


def changes_at(
    problem: Problem, minimum: Minimum, every: Iterable[Rows] | None = None
) -> list[ComponentChange]:
    """Return `component_changes` at a minimum, worked out once."""
    if _CHANGES not in minimum.kept:
        found = component_changes(problem, minimum.evaluation, minimum.information, every)
        minimum.kept[_CHANGES] = found
    return list(minimum.kept[_CHANGES])


def certain(changes: Iterable[ComponentChange]) -> list[ComponentChange]:
    """Return the changes that are no chance."""
    return [each for each in changes if each.change.chi2 > CHANGED**2]


def largest(changes: Iterable[ComponentChange]) -> ComponentChange | None:
    """Return the change that explains most, None where there is none."""
    return max(changes, key=lambda each: each.change.fall, default=None)


def fall_of_change(problem: Problem, minimum: Minimum, names: Container[str]) -> float:
    """Return what the objective falls by, about, if one of some parameters changed once.

    Zero where another one explains more by a change, or none does. Arguments are a problem, its
    minimum, and the names of the parameters.
    """
    best = largest(certain(changes_at(problem, minimum)))
    if best is None or best.parameter.name not in names:
        return 0.0
    return fall_where_free(problem, minimum.evaluation, minimum.information, best)


def fall_where_free(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
    changed: ComponentChange,
    step: gtsam.VectorValues | None = None,
) -> float:
    """Return what the objective falls by, about, if a component changed when it did.

    Where it is one of measurements, all else follows the change, states before and after it
    apart: what follows a parameter of the whole trial, as a heading, may follow no change. Where
    the objective has a gradient that no row has, the test of the change stands.

    Parameters
    ----------
    problem, evaluation, information : Problem, Evaluation or SquareRootInformation
        What was minimised, where it is, and the information there.
    changed : ComponentChange
        The component, and when.
    step : gtsam.VectorValues, optional
        Step to the minimum, if it is not there.
    """
    p = changed.parameter
    own = p.component_names.index(changed.name)
    records = [bound for bound in problem.bound if p.name in parameters_of(bound.observation)]
    if not records or problem.tilt is not None:
        return changed.change.fall
    unknown = {_CHANGE: p.sigma[own : own + 1]}

    def after(_: IntArray, part: BoundObservation, motion: Motion) -> dict[str, Array]:
        lin = part.linearized(motion, evaluation.parameters, [p.name], problem.processes_of(part))
        late = part.observation.time > changed.change.time
        return {_CHANGE: lin.d_parameters[p.name][:, :, own : own + 1] * late[:, None, None]}

    whole = in_all(
        [record_sums_in_turn(problem, each, evaluation, unknown, after) for each in records]
    )
    test = scores_of(whole, information, unknown, step).test([_CHANGE])
    return max(changed.change.fall, test.chi2)


def fall_without_errors(
    problem: Problem, minimum: Minimum, robust_weights: Mapping[str, Array]
) -> float:
    """Return `fall_of_change` where gross errors are most of what is before or after the change.

    Zero elsewhere. Arguments are a problem with all measurements, its minimum, and the weights of
    measurements by label, 0 of gross errors.
    """
    best = largest(certain(changes_at(problem, minimum)))
    if best is None:
        return 0.0
    names = {
        name
        for bound in problem.bound
        if bound.observation.label in robust_weights
        and _most_of_a_side(bound, robust_weights[bound.observation.label], best.change.time)
        for name in parameters_of(bound.observation)
    }
    return fall_of_change(problem, minimum, names)


def _most_of_a_side(bound: BoundObservation, weights: Array, change: float) -> bool:
    """Whether most measurements before a change, or after it, are gross errors."""
    time, used = bound.observation.time, bound.usable
    wrong, late = (weights == 0.0).reshape(time.size, -1).any(axis=1), time > change
    sides = (late & used, ~late & used)
    return any(2 * np.count_nonzero(wrong[own]) > np.count_nonzero(own) for own in sides)


def _most_probable(
    tests: Sequence[ComponentChange], estimates: Iterable[Estimate]
) -> tuple[ComponentChange, list[ComponentChange]] | None:
    """Return the change that is named, and those about as probable; None if there is none."""
    std = {n: s for e in estimates for n, s in zip(e.component_names, e.std, strict=True)}
    significant = [
        t
        for t in tests
        if t.change.chi2 >= CHANGED**2
        and (t.parameter.name in BIASES or std[t.name] < abs(t.change.size))
    ]
    if not significant:
        return None
    most = max(t.change.fall for t in significant)
    ties = [t for t in significant if most - t.change.fall < 2.0 * _TIE]
    # Of what is about as probable, what the trial is for.
    best = min(ties, key=lambda t: (t.parameter.spec.nuisance, -t.change.fall))
    return best, [t for t in ties if t is not best]


def without_explained(
    findings: Iterable[Finding], found: SolvedProblem, estimates: Sequence[Estimate]
) -> list[Finding]:
    """Return findings less those of parameters that would not be far from their priors.

    That is where what changes along the trial is free to: it moves the others as far.

    Parameters
    ----------
    findings : iterable of Finding
        All that there are.
    found : SolvedProblem
        Problem at its minimum, with covariances.
    estimates : sequence of Estimate
        What is reported of each parameter.
    """
    tests = changes_at(found.problem, found.minimum)
    change = _most_probable(tests, estimates)
    if change is None:
        return list(findings)
    shift = {t.name: by for t, by in zip(tests, change[0].change.shift, strict=True)}
    explained = {
        e.name
        for e in estimates
        if e.name != change[0].parameter.name
        and not is_far_from_prior(e, e.value + [shift.get(n, 0.0) for n in e.component_names])
    }
    return [
        f for f in findings if not (f.code == Code.FAR_FROM_PRIOR and f.parameter in explained)
    ]


def change_findings(
    found: SolvedProblem,
    every: Iterable[Rows],
    estimates: Iterable[Estimate],
    limits: Mapping[str, float],
) -> Iterator[Finding]:
    """Yield a finding where a parameter changes along the trial by more than chance allows.

    Of several components the most probable one is named, and those that are about as probable.
    A change below what is good enough is a drift that the standard deviation lacks, and no reason
    not to use the mean. Nor is a change of something else that moves what is calibrated by less.
    A clock that is known to 0.5 s may be linearised 0.5 s off, and seem to change by that. So what
    changes by less than its standard deviation is left out. Measurements depend on biases of the
    IMU in the same way everywhere.

    Parameters
    ----------
    found : SolvedProblem
        Problem at its minimum, with covariances.
    every : iterable of Rows
        All rows of the graph that is linearised there.
    estimates : iterable of Estimate
        What is reported of each parameter.
    limits : mapping of str to float
        Standard deviations that are good enough, by parameter, in reported units.
    """
    tests = changes_at(found.problem, found.minimum, every)
    most_probable = _most_probable(tests, estimates)
    if most_probable is None:
        return
    best, ties = most_probable
    change = best.change
    unit = UNITS[best.parameter.spec.unit].text
    others: Message | str = ""
    if ties:
        others = message("changed_along_trial.others", names=[t.name for t in ties])
    # What changes is either calibrated, or moves what is.
    moves = [(best, change.size)]
    # A clock or an antenna that jumps is a fault of the record, whatever it moves.
    if best.parameter.name in BIASES:
        shifts = zip(tests, change.shift, strict=True)
        moves = [(t, by) for t, by in shifts if t.parameter.name in limits]
    small = bool(moves) and all(abs(by) < limits.get(t.parameter.name, 0.0) for t, by in moves)
    said = "changed_along_trial.changes"
    if small and best.parameter.name in limits:
        said = "changed_along_trial.drifts"
    elif small:
        said = "changed_along_trial.harmless"
    yield Finding(
        Code.CHANGED_ALONG_TRIAL,
        message(
            said,
            name=best.name,
            size=change.size,
            # With the scatter of the scores, as the significance has it.
            std=abs(change.size) / change.significance,
            unit=f" {unit}" if unit else "",
            time=change.time,
            others=others,
            significance=change.significance,
        ),
        parameter=best.parameter.name,
        severity="warning" if small else "error",
    )
