"""Replay of a trial without IMU: batch solutions, and a window of nodes between them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter

import numpy as np

from factorgraph_dvl.errors import ConfigError, FactorgraphDvlError
from factorgraph_dvl.estimates import Noise, Trajectory
from factorgraph_dvl.geometry.records import concatenated
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, BoolArray, rotate
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.smooth_chain import SmoothChain, far_apart, without_long_steps
from factorgraph_dvl.graph.smooth_motion import SmoothStates
from factorgraph_dvl.imu.attitude_record import AttitudeRecord, level_axes
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay.arrivals import Outages
from factorgraph_dvl.replay.calibration import CalibrationReport
from factorgraph_dvl.replay.gate import InnovationGate, Judged, judged
from factorgraph_dvl.replay.record import Update
from factorgraph_dvl.replay.window import (
    BatchSolution,
    Past,
    Window,
    WindowChain,
    information_without,
    stepped,
)
from factorgraph_dvl.sensors.protocol import Observation
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.preparation_without_imu import (
    LONGEST,
    TURN_SPAN,
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
# Most updates a second; chosen: states come with pings, and are behind them by seconds anyway.
MOST_UPDATES_HZ = 0.5
# Data before the first batch solution, s; chosen: some legs show the noise of fixes and pings.
_FIRST = 60.0
# Growth of the record from one batch solution to the next, and to the next attempt where one
# failed; chosen: the cost of all solutions is three times that of the last.
_GROWTH, _RETRY = 1.5, 1.2
# Fewest attitudes that say how the vessel turns; chosen: what a spline and its smoothing need.
_ATTITUDES = 50
# Fewest nodes of a start; chosen.
_FEWEST = 4
# How far, s, two times count as one.
_SAME_TIME = 2e-4


class ReplayWithoutImu:
    """Replay of the records of a trial without IMU, of which only those up to a time are read.

    The noise of sensors and the strengths of motion and current come from batch solutions whenever
    the record has grown by half. Between these the newest nodes are smoothed within a lag, and
    what leaves it becomes the prior of the first node, the processes and the constants.

    Parameters
    ----------
    trial : Trial
        Trial without IMU.
    lag_s : float
        Age beyond which states are no longer corrected, s.
    progress : callable
        Called with stage, iteration and cost while a batch solution runs.

    Attributes
    ----------
    delay : float
        Time by which estimates are behind the records, s.
    findings : list of Finding
        Findings that no update has carried yet.
    unused : int
        Number of an IMU's samples after the newest state: none.
    """

    delay = DELAY
    unused = 0

    def __init__(self, trial: Trial, lag_s: float, progress: Progress) -> None:
        attitude, source = trial.attitude, trial.position_sensor
        if attitude is None or source is None:
            raise ConfigError(
                "nothing measures the attitude",
                where="trial.yaml",
                expected="an `imu`, `ins` or `attitude` section",
            )
        self._trial, self._lag, self._progress = trial, lag_s, progress
        self._attitude, self._positions = attitude, source.time[~np.isnan(source.geodetic[:, 0])]
        log = trial.log
        self._pings = log.time[log.locked] if log is not None and log.locked.sum() > 1 else None
        self.findings: list[Finding] = []
        self._start = float(max(aid.time[0] for aid in trial.aids))
        self._solve_at = self._start + _FIRST
        self._current: tuple[BatchSolution, Window] | None = None
        self._gate, self._outages = InnovationGate(), Outages()
        # Number of rows of each sensor that are before the window.
        self._before: dict[str, int] = {}
        # By label, times of measurements that are not used, and of the last one that was compared
        # with a prediction.
        self._rejected: dict[str, Array] = {}
        self._compared: dict[str, float] = {}
        self._trajectory_to = self._smoothed_to = -np.inf
        self._noted = set(trial.notes)

    @property
    def noise(self) -> tuple[Noise, ...]:
        """Noise of the sensors, as the last batch solution found it."""
        return () if self._current is None else self._current[0].noise

    def counts(self) -> list[Finding]:
        """Return how many measurements were not used, and why."""
        why = message("unused.contradicted")
        return [
            Finding(Code.UNUSED, message("unused.measurements", count=n, why=why), label)
            for label, n in self._gate.rejected.items()
            if n
        ]

    def advance(self, until: float, *, end: bool = False) -> Iterator[Update]:
        """Read the records up to a time, s, and yield the update that they make possible."""
        began = perf_counter()
        trajectory: Trajectory | None = None
        smoothed: list[Trajectory] = []
        found, solved = Judged((), {}, ()), False
        if self._current is not None:
            nodes = self._next_nodes(*self._current, until, end=end)
            if nodes.size:
                found = self._extend(*self._current, nodes, until, smoothed)
                window = self._current[1]
                trajectory = self._trajectory(window, window.last)
        if (until >= self._solve_at and not end) or (end and self._current is None):
            whole = self._solve(until, smoothed, end=end)
            solved = whole is not None
            if whole is not None and trajectory is None:
                trajectory = self._trajectory(*whole)
        if trajectory is not None:
            yield self._update(began, trajectory, smoothed, found, solved=solved)

    def finished(self, last: Update) -> Update:
        """Return the last update with what stays in the window when no more records come."""
        assert self._current is not None
        _, window = self._current
        rest = self._smooth(window, window.last)
        parts = [part for part in (last.smoothed, rest) if part is not None]
        return replace(last, smoothed=concatenated(parts))

    def _solve(
        self, until: float, smoothed: list[Trajectory], *, end: bool
    ) -> tuple[Window, int] | None:
        """Solve the records up to a time as a batch, and start a window at its end.

        Return all nodes and the last that counts, None if there is no solution.
        """
        self._solve_at = self._start + _GROWTH * (until - self._start)
        try:
            prepared = prepare_without_imu(self._trial.until(until))
            settled = settle(prepared, prepared.states, self._progress, clock_zero=self._start)
        except FactorgraphDvlError as error:
            self._solve_at = self._start + _RETRY * (until - self._start)
            if self._current is None:
                why = message("not_started.error", error=str(error))
                text = message("not_started.yet", time=until, reason=why)
                self.findings.append(Finding(Code.NOT_STARTED, text))
            return None
        if not (settled.minimum.converged or end):
            return None
        whole = Window(settled.problem, settled.minimum.evaluation, settled.minimum.information)
        chain = whole.chain
        latest = self._latest(whole, until, end=end)
        count = int(np.searchsorted(chain.node_time[: whole.last + 1], latest, "right"))
        if count < _FEWEST:
            return None
        batch = BatchSolution.of(prepared, settled.problem, until - self._start)
        found = [*prepared.findings, *settled.findings]
        self.findings += [f for f in found if f not in self._noted]
        self._noted.update(found)
        self._rejected = _left_out(whole.problem)
        self._before = {}
        first = self._first_node(chain.node_time[:count])
        smoothed.append(self._smooth(whole, min(first + 1, count - 1)))
        past = self._leave(batch, whole, first)
        nodes = slice(first, count)
        problem, at = self._window(
            batch,
            past,
            chain.node_time[nodes],
            chain.density[first : count - 1],
            _some(whole.evaluation.states, nodes),
            whole.values,
            until,
        )
        self._current = batch, stepped(problem, at)
        for bound in problem.bound:
            self._note_compared(bound.observation, bound.usable)
        return whole, count - 1

    def _extend(
        self,
        batch: BatchSolution,
        window: Window,
        nodes: Array,
        until: float,
        smoothed: list[Trajectory],
    ) -> Judged:
        """Add nodes to the window, and let the oldest leave it."""
        chain = window.chain
        real = chain.node_time[: window.last + 1]
        # A gap longer than the lag leaves the last node.
        first = min(self._first_node(np.append(real, nodes)), window.last)
        smoothed.append(self._smooth(window, min(first + 1, window.last)))
        past = self._leave(batch, window, first)
        gained = float(nodes[-1] - real[-1])
        past = replace(past, known=past.known.tilted(gained * batch.tilt))
        time = np.append(real[first:], nodes)
        record = self._attitudes(float(time[0]), until)
        # What the heading does about the newest steps shows only in the seconds to come.
        middle = 0.5 * (time[1:] + time[:-1])
        problem, at = self._window(
            batch,
            past,
            time,
            batch.density(record, middle),
            _some(window.evaluation.states, slice(first, window.last + 1)),
            window.values,
            until,
        )
        new = {
            b.observation.label: b.usable
            & (b.weight > 0.0).any(axis=1)
            & (b.observation.time > self._compared.get(b.observation.label, -np.inf))
            for b in problem.bound
        }
        found = judged(problem, at, information_without(problem, at, new), new, self._gate)
        for label, times in found.rejected.items():
            self._rejected[label] = np.union1d(self._rejected.get(label, times), times)
        for bound in problem.bound:
            self._note_compared(bound.observation, new[bound.observation.label])
        problem.reject(self._rejected)
        self._current = batch, stepped(problem, at)
        return found

    def _window(
        self,
        batch: BatchSolution,
        past: Past,
        time: Array,
        density: Array,
        states: SmoothStates,
        values: Mapping[str, Array],
        until: float,
    ) -> tuple[Problem, Evaluation]:
        """Return the problem of some nodes, evaluated near its solution.

        Parameters
        ----------
        batch : BatchSolution
            Noise and strengths.
        past : Past
            What left.
        time, density : ndarray, shape (K,) or (K - 1, 6)
            Times and densities of the nodes.
        states : SmoothStates
            States of the first of them.
        values : mapping of str to ndarray
            Values of the parameters.
        until : float
            Time up to which records are read, s.
        """
        whole = batch.chain
        record = self._attitudes(float(time[0]), until)
        # One more: the attitude of the last ping is between two nodes.
        time = np.append(time, time[-1] + LONGEST)
        states = _going_on_straight(whole, record, time, states)
        late = float(values[self._attitude.clock.offset.name][0])
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
        observations = self._observations(batch, until)
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

    def _observations(self, batch: BatchSolution, until: float) -> list[Observation]:
        """Return what was measured and is not before the window, up to a time, s."""
        out: list[Observation] = []
        for aid in self._trial.aids:
            last = int(np.searchsorted(aid.time, until, side="right"))
            rows = slice(self._before.get(aid.section, 0), last)
            if rows.stop <= rows.start:
                continue
            found = batch.observations(rows_of(aid, rows))
            if not found:
                self._before[aid.section] = last
            out += found
        return out

    def _leave(self, batch: BatchSolution, window: Window, node: int) -> Past:
        """Return what is known before a node; what was measured there is read no more."""
        past = window.before(node)
        self._rejected = {
            label: times[times > past.measured.get(label, -np.inf)]
            for label, times in self._rejected.items()
        }
        for aid in self._trial.aids:
            for label in batch.labels[aid.section] & past.measured.keys():
                row = int(np.searchsorted(aid.time, past.measured[label], side="right"))
                self._before[aid.section] = max(row, self._before.get(aid.section, 0))
        return past

    def _next_nodes(
        self, batch: BatchSolution, window: Window, until: float, *, end: bool
    ) -> Array:
        """Return the times of the nodes that the records up to a time, s, allow."""
        last = float(window.chain.node_time[window.last])
        latest = self._latest(window, until, end=end)
        # True times where the clock of the nodes is not estimated.
        own = self._positions + window.lag if self._pings is None else self._pings
        if self._pings is not None:
            own = own - batch.pings_late
        nodes = far_apart(last, own[(own > last) & (own <= latest)], LONGEST)
        if latest - nodes[-1] > (_SAME_TIME if end else LONGEST):
            nodes = np.append(nodes, latest)
        return without_long_steps(nodes, LONGEST)[1:]

    def _latest(self, window: Window, until: float, *, end: bool) -> float:
        """Return the time up to which all have reported at a time, s, by the nodes' clock."""
        values = window.values
        clocks = {o.clock.names[0] for o in window.problem.observations if o.clock is not None}
        clocks.add(self._attitude.clock.offset.name)
        ahead = max(float(values[name][0]) for name in clocks)
        if end:
            # No more is to come; the motion is not known beyond positions and attitudes.
            last = float(self._attitude.time[-1] - values[self._attitude.clock.offset.name][0])
            return min(until - ahead, last, float(self._positions[-1])) + window.lag
        return until - DELAY + min(window.lag - ahead, 0.0)

    def _attitudes(self, since: float, until: float) -> AttitudeRecord:
        """Return the attitudes from well before a time, s, up to another."""
        time = self._attitude.time
        last = int(np.searchsorted(time, until, side="right"))
        first = min(int(np.searchsorted(time, since - 2.0 * WAVES)), max(last - _ATTITUDES, 0))
        rows = rows_of(self._attitude, slice(first, last))
        return AttitudeRecord(rows, self._trial.body_axes, estimated=False)

    def _first_node(self, time: Array) -> int:
        """Return the oldest node within the lag; two stay at least."""
        return min(int(np.searchsorted(time, time[-1] - self._lag)), time.size - 2)

    def _note_compared(self, o: Observation, which: BoolArray) -> None:
        """Take notice of measurements that have been compared with a prediction."""
        if which.any():
            last = float(o.time[which][-1])
            self._compared[o.label] = max(last, self._compared.get(o.label, last))

    def _trajectory(self, window: Window, node: int) -> Trajectory:
        """Return the motion up to a node that no update has carried."""
        found = window.motion(self._trajectory_to, node, self._trial.body_axes)
        self._trajectory_to = float(np.max(found.time, initial=self._trajectory_to))
        return found

    def _smooth(self, window: Window, node: int) -> Trajectory:
        """Return the smoothed motion up to a node that no update has carried."""
        found = window.motion(self._smoothed_to, node, self._trial.body_axes)
        self._smoothed_to = float(np.max(found.time, initial=self._smoothed_to))
        return found

    def _update(
        self,
        began: float,
        trajectory: Trajectory,
        smoothed: Sequence[Trajectory],
        found: Judged,
        *,
        solved: bool,
    ) -> Update:
        assert self._current is not None
        _, window = self._current
        problem, axes = window.problem, self._trial.body_axes
        now = window.now
        report = CalibrationReport(problem.all_parameters)
        undetermined = np.zeros((len(window.constants), 0))
        new = [i for i in found.innovations if i.time.size]
        findings = (*self.findings, *self._outages.findings(now, new), *found.findings)
        self.findings = []
        return Update(
            time=now,
            latency=perf_counter() - began,
            find_state=partial(window.newest, axes),
            find_trajectory=lambda: trajectory,
            find_calibration=lambda: report.at(
                window.values, np.empty(0), window.constants, undetermined
            ),
            smoothed=concatenated([*smoothed]),
            innovations=found.innovations,
            findings=findings,
            solved=solved,
            inconsistent=tuple(sorted(self._gate.inconsistent)),
        )


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


def _left_out(problem: Problem) -> dict[str, Array]:
    """Return the times of the measurements that a batch solution left out, by label."""
    out = dict(problem.rejected)
    for o in problem.observations:
        weight = problem.robust_weights.get(o.label)
        if weight is not None:
            none = o.time[np.all(weight == 0.0, axis=1)]
            out[o.label] = np.union1d(out.get(o.label, none), none)
    return out
