"""Collect, align, go: from a batch solution of what was collected to a smoother's first state."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.priors import ConstantsPrior
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import AttitudeAid
from factorgraph_dvl.solution import Progress, Trajectory
from factorgraph_dvl.solvers.batch import settled_minimum
from factorgraph_dvl.solvers.posterior import posterior
from factorgraph_dvl.solvers.state_times import needs_states
from factorgraph_dvl.solvers.trajectory import EPOCH_ROUNDING, TRAJECTORY_RATE, trajectory_between
from factorgraph_dvl.statistics.spurious_information import spurious_information
from factorgraph_dvl.trial import Trial

# Standard deviation of the attitude up to which the equations may be linearised in it.
_ATTITUDE = 5.0 * DEG
# Residuals whose root mean square says something.
_ENOUGH = 20


@dataclass(frozen=True)
class ReplayStart:
    """The last state of what was collected, and what is known of it.

    Parameters
    ----------
    frame : LocalFrame
        In which positions are.
    node, time : int or float
        Index of the state, and its time, s.
    prior : gtsam.NonlinearFactorGraph
        Linear factors on state, bias and parameters: all that was collected.
    values : gtsam.Values
        At which they are linear, and start from.
    parameters, all_parameters : tuple of Parameter
        Those that are estimated, and all.
    fixed : dict of str to ndarray
        Values of those that are not.
    sections : tuple of str
        Of the sensors that it knows.
    ranges : bool
        Whether there are any, to beacons.
    own_states : tuple of str
        Sections of the sensors whose every measurement needs a state of its own.
    windows : tuple of (int, int)
        Over which the IMU's samples are smoothed.
    spurious : ndarray, shape (P, P)
        Information on the parameters that only noise makes, in units of the priors' standard
        deviations.
    walking : bool
        Whether biases walk.
    trajectory : Trajectory
        Of what was collected, as `begin` was asked for it.
    notes : tuple of str
        For the user.
    misfit : float
        Largest root mean square of a kind of residuals over their standard deviations.
    """

    frame: LocalFrame
    node: int
    time: float
    prior: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    parameters: tuple[Parameter, ...]
    all_parameters: tuple[Parameter, ...]
    fixed: dict[str, Array]
    sections: tuple[str, ...]
    ranges: bool
    own_states: tuple[str, ...]
    windows: tuple[int, int]
    spurious: Array
    walking: bool
    trajectory: Trajectory
    notes: tuple[str, ...]
    misfit: float


def begin(
    trial: Trial, known: ConstantsPrior | None, interval: float, since: float, progress: Progress
) -> ReplayStart | str:
    """Solve what was collected, and condense it to its last state.

    Parameters
    ----------
    trial : Trial
        What was collected.
    known : ConstantsPrior or None
        Of biases and calibration from before, in place of the trial's priors.
    interval : float
        Of the states to come, s.
    since : float
        Time, s, after which the trajectory is wanted.
    progress : callable
        Called with stage, iteration and cost.

    Returns
    -------
    Start, or why there is none yet.

    Raises
    ------
    DataError, SolveError
        If the data collected so far cannot be solved.
    """
    settled, start_positions = settled_minimum(trial, progress=progress, constants_prior=known)
    problem, minimum = settled.problem, settled.minimum
    if len(start_positions.states) > 1:
        return (
            f"{len(start_positions.states)} trajectories fit the ranges; a turn of 30 degrees or "
            "more, or `initial.position`, would tell"
        )
    if start_positions.notes:
        return start_positions.notes[0]
    if not minimum.converged:
        return "the solver did not converge"
    covariances = posterior(problem, minimum)
    attitude = float(np.sqrt(np.linalg.eigvalsh(covariances.nodes[-1][:3, :3])[-1]))
    if not attitude < _ATTITUDE:
        return f"the attitude is known to {np.degrees(attitude):.2g} deg only"
    if trial.beacons is not None:
        position = float(np.sqrt(np.linalg.eigvalsh(covariances.nodes[-1][3:6, 3:6])[-1]))
        if not position < _straight(trial.beacons.range, trial.beacons.settings.range_std_m):
            return f"the position is known to {position:.2g} m only"
    evaluation = minimum.evaluation
    # The whole error, also what all states share: those to come will be linearised without it.
    spurious = spurious_information(problem, evaluation, covariances.nodes).sum(axis=0)
    last = problem.chain.segments.node_time.size - 1
    kept = [
        keys.node(last),
        problem.chain.bias_key(last),
        *(problem.key(p.name) for p in problem.parameters),
    ]
    gaussian = problem.linearize(evaluation)
    gone = [key for key in evaluation.values.dims() if key not in kept]
    _, rest = gaussian.eliminatePartialMultifrontal(gone, gtsam.EliminateQR)
    values = _some(problem, evaluation.values, last)
    return ReplayStart(
        frame=problem.chain.frame,
        node=last,
        time=float(problem.chain.segments.node_time[-1]),
        prior=gtsam.LinearContainerFactor.ConvertLinearGraph(rest, values),
        values=values,
        parameters=problem.parameters,
        all_parameters=problem.all_parameters,
        fixed={
            p.name: problem.prior_values()[p.name]
            for p in problem.all_parameters
            if not p.estimated
        },
        sections=tuple(aid.section for aid in trial.aids),
        ranges=trial.beacons is not None,
        own_states=_own_states(trial, problem.chain.frame, interval),
        windows=problem.chain.segments.increments.chosen_windows,
        spurious=spurious,
        walking=problem.chain.walking,
        trajectory=_trajectory(
            problem, evaluation.states, covariances.nodes, trial.body_axes, since
        ),
        notes=settled.notes,
        misfit=_misfit(problem, evaluation),
    )


def _trajectory(
    problem: Problem, states: States, P: Array, body_axes: BodyAxes, since: float
) -> Trajectory:
    chain = problem.chain
    time = chain.segments.increments.ticks(TRAJECTORY_RATE)
    time = time[time * TRAJECTORY_RATE > since * TRAJECTORY_RATE + EPOCH_ROUNDING]
    return trajectory_between(
        chain.segments, states, P, chain.gravity_n, chain.frame, body_axes, time
    )


def _straight(ranges: Array, std: float) -> float:
    """Return the standard deviation of a position, m, up to which ranges are linear in it.

    A step s across the way to a beacon at a distance d changes it by s² / 2 d: here by the
    standard deviation of a range.
    """
    nearest = float(np.nanmin(ranges, initial=np.inf))
    return float(np.sqrt(2.0 * nearest * std))


def _own_states(trial: Trial, frame: LocalFrame, interval: float) -> tuple[str, ...]:
    out = []
    for aid in trial.aids:
        if isinstance(aid, AttitudeAid):
            seen = aid.attitudes(frame)
            if seen.time.size and needs_states(seen, trial.imu.settings, interval):
                out.append(aid.section)
    return tuple(out)


def _misfit(problem: Problem, evaluation: Evaluation) -> float:
    out = 0.0
    for residual, weight in zip(evaluation.residuals, problem.weights, strict=True):
        used = weight > 0.0
        if np.count_nonzero(used) >= _ENOUGH:
            out = max(out, float(np.sqrt(np.mean(residual[used] ** 2))))
    return out


def _some(problem: Problem, values: gtsam.Values, last: int) -> gtsam.Values:
    out = gtsam.Values()
    out.insert(keys.node(last), values.atNavState(keys.node(last)))
    bias = problem.chain.bias_key(last)
    out.insert(bias, values.atConstantBias(bias))
    for p in problem.parameters:
        key = problem.key(p.name)
        out.insert(key, values.atRot3(key) if p.rotation else values.atVector(key))
    return out
