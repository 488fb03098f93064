"""The start of a smoother: a batch solution, condensed to its last state."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from factorgraph_dvl.estimates import Noise, Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.inertial_chain import InertialChain
from factorgraph_dvl.graph.priors import ConstantsPrior, places, prior_mean
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.trajectory import TRAJECTORY_RATE
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.replay.correlated_errors import CorrelatedErrors
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import AttitudeAid
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.batch import settled_minimum
from factorgraph_dvl.solvers.correlated_noise import noise_of
from factorgraph_dvl.solvers.position_from_ranges import StartPositions
from factorgraph_dvl.solvers.posterior import Posterior, posterior
from factorgraph_dvl.solvers.rounds import SettledMinimum
from factorgraph_dvl.solvers.state_times import needs_states
from factorgraph_dvl.statistics.spurious_information import spurious_information
from factorgraph_dvl.trial import Trial

# Standard deviation of the attitude up to which the smoother may be linearised in it; chosen: what
# is left out is second order, 0.4 % of a velocity.
_ATTITUDE = 5.0 * DEG
# Fewest residuals of a kind whose RMS is judged; chosen: it then varies by 16 %.
_ENOUGH = 20


@dataclass(frozen=True)
class ReplayStart:
    """The last state of a batch solution, with all that the records say of it.

    Parameters
    ----------
    chain : InertialChain
        What the segments to come follow.
    body_axes : BodyAxes
        Axes of the body.
    node : int
        Index of the state.
    time : float
        Its time, s.
    interval : float
        Interval of the states to come, s.
    prior : gtsam.NonlinearFactorGraph
        Linear factors on state, bias and parameters that stand for all records so far.
    values : gtsam.Values
        Values at which they are linear.
    parameters, all_parameters : tuple of Parameter
        Those that are estimated, and all.
    fixed : dict of str to ndarray
        Values of those that are not estimated, SI.
    sections : tuple of str
        Sections of the sensors that have reported.
    ranges : bool
        Whether there are ranges to beacons.
    own_states : tuple of str
        Sections of the sensors whose every measurement needs a state of its own.
    smoothing : tuple of (int, int)
        How gyros and accelerometers are smoothed.
    longest : float
        Length of the longest window over which a sensor averages, s.
    spurious : ndarray, shape (P, P)
        Spurious information on the parameters, in units of the priors' standard deviations.
    noise_factors : mapping of str to ndarray
        Factors (d,) of each label on the standard deviations that sensors state for their own
        noise; (2, d) where a constant part and one that grows with speed have their own.
    noise : tuple of Noise
        Noise as it is reported.
    errors : CorrelatedErrors
        Correlated errors of the sensors.
    noise_known : bool
        Whether the records are long enough to show what persists of the noise.
    clock_zero : float
        Reference time of the clock offsets, s.
    trajectory : Trajectory
        Motion after the time that `solve_start` was given.
    findings : tuple of Finding
        What the user must know.
    misfit : float
        Largest RMS of the residuals of any kind of measurement, over what is stated.
    """

    chain: InertialChain
    body_axes: BodyAxes
    node: int
    time: float
    interval: float
    prior: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    parameters: tuple[Parameter, ...]
    all_parameters: tuple[Parameter, ...]
    fixed: dict[str, Array]
    sections: tuple[str, ...]
    ranges: bool
    own_states: tuple[str, ...]
    smoothing: tuple[int, int]
    longest: float
    spurious: Array
    noise_factors: Mapping[str, Array]
    noise: tuple[Noise, ...]
    errors: CorrelatedErrors
    noise_known: bool
    clock_zero: float
    trajectory: Trajectory
    findings: tuple[Finding, ...]
    misfit: float

    @property
    def frame(self) -> LocalFrame:
        """Navigation frame of the states."""
        return self.chain.frame

    @property
    def walking(self) -> bool:
        """Whether biases walk."""
        return self.chain.walking

    def columns(self, names: Collection[str]) -> np.ndarray:
        """Return the indices of some parameters' components among those of all estimated."""
        own = (np.r_[place] for name, place in places(self.parameters).items() if name in names)
        return np.concatenate([np.empty(0, dtype=int), *own])


def solve_start(
    trial: Trial,
    known: ConstantsPrior | None,
    interval: float,
    since: float,
    progress: Progress,
    clock_zero: float,
) -> ReplayStart | Message:
    """Solve the records so far, and condense them to their last state.

    Parameters
    ----------
    trial : Trial
        Records so far.
    known : ConstantsPrior or None
        Biases and calibration known from before, in place of the trial's priors.
    interval : float
        Interval of the states to come, s.
    since : float
        Time after which the trajectory is wanted, s.
    progress : callable
        Called with stage, iteration and cost.
    clock_zero : float
        Reference time of the clock offsets, s.

    Returns
    -------
    ReplayStart or Message
        Start, or why there is none yet.

    Raises
    ------
    DataError, SolveError
        If the data so far cannot be solved.
    """
    settled, start_positions = settled_minimum(
        trial,
        progress=progress,
        constants_prior=known,
        clock_zero=clock_zero,
    )
    why = not_one_minimum(settled, start_positions)
    if why is not None:
        return why
    covariances = posterior(settled.problem, settled.minimum)
    unsure = _not_linear(trial, covariances.nodes[-1])
    if unsure is not None:
        return unsure
    return _condensed(trial, settled, covariances, interval, since, clock_zero)


