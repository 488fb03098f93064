"""The posterior of a planned trial: linearised at its true motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import gtsam
import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.inertial_chain import inertial_chain
from factorgraph_dvl.graph.problem import Evaluation, Problem, observed
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import segments
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.solvers.correlated_noise import correlated_noise
from factorgraph_dvl.solvers.fixed_directions import with_covariances
from factorgraph_dvl.solvers.information_along_trial import (
    RATE_HZ,
    Frontier,
    as_history,
    run_filter,
)
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, factorized
from factorgraph_dvl.solvers.state_times import STATE_INTERVAL, dense_epochs
from factorgraph_dvl.solvers.summary import summarise
from factorgraph_dvl.statistics.information_history import InformationHistory
from factorgraph_dvl.trial import Trial

TrueStates = Callable[[LocalFrame, Array], States]


def predict_posterior(
    trial: Trial, true_states: TrueStates
) -> tuple[Solution, InformationHistory, Frontier]:
    """Return what a solver will know of a trial, without noise and without solving.

    Parameters
    ----------
    trial : Trial
        Its records without noise, its true calibration, and the noise that it claims.
    true_states : TrueStates
        Returns the states at (K,) times in a frame.

    Returns
    -------
    solution : Solution
        Its values are the truth.
    history : InformationHistory
        The information along the trial.
    frontier : Frontier
        Information at the last node, to go on from.
    """
    problem, evaluation = _at_truth(trial, true_states)
    triangles, frontier = run_filter(problem, evaluation)

    def linearised_at(values: gtsam.Values) -> Minimum:
        return _minimum(problem, problem.evaluate(values))

    found = with_covariances(
        problem, _minimum(problem, evaluation), linearised_at, findings=trial.notes, at_truth=True
    )
    evaluation = found.minimum.evaluation
    if found.fixed.size:
        triangles, _ = run_filter(problem, evaluation)
    history = as_history(problem, evaluation, found.fixed, triangles, {})
    return summarise(trial, found, rate_hz=RATE_HZ), history, frontier


def continue_posterior(
    trial: Trial, true_states: TrueStates, start: Frontier
) -> tuple[InformationHistory, Frontier]:
    """Go on from the information at the end of a trial through another that follows it.

    Parameters
    ----------
    trial, true_states : Trial or TrueStates
        As of `predict_posterior`; its priors are not used.
    start : Frontier
        At the first node.
    """
    problem, evaluation = _at_truth(trial, true_states)
    triangles, frontier = run_filter(problem, evaluation, start)
    none_fixed = np.zeros((len(problem.prior_root), 0))
    return as_history(problem, evaluation, none_fixed, triangles[-1:], {}), frontier


def _at_truth(trial: Trial, true_states: TrueStates) -> tuple[Problem, Evaluation]:
    frame = trial.frame()
    inc, _ = increments(trial.inertial)
    seg = segments(inc, STATE_INTERVAL, dense_epochs(trial, frame, STATE_INTERVAL))
    states = true_states(frame, seg.node_time)
    chain = inertial_chain(trial, frame, seg, states)
    observations, parameters = observed(trial.aids, frame, trial.body_axes)
    parameters = (*parameters, *trial.inertial.error_parameters())
    truth: dict[str, Array] = {}
    for p in parameters:
        value = trial.calibration_truth.get(p.name)
        if p.estimated and value is not None:
            if p.nominal is None and p.mean.size < value.size:
                # One scale is estimated of an instrument that has three.
                value = np.mean(value, keepdims=True)
            truth[p.name] = p.internal(value)
    problem, evaluation = _weighed(
        Problem(chain, observations, parameters, start=truth), states, truth
    )
    stated = correlated_noise(problem, evaluation, ()).processes
    if not stated:
        return problem, evaluation
    problem = Problem(chain, observations, parameters, start=truth, processes=stated)
    return _weighed(problem, states, truth)


def _weighed(
    problem: Problem, states: States, truth: Mapping[str, Array]
) -> tuple[Problem, Evaluation]:
    """Return a problem with its weights at the truth, and its evaluation there."""
    values = problem.values(states, {**problem.prior_values(), **truth})
    return problem, problem.weighed(problem.evaluate(values))


def _minimum(problem: Problem, evaluation: Evaluation) -> Minimum:
    return Minimum(evaluation, factorized(problem, evaluation)[0], True, 0)
