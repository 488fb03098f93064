"""Steps of the solver: each proposes other assumptions, of which the objective keeps the better.

A step has a name and one method. It proposes models in the order in which they are tried; those
after the first are nearer to the present one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.clocks import parameters_of
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.graph.smooth_chain import SmoothChain
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.quality.results import DO_NOT_FIT
from factorgraph_dvl.sensors.imu import BIASES
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.averaging import shown_windows
from factorgraph_dvl.solvers.bias_walks import bias_walks
from factorgraph_dvl.solvers.change_along_trial import (
    certain,
    changes_at,
    fall_of_change,
    fall_without_errors,
    largest,
)
from factorgraph_dvl.solvers.correlated_noise import (
    correlated_noise,
    noise_of,
    with_closer_nodes,
    with_others,
)
from factorgraph_dvl.solvers.imu_noise import NOISE_KEYS, lower_noise
from factorgraph_dvl.solvers.known_parameters import Explanation, explanation, is_needless, wide
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.model import Estimated, Model, linear_objective
from factorgraph_dvl.solvers.motion_strengths import LEAST_GAIN, Strengths
from factorgraph_dvl.solvers.noise_growth import growths, normalised
from factorgraph_dvl.solvers.outliers import noise_of_the_rest, robust_weights
from factorgraph_dvl.solvers.preparation import Preparation
from factorgraph_dvl.solvers.process_fit import refitted
from factorgraph_dvl.solvers.scale_walks import in_place_of, instead_of_a_change
from factorgraph_dvl.statistics.variance_components import variance_components

# Shares of a change of noise that are tried in turn. Chosen: what is left changes no σ.
_SHARES = (1.0, 0.5, 0.25, 0.125)
# The same of noise whose estimates fall by less and less. Chosen: three estimates in one.
_FURTHER = 3.0
# Most parameters that are estimated although stated as known. Chosen: more make a wrong model.
_MOST_FREED = 2
# Squares of residuals beyond noise, over it, that are a large misfit. Chosen: noise is twice that
# stated. Share of it that a bias must explain. Chosen: elsewhere, the mounting follows a part.
_LARGE_MISFIT, _SHARE_OF_MISFIT = 3.0, 0.2
# Variance of the scores, beside that of white noise, that a change may leave to explain what looks
# like correlated noise. Measured: 8 where a mount slipped, 600 where samples were misstated.
_MOST_SCATTER = 20.0
# Fall of the objective from which on tests of what was stated as known are made again. Chosen: as
# much as the most that chance makes of them.
_KNOWN_BETTER = 30.0


@dataclass(frozen=True)
class Proposal:
    """Assumptions to try, and where their minimisation starts.

    Parameters
    ----------
    model : Model
        What is assumed.
    states, values : object and dict of str to ndarray
        States of the nodes, and values of all parameters.
    rough : bool, default False
        Whether the minimisation may end early, as another one follows.
    nearer : bool, default False
        Whether it is on the way to what was proposed before it.
    price : float, default 0
        What the objective must fall by, as it is the best of many that were tried.
    """

    model: Model
    states: Any
    values: dict[str, Array]
    rough: bool = False
    nearer: bool = False
    price: float = 0.0


class Step(Protocol):
    """What may change of a model."""

    @property
    def name(self) -> str:
        """What changes, for the record of steps."""

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield what to try from a minimum on, until one of them lowers the objective."""


def _from(at: Estimated, **changes: Any) -> Proposal:
    """Return a proposal that starts where a minimum is."""
    return Proposal(replace(at.model, **changes), at.states, at.values)


class _Asked:
    """Assumptions for which a step has asked what it asks once only."""

    def __init__(self) -> None:
        self._for: tuple[Any, ...] | None = None

    def before(self, *assumptions: Any) -> bool:
        """Whether these were the last that were noted."""
        return _are_those(assumptions, self._for)

    def note(self, *assumptions: Any) -> None:
        """Note what need not be asked again."""
        self._for = assumptions


