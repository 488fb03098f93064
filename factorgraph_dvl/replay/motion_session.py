"""Replay of a trial without IMU: batch solutions, and a window of nodes between them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from factorgraph_dvl.errors import ConfigError, FactorgraphDvlError
from factorgraph_dvl.geometry.records import concatenated
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.motion_chain import MotionChain, chain_nodes
from factorgraph_dvl.graph.motion_problem import TRACK_STD
from factorgraph_dvl.graph.trajectory import TRAJECTORY_RATE
from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.replay.calibration import CalibrationEstimate
from factorgraph_dvl.replay.motion_window import (
    Known,
    SmoothedWindow,
    WindowProblem,
    smooth_window,
)
from factorgraph_dvl.replay.update import Innovations, Update
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.message import message
from factorgraph_dvl.sensors.protocol import Observation
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.solution import Noise, Progress, Trajectory, white_noise
from factorgraph_dvl.solvers.motion_preparation import (
    TURN_SPAN,
    motion_observations,
    own_times,
    prepare_motion,
    turns,
    without_long_gaps,
)
from factorgraph_dvl.solvers.motion_smoother import SmoothedMotion, smooth_motion
from factorgraph_dvl.solvers.motion_summary import (
    reported_calibration,
    trajectory_epochs,
    trajectory_of,
)
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
# Attitudes before a window that its spline needs, s; chosen: some samples of any compass.
_ATTITUDES = 15.0
# Density of acceleration in turns, m²/s³, until the first one; chosen: that of ships.
_FIRST_TURNS = 1e-3
# Fewest nodes of a start, and times, s, that count as the same; chosen.
_FEWEST, _APART = 4, 1e-3


@dataclass(frozen=True)
class _Batch:
    """Batch solution of the records up to a time, s, and what the window takes from it."""

    found: SmoothedMotion
    start: float
    until: float
    interval: float
    on_legs: Array
    in_turns: Array

    @property
    def slope(self) -> Array:
        """Gain of the slope in a second."""
        return self.found.problem.slope / (self.until - self.start)

    def by_track(self, now: float) -> Array:
        """Return the derivative by the current's unknown share at a time, s."""
        if not self.found.by_track.any():
            return self.found.by_track
        whole = np.linalg.solve(self.found.factors.constants, self.found.by_track) / TRACK_STD
        return np.asarray(whole * (now - self.start) / (self.until - self.start))


