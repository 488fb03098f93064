"""Navigation by records alone, without IMU: what is common to motion in space and in the plane."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from factorgraph_dvl.estimates import Noise, Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.records import concatenated
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array, BoolArray
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.replay.calibration import CalibrationEstimate, CalibrationReport
from factorgraph_dvl.replay.gate import InnovationGate, judged
from factorgraph_dvl.replay.history import RecordHistory
from factorgraph_dvl.replay.record import Innovations
from factorgraph_dvl.replay.window import SteppedNodes, information_without


@dataclass(frozen=True)
class RecordStart:
    """A batch solution of a trial without IMU.

    Parameters
    ----------
    whole : SteppedNodes
        All of its nodes.
    body_axes : BodyAxes
        Axes of the body.
    trajectory : Trajectory
        Motion that it has found and that was asked for.
    findings : tuple of Finding
        What the user must know.
    misfit : float
        Largest RMS of the residuals of any kind of measurement, over what is stated.
    """

    whole: SteppedNodes
    body_axes: BodyAxes
    trajectory: Trajectory
    findings: tuple[Finding, ...]
    misfit: float

    @property
    def frame(self) -> LocalFrame:
        """Navigation frame of the nodes."""
        return self.whole.problem.chain.frame

    @property
    def noise(self) -> tuple[Noise, ...]:
        """Noise as it is reported: none that is estimated."""
        return ()


class RecordNavigator:
    """Navigation between two batch solutions, by records that grow.

    Parameters
    ----------
    start : RecordStart
        Batch solution to start from.
    gate : InnovationGate
        Gate that decides which measurements are used.
    lag : float
        Age from which on motion counts as smoothed, s.
    before : RecordNavigator, optional
        What ran before.

    Attributes
    ----------
    window : SteppedNodes
        The newest nodes.
    frame : LocalFrame
        Navigation frame of the nodes.
    first_motion : Trajectory
        Motion that the start has found.
    rotation_change : float
        None that counts: every step is linear where the constants are.
    innovations : list of Innovations
        Innovations since they were last taken.
    findings : list of Finding
        Findings since they were last taken.
    """

    rotation_change = 0.0

    def __init__(
        self,
        start: RecordStart,
        gate: InnovationGate,
        *,
        lag: float,
        before: RecordNavigator | None,
    ) -> None:
        self.window = start.whole
        self.frame, self.first_motion = start.frame, start.trajectory
        self._gate, self._lag, self._body_axes = gate, lag, start.body_axes
        self.innovations: list[Innovations] = []
        self.findings: list[Finding] = []
        # By label, times of measurements that are not used, and of the last one that was compared
        # with a prediction.
        self._rejected = _left_out(start.whole.problem)
        self._compared: dict[str, float] = {} if before is None else before._compared
        self._smoothed: list[Trajectory] = [] if before is None else before._smoothed
        self._smoothed_to: float = -np.inf if before is None else before._smoothed_to

    @property
    def time(self) -> float:
        """True time up to which the motion is known, s."""
        return self.window.now

    def advance(self, history: RecordHistory, until: float, *, end: bool) -> bool:
        """Go on by the records up to a time, s; return whether these allow it."""
        raise NotImplementedError

    def find_calibration(self) -> Callable[[], CalibrationEstimate]:
        """Return what computes the calibration that is known now, whenever it is called."""
        window = self.window
        report = CalibrationReport(window.problem.all_parameters)

        def calibration() -> CalibrationEstimate:
            P = window.constants
            return report.at(window.values, np.empty(0), P, np.zeros((len(P), 0)))

        return calibration

    def newest(self, body_axes: BodyAxes) -> Callable[[], Trajectory]:
        """Return what computes the newest state as known now, as a trajectory of one epoch."""
        return partial(self.window.newest, body_axes)

    def last_segment(self, body_axes: BodyAxes, since: float) -> Callable[[], Trajectory]:
        """Return what computes the motion as known now, at the epochs after a time, s."""
        return partial(self.window.motion, since, self.window.last, body_axes)

    def smoothed(self, body_axes: BodyAxes, *, rest: bool = False) -> Trajectory | None:
        """Return smoothed motion that was not returned before: what has left, or all the rest."""
        if rest:
            self._smooth(self.window, self.window.last)
        found = concatenated(self._smoothed) if self._smoothed else None
        self._smoothed.clear()
        return found

    def _judge(self, problem: Problem, at: Evaluation) -> None:
        """Compare what was measured since the last time with its prediction; reject what differs.

        Parameters
        ----------
        problem : Problem
            Weighed at the evaluation.
        at : Evaluation
            Where it is linear.
        """
        new = {
            b.observation.label: b.usable
            & (b.weight > 0.0).any(axis=1)
            & (b.observation.time > self._compared.get(b.observation.label, -np.inf))
            for b in problem.bound
        }
        found = judged(problem, at, information_without(problem, at, new), new, self._gate)
        self.innovations += found.innovations
        self.findings += found.findings
        for label, times in found.rejected.items():
            self._rejected[label] = np.union1d(self._rejected.get(label, times), times)
        self._note_compared(problem, new)
        problem.reject(self._rejected)

    def _note_compared(self, problem: Problem, which: Mapping[str, BoolArray]) -> None:
        """Take notice of measurements, by label, that have been compared with a prediction."""
        for bound in problem.bound:
            o = bound.observation
            if which[o.label].any():
                last = float(o.time[which[o.label]][-1])
                self._compared[o.label] = max(last, self._compared.get(o.label, last))

    def _smooth(self, window: SteppedNodes, node: int) -> None:
        """Keep the smoothed motion up to a node that no update has carried."""
        found = window.motion(self._smoothed_to, node, self._body_axes)
        self._smoothed_to = float(np.max(found.time, initial=self._smoothed_to))
        self._smoothed.append(found)


def _left_out(problem: Problem) -> dict[str, Array]:
    """Return the times of the measurements that a batch solution left out, by label."""
    out = dict(problem.rejected)
    for o in problem.observations:
        weight = problem.robust_weights.get(o.label)
        if weight is not None:
            none = o.time[np.all(weight == 0.0, axis=1)]
            out[o.label] = np.union1d(out.get(o.label, none), none)
    return out