class MotionStrengths:
    """Strengths of a motion's prior, of processes and of white noise, by their likelihood."""

    name = "strengths of motion and noise"

    def __init__(self) -> None:
        self._settled = _Asked()
        # Objective from which it last asked for another estimate.
        self._asked_at = np.inf

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield strengths that the residuals ask for, and others on the way there."""
        model = at.model
        # What other assumptions made of the noise is to be found anew.
        own = model.parameters, model.robust_weights, _labels(model.processes)
        if self._settled.before(*own):
            return
        found = model.prepared.strengths(at.problem, at.minimum)
        if found is None:
            self._settled.note(*own)
            return
        if self._asked_at - at.objective < LEAST_GAIN:
            # What one strength gains, others may lose, for ever.
            found = replace(found, same=True)
        self._asked_at = at.objective
        if found.same:
            self._settled.note(*own)
            self._asked_at = np.inf
        # Less of what is the same is tried in vain.
        for share in _SHARES[:1] if found.same else _SHARES:
            yield _with_strengths(model, found, share)
        # None of them is better: nor will they be at states that are known better.
        self._settled.note(*own)
        self._asked_at = np.inf


def _with_strengths(model: Model, found: Strengths, share: float) -> Proposal:
    """Return a model part of the way to other strengths, in logarithms."""
    before = model.chain
    assert isinstance(before, SmoothChain)
    density = before.density ** (1.0 - share) * found.chain.density**share
    changed = replace(
        model,
        chain=replace(found.chain, density=density),
        processes=tuple(
            _between(p, q, share) for p, q in zip(model.processes, found.processes, strict=True)
        ),
        noise_factors=_part_of(model.noise_factors, found.factors, share),
        tilt=found.tilt,
    )
    return Proposal(changed, found.states, found.values, rough=not found.same, nearer=share < 1.0)


class States:
    """States and constants: a minimisation that ended early goes on."""

    name = "states and constants"

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield the same model where its minimum is not reached."""
        if at.rough or not at.minimum.converged:
            yield Proposal(at.model, at.states, at.values)


class Gates:
    """Measurements that may be none at all, as ranges of echoes: which of them are left out."""

    name = "echoes"

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield what leaves out all beyond the gates of their sensors."""
        found: Mapping[str, Array] = at.problem.outliers(at.minimum.evaluation)
        if not _same(found, at.model.rejected):
            yield _from(at, rejected=found)


class Averaging:
    """Sensors that are stated to measure in no time: whether they average over a window."""

    name = "averaging"

    def __init__(self) -> None:
        self._tested = _Asked()

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield what estimates the length of a window, where the data show one."""
        model, problem = at.model, at.problem
        own = model.parameters, model.prepared, _labels(model.processes)
        if self._tested.before(*own) or at.rough or problem.chain.interpolates:
            return
        self._tested.note(*own)
        for name, length in shown_windows(problem, at.minimum).items():
            # A clock that jumps looks like a window where it turns.
            others = {
                other
                for o in problem.observations
                if name in parameters_of(o)
                for other in parameters_of(o)
            }
            price = fall_of_change(problem, at.minimum, others)
            (freed,) = (wide(p, p.mean) for p in model.parameters if p.name == name)
            there = {**at.values, name: length}
            changed = replace(_with_others(at, freed), reference=(at.states, there))
            yield Proposal(changed, at.states, there, price=price)


