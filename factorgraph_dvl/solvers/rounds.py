"""Rounds of minimisation until gravity, weights, times, outliers and noise no longer change.

All of these are taken at the states before a round and are constant within it, so that the cost
has a minimum. The noise of the sensors comes last: it follows from residuals of what else has
settled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, BoolArray
from factorgraph_dvl.graph.bound_observation import EXTRAPOLATED
from factorgraph_dvl.graph.priors import ConstantsPrior
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.message import Message, message
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import DO_NOT_FIT
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.bias_walks import BiasWalks, bias_walks
from factorgraph_dvl.solvers.change_along_trial import CHANGED, component_changes
from factorgraph_dvl.solvers.correlated_noise import (
    correlated_noise,
    long_run_share,
    noise_of,
    with_innovations,
)
from factorgraph_dvl.solvers.known_parameters import (
    Explanation,
    confirmed,
    explanation,
    explanation_findings,
)
from factorgraph_dvl.solvers.levenberg_marquardt import CONVERGED, Minimum, factorized, minimise
from factorgraph_dvl.solvers.motion_strengths import Strengths
from factorgraph_dvl.solvers.outliers import robust_weights
from factorgraph_dvl.solvers.preparation import Preparation, Prepared
from factorgraph_dvl.solvers.process_fit import refitted
from factorgraph_dvl.statistics.variance_components import (
    VarianceComponents,
    variance_components,
)

# Root mean square change of the positions, m, from which on gravity is taken anew. Chosen: 1 m
# turns it by 0.16 micro-g.
_SAME_GRAVITY = 2.0
# Rounds after which the problem counts as not settled. Measured: most trials take one or two; with
# correlated noise, and clocks under sway, up to 14.
_ROUNDS = 24
# Iterations in a row without a minimum, after which there is none. Measured: with gross errors 60,
# and the next converges.
_FRUITLESS = 150
# Rounds after which noise counts as not settled. Measured: a factor of five takes two.
_NOISE_ROUNDS = 4
# Estimates of the strength of a motion's prior, and promised fall of the cost that ends a
# minimisation before the next one. Measured: four to eight are enough.
_MOTION_ROUNDS = 20
_ROUGHLY = 1e-2
# What of a problem changes without a new one.
_NOISE = message("not_converged.noise")
_OUTLIERS = message("not_converged.outliers")
_TIMES = message("not_converged.times")
_CORRELATED = message("not_converged.correlated")
_KNOWN = message("not_converged.known")
_WALKS = message("not_converged.walks")
_MOTION = message("not_converged.acceleration")
_MINIMUM = message("not_converged.minimum")
# Parameters that are estimated although they were stated as known. Chosen: a third is a sign that
# the model is wrong.
_MOST_FREED = 2
# Relative change of the noise over a long time, by that of innovations, from which on it counts.
# Chosen: less changes no σ that is shown.
_SAME_INNOVATIONS = 0.05
# Bindings in a row after which clocks need not settle closer than the motion is extrapolated, or
# than a share of their standard deviation. Chosen: most trials take one or two.
_IN_A_ROW = 4
# That share. Chosen: a tenth of the variance. Noise of the IMU's samples may give the cost a bend
# within it, from where two bindings lead to each other.
_SETTLED_SHARE = 0.3
# Share of the last movement of the clocks from which on the next binding is half-way. Chosen: half
# is what is left of a movement after one that went half the way.
_NOT_SETTLING = 0.75
# Variance of the scores, beside that of white noise, that a change may leave to explain what looks
# like correlated noise. Measured: 8 where a mount slipped, 600 where samples were misstated.
_MOST_SCATTER = 20.0
# Searches for outliers. Chosen: the second finds those that the first could not see.
_SEARCHES = 2


@dataclass(frozen=True)
class SettledMinimum:
    """A minimum at which the problem itself no longer changes, if `minimum.converged`.

    Parameters
    ----------
    problem : Problem
        What the last round minimised.
    minimum : Minimum
        Where it ended, with the iterations of all rounds.
    settled : bool
        Whether the problem no longer changes, whatever the minimum.
    findings : tuple of Finding
        What the user must know.
    """

    problem: Problem
    minimum: Minimum
    settled: bool
    findings: tuple[Finding, ...]


def settle(
    prepared: Prepared,
    states: Any,
    report: Progress,
    *,
    constants_prior: ConstantsPrior | None = None,
    values: dict[str, Array] | None = None,
    clock_zero: float | None = None,
) -> SettledMinimum:
    """Return the minimum that some states lead to.

    Parameters
    ----------
    prepared : Prepared
        Chain, measurements and parameters.
    states : object
        Where to start.
    report : callable
        Called with stage, iteration and cost.
    constants_prior : ConstantsPrior, optional
        Joint prior of biases and calibration; it takes the place of the trial's priors, and
        its values are those to start from.
    values : dict of str to ndarray, optional
        Parameters to start from; by default mountings that fit the motion.
    clock_zero : float, optional
        When the offsets of clocks hold, s; by default in the middle of the trial.
    """
    chain = prepared.chain(states)
    p_gravity = states.p_n
    if constants_prior is not None:
        values = constants_prior.parameters
    iterations = 0
    robust: dict[str, Array] = {}
    usable: Mapping[str, BoolArray] | None = None
    if values is None:
        start = prepared.start(chain, states, report)
        states, values, iterations = start.states, start.values, start.iterations
        robust = start.robust_weights
    parameters: tuple[Parameter, ...] = prepared.parameters
    tilt = prepared.first_tilt(values) if constants_prior is None else None
    rejected = prepared.rejected
    tried: list[Mapping[str, Array]] = []
    cycle: list[Mapping[str, Array]] = []
    as_stated = {
        o.label: np.ones(len(o.components))
        for o in prepared.observations
        if o.label in prepared.estimated_noise and o.noise_groups
    }
    searches = 0
    correlation_searched = False
    walks: BiasWalks | None = None
    freed: list[Explanation] = []
    left: Explanation | None = None
    tested: tuple[Parameter, ...] | None = None
    long_run: Mapping[str, Array] = {}
    motion = 0
    last_strengths: Strengths | None = None
    stated = prepared.stated_processes(chain, states, values)
    first_levels = _NoiseLevels(
        ({**as_stated, **prepared.noise_factors},), bool(as_stated), processes=stated
    )
    levels = first_levels
    changing = [message("not_converged.all")]
    tolerance: Mapping[str, float] = {}
    count = in_a_row = fruitless = 0
    movement = np.inf
    bound = values
    while count < _ROUNDS and fruitless < _FRUITLESS:
        only_times = changing == [_TIMES]
        before = movement
        movement = _clock_movement(prepared, bound, values) if only_times else np.inf
        if changing not in ([_NOISE], [_OUTLIERS]):
            # Where sway repeats itself, two bindings may lead to each other for ever.
            settling = not only_times or movement < _NOT_SETTLING * before
            bound = values if settling else values | _halfway(prepared, bound, values)
            problem = Problem(
                chain,
                prepared.observations,
                parameters,
                start=bound,
                constants_prior=constants_prior,
                clock_zero=clock_zero,
                processes=levels.processes,
                usable=usable,
                tilt=tilt,
            )
            problem.reject(rejected)
        problem.processes = levels.processes
        problem.noise_factors = levels.factors[-1]
        problem.long_run = long_run
        problem.robust_weights = robust
        in_a_row = in_a_row + 1 if only_times else 0
        problem.clock_tolerance = tolerance
        # At the ends of the record two bindings may use one measurement in turn.
        usable = problem.usable if tolerance else None
        at = problem.values(states, problem.prior_values() | values)
        roughly = chain.interpolates and motion < _MOTION_ROUNDS
        minimum = minimise(
            problem,
            at,
            stage="all sensors",
            progress=report,
            binding=True,
            proven=not roughly,
            tolerance=_ROUGHLY if roughly else CONVERGED,
        )
        iterations += minimum.iterations
        fruitless = 0 if minimum.converged else fruitless + minimum.iterations
        states, values = minimum.evaluation.states, minimum.evaluation.parameters
        changing = _changing(problem, minimum.evaluation)
        if changing == [_TIMES] and in_a_row >= _IN_A_ROW and not tolerance:
            tolerance = _clock_tolerance(prepared, problem, minimum.evaluation)
        strengths = None
        if motion < _MOTION_ROUNDS:
            strengths = last_strengths = prepared.strengths(problem, minimum, last_strengths)
        if strengths is not None:
            motion += 1
            levels = replace(
                levels, factors=(*levels.factors, strengths.factors), processes=strengths.processes
            )
            chain, tilt = strengths.chain, strengths.tilt
            states, values = strengths.states, strengths.values
            # The last minimum was a rough one, good enough for strengths.
            changing.append(_MINIMUM if strengths.same else _MOTION)
            if strengths.same:
                motion = _MOTION_ROUNDS
            continue
        count += 1
        moved = np.sqrt(np.mean((states.p_n - p_gravity) ** 2))
        if not chain.interpolates and moved > _SAME_GRAVITY:
            changing.insert(0, message("not_converged.gravity"))
            chain = prepared.chain(states)
            p_gravity = states.p_n
        if chain.interpolates:
            # Its steps are so stiff that the last one, however small, turns their rows by more
            # than their noise: information and rows must be those of the same values.
            information = factorized(problem, minimum.evaluation)[0]
            minimum = replace(minimum, square_root=information)
        if not cycle:
            if not (tried and _same(tried[-1], rejected)):
                tried.append(rejected)
            outliers: Mapping[str, Array] = problem.outliers(minimum.evaluation)
            cycle = _cycle(tried, outliers)
        if cycle:
            outliers = min(cycle, key=_count)
        if not _same(outliers, rejected):
            changing.append(message("not_converged.echoes"))
        if not changing and searches < _SEARCHES:
            if robust and searches == 0:
                # Gross errors of the start are searched anew, among all.
                problem.robust_weights = robust = {}
                problem.weigh(minimum.evaluation)
            searches += 1
            outliers_found = robust_weights(problem, minimum.evaluation)
            if outliers_found is not None:
                changing.append(_OUTLIERS)
                # What they made of the noise is to be found anew.
                motion, last_strengths = 0, None
                robust, evaluation = outliers_found
                states, values = evaluation.states, evaluation.parameters
        if not changing and not correlation_searched and minimum.converged:
            correlation_searched = True
            found = correlated_noise(problem, minimum.evaluation, as_stated)
            if found.gain > 0.0 and _changes_explain_more(problem, minimum, found.gain):
                # Noise that persists would take the place of what changed.
                found = correlated_noise(problem, minimum.evaluation, ())
            if found.long_run or {p.label for p in found.processes} - {
                p.label for p in levels.processes
            }:
                changing.append(_CORRELATED)
                tolerance = {}
                long_run = found.long_run
                white = levels.factors[-1] | found.factors
                processes = _with_others(levels.processes, found.processes)
                levels = replace(levels, factors=(*levels.factors, white), processes=processes)
                motion, last_strengths = 0, None
                if any(process.label in robust for process in found.processes):
                    # What wanders for long is no outlier.
                    robust, searches = {}, 0
        if not changing and minimum.converged and parameters is not tested:
            tested = parameters
            # The test has a problem of its own, and more columns.
            problem.release()
            left = explanation(problem, minimum, prepared.trial.imu)
            if left is not None and len(freed) < _MOST_FREED:
                freed.append(left)
                parameters = tuple(
                    left.freed if p.name == left.parameter.name else p for p in parameters
                )
                # With another model, all that its misfit made is to be found anew.
                changing.append(_KNOWN)
                robust, long_run, levels, tolerance = {}, {}, first_levels, {}
                if tilt is not None:
                    free = tuple(p for p in parameters if p.estimated)
                    tilt = tilt.of(problem.parameters, free)
                motion, last_strengths = 0, None
                searches, correlation_searched, count = 0, False, 0
        if not changing and levels.estimated and minimum.converged and not chain.interpolates:
            last = levels
            levels = _next_noise(levels, problem, minimum)
            same = levels.processes == last.processes
            if len(levels.processes) != len(last.processes):
                changing.append(_CORRELATED)
            elif not (same and _same(levels.factors[-1], last.factors[-1])):
                changing.append(_NOISE)
        if (
            not changing
            and isinstance(prepared, Preparation)
            and walks is None
            and left is None
            and not freed
            and _misfit(problem)
        ):
            walks = bias_walks(prepared, problem, minimum, as_stated, report)
            if walks is not None:
                prepared = walks.prepared
                states, values = walks.evaluation.states, walks.evaluation.parameters
                chain, p_gravity = prepared.chain(states), states.p_n
                changing.append(_WALKS)
                robust, long_run, levels, tolerance = {}, {}, first_levels, {}
                searches, correlation_searched, count = 0, False, 0
                tested = None
        if not changing:
            break
        rejected = outliers
    freed = [e for e in freed if not changing and confirmed(problem, minimum, e)]
    findings = (
        *_at_the_gate(cycle),
        *levels.findings,
        *(walks.findings if walks is not None else ()),
        *explanation_findings(freed, left, minimum.evaluation),
    )
    if changing:
        text = message("not_converged.rounds", rounds=count, changing=changing)
        findings += (Finding(Code.NOT_CONVERGED, text, severity="error"),)
    if minimum.square_root is None:
        minimum = replace(minimum, square_root=factorized(problem, minimum.evaluation)[0])
    problem.release()
    converged = minimum.converged and not changing
    minimum = replace(minimum, converged=converged, iterations=iterations)
    return SettledMinimum(problem, minimum, not changing, findings)


def _with_others(before: Sequence[Process], found: Sequence[Process]) -> tuple[Process, ...]:
    """Return processes as they were, with others that were found."""
    known = {p.label for p in before}
    free = (i for i in range(len(before) + len(found)) if i not in {p.index for p in before})
    others = (p for p in found if p.label not in known)
    return (*before, *(replace(p, index=i) for p, i in zip(others, free, strict=False)))


def _changes_explain_more(problem: Problem, minimum: Minimum, gain: float) -> bool:
    """Whether a parameter that changed along the trial explains more than correlated noise."""
    information = minimum.square_root or factorized(problem, minimum.evaluation)[0]
    tests = component_changes(problem, minimum.evaluation, information)
    found = [t.change for t in tests if t.change.chi2 > CHANGED**2]
    if not found:
        return False
    most = max(found, key=lambda c: c.fall)
    return max(c.chi2 for c in found) > gain or gain < most.fall < _MOST_SCATTER * most.chi2


def _misfit(problem: Problem) -> bool:
    """Whether the noise of a sensor is far more than anyone would state."""
    return any(np.max(noise.factor) > DO_NOT_FIT for noise in noise_of(problem))


@dataclass(frozen=True)
class _NoiseLevels:
    """Factors on stated noise that were applied, and whether to estimate more of them.

    `processes` is the correlated noise to assume next, `rounds` counts estimates.
    """

    factors: tuple[dict[str, Array], ...]
    estimated: bool
    findings: tuple[Finding, ...] = ()
    processes: tuple[Process, ...] = ()
    rounds: int = 0


def _next_noise(levels: _NoiseLevels, problem: Problem, minimum: Minimum) -> _NoiseLevels:
    """Return the factors that residuals ask for; noise that never settles is as stated.

    It grows for ever where it takes the place of errors of the IMU: the less a sensor counts, the
    more the motion is the IMU's, and the larger are the residuals.
    """
    found = variance_components(problem, minimum.evaluation, minimum.information)
    last = levels.factors[-1]
    latest = last | {label: f.after(last[label]) for label, f in found.white.items()}
    processes = tuple(
        with_innovations(p, found.correlated[p.label].factor)
        if p.density_only and p.label in found.correlated and _counts(problem, found, p)
        else p
        for p in refitted(problem, minimum.evaluation)
    )
    rounds = levels.rounds + 1
    if rounds <= _NOISE_ROUNDS:
        return replace(
            levels,
            factors=(*levels.factors, latest),
            processes=processes,
            rounds=rounds,
        )
    if _same(latest, last):
        return replace(levels, rounds=rounds)
    unsettled = [name for name in latest if not np.array_equal(latest[name], last[name])]
    findings = tuple(
        Finding(
            Code.NOISE_NOT_SETTLED,
            message("noise_not_settled.growing", ratio=np.max(latest[label])),
            sensor=label,
        )
        for label in unsettled
    )
    first = {name: f for name, f in levels.factors[1].items() if name not in unsettled}
    return replace(
        levels,
        factors=(*levels.factors, first),
        estimated=False,
        findings=findings,
        processes=tuple(p for p in levels.processes if p.label not in unsettled),
    )


def _counts(problem: Problem, found: VarianceComponents, process: Process) -> bool:
    """Whether other innovations change the noise over a long time."""
    change = np.log(found.correlated[process.label].factor)
    return bool(np.abs(long_run_share(problem, process) * change).max() > _SAME_INNOVATIONS)


def _changing(problem: Problem, evaluation: Evaluation) -> list[Message]:
    """Return what of the measurements would differ in a problem that starts here."""
    found = {
        _TIMES: problem.needs_rebinding(evaluation.parameters),
        message("not_converged.weights"): problem.needs_reweighting(evaluation),
    }
    return [name for name, changed in found.items() if changed]


def _clock_tolerance(
    prepared: Prepared, problem: Problem, evaluation: Evaluation
) -> dict[str, float]:
    """Return how closely clocks are to settle, s, by the names of their offsets."""
    names = {o.clock.names[0] for o in prepared.observations if o.clock is not None}
    keys = {p.name: problem.key(p.name) for p in problem.parameters if p.name in names}
    marginals = factorized(problem, evaluation)[0].marginals(list(keys.values()))
    return {
        name: max(EXTRAPOLATED, _SETTLED_SHARE * float(np.sqrt(marginals[key][0, 0])))
        for name, key in keys.items()
    }


def _halfway(
    prepared: Prepared, before: Mapping[str, Array], after: Mapping[str, Array]
) -> dict[str, Array]:
    """Return offsets and rates of clocks half-way between two sets of values."""
    names = _clock_parameters(prepared, before, after)
    return {name: 0.5 * (before[name] + after[name]) for name in names}


def _clock_movement(
    prepared: Prepared, before: Mapping[str, Array], after: Mapping[str, Array]
) -> float:
    """Return the largest change of an offset, s, or of a rate between two sets of values."""
    names = _clock_parameters(prepared, before, after)
    return max((float(np.abs(after[n] - before[n]).max()) for n in names), default=0.0)


def _clock_parameters(
    prepared: Prepared, before: Mapping[str, Array], after: Mapping[str, Array]
) -> list[str]:
    """Return the names of offsets and rates of clocks that both sets of values have."""
    clocks = [o.clock for o in prepared.observations if o.clock is not None]
    return [n for clock in clocks for n in clock.names if n in before and n in after]


def _cycle(
    tried: Sequence[Mapping[str, Array]], outliers: Mapping[str, Array]
) -> list[Mapping[str, Array]]:
    """Return the sets of outliers that follow each other for ever; none if they do not.

    Each set led to the next; the last of them led to `outliers`. A measurement at its gate may
    lie inside where it is left out, and outside where it is used.
    """
    for i, before in enumerate(tried[:-1]):
        if _same(before, outliers):
            return list(tried[i:])
    return []


def _count(rejected: Mapping[str, Array]) -> int:
    return sum(times.size for times in rejected.values())


def _at_the_gate(cycle: Sequence[Mapping[str, Array]]) -> tuple[Finding, ...]:
    """Say how many measurements of a cycle may be echoes or not."""
    if not cycle:
        return ()
    kept, none = min(cycle, key=_count), np.empty(0)
    out = []
    for label in dict.fromkeys(label for each in cycle for label in each):
        ever = np.unique(np.concatenate([each.get(label, none) for each in cycle]))
        undecided = np.setdiff1d(ever, kept.get(label, none)).size
        if undecided:
            out.append(
                Finding(
                    Code.AT_THE_GATE,
                    message("at_the_gate.undecided", count=undecided),
                    sensor=label,
                )
            )
    return tuple(out)


def _same(a: Mapping[str, Array], b: Mapping[str, Array]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)
