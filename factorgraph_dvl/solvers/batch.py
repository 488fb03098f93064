"""Batch smoothing of a whole trial: alignment, mounting, Levenberg-Marquardt, covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from factorgraph_dvl.alignment import initial_states
from factorgraph_dvl.chain import Chain, inertial_chain
from factorgraph_dvl.earth import LocalFrame
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.graph import Known, Problem
from factorgraph_dvl.increments import increments
from factorgraph_dvl.mounting import initial_mounting
from factorgraph_dvl.preintegration import Segments, States, attach, motion_at, segments
from factorgraph_dvl.sensors.protocol import Aid, Motion, Observation, Parameter
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.solvers.covariance import posterior
from factorgraph_dvl.solvers.feigned import at_prior_along, feigned_directions
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, Progress, minimise
from factorgraph_dvl.solvers.summary import summarise
from factorgraph_dvl.trial import Trial

# States this far apart, s, are as good as denser ones: every measurement hangs on the
# state before it through the increments up to its own time.
STATE_INTERVAL = 1.0
# Root mean square error of the positions at which gravity was taken, m: 1 m turns it by
# 0.16 micro-g.
_SAME_GRAVITY = 2.0
# The first stage only prepares the second.
_ROUGH = 1.0
_ROUGH_ITERATIONS = 10
_ROUNDS = 4


def solve(
    trial: Trial,
    *,
    rate_hz: float = 10.0,
    state_interval_s: float = STATE_INTERVAL,
    progress: Progress | None = None,
) -> Solution:
    """Estimate trajectory and calibration of a trial with their joint covariance.

    Parameters
    ----------
    trial : Trial
    rate_hz : rate of the trajectory in the solution; the solver's states are independent
        of it.
    state_interval_s : time between the states of the graph.
    progress : called with stage, iteration and cost (None where there is none yet).

    Returns
    -------
    Solution
        Also where the solver did not converge: `Solution.converged` says so.

    Raises
    ------
    ConfigError, DataError
        If the trial cannot be solved as it is.
    SolveError
        If no minimum can be searched for at all.
    """
    for name, value in (("rate_hz", rate_hz), ("state_interval_s", state_interval_s)):
        if not (np.isfinite(value) and value > 0.0):
            raise ConfigError(f"{name} is {value}", expected="a number above 0")
    report = progress or (lambda stage, iteration, cost: None)
    problem, minimum, notes = fit(trial, state_interval_s=state_interval_s, progress=report)
    report("covariance", 0, None)
    covariances = posterior(problem, minimum)
    held = feigned_directions(problem, minimum, covariances)
    if held.size:
        origin = at_prior_along(problem, minimum.evaluation.parameters, held)
        problem.hold(held, origin)
        at = problem.values(minimum.evaluation.states, origin)
        again = minimise(
            problem, at, stage="all sensors, without what they cannot tell", progress=report
        )
        minimum = replace(again, iterations=minimum.iterations + again.iterations)
        covariances = posterior(problem, minimum)
    return summarise(problem, minimum, covariances, held=held, rate_hz=rate_hz, notes=notes)


def fit(
    trial: Trial, *, state_interval_s: float, progress: Progress, known: Known | None = None
) -> tuple[Problem, Minimum, tuple[str, ...]]:
    """Find the minimum of a trial's cost, from nothing but its data.

    Parameters
    ----------
    trial, state_interval_s : as for `solve`.
    progress : called with stage, iteration and cost.
    known : of biases and calibration, in place of the trial's priors.

    Returns
    -------
    problem, minimum, notes : what was minimised, where it ended, what the user must know.
    """
    frame = trial.frame()
    progress("increments", 0, None)
    inc, gaps = increments(trial.imu)
    seg = segments(inc, state_interval_s)
    progress("alignment", 0, None)
    start = initial_states(trial, frame, seg)
    notes = (*trial.notes, *gaps, *start.notes)

    states = start.states
    values = None if known is None else known.parameters
    iterations = 0
    p_gravity = np.full_like(states.p_n, np.inf)
    for _ in range(_ROUNDS):
        if np.sqrt(np.mean((states.p_n - p_gravity) ** 2)) > _SAME_GRAVITY:
            chain = inertial_chain(trial, frame, seg, states, bias_prior=known is None)
            p_gravity = states.p_n
        if values is None:
            if trial.gnss is not None:
                coarse = _without_dvl(chain, states, progress)
                iterations += coarse.iterations
                states = coarse.evaluation.states
            progress("mounting", 0, None)
            values = _mounting(trial, frame, seg, chain.gravity_n, states)
        problem = Problem(chain, *_sensors(trial.aids, frame), start=values, known=known)
        at = problem.values(states, {**problem.prior_values(), **values})
        minimum = minimise(problem, at, stage="all sensors", progress=progress)
        iterations += minimum.iterations
        states, values = minimum.evaluation.states, minimum.evaluation.parameters
        same_gravity = np.sqrt(np.mean((states.p_n - p_gravity) ** 2)) <= _SAME_GRAVITY
        if same_gravity and not problem.strayed(values):
            break
    return problem, replace(minimum, iterations=iterations), notes


def _without_dvl(chain: Chain, states: States, report: Progress) -> Minimum:
    trial = chain.trial
    assert trial.gnss is not None
    problem = Problem(chain, *_sensors([trial.gnss], chain.frame))
    return minimise(
        problem,
        problem.values(states, problem.prior_values()),
        stage="inertial and GNSS",
        progress=report,
        max_iterations=_ROUGH_ITERATIONS,
        tolerance=_ROUGH,
        proven=False,
    )


def _sensors(aids: Sequence[Aid], frame: LocalFrame) -> tuple[list[Observation], list[Parameter]]:
    observations = [o for aid in aids for o in aid.observations(frame)]
    parameters = [p for aid in aids for p in aid.parameters()]
    return observations, parameters


def _mounting(
    trial: Trial, frame: LocalFrame, seg: Segments, gravity_n: np.ndarray, states: States
) -> dict[str, np.ndarray]:
    if trial.dvl is None:
        return {}

    def motion_at_pings(pings: np.ndarray, time: np.ndarray) -> tuple[Motion, np.ndarray]:
        index, since, covered = seg.increments.locate(time)
        inside = seg.increments.start[index] + np.clip(since, 0.0, seg.increments.dt[index])
        at = attach(seg, np.where(covered, time, inside), frame.earth_rate)
        return motion_at(at, states, gravity_n, frame.earth_rate), covered

    return initial_mounting(trial.dvl, motion_at_pings)