class GrossErrors:
    """Gross errors, by graduated truncation."""

    name = "gross errors"

    def __init__(self) -> None:
        self._asked = _Asked()

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield the gross errors that are found where all measurements count."""
        model, problem = at.model, at.problem
        # Once some are left out, others show, and what was taken for some fits.
        own = model.parameters, model.prepared, model.robust_weights, _labels(model.processes)
        if self._asked.before(*own):
            return
        self._asked.note(*own)
        evaluation = at.minimum.evaluation
        if model.robust_weights:
            problem.robust_weights = {}
            problem.weigh(evaluation)
        found = robust_weights(problem, evaluation)
        if found is None:
            if model.robust_weights:
                yield _from(at, robust_weights={})
            return
        weights, there = found
        if not _same(weights, model.robust_weights):
            # Where gross errors were taken for noise, only both together lower the objective.
            factors = noise_of_the_rest(problem, there, weights)
            changed = replace(model, robust_weights=weights)
            price = 0.0
            if not model.robust_weights:
                # What changed once would be a gross error ever after.
                problem.robust_weights = {}
                problem.weigh(evaluation)
                price = fall_without_errors(problem, at.minimum, weights)
            for each in (changed, replace(changed, noise_factors=factors)):
                yield Proposal(each, there.states, there.parameters, price=price)


class Correlation:
    """Noise that persists: processes, or wide white noise where it lasts for seconds."""

    name = "correlation of noise"

    def __init__(self) -> None:
        self._asked = _Asked()

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield the correlated noise that residuals show."""
        model, problem, minimum = at.model, at.problem, at.minimum
        own = model.parameters, model.prepared
        if self._asked.before(*own) or not minimum.converged:
            return
        self._asked.note(*own)
        found = correlated_noise(problem, minimum.evaluation, set(model.noise_factors))
        if found.gain > 0.0 and _changes_explain_more(problem, minimum, found.gain):
            # Noise that persists would take the place of what changed.
            found = correlated_noise(problem, minimum.evaluation, ())
        known = {p.label for p in model.processes}
        if not (found.long_run or {p.label for p in found.processes} - known):
            return
        persists = any(p.label in model.robust_weights for p in found.processes)
        yield _from(
            at,
            processes=with_others(model.processes, found.processes),
            noise_factors={**model.noise_factors, **found.factors},
            long_run=found.long_run,
            gain=found.long_run_gain,
            # What wanders for long is no outlier.
            robust_weights={} if persists else model.robust_weights,
        )


class ScaleWalks:
    """Scales that walk, in place of noise that persists."""

    name = "walk of a scale"

    def __init__(self) -> None:
        self._asked = _Asked()

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield the walks with the lowest objective by the linear model, where that is lower."""
        model = at.model
        own = model.prepared, model.parameters, _labels(model.processes)
        if not at.minimum.converged or model.chain.interpolates or self._asked.before(*own):
            return
        self._asked.note(*own)
        for every in self._alternatives(at):
            if not every:
                continue
            at.problem.release()
            expected = [linear_objective(p.model, p.states, p.values) + p.price for p in every]
            if min(expected) < at.objective:
                yield every[int(np.argmin(expected))]

    def _alternatives(self, at: Estimated) -> Iterator[list[Proposal]]:
        """Yield models in which a scale walks and the noise of its sensor is white."""
        stated = {p.label for p in at.model.stated_processes}
        for process in at.model.processes:
            if process.label not in stated:
                every = (
                    tuple(walking if p is process else p for p in at.model.processes)
                    for walking in in_place_of(at.problem, process)
                )
                yield [_from(at, processes=each) for each in every]


class ChangedScales(ScaleWalks):
    """Scales that walk, where they change along the trial."""

    def _alternatives(self, at: Estimated) -> Iterator[list[Proposal]]:
        """Yield models in which a scale walks that would change once otherwise."""
        yield [
            replace(_from(at, processes=(*at.model.processes, walking)), price=fall)
            for walking, fall in instead_of_a_change(at.problem, at.minimum)
        ]


class Uncorrelated:
    """Noise that was found to persist: whether it still does, as other noise is known better."""

    name = "correlation that is none"

    def __init__(self) -> None:
        self._asked = _Asked()

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield models without one of the processes that were found."""
        model = at.model
        own = model.prepared, _labels(model.processes)
        if self._asked.before(*own) or not at.minimum.converged:
            return
        self._asked.note(*own)
        stated = {p.label for p in model.stated_processes}
        for process in model.processes:
            if process.label not in stated:
                left = tuple(p for p in model.processes if p is not process)
                yield _from(at, processes=left)


