"""A replay in progress: measurements go in one at a time, estimates come out."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from factorgraph_dvl.errors import ConfigError, DataError, FactorgraphDvlError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.priors import ConstantsPrior
from factorgraph_dvl.replay.clocks import Clocks
from factorgraph_dvl.replay.collected import Collected
from factorgraph_dvl.replay.estimate import Update
from factorgraph_dvl.replay.gate import Gate
from factorgraph_dvl.replay.navigator import Navigator
from factorgraph_dvl.replay.repeats import Repeats
from factorgraph_dvl.replay.samples import Gap, SampleBuffer
from factorgraph_dvl.replay.silence import Silence
from factorgraph_dvl.replay.start import ReplayStart, begin
from factorgraph_dvl.replay.waiting import AHEAD, SAME_TIME, Waiting
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.solution import Progress, Trajectory
from factorgraph_dvl.solvers.state_times import CLOSEST
from factorgraph_dvl.trial import InitialPosition, Trial

Kind = Literal["fixed-lag", "isam2"]
KINDS: tuple[Kind, ...] = ("fixed-lag", "isam2")
LAG = 30.0
RATE = 5.0

# Data before the first attempt to start, s, and the growth of the time until the next one.
_FIRST = 30.0
_GROWTH = 1.5
_RETRY = 1.2
# The same after a gap of the IMU.
_AFTER_GAP = 10.0
# Misfit of what was collected since a gap, from which on the IMU's clock may have jumped.
_MISFIT = 1.5
# How a vessel may move in it: acceleration, m/s², and sway, m.
_ACCELERATION = 1.0
_SWAY = 0.5
# Data that are kept for a start, s.
_LONGEST = 1800.0
# Agreement with a batch solution, in its standard deviations, and standard deviation of
# rotations, rad, with which linearising once is enough.
_AGREES = 0.1
_SETTLED_ROTATION = np.radians(0.2)
# A parameter that has moved so far since it was linearised, rad.
_MOVED = 0.01
_LEAST_BETWEEN = 10.0


class Replay:
    """Smoother for a live feed: give it measurements as they arrive.

    An estimate for time t needs IMU samples up to t + `delay`; it uses what else was
    measured up to t and has arrived by then. Later arrivals correct it as long as their
    time is within the lag.

    Parameters
    ----------
    known : Trial
        Trial of which everything but the records counts: settings, axes, priors.
    smoother : Kind, default 'fixed-lag'
        `fixed-lag` or `isam2`.
    lag_s : float, optional
        States older than this are no longer corrected.
    rate_hz : float, optional
        States a second.
    progress : callable, optional
        Called with stage, iteration and cost while a start is solved.
    """

    def __init__(
        self,
        known: Trial,
        *,
        smoother: Kind = "fixed-lag",
        lag_s: float = LAG,
        rate_hz: float = RATE,
        progress: Progress | None = None,
    ) -> None:
        if smoother not in KINDS:
            raise ConfigError(f"smoother is {smoother!r}", expected=f"one of {', '.join(KINDS)}")
        for name, value in (("lag_s", lag_s), ("rate_hz", rate_hz)):
            if not (np.isfinite(value) and value > 0.0):
                raise ConfigError(f"{name} is {value}", expected="a number above 0")
        self._known = known
        self._kind = smoother
        self._lag = lag_s
        self._interval = 1.0 / rate_hz
        self._progress = progress or (lambda stage, iteration, cost: None)
        self._samples = SampleBuffer(known.imu.settings)
        self._collected: Collected | None = Collected(known, _LONGEST)
        self._gate = Gate()
        self._navigator: Navigator | None = None
        self._waiting = Waiting()
        self._repeats = Repeats()
        self._clocks = Clocks()
        self._silence = Silence()
        self._gap: Gap | None = None
        self._usual_misfit = 1.0
        self._attempt = np.nan
        self._prior: ConstantsPrior | None = None
        self._solved_at = np.nan
        self._solve_again = np.nan
        self._smoothed_to = 0
        self._messages: list[str] = []
        self._why_not = ""
        # Notes that the user has seen.
        self._noted = set(known.notes)
        self._newest_state = -np.inf
        self._too_late: dict[str, int] = {}
        self._deferred: dict[str, int] = {}

    @property
    def delay(self) -> float:
        """Time by which estimates are behind the newest IMU sample, s."""
        return self._samples.delay

    @property
    def started(self) -> bool:
        """Whether there is an estimate."""
        return self._navigator is not None

    @property
    def settled(self) -> bool:
        """Whether linearising once is enough from now on."""
        return self._collected is None

    @property
    def messages(self) -> tuple[str, ...]:
        """Messages that no update has carried yet."""
        return tuple(self._messages)

    @property
    def unused(self) -> int:
        """Number of the IMU's samples after the newest state."""
        return self._samples.since(self._newest_state + 0.5 * self._samples.dt).shape[0]

    def counts(self) -> list[str]:
        """Say how many measurements were not used, and why."""
        why = (
            (
                self._too_late,
                f"came too late: what they belong to had left the lag of {self._lag:g} s, or was "
                "older than the last solution of all data",
            ),
            (self._deferred, "came late, and would have been part of the next solution"),
            (self._repeats.refused, "came twice"),
            (self._waiting.refused, f"were more than {AHEAD:g} s ahead of the IMU"),
            (self._gate.refused, "contradicted the prediction"),
        )
        out = [
            f"{k}: {n} measurements {text}" for found, text in why for k, n in found.items() if n
        ]
        if self._samples.refused:
            out.append(f"IMU: {self._samples.refused} samples were out of order or not numbers")
        if self._samples.interpolated:
            out.append(
                f"IMU: {self._samples.interpolated} samples that were lost after the start were "
                "interpolated"
            )
        return out

    def add_imu(self, time: ArrayLike, gyro: ArrayLike, accel: ArrayLike) -> list[Update]:
        """Take one IMU sample, or some, and return the updates that they make possible.

        Parameters
        ----------
        time : array_like
            () or (N,) s.
        gyro, accel : array_like
            (3,) or (N, 3) angular rate, rad/s, and specific force, m/s², in body.
        """
        table = np.column_stack(
            [
                np.atleast_1d(np.asarray(time, dtype=float)) + self._clocks.imu,
                np.reshape(gyro, (-1, 3)),
                np.reshape(accel, (-1, 3)),
            ]
        )
        used, jump = self._samples.add(table)
        if jump:
            self._clocks.jumped_back(jump)
            self._messages.append(
                f"the clock of the IMU jumped back by {jump:.3f} s at {self._samples.newest:.3f} "
                "s: what follows is moved by that"
            )
        if self._collected is not None:
            self._collected.add_samples(used)
        return self._advance(end=False)

    def add(self, record: Aid) -> None:
        """Take one measurement of another sensor, or some.

        Parameters
        ----------
        record : Aid
            Of a `Gnss`, `Dvl`, ...; one row or more.

        Raises
        ------
        ConfigError
            If the trial does not have such a sensor.
        """
        sections = [aid.section for aid in self._known.aids]
        if record.section not in sections:
            raise ConfigError(
                f"the trial has no sensor {record.section}", expected=", ".join(sections)
            )
        record = self._repeats.without(record)
        if record.time.size:
            self._waiting.add(self._clocks.on_time(record), self._samples.newest)

    def finish(self) -> list[Update]:
        """Return the updates that the last samples allow, without waiting for more."""
        return self._advance(end=True)

    def _advance(self, *, end: bool) -> list[Update]:
        out = []
        while True:
            began = perf_counter()
            if self._navigator is None:
                before = self._attempt
                if not self._start(end=end):
                    arrived = self._samples.newest - self._samples.delay
                    if self._attempt != before and arrived >= self._attempt:
                        continue
                    break
                out.append(self._update(began, None, True, end=end))
                continue
            now = self._navigator.time
            seg = self._samples.segment_after(now, self._interval, self._wanted(now), end=end)
            if seg is None:
                break
            if isinstance(seg, Gap):
                self._break(seg)
                continue
            until = float(seg.node_time[1])
            if end and until > self._samples.newest - 0.5 * self._samples.dt:
                # No segment follows that what was measured right now would belong to.
                until += 2.0 * SAME_TIME
            aids = self._take(now, until)
            self._navigator.extend(seg, aids)
            if self._collected is not None:
                for i in self._navigator.innovations:
                    self._collected.refuse(i.label, i.time[~i.used])
            self._samples.forget(self._navigator.time)
            passed = self._navigator.passed(self._known.body_axes)
            out.append(self._update(began, passed, self._again(), end=end))
        if end and out and self._navigator is not None:
            out[-1] = replace(out[-1], smoothed=self._smooth(-1.0))
        return out

    def _break(self, gap: Gap) -> None:
        """End the chain at a gap of the IMU, and collect anew."""
        nav = self._navigator
        assert nav is not None
        length = gap.after - gap.before
        self._messages.append(
            f"gap of {length:.2f} s in the IMU at {gap.before:.2f} s: the attitude is found anew"
        )
        if self._collected is None:
            state = nav.filtered(self._known.body_axes)
            speed = float(np.linalg.norm(state.velocity[0]))
            reach = speed * length + 0.5 * _ACCELERATION * length**2 + _SWAY
            self._prior = nav.known(length)
            here = InitialPosition(state.geodetic[0], np.hypot(state.position_std[0], reach))
            self._known = replace(self._known, initial_attitude=None, initial_position=here)
            self._collected = Collected(self._known, _LONGEST, length + 1.0, nav.start.sections)
            self._collected.add_samples(self._samples.since(gap.after))
        self._gap = gap
        self._attempt = gap.after + _AFTER_GAP
        self._silence.forget()
        self._samples.forget(gap.after)
        self._navigator = None

    def _wanted(self, now: float) -> float:
        """Return the time of the next attitude that needs a state of its own, s."""
        assert self._navigator is not None
        after = now + CLOSEST
        wanted = (self._waiting.first_after(s, after) for s in self._navigator.start.own_states)
        return min(wanted, default=np.inf)

    def _start(self, *, end: bool) -> bool:
        """Solve what was collected, if it is time to; return whether there is a start."""
        assert self._collected is not None
        if self._collected.empty or self._samples.dt == 0.0:
            return False
        until = self._samples.newest - self._samples.delay
        if until < self._collected.start:
            return False
        if np.isnan(self._attempt):
            self._attempt = self._collected.start + _FIRST
        elif self._attempt <= self._collected.start:
            self._messages.append(
                f"what the IMU recorded before {self._collected.start:.3f} s is not used: before "
                f"there was a start its clock jumped, or it was silent for over {_LONGEST:g} s"
            )
            self._attempt = self._collected.start + _FIRST
        if until >= self._attempt:
            # However many samples came at once.
            until = self._attempt
        elif not end:
            return False
        since = until - self._collected.start
        self._attempt = until + max((_RETRY - 1.0) * since, 1.0)
        for section in self._waiting.sections:
            self._due(section, until)
        self._samples.forget(until)
        return self._solve(until)

    def _solve(self, until: float) -> bool:
        assert self._collected is not None
        start = self._begin(until)
        if self._navigator is not None and self._contradicts(start):
            start = self._without_refused(until, start)
        if self._gap is not None and self._contradicts(start):
            # Either there was a gap, or the IMU went on and its clock jumped.
            gap, by = self._gap, self._gap.after - self._gap.before - self._samples.dt
            self._collected.set_back(gap.after, by)
            other = self._begin(until - by)
            if self._contradicts(other):
                self._collected.set_back(gap.before + 0.5 * self._samples.dt, -by)
                why = start if isinstance(start, str) else f"misfit of {start.misfit:.1f}"
                start = f"after the gap IMU and other sensors contradict each other ({why})"
            else:
                start, until = other, until - by
                self._samples.set_back(gap.after, by)
                self._clocks.jumped_ahead(by)
                self._messages.append(
                    f"there was no gap in the IMU at {gap.before:.2f} s: its clock jumped ahead "
                    f"by {by:.2f} s; what follows is moved by that"
                )
                for record in self._collected.give_back(until):
                    self._waiting.add(record)
        self._solved_at = until
        if isinstance(start, str):
            if self._navigator is not None:
                return False
            if start != self._why_not:
                self._messages.append(f"no start yet at {until:.1f} s: {start}")
            self._why_not = start
            return False
        self._why_not = ""
        self._deferred.clear()
        self._gap = None
        self._usual_misfit = max(1.0, start.misfit)
        lag = self._lag if self._kind == "fixed-lag" else None
        self._navigator = Navigator(start, self._known.imu, self._gate, lag=lag, memory=self._lag)
        self._samples.windows = start.windows
        self._solve_again = self._collected.start + _GROWTH * (until - self._collected.start)
        self._smoothed_to = start.node
        self._messages += [note for note in start.notes if note not in self._noted]
        self._noted.update(start.notes)
        return True

    def _without_refused(self, until: float, start: ReplayStart | str) -> ReplayStart | str:
        """Return a better start without what the smoother did not believe, if there is one."""
        assert self._navigator is not None
        assert self._collected is not None
        every = self._collected
        fewer = every.without_refused(self._navigator.start.frame)
        if fewer is None:
            return start
        self._collected = fewer
        other = self._begin(until)
        if isinstance(other, str) or (not isinstance(start, str) and other.misfit >= start.misfit):
            self._collected = every
            return start
        return other

    def _begin(self, until: float) -> ReplayStart | str:
        assert self._collected is not None
        trial = self._collected.trial(until)
        try:
            trial.frame()
        except DataError:
            return "no position has been measured since" if self._gap else "no position yet"
        try:
            since = np.inf if self._navigator is not None else self._newest_state
            return begin(trial, self._prior, self._interval, since, self._progress)
        except FactorgraphDvlError as error:
            return str(error)

    def _contradicts(self, start: ReplayStart | str) -> bool:
        """Whether there is no start, or one whose residuals are larger than they were."""
        return isinstance(start, str) or start.misfit > _MISFIT * self._usual_misfit

    def _again(self) -> bool:
        """Solve all that was collected once more, while that still makes a difference."""
        if self._collected is None:
            return False
        assert self._navigator is not None
        now = self._navigator.time
        if now < self._solve_again and not self._moved(now):
            return False
        before = self._navigator
        if not self._solve(now):
            self._solve_again = self._collected.start + _GROWTH * (now - self._collected.start)
            return False
        self._settle(before, self._navigator)
        self._navigator.innovations = before.innovations
        self._navigator.messages = before.messages
        return True

    def _moved(self, now: float) -> bool:
        """Whether a rotation has left where it was linearised."""
        assert self._navigator is not None
        return now > self._solved_at + _LEAST_BETWEEN and self._navigator.turned > _MOVED

    def _settle(self, before: Navigator, after: Navigator) -> None:
        """Let what was collected go if the smoother found the same as the batch solution."""
        assert self._collected is not None
        if not self._collected.complete or before.start.sections != after.start.sections:
            return
        old, new = before.calibration(), after.calibration()
        std = np.sqrt(np.diag(new.covariance))
        free = std > 0.0
        moved = np.concatenate(
            [a.value - b.value for a, b in zip(old.estimates, new.estimates, strict=True)]
        )
        agrees = bool(np.all(np.abs(moved[free]) < _AGREES * std[free]))
        sure = all(
            np.all(np.diag(after.covariance_of(p)) < _SETTLED_ROTATION**2)
            for p in after.start.parameters
            if p.rotation
        )
        if agrees and sure and not after.held.size:
            self._collected = None

    def _take(self, start: float, end: float) -> list[Aid]:
        """Return measurements true from `start` to before `end`; late ones correct."""
        assert self._navigator is not None
        out = []
        late: dict[int, list[Aid]] = {}
        for section in self._waiting.sections:
            found = self._due(section, end)
            if found is None:
                continue
            record, true = found
            if section not in self._navigator.start.sections:
                # It brings parameters that are not in the graph yet.
                self._solve_again = min(self._solve_again, end + _LEAST_BETWEEN)
                continue
            now = true >= start - SAME_TIME
            if now.all():
                out.append(record)
                continue
            if now.any():
                out.append(rows_of(record, now))
            for i in np.flatnonzero(~now).tolist():
                k = self._navigator.node_before(float(true[i]))
                one = rows_of(record, np.array([i]))
                if k is not None:
                    late.setdefault(k, []).append(one)
                elif self._collected is None:
                    self._too_late[record.label] = self._too_late.get(record.label, 0) + 1
                else:
                    # The next solution has it, unless the sensor is not believed.
                    self._deferred[record.label] = self._deferred.get(record.label, 0) + 1
                    for o in one.observations(self._navigator.start.frame):
                        if o.label in self._gate.shut:
                            self._collected.refuse(o.label, o.time)
        if late:
            self._navigator.correct(late)
        return out

    def _due(self, section: str, end: float) -> tuple[Aid, Array] | None:
        """Take what was true before a time out of what waits of a sensor; true times too."""
        nav = self._navigator
        frame, values = None, {}
        # Of a sensor that was not heard before the start nothing is known yet.
        if nav is not None and section in nav.start.sections:
            frame, values = nav.start.frame, nav.values
        found = self._waiting.due(section, end, frame, values)
        if found is None or not self._measures(found[0]):
            return None
        if self._collected is not None:
            self._collected.add_aid(found[0])
        return found

    def _measures(self, record: Aid) -> bool:
        """Whether anything is in a record.

        A sensor that only says that it cannot measure has not been heard: what it calibrates
        must not be linearised at its prior.
        """
        anywhere = LocalFrame(0.0, 0.0, 0.0, self._known.epoch)
        return not record.missing.all() or bool(record.observations(anywhere))

    def _update(
        self, began: float, passed: Trajectory | None, solved: bool, *, end: bool
    ) -> Update:
        """Return what is known now; `passed` since the update before, None = at a start."""
        nav = self._navigator
        assert nav is not None
        axes = self._known.body_axes
        smoothed = None
        s = nav.smoother
        self._newest_state = nav.time
        late = s.times.get(self._smoothed_to)
        if late is not None and not end and nav.time - late > self._lag - 2.0 * self._interval:
            smoothed = self._smooth(0.5 * self._lag)
        self._messages += self._silence.listen(nav.time, nav.innovations)
        messages = (*self._messages, *nav.messages)
        innovations = tuple(nav.innovations)
        self._messages, nav.messages, nav.innovations = [], [], []
        state, calibration = nav.filtered(axes), nav.calibration()
        return Update(
            time=nav.time,
            latency=perf_counter() - began,
            state=state,
            trajectory=nav.start.trajectory if passed is None else passed,
            calibration=calibration,
            smoothed=smoothed,
            innovations=innovations,
            messages=messages,
            solved=solved,
            doubted=tuple(sorted(self._gate.doubted)),
        )

    def _smooth(self, age: float) -> Trajectory | None:
        """Return the motion before an age, s, that was not returned before."""
        nav = self._navigator
        assert nav is not None
        s = nav.smoother
        last = next((k for k, t in s.times.items() if t > nav.time - age), s.node + 1) - 1
        if last <= self._smoothed_to:
            return None
        out = nav.smoothed(self._smoothed_to, last, self._known.body_axes)
        self._smoothed_to = last
        return out
