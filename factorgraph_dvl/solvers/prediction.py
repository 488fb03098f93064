"""The posterior of a planned trial: linearised at its true motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.units import DEG_PER_HOUR, MICRO_G
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.inertial_chain import inertial_chain
from factorgraph_dvl.graph.priors import prior_mean
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.graph.smooth_chain import SmoothChain
from factorgraph_dvl.graph.smooth_motion import SmoothStates
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import segments
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.sensors.clock import on_shared_clocks
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Observation, observed
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
from factorgraph_dvl.solvers.phases import each_phase
from factorgraph_dvl.solvers.preparation_without_imu import LEAST_DENSITY, prepare_without_imu
from factorgraph_dvl.solvers.state_times import STATE_INTERVAL, dense_epochs
from factorgraph_dvl.solvers.summary import summarise
from factorgraph_dvl.statistics.information_history import InformationHistory
from factorgraph_dvl.trial import Trial

# Returns the true motion at times (M,), s, in a frame.
TrueStates = Callable[[LocalFrame, Array], SmoothStates]


@dataclass(frozen=True)
class _Planned:
    """A planned trial: what its problem is made of.

    Parameters
    ----------
    chain : Chain
        Nodes, and what ties them.
    states : object
        True states of the nodes.
    values : dict of str to ndarray
        True values of what is estimated.
    observations, parameters : tuple of Observation or Parameter
        Observations and parameters of all sensors.
    processes : tuple of Process, optional
        Beside those of the sensors.
    """

    chain: Chain
    states: Any
    values: dict[str, Array]
    observations: tuple[Observation, ...]
    parameters: tuple[Parameter, ...]
    processes: tuple[Process, ...] = ()


def predict_posterior(
    trial: Trial, true_states: TrueStates, white: Mapping[str, Array] | None = None
) -> tuple[Solution, InformationHistory, Frontier]:
    """Return what a solver will know of a trial, without noise and without solving.

    Parameters
    ----------
    trial : Trial
        Its records without noise, its true calibration, and the noise that it claims.
    true_states : TrueStates
        Returns the motion at (K,) times in a frame.
    white : mapping of str to ndarray, optional
        Standard deviations (d,), SI, of the white noise of each label, where a solver finds
        them in the record; NaN where they are as stated.

    Returns
    -------
    solution : Solution
        Its values are the truth.
    history : InformationHistory
        The information along the trial.
    frontier : Frontier
        Information at the last node, to go on from.
    """
    problem, evaluation = _at_truth(trial, true_states, white or {})
    filtered = run_filter(problem, evaluation)

    def linearised_at(values: gtsam.Values) -> Minimum:
        return _minimum(problem, problem.evaluate(values))

    found = with_covariances(
        problem, _minimum(problem, evaluation), linearised_at, findings=trial.notes, at_truth=True
    )
    evaluation = found.minimum.evaluation
    if found.fixed.size:
        again = run_filter(problem, evaluation)
        filtered = replace(again, frontier=filtered.frontier)
    history = as_history(problem, evaluation, found.fixed, filtered.triangles, {})
    return summarise(trial, found, rate_hz=RATE_HZ), history, filtered.frontier


def continue_posterior(
    trial: Trial, true_states: TrueStates, start: Frontier
) -> tuple[InformationHistory, Frontier]:
    """Go on from the information at the end of a trial through another that follows it.

    Parameters
    ----------
    trial, true_states : Trial or TrueStates
        The same as for `predict_posterior`. The trial has an IMU; its priors are not used.
    start : Frontier
        Frontier at the first node.
    """
    problem, evaluation = _at_truth(trial, true_states, {})
    found = run_filter(problem, evaluation, start)
    none_fixed = np.zeros((len(problem.prior_root), 0))
    history = as_history(problem, evaluation, none_fixed, found.triangles[-1:], {})
    return history, found.frontier


def _at_truth(
    trial: Trial, true_states: TrueStates, white: Mapping[str, Array]
) -> tuple[Problem, Evaluation]:
    planned = (_without_imu if trial.imu is None else _with_imu)(trial, true_states)
    problem, evaluation = _problem(planned, planned.processes, {})
    factors = {
        o.label: np.nan_to_num(white[o.label] / np.median(sigma, axis=0), nan=1.0)
        for o, sigma in zip(problem.observations, problem.sigma(evaluation), strict=True)
        if o.label in white
    }
    stated = correlated_noise(problem, evaluation, ()).processes
    if not stated and not factors:
        return problem, evaluation
    return _problem(planned, (*stated, *planned.processes), factors)


def _problem(
    planned: _Planned, processes: tuple[Process, ...], factors: Mapping[str, Array]
) -> tuple[Problem, Evaluation]:
    """Return a problem with its weights at the truth, and its evaluation there."""
    problem = Problem(
        planned.chain,
        planned.observations,
        planned.parameters,
        start=planned.values,
        processes=processes,
    )
    problem.noise_factors = factors
    values = problem.values(planned.states, problem.prior_values() | planned.values)
    return problem, problem.weighed(problem.evaluate(values))


def _with_imu(trial: Trial, true_states: TrueStates) -> _Planned:
    frame = trial.frame()
    inc, _ = increments(trial.inertial)
    seg = segments(inc, STATE_INTERVAL, dense_epochs(trial, frame, STATE_INTERVAL))
    motion = true_states(frame, seg.node_time)
    zero, none = np.zeros_like(motion.v_n), np.zeros(3)
    gyro = trial.calibration_truth.get("gyro_bias_deg_h", none) * DEG_PER_HOUR
    accel = trial.calibration_truth.get("accel_bias_ug", none) * MICRO_G
    states = States(motion.nRb, motion.p_n, motion.v_n, zero + gyro, zero + accel)
    observations, parameters = observed(trial.aids, frame, trial.body_axes)
    clocks = on_shared_clocks(parameters, trial.aids)
    parameters = (*clocks, *trial.inertial.error_parameters())
    chain = inertial_chain(trial, frame, seg, states)
    return _Planned(chain, states, _true_values(trial, parameters), observations, parameters)


def _without_imu(trial: Trial, true_states: TrueStates) -> _Planned:
    prepared = prepare_without_imu(trial)
    chain, values = prepared.first_chain, _true_values(trial, prepared.parameters)
    every = {p.name: prior_mean(p) for p in prepared.parameters} | values
    time = chain.node_time - (0.0 if chain.clock is None else every[chain.clock])
    at_turns = chain.attitude_time - every[chain.attitude_clock]
    states, turned = (true_states(chain.frame, t) for t in (time, at_turns))
    states = replace(states, nRb=turned.nRb, omega_b=turned.omega_b)
    return _Planned(
        as_moving(chain, states, prepared.phase),
        states,
        values,
        prepared.observations,
        prepared.parameters,
        prepared.processes,
    )


def _true_values(trial: Trial, parameters: Sequence[Parameter]) -> dict[str, Array]:
    """Return the true values of those that are estimated."""
    truth: dict[str, Array] = {}
    for p in parameters:
        value = trial.calibration_truth.get(p.name)
        if p.estimated and value is not None:
            if p.nominal is None and p.mean.size < value.size:
                # One scale is estimated of an instrument that has three.
                value = np.mean(value, keepdims=True)
            truth[p.name] = p.internal(value)
    return truth


def as_moving(chain: SmoothChain, states: SmoothStates, phase: IntArray) -> SmoothChain:
    """Return a chain with the densities that its states have, by phase.

    Those that the preparation takes from records without noise are those of the sway, which turns
    the velocity of a log but not that of the track.
    """
    own = chain.states(chain.values(states))
    squares = np.concatenate([step.residual for step in chain.steps(own)]) ** 2
    density = chain.density.copy()
    for _, i, where in each_phase(phase):
        density[where, i] *= 0.5 * (squares[where, i] + squares[where, 6 + i]).mean()
    return replace(chain, density=np.maximum(density, LEAST_DENSITY))


def _minimum(problem: Problem, evaluation: Evaluation) -> Minimum:
    return Minimum(evaluation, factorized(problem, evaluation)[0], True, 0)
