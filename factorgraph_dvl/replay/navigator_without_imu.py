"""Navigation without IMU: a batch solution, and a window of the newest nodes after it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.estimates import Noise
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.smooth_chain import SmoothChain, far_apart, without_long_steps
from factorgraph_dvl.graph.smooth_motion import SmoothStates
from factorgraph_dvl.imu.attitude_record import AttitudeRecord, level_axes
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.replay.gate import InnovationGate
from factorgraph_dvl.replay.history import RecordHistory
from factorgraph_dvl.replay.record_navigator import RecordNavigator, RecordStart
from factorgraph_dvl.replay.start import largest_misfit
from factorgraph_dvl.replay.window import (
    BatchSolution,
    Past,
    Window,
    WindowChain,
    stepped,
)
from factorgraph_dvl.sensors.protocol import Observation
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.phases import TURN_SPAN
from factorgraph_dvl.solvers.preparation_without_imu import (
    LONGEST,
    WAVES,
    prepare_without_imu,
    track_axes,
)
from factorgraph_dvl.solvers.rounds import settle
from factorgraph_dvl.solvers.true_times import nodes_late
from factorgraph_dvl.trial import Trial

# Time, s, by which states are behind the records: whether the vessel turns shows in the seconds
# after.
DELAY = 0.5 * TURN_SPAN
# Fewest attitudes that say how the vessel turns; chosen: what a spline and its smoothing need.
_ATTITUDES = 50
# Fewest nodes of a start; chosen.
_FEWEST = 4
# How far, s, two times count as one.
_SAME_TIME = 2e-4


@dataclass(frozen=True)
class StartWithoutImu(RecordStart):
    """A batch solution of a motion in space, from which a window starts.

    Parameters
    ----------
    count : int
        Number of the nodes by whose time all sensors have reported.
    batch : BatchSolution
        What windows take from it.
    """

    whole: Window
    count: int
    batch: BatchSolution

    @property
    def noise(self) -> tuple[Noise, ...]:
        """Noise as it is reported."""
        return self.batch.noise


def solve_start_without_imu(
    trial: Trial, until: float, since: float, progress: Progress, clock_zero: float
) -> StartWithoutImu | Message:
    """Solve the records so far as a batch.

    Parameters
    ----------
    trial : Trial
        Records so far.
    until : float
        Time up to which they are, s.
    since : float
        Time after which the trajectory is wanted, s.
    progress : callable
        Called with stage, iteration and cost.
    clock_zero : float
        Reference time of the clock offsets, s.

    Returns
    -------
    StartWithoutImu or Message
        Start, or why there is none yet.

    Raises
    ------
    ConfigError, DataError, SolveError
        If the data so far cannot be solved.
    """
    prepared = prepare_without_imu(trial)
    settled = settle(prepared, prepared.states, progress, clock_zero=clock_zero)
    problem, minimum = settled.problem, settled.minimum
    if not minimum.converged:
        return message("not_started.not_converged")
    whole = Window(problem, minimum.evaluation, minimum.information)
    latest = _latest(whole, trial, until, end=False)
    count = int(np.searchsorted(whole.chain.node_time[: whole.last + 1], latest, "right"))
    if count < _FEWEST:
        return message("not_started.no_position")
    return StartWithoutImu(
        whole,
        trial.body_axes,
        whole.motion(since, count - 1, trial.body_axes),
        (*prepared.findings, *settled.findings),
        largest_misfit(problem, minimum.evaluation),
        count,
        BatchSolution.of(prepared, problem, until - clock_zero),
    )


class NavigatorWithoutImu(RecordNavigator):
    """Navigation between two batch solutions: a window of nodes, and what is known before it.

    The noise of sensors and the strengths of motion and current are those of the batch solution.
    The newest nodes are smoothed within a lag, and what leaves it becomes the prior of the first
    node, the processes and the constants.

    Parameters
    ----------
    start : StartWithoutImu
        Batch solution to start from.
    gate : InnovationGate
        Gate that decides which measurements are used.
    lag : float
        Age beyond which states are no longer corrected, s.
    before : RecordNavigator, optional
        What ran before.

    Attributes
    ----------
    window : Window
        The newest nodes.
    """

    window: Window

    def __init__(
        self,
        start: StartWithoutImu,
        gate: InnovationGate,
        *,
        lag: float,
        before: RecordNavigator | None = None,
    ) -> None:
        whole, chain = start.whole, start.whole.chain
        super().__init__(start, gate, lag=lag, before=before)
        self._batch = start.batch
        # By section, time of the last row that is before the window.
        self._since: dict[str, float] = {}
        first = self._first_node(chain.node_time[: start.count])
        self._smooth(whole, min(first + 1, start.count - 1))
        past = self._leave(whole, first)
        nodes = slice(first, start.count)
        problem, at = self._problem(
            past,
            chain.node_time[nodes],
            chain.density[first : start.count - 1],
            _some(whole.evaluation.states, nodes),
            whole.values,
            self._batch.trial,
        )
        self.window = stepped(problem, at)
        self._note_compared(problem, {b.observation.label: b.usable for b in problem.bound})

    def advance(self, history: RecordHistory, until: float, *, end: bool) -> bool:
        """Go on by the records up to a time, s; return whether these allow it."""
        since = float(self.window.chain.node_time[0]) - 2.0 * WAVES
        records = history.newest(since, _ATTITUDES)
        nodes = self._next_nodes(records, until, end=end)
        if nodes.size:
            self._extend(nodes, records)
        return bool(nodes.size)

    def _next_nodes(self, records: Trial, until: float, *, end: bool) -> Array:
        """Return the times of the nodes that the records up to a time, s, allow."""
        window, log = self.window, self._batch.trial.log
        last = float(window.chain.node_time[window.last])
        latest = _latest(window, records, until, end=end)
        # True times where the clock of the nodes is not estimated.
        if log is not None and log.locked.sum() > 1:
            assert records.log is not None
            own = records.log.time[records.log.locked] - self._batch.pings_late
        else:
            own = _positions(records) + window.lag
        nodes = far_apart(last, own[(own > last) & (own <= latest)], LONGEST)
        if latest - nodes[-1] > (_SAME_TIME if end else LONGEST):
            nodes = np.append(nodes, latest)
        return without_long_steps(nodes, LONGEST)[1:]

    def _extend(self, nodes: Array, records: Trial) -> None:
        """Add nodes at times (M,), s, to the window, and let the oldest leave it."""
        window, batch = self.window, self._batch
        real = window.chain.node_time[: window.last + 1]
        # A gap longer than the lag leaves the last node.
        first = min(self._first_node(np.append(real, nodes)), window.last)
        self._smooth(window, min(first + 1, window.last))
        past = self._leave(window, first)
        gained = float(nodes[-1] - real[-1])
        past = replace(past, known=past.known.tilted(gained * batch.tilt))
        time = np.append(real[first:], nodes)
        # What the heading does about the newest steps shows only in the seconds to come.
        middle = 0.5 * (time[1:] + time[:-1])
        problem, at = self._problem(
            past,
            time,
            batch.density(_attitudes(records, float(time[0])), records, middle, window.values),
            _some(window.evaluation.states, slice(first, window.last + 1)),
            window.values,
            records,
        )
        self._judge(problem, at)
        self.window = stepped(problem, at)

    def _problem(
        self,
        past: Past,
        time: Array,
        density: Array,
        states: SmoothStates,
        values: Mapping[str, Array],
        records: Trial,
    ) -> tuple[Problem, Evaluation]:
        """Return the problem of some nodes, evaluated near its solution.

        Parameters
        ----------
        past : Past
            What left.
        time, density : ndarray, shape (K,) or (K - 1, 6)
            Times and densities of the nodes.
        states : SmoothStates
            States of the first of them.
        values : mapping of str to ndarray
            Values of the parameters.
        records : Trial
            What was measured.
        """
        batch, whole = self._batch, self._batch.chain
        record = _attitudes(records, float(time[0]))
        # One more: the attitude of the last ping is between two nodes.
        time = np.append(time, time[-1] + LONGEST)
        states = _going_on_straight(whole, record, time, states)
        late = float(values[record.sensor.clock.offset.name][0])
        chain = WindowChain(
            frame=whole.frame,
            node_time=time,
            attitude_time=time + whole.attitude_shift,
            density=np.concatenate([density, density[-1:]]),
            start=states,
            nRt=track_axes(record, whole.frame, states, time - nodes_late(whole, values), late),
            clock=whole.clock,
            attitude_clock=whole.attitude_clock,
            resolution=whole.resolution,
            known=past.known,
        )
        observations = self._observations(records)
        processes, nodes = past.going_on(observations)
        problem = Problem(
            chain,
            observations,
            batch.parameters,
            start={**values},
            clock_zero=batch.clock_zero,
            processes=processes,
        )
        problem.noise_factors, problem.long_run = batch.noise_factors, batch.long_run
        problem.reject(self._rejected)
        at = problem.evaluate(problem.values(states, {**values, **nodes}))
        return problem, problem.weighed(at)

    def _observations(self, records: Trial) -> list[Observation]:
        """Return what was measured and is not before the window."""
        out: list[Observation] = []
        for aid in records.aids:
            first = np.searchsorted(aid.time, self._since.get(aid.section, -np.inf), side="right")
            if first == aid.time.size:
                continue
            found = self._batch.observations(rows_of(aid, slice(int(first), None)))
            if not found:
                self._since[aid.section] = float(aid.time[-1])
            out += found
        return out

    def _leave(self, window: Window, node: int) -> Past:
        """Return what is known before a node; what was measured there is read no more."""
        past = window.before(node)
        self._rejected = {
            label: times[times > past.measured.get(label, -np.inf)]
            for label, times in self._rejected.items()
        }
        for section, labels in self._batch.labels.items():
            left = (past.measured[label] for label in labels & past.measured.keys())
            since = max(left, default=-np.inf)
            self._since[section] = max(since, self._since.get(section, since))
        return past

    def _first_node(self, time: Array) -> int:
        """Return the oldest node within the lag; two stay at least."""
        return min(int(np.searchsorted(time, time[-1] - self._lag)), time.size - 2)


def _latest(window: Window, records: Trial, until: float, *, end: bool) -> float:
    """Return the time up to which all have reported at a time, s, by the nodes' clock."""
    assert records.attitude is not None
    values, attitude = window.values, records.attitude
    clocks = {o.clock.names[0] for o in window.problem.observations if o.clock is not None}
    clocks.add(attitude.clock.offset.name)
    ahead = max(float(values[name][0]) for name in clocks)
    if end:
        # No more is to come; the motion is not known beyond positions and attitudes.
        last = float(attitude.time[-1] - values[attitude.clock.offset.name][0])
        return min(until - ahead, last, float(_positions(records)[-1])) + window.lag
    return until - DELAY + min(window.lag - ahead, 0.0)


