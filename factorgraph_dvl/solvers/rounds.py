"""Descent to the most probable model of a trial: steps that are kept if they lower the objective.

The objective is -2 log of the restricted likelihood (`statistics.marginal_likelihood`). Each step
proposes other assumptions: what is rejected, how large and how lasting the noise is, which
parameters are known, how biases walk. The trial is minimised with them, and they are kept only
where the objective is lower there. So it never rises, and steps cannot lead in circles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.priors import ConstantsPrior
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.imu.noise import noise_findings
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import DO_NOT_FIT
from factorgraph_dvl.solution import Progress, SolverStep
from factorgraph_dvl.solvers.averaging import averaging_findings
from factorgraph_dvl.solvers.correlated_noise import correlated_noise, with_others
from factorgraph_dvl.solvers.known_parameters import explanation_findings
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.model import (
    Estimated,
    Model,
    estimated,
    least_objective,
    minimised,
    with_all_digits,
)
from factorgraph_dvl.solvers.preparation import Preparation, Prepared
from factorgraph_dvl.solvers.scale_walks import scale_walk_findings
from factorgraph_dvl.solvers.steps import (
    Averaging,
    ChangedScales,
    Correlation,
    Gates,
    GrossErrors,
    ImuNoise,
    KnownParameters,
    KnownParametersAgain,
    MotionStrengths,
    Noise,
    NoiseGrowth,
    Proposal,
    ScaleWalks,
    States,
    Step,
    Uncorrelated,
    Walks,
    WalksFirst,
)

# Fall of the objective and move of a constant, in standard deviations, below which a step leaves
# the answer as it is: nothing follows from it. Chosen: neither shows in a result.
_SAME_OBJECTIVE, _SAME_CONSTANTS = 0.01, 0.05
# Steps after which the solver gives up. Measured: most trials take two, the most 30.
_MOST_STEPS = 200
# Iterations in vain after which it does, too: records that contradict each other have no minimum
# that a few lead to. Measured: trials that fit take up to 90 in all.
_MOST_IN_VAIN = 100


@dataclass(frozen=True)
class SettledMinimum:
    """A minimum at which no step lowers the objective, if `settled`.

    Parameters
    ----------
    problem : Problem
        What the last step minimised.
    minimum : Minimum
        Where it ended, with the iterations of all steps.
    settled : bool
        Whether no step changes the problem, whatever the minimum.
    findings : tuple of Finding
        What the user must know.
    steps : tuple of SolverStep
        What changed on the way, and what it took off the objective.
    """

    problem: Problem
    minimum: Minimum
    settled: bool
    findings: tuple[Finding, ...]
    steps: tuple[SolverStep, ...] = ()


def settle(
    prepared: Prepared,
    states: Any,
    report: Progress,
    *,
    constants_prior: ConstantsPrior | None = None,
    values: dict[str, Array] | None = None,
    clock_zero: float | None = None,
    roughly: bool = False,
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
        Reference time of the clock offsets, s; by default in the middle of the trial.
    roughly : bool, default False
        Whether what else the data show is not asked for: another trial starts from there, or
        records contradict each other, and all else would explain a part of that.
    """
    start, iterations = _start(prepared, states, report, constants_prior, values, clock_zero)
    at = _first(start, report)
    iterations += at.minimum.iterations
    record = [SolverStep("start", at.objective, 0.0, 0.0)]
    known = KnownParameters(at)
    walks = Walks(report, known)
    steps: list[Step] = [
        MotionStrengths(), States(), Averaging(), Gates(), WalksFirst(walks), GrossErrors(),
        Correlation(), ScaleWalks(), known, ChangedScales(), Noise(), NoiseGrowth(), ImuNoise(),
        Uncorrelated(), KnownParametersAgain(known), walks,
    ]  # fmt: skip
    if roughly:
        steps = [
            step for step in steps if isinstance(step, (MotionStrengths, States, GrossErrors))
        ]
    elif constants_prior is not None:
        # A joint prior knows what was estimated before, and of nothing else.
        freeing = Averaging, KnownParameters, KnownParametersAgain
        steps = [step for step in steps if not isinstance(step, freeing)]
    recorded, changed, going_on, in_vain = at, "", True, 0
    while going_on and len(record) < _MOST_STEPS and in_vain < _MOST_IN_VAIN:
        going_on = False
        for step in steps:
            found, tried = _kept(step, at, report, _MOST_IN_VAIN - in_vain)
            iterations += tried
            if found is None or _is_lost(found):
                in_vain += tried
            if found is None:
                continue
            changed = changed or step.name
            fall, move = recorded.objective - found.objective, found.moved_from(recorded)
            going_on = found.rough or fall > _SAME_OBJECTIVE or move > _SAME_CONSTANTS
            if known.first is at and isinstance(step, (Averaging, States)):
                # Noise is as stated still, and nothing left out.
                known.first = found
            at = found
            if not found.rough:
                if recorded.rough and changed == States.name:
                    # What began roughly begins where its minimum is.
                    record[-1] = replace(record[-1], objective=found.objective)
                else:
                    record.append(SolverStep(changed, found.objective, fall, move))
                recorded, changed = found, ""
            if going_on:
                break
    findings = (
        *_imu_findings(at),
        *walks.findings,
        *averaging_findings(prepared.parameters, at),
        *scale_walk_findings(at),
        *explanation_findings(known.estimated_by(at.model), known.left, at.minimum.evaluation),
    )
    if going_on:
        text = message("not_converged.steps", count=len(record))
        findings += (Finding(Code.NOT_CONVERGED, text, severity="error"),)
    minimum = with_all_digits(at)
    at.problem.release()
    settled = not going_on and in_vain < _MOST_IN_VAIN
    minimum = replace(minimum, converged=minimum.converged and settled, iterations=iterations)
    return SettledMinimum(at.problem, minimum, settled, findings, tuple(record))


