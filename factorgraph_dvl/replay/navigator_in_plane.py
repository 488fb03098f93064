"""Navigation in the plane: a batch solution, and steps of the whole problem as records grow.

A node has four numbers. So all nodes stay, and each step is one of the problem that `solve` makes
of the records so far: nothing is linear at an old state, and a measurement that comes late counts
as if it had come in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.estimates import Noise, Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.planar_chain import PlanarChain
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.trajectory import TRAJECTORY_RATE
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.replay.gate import InnovationGate
from factorgraph_dvl.replay.history import RecordHistory
from factorgraph_dvl.replay.record_navigator import RecordNavigator
from factorgraph_dvl.replay.start import largest_misfit, not_one_minimum
from factorgraph_dvl.replay.window import SteppedNodes, stepped
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.batch import settled_minimum
from factorgraph_dvl.solvers.curved_posterior import is_curved
from factorgraph_dvl.solvers.planar_setup import (
    PlanarSetup,
    Track,
    planar_setup,
    planar_trajectory,
)
from factorgraph_dvl.trial import Trial


@dataclass(frozen=True)
class PlanarNodes(SteppedNodes):
    """All nodes so far."""

    @property
    def chain(self) -> PlanarChain:
        """The nodes."""
        chain = self.problem.chain
        assert isinstance(chain, PlanarChain)
        return chain

    @property
    def last(self) -> int:
        """The last node."""
        return self.chain.count

    @property
    def now(self) -> float:
        """Time of the last node, s."""
        return float(self.chain.node_time[-1])

    @property
    def first_position(self) -> Array:
        """Covariance of the first position, (2, 2), m²."""
        return np.asarray(self._posterior.nodes[0][:2, :2])

    def _epochs(self, since: float, last: int) -> Array:
        time = self.chain.epochs(TRAJECTORY_RATE, since)
        return time[time <= self.chain.node_time[last]]

    def _at(self, time: Array, body_axes: BodyAxes) -> Trajectory:
        return planar_trajectory(self.problem, self.evaluation, self._posterior, time)


@dataclass(frozen=True)
class StartInPlane:
    """A batch solution of a planar trial.

    Parameters
    ----------
    whole : PlanarNodes
        All of its nodes.
    trial : Trial
        Records up to then.
    trajectory : Trajectory
        Motion after the time that `solve_start_in_plane` was given.
    findings : tuple of Finding
        What the user must know.
    misfit : float
        Largest RMS of the residuals of any kind of measurement, over what is stated.
    """

    whole: PlanarNodes
    trial: Trial
    trajectory: Trajectory
    findings: tuple[Finding, ...]
    misfit: float

    @property
    def frame(self) -> LocalFrame:
        """Navigation frame of the nodes."""
        return self.whole.chain.frame

    @property
    def noise(self) -> tuple[Noise, ...]:
        """None: it is as stated."""
        return ()


def solve_start_in_plane(
    trial: Trial, since: float, progress: Progress, clock_zero: float
) -> StartInPlane | Message:
    """Solve the records so far as `solve` does.

    Parameters
    ----------
    trial : Trial
        Records so far.
    since : float
        Time after which the trajectory is wanted, s.
    progress : callable
        Called with stage, iteration and cost.
    clock_zero : float
        Reference time of the clock offsets, s.

    Returns
    -------
    StartInPlane or Message
        Start, or why there is none yet: ranges allow several tracks, or an arc of them.

    Raises
    ------
    ConfigError, DataError, SolveError
        If the data so far cannot be solved.
    """
    settled, start_positions = settled_minimum(trial, progress=progress, clock_zero=clock_zero)
    why = not_one_minimum(settled, start_positions)
    if why is not None:
        return why
    problem, evaluation = settled.problem, settled.minimum.evaluation
    whole = PlanarNodes(problem, evaluation, settled.minimum.information)
    assert trial.beacons is not None
    P, frame = whole.first_position, whole.chain.frame
    places = np.array(frame.position(*trial.beacons.places.T))[:, :2]
    if is_curved(P, np.linalg.norm(places - evaluation.states.x[0, :2], axis=1)):
        std = float(np.sqrt(np.linalg.eigvalsh(P)[-1]))
        return message("not_started.position", std=std)
    return StartInPlane(
        whole,
        trial,
        whole.motion(since, whole.last, trial.body_axes),
        settled.findings,
        largest_misfit(problem, evaluation),
    )


class NavigatorInPlane(RecordNavigator):
    """Navigation in the plane, between two batch solutions.

    Parameters
    ----------
    start : StartInPlane
        Batch solution to start from.
    gate : InnovationGate
        Gate that decides which measurements are used.
    interval : float
        Time between updates, s.
    lag : float
        Age from which on motion counts as smoothed, s.
    before : RecordNavigator, optional
        What ran before.
    """

    window: PlanarNodes

    def __init__(
        self,
        start: StartInPlane,
        gate: InnovationGate,
        *,
        interval: float,
        lag: float,
        before: RecordNavigator | None = None,
    ) -> None:
        super().__init__(
            start.whole,
            start.frame,
            start.trajectory,
            gate,
            lag=lag,
            body_axes=start.trial.body_axes,
            before=before,
        )
        self._interval = interval
        problem = start.whole.problem
        self._parameters, self._clock_zero = problem.all_parameters, problem.clock_zero
        self._note_compared(problem, {b.observation.label: b.usable for b in problem.bound})
        self._smooth_old()

    def advance(self, history: RecordHistory, until: float, *, end: bool) -> bool:
        """Go on by the records up to a time, s; return whether these allow it."""
        # Measurements are compared with what those shortly before them predict.
        for time in (min(until, self.time + self._interval), until):
            setup = planar_setup(history.trial(time), self.frame)
            if setup.chain.node_time[-1] > self.time:
                self._extend(setup)
                return True
        return False

    def _extend(self, setup: PlanarSetup) -> None:
        """Go on to the problem of more records."""
        chain, values = setup.chain, self.window.values
        known = Track(self.window.problem, self.window.evaluation, converged=True)
        states = chain.with_recorded(chain.node_time, setup.carried(known, chain.node_time.size))
        problem = Problem(
            chain, setup.observations, self._parameters, start=values, clock_zero=self._clock_zero
        )
        problem.reject(self._rejected)
        at = problem.weighed(problem.evaluate(problem.values(states, values)))
        self._judge(problem, at)
        self.window = stepped(problem, at, PlanarNodes)
        # What is an echo shows better with all that was measured.
        echoes = problem.outliers(self.window.evaluation)
        for o in setup.observations:
            if o.gate is not None and o.label not in self._gate.excluded:
                self._rejected[o.label] = echoes.get(o.label, np.empty(0))
        self._smooth_old()

    def _smooth_old(self) -> None:
        """Keep the motion that is older than the lag."""
        old = np.searchsorted(self.window.chain.node_time, self.time - self._lag)
        self._smooth(self.window, int(old))