@dataclass
class KnownParameters:
    """Parameters that are stated as known, but that the data say have another value.

    Parameters
    ----------
    first : Estimated, optional
        The minimum with noise as stated and all measurements. Where gross errors and noise that
        persists explain its misfit, a parameter may explain more, which then no longer shows.
    freed : list of Explanation
        Those that are estimated.
    left : Explanation, optional
        What still contradicts the data.
    tested_at : float
        Objective where they were tested last.
    refined : bool
        Whether one was found as noise was known better, after which none is asked for.
    """

    name = "a parameter that was stated"
    first: Estimated | None = None
    freed: list[Explanation] = field(default_factory=list)
    left: Explanation | None = None
    tested_at: float = np.inf
    refined: bool = False
    _tested: _Asked = field(default_factory=_Asked)

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield what estimates the most probable of these, with noise as stated and as found."""
        asked = self.refined or self._tested.before(at.model.parameters)
        if at.minimum.converged and not asked:
            yield from self.tested(at)

    def tested(self, at: Estimated) -> Iterator[Proposal]:
        """Yield the same, also where parameters are those that were tested."""
        model = at.model
        self._tested.note(model.parameters)
        self.tested_at = at.objective
        self.freed = self.estimated_by(model)
        self.left = found = _explained(at)
        if len(self.freed) >= _MOST_FREED:
            return
        self.left = None
        for cause in _different(found, self._at_first(at)):
            self.freed.append(cause)
            yield from _freeing(cause, at)
            # It did not explain enough.
            self.freed.pop()

    def estimated_by(self, model: Model) -> list[Explanation]:
        """Return those that a model estimates: a step may have taken others back."""
        stated = {id(p) for p in model.parameters}
        return [cause for cause in self.freed if id(cause.parameter) not in stated]

    def _at_first(self, at: Estimated) -> Explanation | None:
        """Return what explains the first minimum, None where that has other parameters."""
        first, model = self.first, at.model
        # Without an IMU, what is the same kind of noise has other strengths than assumed at first.
        other = model.processes != model.stated_processes
        if model.chain.interpolates:
            other = _labels(model.processes) != _labels(model.stated_processes)
        found = model.robust_weights or other
        if first is None or first.model.parameters is not model.parameters or not found:
            return None
        return _explained(_applied(first))


@dataclass
class KnownParametersAgain:
    """What was stated as known, once noise is known better: what shows now, and what no more.

    Parameters
    ----------
    known : KnownParameters
        The step that tested them first.
    """

    known: KnownParameters
    name = KnownParameters.name
    _asked: _Asked = field(default_factory=_Asked)

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield what takes a parameter back to what was stated, then what estimates another.

        One other at most: the noise that is found may be far less than is stated, and what is
        left beside it contradicts nothing that is stated.
        """
        model, known = at.model, self.known
        if not at.minimum.converged:
            return
        for cause in known.estimated_by(model):
            if is_needless(cause.parameter, at.problem, at.minimum):
                yield Proposal(_with_others(at, cause.parameter), at.states, at.values)
        if known.tested_at - at.objective < _KNOWN_BETTER:
            return
        if not self._asked.before(model.parameters, model.processes):
            self._asked.note(model.parameters, model.processes)
            for cause in known.estimated_by(model):
                yield Proposal(_with_others(at, cause.parameter), at.states, at.values)
        if not known.refined:
            left, known.refined = known.left, True
            yield from known.tested(at)
            # None explains more.
            known.refined, known.left = False, left


def _applied(at: Estimated) -> Estimated:
    """Return a minimum whose problem has its weights."""
    if not at.model.is_applied(at.problem):
        at.model.applied(at.problem)
    return at


def _explained(at: Estimated) -> Explanation | None:
    """Return the parameter that explains most of the misfit of a minimum."""
    # The test has a problem of its own, and more columns.
    at.problem.release()
    return explanation(at.problem, at.minimum, at.model.prepared.trial.imu)


def _different(now: Explanation | None, at_first: Explanation | None) -> list[Explanation]:
    """Return the causes that there are, each parameter once.

    Its shape is that of the first minimum: nothing of it was left out there as a gross error.
    """
    found = [cause for cause in (now, at_first) if cause is not None]
    return list({cause.parameter.name: cause for cause in found}.values())


def _freeing(cause: Explanation, at: Estimated) -> Iterator[Proposal]:
    """Yield what estimates a parameter instead, with noise as stated and as found."""
    freed = _with_others(at, *cause.freed)
    if not freed.chain.interpolates:
        # What the misfit made of noise and gross errors is to be found anew. Without an IMU,
        # strengths follow any change of the parameters.
        yield Proposal(freed.as_stated(), at.states, at.values, price=cause.price)
    yield Proposal(freed, at.states, at.values, price=cause.price)