def _positions(records: Trial) -> Array:
    """Return the times (M,), s, at which positions were measured."""
    source = records.position_sensor
    assert source is not None
    return np.asarray(source.time[~np.isnan(source.geodetic[:, 0])])


def _attitudes(records: Trial, since: float) -> AttitudeRecord:
    """Return the attitudes from well before a time, s."""
    assert records.attitude is not None
    time = records.attitude.time
    first = min(int(np.searchsorted(time, since - 2.0 * WAVES)), max(time.size - _ATTITUDES, 0))
    rows = rows_of(records.attitude, slice(first, None))
    return AttitudeRecord(rows, records.body_axes, estimated=False)


def _some(states: SmoothStates, nodes: slice) -> SmoothStates:
    """Return the states of some nodes."""
    every = (states.nRb, states.p_n, states.v_n, states.omega_b)
    return SmoothStates(*(each[nodes] for each in every))


def _going_on_straight(
    chain: SmoothChain, record: AttitudeRecord, time: Array, states: SmoothStates
) -> SmoothStates:
    """Return states of the first nodes at times (K,), s, and about those of the others.

    The speed goes on as it was, and turns as the body does; how that points is as it was measured.
    """
    known = len(states.p_n)
    since = (time[known:] - time[known - 1])[:, None]
    stamp = np.clip(time[known - 1 :] + chain.attitude_shift, record.time[0], record.time[-1])
    p_n = states.p_n[-1] + since * states.v_n[-1]
    level = level_axes(chain.frame, p_n)
    body = record.at(stamp[1:], np.zeros_like(p_n), level)
    turned = np.zeros_like(p_n)
    turned[:, 2] = record.rph_at(stamp[:1])[:, 2] - body.rph[:, 2]
    v_n = rotate(level @ exp_so3(turned) @ level.transpose(0, 2, 1), states.v_n[-1:])
    new = (body.nRb, p_n, v_n, body.omega_eb_b)
    old = (states.nRb, states.p_n, states.v_n, states.omega_b)
    return SmoothStates(*(np.concatenate([a, b]) for a, b in zip(old, new, strict=True)))