def _imu_findings(at: Estimated) -> tuple[Finding, ...]:
    """Return what the user must know about the noise of the IMU that a model ends with."""
    prepared = at.model.prepared
    if not isinstance(prepared, Preparation):
        return ()
    return noise_findings(prepared.stated_imu, prepared.trial.inertial.settings)


def _start(
    prepared: Prepared,
    states: Any,
    report: Progress,
    constants_prior: ConstantsPrior | None,
    values: dict[str, Array] | None,
    clock_zero: float | None,
) -> tuple[Proposal, int]:
    """Return what is assumed first, where its minimisation starts, and iterations up to there."""
    chain, track = prepared.chain(states), states.p_n
    robust: dict[str, Array] = {}
    iterations = 0
    if constants_prior is not None:
        values = constants_prior.parameters
    if values is None:
        start = prepared.start(chain, states, report)
        states, values, iterations = start.states, start.values, start.iterations
        robust = start.robust_weights
    tilt = prepared.first_tilt(values) if constants_prior is None else None
    processes = prepared.stated_processes(chain, states, values)
    model = Model(
        prepared,
        chain,
        prepared.parameters,
        (states, values),
        track,
        processes=processes,
        stated_processes=processes,
        noise_factors={
            o.label: np.ones(len(o.components))
            for o in prepared.observations
            if o.label in prepared.estimated_noise and o.noise_groups
        }
        | dict(prepared.noise_factors),
        robust_weights=robust,
        rejected=prepared.rejected,
        tilt=tilt,
        constants_prior=constants_prior,
        clock_zero=clock_zero,
    )
    return Proposal(model, states, values), iterations


def _first(start: Proposal, report: Progress) -> Estimated:
    """Return the first minimum: gravity and weights are taken there, and all others compare.

    Correlated noise that the trial states is in it.
    """
    if start.model.chain.interpolates:
        return estimated(start.model, start.states, start.values, report, rough=True)
    model, problem, minimum = minimised(
        start.model, start.states, start.values, report, rough=True
    )
    rough = Estimated(model, problem, minimum, np.inf, rough=True)
    reference = rough.states, rough.values
    stated = with_others(
        model.processes, correlated_noise(problem, minimum.evaluation, ()).processes
    )
    model = replace(model, reference=reference, processes=stated, stated_processes=stated)
    found = estimated(model, *reference, report, before=rough)
    iterations = minimum.iterations + found.minimum.iterations
    return replace(found, minimum=replace(found.minimum, iterations=iterations))


def _is_lost(found: Estimated) -> bool:
    """Whether no minimum was reached, and residuals are larger than any noise."""
    minimum, most = found.minimum, DO_NOT_FIT**2 * found.problem.used_count
    return not minimum.converged and 2.0 * minimum.evaluation.cost > most


def _is_hopeless(proposal: Proposal, at: Estimated) -> bool:
    """Whether noise is so much larger than found that no fit would lower the objective."""
    model = proposal.model
    if model.parameters is at.model.parameters or not any(
        np.any(f > at.model.noise_factors.get(label, f))
        for label, f in model.noise_factors.items()
    ):
        return False
    at.problem.release()
    return least_objective(model, proposal.states, proposal.values) > at.objective


def _strengths_follow(model: Model, before: Model) -> bool:
    """Whether strengths of motion and noise are estimated anew: see `MotionStrengths`."""
    return model.chain.interpolates and not (
        model.parameters is before.parameters
        and model.robust_weights is before.robust_weights
        and [p.label for p in model.processes] == [p.label for p in before.processes]
    )


def _kept(
    step: Step, at: Estimated, report: Progress, most: int = _MOST_IN_VAIN
) -> tuple[Estimated | None, int]:
    """Return what a step leads to if the objective is lower there, and the iterations it took.

    Nothing is tried once it took the most that it may.
    """
    if most <= 0:
        return None, 0
    iterations, last, nearer = 0, np.inf, np.inf
    for proposal in step.proposals(at):
        if iterations >= most:
            break
        # Where less of a change is worse than more of it, none of it is better.
        if (proposal.nearer and nearer > last) or _is_hopeless(proposal, at):
            continue
        found = estimated(
            proposal.model,
            proposal.states,
            proposal.values,
            report,
            before=at,
            rough=proposal.rough or _strengths_follow(proposal.model, at.model),
        )
        iterations += found.minimum.iterations
        last, nearer = nearer, found.objective
        if at.rough and proposal.model is at.model:
            return found, iterations
        if found.objective + proposal.price >= at.objective:
            continue
        if found.minimum.converged or found.rough or not at.minimum.converged:
            return found, iterations
        # An objective is that of a minimum: where one was not reached, it is still open.
        found = estimated(found.model, found.states, found.values, report, before=found)
        iterations += found.minimum.iterations
        if found.minimum.converged and found.objective + proposal.price < at.objective:
            return found, iterations
    if not at.model.is_applied(at.problem):
        at.model.applied(at.problem)
    return None, iterations