def _with_others(at: Estimated, *others: Parameter) -> Model:
    """Return the model with other parameters of the same names, known or to be estimated."""
    named = {p.name: p for p in others}
    parameters = tuple(named.get(p.name, p) for p in at.model.parameters)
    tilt = at.model.tilt
    if tilt is not None:
        tilt = tilt.of(at.problem.parameters, tuple(p for p in parameters if p.estimated))
    return replace(at.model, parameters=parameters, tilt=tilt)


class Noise:
    """Factors on stated noise, and strengths of correlated noise, by restricted likelihood."""

    name = "noise"

    def __init__(self) -> None:
        # Objective from which it last asked.
        self._asked_at = np.inf

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield what residuals ask for, then part of it."""
        model, problem, minimum = at.model, at.problem, at.minimum
        if not model.noise_factors or not minimum.converged or problem.chain.interpolates:
            return
        gained, self._asked_at = self._asked_at - at.objective, at.objective
        if 0.0 < gained < LEAST_GAIN:
            # Estimates of strengths fall by a part of what is left each time.
            return
        found = variance_components(problem, minimum.evaluation, minimum.information)
        before = model.noise_factors
        factors = dict(before) | {label: f.after(before[label]) for label, f in found.items()}
        processes = refitted(problem, minimum.evaluation)
        for share in _SHARES:
            changed = _part_of(before, factors, share)
            part = tuple(
                _between(p, q, share) for p, q in zip(model.processes, processes, strict=True)
            )
            if _same(changed, before) and _are_those(part, model.processes):
                return
            change = {label: f / before[label] for label, f in changed.items()}
            closer = tuple(with_closer_nodes(p, problem, change) for p in part)
            yield _from(at, noise_factors=changed, processes=closer)


class NoiseGrowth:
    """Noise of velocity logs: what of it is constant, and what grows with speed."""

    name = "noise by speed"

    def __init__(self) -> None:
        self._asked = _Asked()

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield the parts that residuals ask for, of each log, then some of the way to them."""
        model, problem, minimum = at.model, at.problem, at.minimum
        own = model.noise_factors, model.noise_growth, model.processes, model.robust_weights
        if problem.chain.interpolates or not minimum.converged or self._asked.before(*own):
            return
        self._asked.note(*own)
        for label, found, parts, price in list(
            growths(problem, minimum.evaluation, minimum.information)
        ):
            now = model.noise_growth.get(label, np.ones(2))
            for share in _SHARES:
                growth, factor = normalised(now ** (1.0 - share) * found**share, parts)
                proposal = _from(
                    at,
                    noise_growth={**model.noise_growth, label: growth},
                    noise_factors={
                        **model.noise_factors,
                        label: model.noise_factors[label] * factor,
                    },
                )
                yield replace(proposal, price=price, nearer=share < 1.0)


class ImuNoise:
    """Noise of gyros and accelerometers of a record that is noisier than stated."""

    name = "noise of the IMU"

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield the noise that the motion between states shows, then part of the way to it."""
        prepared = at.model.prepared
        if not (isinstance(prepared, Preparation) and at.minimum.converged):
            return
        used, stated = prepared.trial.inertial.settings, prepared.stated_imu
        larger = [s for s, k in NOISE_KEYS.items() if getattr(used, k) > getattr(stated, k)]
        found = lower_noise(at.problem, at.minimum, larger) if larger else {}
        if not found:
            return
        # What is left of an estimate falls by a part of it each time.
        for share in (_FURTHER, *_SHARES):
            keys = {
                key: max(getattr(used, key) * factor**share, getattr(stated, key))
                for key, factor in found.items()
            }
            less = prepared.with_imu(**keys)
            chain = less.chain(at.states)
            yield _from(at, prepared=less, chain=chain, track=at.states.p_n)


@dataclass
class Walks:
    """Biases of the IMU that walk more than stated."""

    name = "walks of biases"
    report: Progress
    known: KnownParameters
    findings: tuple[Finding, ...] = ()
    _tried: bool = False

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield walks where biases change along the trial, and nothing else explains it."""
        prepared = at.model.prepared
        if self._tried or not isinstance(prepared, Preparation) or self.known.left is not None:
            return
        imu = prepared.trial.inertial
        if not prepared.trial.estimates_noise(imu):
            return
        # Biases that are not those of an earlier calibration look as if they walked.
        if imu.prior is not None and not _misfit(at.problem):
            return
        self._tried = True
        first = self.known.first
        if first is not None and (
            self.known.freed or _labels(at.model.processes) != _labels(first.model.processes)
        ):
            # Lasting noise or a freed parameter may have taken the place of a walk.
            at = _applied(first)
        # A walk explains what is beyond the noise that is stated.
        noise = {label: np.minimum(f, 1.0) for label, f in at.model.noise_factors.items()}
        model, prepared = at.model, at.model.prepared
        assert isinstance(prepared, Preparation)
        found = bias_walks(prepared, at.problem, at.minimum, noise, self.report)
        if found is None:
            return
        there = found.evaluation
        chain = found.prepared.chain(there.states)
        reference = there.states, there.parameters
        self.findings = found.findings
        yield Proposal(
            replace(
                model.as_stated(),
                prepared=found.prepared,
                chain=chain,
                reference=reference,
                noise_factors=noise,
            ),
            *reference,
        )
        self.findings = ()