class MotionReplay:
    """Replay of the records of a trial without IMU, of which only those up to a time are read.

    The noise of sensors and the strengths of motion and current come from batch solutions whenever
    the record has grown by half. Between these the newest nodes are smoothed within a lag, and
    what leaves it becomes the prior of the first node and the constants.

    Parameters
    ----------
    trial : Trial
        Without IMU.
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
        source = trial.position_sensor
        if trial.attitude is None or source is None:
            raise ConfigError(
                "nothing measures the attitude",
                where="trial.yaml",
                expected="an `imu`, `ins` or `attitude` section",
            )
        self._trial, self._lag, self._progress = trial, lag_s, progress
        self._attitude = trial.attitude
        self.findings: list[Finding] = []
        self._own = own_times(trial, source.time)
        self._labels = {
            aid.section: {
                o.label for o in motion_observations(aid, trial.frame(), trial.body_axes)
            }
            for aid in trial.aids
        }
        self._start = float(max(aid.time[0] for aid in trial.aids))
        self._solve_at = self._start + _FIRST
        self._current: tuple[_Batch, SmoothedWindow] | None = None
        # Number of rows of each sensor that are before the window.
        self._before: dict[str, int] = {}
        self._trajectory_to = self._smoothed_to = -np.inf
        self._residuals_to: dict[str, float] = {}
        self._rejected: Counter[str] = Counter()
        self._noted = set(trial.notes)

    @property
    def noise(self) -> tuple[Noise, ...]:
        """Noise of the sensors, as the last batch solution found it."""
        if self._current is None:
            return ()
        batch, _ = self._current
        return white_noise(batch.found.problem.noise_factors)

    def counts(self) -> list[Finding]:
        """Return how many measurements were not used, and why."""
        why = message("unused.contradicted")
        return [
            Finding(Code.UNUSED, message("unused.measurements", count=n, why=why), label)
            for label, n in self._rejected.items()
            if n
        ]

    def advance(self, until: float, *, end: bool = False) -> Iterator[Update]:
        """Read the records up to a time, s, and yield the updates that they make possible."""
        began = perf_counter()
        if until >= self._solve_at or (end and self._current is None):
            update = self._solve(until, began, end=end)
            if update is not None:
                yield update
                began = perf_counter()
        if self._current is None:
            return
        nodes = self._next_nodes(*self._current, until)
        if nodes.size:
            yield self._extend(*self._current, nodes, until, began)

    def finished(self, last: Update) -> Update:
        """Return the last update with what stays in the window when no more records come."""
        assert self._current is not None
        _, window = self._current
        smoothed, innovations = self._leave(window, window.problem.chain.time.size)
        if last.smoothed is not None:
            smoothed = concatenated([last.smoothed, smoothed])
        return replace(last, smoothed=smoothed, innovations=(*last.innovations, *innovations))

    def _solve(self, until: float, began: float, *, end: bool) -> Update | None:
        """Solve the records up to a time as a batch, and start a window at its end."""
        self._solve_at = self._start + _GROWTH * (until - self._start)
        try:
            prepared = prepare_motion(self._trial.until(until))
            found = smooth_motion(prepared, self._progress)
        except FactorgraphDvlError as error:
            self._solve_at = self._start + _RETRY * (until - self._start)
            if self._current is None:
                why = message("not_started.error", error=str(error))
                text = message("not_started.yet", time=until, reason=why)
                self.findings.append(Finding(Code.NOT_STARTED, text))
            return None
        if not (found.converged or end):
            return None
        whole = SmoothedWindow(found.problem, found.evaluation, found.covariances)
        chain, at = found.problem.chain, found.evaluation
        count = int(np.searchsorted(chain.time, _latest(whole, until)))
        if count < _FEWEST:
            return None
        legs, curves = (chain.density[each][:1] for each in (~prepared.turning, prepared.turning))
        batch = _Batch(
            found,
            self._start,
            until,
            prepared.interval,
            on_legs=(legs if legs.size else curves)[0],
            in_turns=curves[0] if curves.size else np.maximum(legs[0], _FIRST_TURNS),
        )
        self.findings += [f for f in found.findings if f not in self._noted]
        self._noted.update(found.findings)
        trajectory = self._trajectory(whole, count - 1)
        first = self._first_node(chain.time[:count])
        self._before = {}
        smoothed, innovations = self._leave(whole, first)
        nodes = slice(first, count)
        chain = replace(chain, time=chain.time[nodes], density=chain.density[nodes][:-1])
        known = whole.known_before(first)
        window = self._smooth(
            batch, known, chain, at.states[nodes], at.parameters, until, gained=0.0
        )
        self._current = batch, window
        return self._update(began, trajectory, smoothed, innovations, solved=True)

    def _extend(
        self,
        batch: _Batch,
        window: SmoothedWindow,
        nodes: Array,
        until: float,
        began: float,
    ) -> Update:
        """Add nodes to the window, and let the oldest leave it."""
        chain, at = window.problem.chain, window.evaluation
        first = self._first_node(np.append(chain.time, nodes))
        smoothed, innovations = self._leave(window, first)
        time = np.append(chain.time[first:], nodes)
        record = self._attitudes(batch, float(time[0]), until)
        turning = turns(record, 0.5 * (time[1:] + time[:-1]) + _attitude_lag(window))
        density = np.where(turning[:, None], batch.in_turns, batch.on_legs)
        states = [*at.states[first:]]
        for dt in np.diff(np.append(chain.time[-1], nodes)):
            states.append(_predicted(chain, states[-1], dt))
        known = window.known_before(first)
        gained = float(nodes[-1] - chain.time[-1])
        chain = replace(chain, time=time, density=density)
        window = self._smooth(
            batch, known, chain, np.array(states), at.parameters, until, gained=gained
        )
        self._current = batch, window
        trajectory = self._trajectory(window, time.size - 1)
        return self._update(began, trajectory, smoothed, innovations, solved=False)

    def _smooth(
        self,
        batch: _Batch,
        known: Known,
        chain: MotionChain,
        states: Array,
        values: dict[str, Array],
        until: float,
        *,
        gained: float,
    ) -> SmoothedWindow:
        """Return the window of a chain; its slope gains what so many seconds make."""
        whole = batch.found.problem
        observations: list[Observation] = []
        for aid in self._trial.aids:
            last = int(np.searchsorted(aid.time, until, side="right"))
            rows = rows_of(aid, slice(self._before.get(aid.section, 0), last))
            if rows.time.size:
                observations += motion_observations(rows, whole.frame, self._trial.body_axes)
        problem = WindowProblem(
            whole,
            known,
            chain,
            self._attitudes(batch, float(chain.time[0]), until),
            observations,
            states,
            gained * batch.slope,
        )
        return smooth_window(problem, states, values)

    def _next_nodes(self, batch: _Batch, window: SmoothedWindow, until: float) -> Array:
        """Return the times of the nodes that the records up to a time, s, allow."""
        last = window.problem.chain.time[-1]
        own = self._own[(self._own > last + _APART) & (self._own <= _latest(window, until))]
        if not own.size:
            return np.asarray(own)
        edges = without_long_gaps(np.append(last, own))
        turning = turns(self._attitudes(batch, last, until), edges + _attitude_lag(window))
        nodes = chain_nodes(edges, turning, batch.interval)
        if not turning[-1] and nodes[-1] - nodes[-2] < batch.interval:
            # It is there as the last one only.
            nodes = nodes[:-1]
        return nodes[1:]

    def _attitudes(self, batch: _Batch, since: float, until: float) -> AttitudeRecord:
        """Return the attitudes from well before a time, s, up to another."""
        record, time = batch.found.problem.attitude, self._attitude.time
        rows = (time >= since - max(_ATTITUDES, 10.0 * record.interval)) & (time <= until)
        return record.of_rows(rows_of(self._attitude, rows))

    def _first_node(self, time: Array) -> int:
        """Return the oldest node within the lag; two stay at least."""
        return min(int(np.searchsorted(time, time[-1] - self._lag)), time.size - 2)

    def _leave(
        self, window: SmoothedWindow, node: int
    ) -> tuple[Trajectory, tuple[Innovations, ...]]:
        """Return motion and residuals before a node, and count what was measured there as used."""
        problem = window.problem
        smoothed = _motion(window, self._smoothed_to, min(node, problem.chain.time.size - 1))
        self._smoothed_to = float(np.max(smoothed.time, initial=self._smoothed_to))
        innovations = []
        for o, seen, total in zip(
            problem.observations, window.evaluation.seen, problem.total_sigma, strict=True
        ):
            past = np.asarray(seen.interpolation.node < node)
            new = past & seen.covered & (o.time > self._residuals_to.get(o.label, -np.inf))
            used = np.isfinite(total)
            every = Innovations(
                o.label,
                o.unit,
                o.components,
                o.time[new],
                np.where(used, seen.residual, np.nan)[new],
                np.where(used, total, np.nan)[new],
                np.asarray(used.any(axis=1))[new],
            )
            innovations.append(every)
            rejected = problem.rejected.get(o.label)
            if rejected is not None:
                self._rejected[o.label] += int(np.sum(rejected & new))
            if past.any():
                last = float(o.time[past][-1])
                self._residuals_to[o.label] = max(last, self._residuals_to.get(o.label, last))
                for aid in self._trial.aids:
                    if o.label in self._labels[aid.section]:
                        row = int(np.searchsorted(aid.time, last, side="right"))
                        self._before[aid.section] = max(row, self._before.get(aid.section, 0))
        return smoothed, tuple(innovations)

    def _trajectory(self, window: SmoothedWindow, node: int) -> Trajectory:
        """Return the motion up to a node that no update has carried."""
        found = _motion(window, self._trajectory_to, node)
        self._trajectory_to = float(np.max(found.time, initial=self._trajectory_to))
        return found

    def _update(
        self,
        began: float,
        trajectory: Trajectory,
        smoothed: Trajectory,
        innovations: tuple[Innovations, ...],
        *,
        solved: bool,
    ) -> Update:
        assert self._current is not None
        batch, window = self._current
        problem, at = window.problem, window.evaluation
        now = float(problem.chain.time[-1]) - problem.offset(at.parameters)
        constants = window.covariances.constants
        by_track = TRACK_STD * constants @ batch.by_track(now)
        estimates, covariance, _ = reported_calibration(
            problem, at.parameters, constants + np.outer(by_track, by_track)
        )
        findings, self.findings = tuple(self.findings), []
        state = trajectory_of(problem, at, window.covariances, np.array([now]))
        return Update(
            time=now,
            latency=perf_counter() - began,
            find_state=lambda: state,
            find_trajectory=lambda: trajectory,
            find_calibration=lambda: CalibrationEstimate(estimates, covariance),
            smoothed=smoothed,
            innovations=innovations,
            findings=findings,
            solved=solved,
            inconsistent=window.inconsistent,
        )


def _latest(window: SmoothedWindow, until: float) -> float:
    """Return the time up to which all sensors have reported at a time, s, by the nodes' clock."""
    problem, values = window.problem, window.evaluation.parameters
    clocks = {o.clock.names[0] for o in problem.observations if o.clock is not None}
    clocks.add(problem.attitude.sensor.clock.names[0])
    ahead = max(float(values[name][0]) for name in clocks)
    return until - DELAY + min(problem.offset(values) - ahead, 0.0)


def _attitude_lag(window: SmoothedWindow) -> float:
    """Return the stamps of the attitude less the times of the nodes, s."""
    problem, values = window.problem, window.evaluation.parameters
    return float(values[problem.attitude.sensor.clock.names[0]][0]) - problem.offset(values)


def _predicted(chain: MotionChain, state: Array, dt: float) -> Array:
    """Return the state some seconds after another, as the prior has it."""
    out = state.copy()
    out[:3] += dt * state[3:6]
    for process in chain.processes:
        out[chain.place(process.name)] *= np.exp(-dt / process.tau)
    return out


def _motion(window: SmoothedWindow, since: float, node: int) -> Trajectory:
    """Return the motion after a true time, s, up to a node."""
    problem, at = window.problem, window.evaluation
    begin, end = problem.chain.time[[0, node]] - problem.offset(at.parameters)
    if begin < since + 2.0 * max(1.0 / TRAJECTORY_RATE, problem.attitude.interval):
        # The clock may have moved since the window before ended there: no epoch lies in between.
        begin = since
    time = trajectory_epochs(problem, at.parameters, begin, end, TRAJECTORY_RATE)
    return trajectory_of(problem, at, window.covariances, time[time > since + _APART])
