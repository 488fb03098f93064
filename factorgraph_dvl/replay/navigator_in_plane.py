"""Navigation in the plane: a batch solution, and the whole problem anew as records grow.

A node has four numbers. So all nodes stay, and each update minimises the problem that `solve`
makes of the records so far, from where the last one ended: nothing is linear at an old state, and
a measurement that comes late counts as if it had come in time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from factorgraph_dvl.estimates import Trajectory, mixed
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.planar_chain import PlanarChain
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.trajectory import TRAJECTORY_RATE
from factorgraph_dvl.message import Message
from factorgraph_dvl.replay.gate import InnovationGate
from factorgraph_dvl.replay.history import RecordHistory
from factorgraph_dvl.replay.record_navigator import RecordNavigator, RecordStart
from factorgraph_dvl.replay.start import largest_misfit, not_one_minimum
from factorgraph_dvl.replay.window import SteppedNodes
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.batch import settled_minimum
from factorgraph_dvl.solvers.curved_posterior import points_along_arc
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.solvers.levenberg_marquardt import minimise
from factorgraph_dvl.solvers.planar_setup import (
    PlanarSetup,
    Track,
    planar_setup,
    planar_trajectory,
)
from factorgraph_dvl.trial import Trial


@dataclass(frozen=True)
class PlanarNodes(SteppedNodes):
    """All nodes so far, at a minimum.

    Parameters
    ----------
    places : ndarray, shape (B, 2), m
        Places of the beacons, east and north.
    """

    places: Array = field(kw_only=True)

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

    @cached_property
    def constants(self) -> Array:
        """Covariance (P, P) of the parameters, SI, with their spread along an arc."""
        points, weights = self._points
        P = np.zeros_like(self._posterior.parameters)
        for point, weight in zip(points, weights, strict=True):
            root, own = point.problem.prior_root, point.minimum.evaluation.parameters
            off = [own[p.name] - self.values[p.name] for p in self.problem.parameters]
            apart = np.concatenate([np.empty(0), *off])
            P += weight * (root @ point.covariances.parameters @ root.T + np.outer(apart, apart))
        return P

    @cached_property
    def _points(self) -> tuple[list[SolvedProblem], Array]:
        """Tracks along the arc that ranges leave, and their weights; one where it is straight."""
        none = np.zeros((len(self._posterior.parameters), 0))
        found = SolvedProblem(self.problem, self._minimum, self._posterior, none)
        points, costs = points_along_arc(found, self.places, lambda *_: None)
        weights = np.exp(costs[0] - costs)
        return points, weights / weights.sum()

    def _epochs(self, since: float, last: int) -> Array:
        time = self.chain.epochs(TRAJECTORY_RATE, since)
        return time[time <= self.chain.node_time[last]]

    def _at(self, time: Array, body_axes: BodyAxes) -> Trajectory:
        points, weights = self._points
        tracks = [
            planar_trajectory(each.problem, each.minimum.evaluation, each.covariances, time)
            for each in points
        ]
        return mixed(tracks, weights) if time.size else tracks[0]


@dataclass(frozen=True)
class StartInPlane(RecordStart):
    """A batch solution of a planar trial; its noise is as stated."""

    whole: PlanarNodes


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
        Start, or why there is none yet: the ranges may allow several tracks.

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
    assert trial.beacons is not None
    places = problem.chain.frame.position(*trial.beacons.places.T)[:, :2]
    whole = PlanarNodes(problem, evaluation, settled.minimum.information, places=places)
    return StartInPlane(
        whole,
        trial.body_axes,
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
        super().__init__(start, gate, lag=lag, before=before)
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
        minimum = minimise(problem, at.values, stage="all sensors")
        self.window = PlanarNodes(
            problem, minimum.evaluation, minimum.information, places=self.window.places
        )
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