@dataclass
class WalksFirst:
    """Biases of the IMU that walk, where one of them explains a large misfit.

    Parameters
    ----------
    walks : Walks
        The step that tries them after all others.
    """

    walks: Walks
    name = Walks.name

    def proposals(self, at: Estimated) -> Iterator[Proposal]:
        """Yield walks before noise and gross errors take their place."""
        if not np.isfinite(self.walks.known.tested_at) and _biases_explain_more(at):
            yield from self.walks.proposals(at)


def _labels(processes: Iterable[Process]) -> str:
    """Return which noise persists."""
    return ", ".join(p.label for p in processes)


def _are_those(some: tuple[Any, ...], others: tuple[Any, ...] | None) -> bool:
    """Whether objects are the same, and not only equal; texts, if they are equal."""
    return others is not None and all(
        a is b or (isinstance(a, str) and a == b) for a, b in zip(some, others, strict=True)
    )


def _part_of(
    before: Mapping[str, Array], after: Mapping[str, Array], share: float
) -> dict[str, Array]:
    """Return factors part of the way to others, in logarithms."""
    return {label: before[label] ** (1.0 - share) * after[label] ** share for label in before}


def _between(before: Process, after: Process, share: float) -> Process:
    """Return a process part of the way to another one, in logarithms."""
    if after is before or share == 1.0:
        return after
    active = before.sigma > 0.0
    ratio = np.divide(after.sigma, before.sigma, out=np.ones(active.size), where=active)
    walk = before.walk
    if walk is not None and after.walk is not None and walk.rate > 0.0:
        walk = replace(walk, rate=walk.rate * (after.walk.rate / walk.rate) ** share)
    return replace(
        before,
        sigma=before.sigma * ratio**share,
        tau=before.tau * (after.tau / before.tau) ** share,
        walk=walk,
    )


def _changes_explain_more(problem: Problem, minimum: Minimum, gain: float) -> bool:
    """Whether a parameter that changed along the trial explains more than correlated noise."""
    found = certain(changes_at(problem, minimum))
    most = largest(found)
    if most is None:
        return False
    change = most.change
    explains = gain < change.fall < _MOST_SCATTER * change.chi2
    return explains or max(t.change.chi2 for t in found) > gain


def _biases_explain_more(at: Estimated) -> bool:
    """Whether a bias of the IMU that changes once explains more of a large misfit than others."""
    evaluation, count = at.minimum.evaluation, at.problem.used_count
    misfit = 2.0 * evaluation.cost - count
    if not (at.minimum.converged and misfit > _LARGE_MISFIT * count):
        return False
    most = largest(changes_at(at.problem, at.minimum))
    if most is None or most.parameter.name not in BIASES:
        return False
    return most.change.fall > _SHARE_OF_MISFIT * misfit


def _misfit(problem: Problem) -> bool:
    """Whether the noise of a sensor is far more than anyone would state."""
    return any(np.max(noise.factor) > DO_NOT_FIT for noise in noise_of(problem))


def _same(a: Mapping[str, Array], b: Mapping[str, Array]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)