def not_one_minimum(settled: SettledMinimum, start_positions: StartPositions) -> Message | None:
    """Return why the records so far do not lead to one minimum, None if they do."""
    if len(start_positions.states) > 1:
        return message("not_started.ambiguous", count=len(start_positions.states))
    if start_positions.findings:
        first = start_positions.findings[0].message
        return message("not_started.error", error=first)
    return None if settled.minimum.converged else message("not_started.not_converged")


def _condensed(
    trial: Trial,
    settled: SettledMinimum,
    covariances: Posterior,
    interval: float,
    since: float,
    clock_zero: float,
) -> ReplayStart:
    """Return what a minimum says of its last state and of the constants; see `solve_start`."""
    problem, evaluation = settled.problem, settled.minimum.evaluation
    # The whole error, also what all states share: the smoother linearises later states without it.
    spurious = spurious_information(problem, evaluation, covariances.nodes).sum(axis=0)
    chain = problem.chain
    assert isinstance(chain, InertialChain)
    last = chain.node_time.size - 1
    values = _last_values(problem, evaluation.values, chain.bias_key(last), last)
    gaussian = problem.linearize(evaluation)
    time = float(chain.node_time[-1])
    errors = CorrelatedErrors.of(problem.processes)
    if errors.size:
        found = errors.add_start(gaussian, problem.processes, evaluation.parameters, last, time)
        values.insert(keys.correlated(last), found)
    eliminated = [key for key in evaluation.values.dims() if not values.exists(key)]
    _, rest = gaussian.eliminatePartialMultifrontal(eliminated, gtsam.EliminateQR)
    return ReplayStart(
        chain=chain,
        body_axes=trial.body_axes,
        node=last,
        time=time,
        interval=interval,
        prior=gtsam.LinearContainerFactor.ConvertLinearGraph(rest, values),
        values=values,
        parameters=problem.parameters,
        all_parameters=problem.all_parameters,
        fixed={p.name: prior_mean(p) for p in problem.all_parameters if not p.estimated},
        sections=tuple(aid.section for aid in trial.aids),
        ranges=trial.beacons is not None,
        own_states=_own_states(trial, chain.frame, interval),
        smoothing=chain.segments.increments.chosen_smoothing,
        longest=max(
            (
                abs(window.length)
                for b in problem.bound
                if (window := b.window(evaluation.parameters)) is not None
            ),
            default=0.0,
        ),
        spurious=spurious,
        noise_factors=problem.factors_by_part,
        noise=noise_of(problem),
        errors=errors,
        noise_known=not any(
            p.density_only and p.label in problem.noise_factors for p in problem.processes
        ),
        clock_zero=clock_zero,
        trajectory=chain.trajectory(
            evaluation.states, covariances.nodes, trial.body_axes, TRAJECTORY_RATE, since
        ),
        findings=settled.findings,
        misfit=largest_misfit(problem, evaluation),
    )


def _not_linear(trial: Trial, P: Array) -> Message | None:
    """Return why a smoother may not be linearised at a state of covariance P (9, 9), if so."""
    attitude = float(np.sqrt(np.linalg.eigvalsh(P[:3, :3])[-1]))
    if not attitude < _ATTITUDE:
        return message("not_started.attitude", std=np.degrees(attitude))
    if trial.beacons is not None:
        position = float(np.sqrt(np.linalg.eigvalsh(P[3:6, 3:6])[-1]))
        if not position < _linear_std(trial.beacons.range, trial.beacons.settings.range_std_m):
            return message("not_started.position", std=position)
    return None


def _linear_std(ranges: Array, std: float) -> float:
    """Return the standard deviation of a position, m, up to which ranges are linear in it.

    A step s across the line of sight to a beacon at a distance d changes the range by s² / 2 d,
    which may be the standard deviation of a range.
    """
    nearest = float(np.nanmin(ranges, initial=np.inf))
    return float(np.sqrt(2.0 * nearest * std))


def _own_states(trial: Trial, frame: LocalFrame, interval: float) -> tuple[str, ...]:
    out = []
    for aid in trial.aids:
        if isinstance(aid, AttitudeAid):
            seen = aid.attitudes(frame)
            if seen.time.size and needs_states(seen, trial.inertial.settings, interval):
                out.append(aid.section)
    return tuple(out)


def largest_misfit(problem: Problem, evaluation: Evaluation) -> float:
    """Return the largest RMS of the residuals of any kind of measurement, over what is stated."""
    out = 0.0
    factors = problem.white_factors
    for o, residual, weight in zip(
        problem.observations, evaluation.residuals, problem.weights, strict=True
    ):
        used = weight > 0.0
        if np.count_nonzero(used) >= _ENOUGH:
            stated = factors.get(o.label, 1.0) * residual
            out = max(out, float(np.sqrt(np.mean(stated[used] ** 2))))
    return out


def _last_values(problem: Problem, values: gtsam.Values, bias: int, last: int) -> gtsam.Values:
    """Return the values of the last state, its bias and the parameters."""
    out = gtsam.Values()
    out.insert(keys.node(last), values.atNavState(keys.node(last)))
    out.insert(bias, values.atConstantBias(bias))
    for p in problem.parameters:
        key = problem.key(p.name)
        out.insert(key, values.atRot3(key) if p.rotation else values.atVector(key))
    return out
