"""A replay in progress: measurements go in one at a time, estimates come out."""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from time import perf_counter
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.estimates import Noise, Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay.arrivals import (
    AHEAD,
    SAME_TIME,
    Clocks,
    Duplicates,
    Outages,
    PendingMeasurements,
)
from factorgraph_dvl.replay.gate import InnovationGate
from factorgraph_dvl.replay.history import InertialHistory
from factorgraph_dvl.replay.initializer import AnyNavigator, Initializer
from factorgraph_dvl.replay.navigator import Navigator
from factorgraph_dvl.replay.navigator_in_plane import NavigatorInPlane, StartInPlane
from factorgraph_dvl.replay.navigator_without_imu import DELAY, NavigatorWithoutImu
from factorgraph_dvl.replay.record import Update
from factorgraph_dvl.replay.record_navigator import RecordNavigator
from factorgraph_dvl.replay.samples import Gap, SampleBuffer
from factorgraph_dvl.replay.start import ReplayStart
from factorgraph_dvl.sensors.protocol import Aid, ClocksAid
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.state_times import CLOSEST
from factorgraph_dvl.trial import Trial

Kind = Literal["fixed-lag", "isam2"]
KINDS: tuple[Kind, ...] = ("fixed-lag", "isam2")
# Lag of the smoother, s, and states a second; chosen. Measured: with a lag of 30 s the end is
# within 0.1 standard deviations of a batch solution.
LAG = 30.0
RATE = 5.0
# Most updates a second without an IMU; chosen: states come with pings, and are behind them by
# seconds anyway.
_MOST_WITHOUT_IMU = 0.5


class Replay:
    """Smoother for a live feed: give it measurements as they arrive.

    An estimate for time t needs IMU samples up to t + `delay`, or records of a trial without IMU;
    it uses what else was measured up to t and has arrived by then. Later arrivals correct it as
    long as their time is within the lag.

    Parameters
    ----------
    settings : Trial
        Everything but its records counts: sensor settings, axes, priors.
    smoother : Kind, default 'fixed-lag'
        Smoother: `fixed-lag` or, with an IMU, `isam2`.
    lag_s : float, optional
        Age beyond which states are no longer corrected, s.
    rate_hz : float, optional
        States a second.
    progress : callable, optional
        Called with stage, iteration and cost while a batch solution runs.

    Raises
    ------
    ConfigError
        If an option is out of range.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> trial = fd.simulate("examples/short.yaml", seed=1)
    >>> replay = fd.Replay(trial)
    >>> replay.add(trial.gnss)
    >>> replay.add(trial.dvl)
    >>> imu = trial.imu
    >>> updates = replay.add_imu(imu.time[:1000], imu.gyro[:1000], imu.accel[:1000])
    >>> replay.started
    False
    """

    def __init__(
        self,
        settings: Trial,
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
        if settings.imu is None and smoother != "fixed-lag":
            raise ConfigError(
                f"smoother is {smoother!r}, which needs an IMU",
                expected="fixed-lag, without an IMU",
            )
        self._findings: list[Finding] = []
        self._settings = settings
        self._sections = tuple(aid.section for aid in settings.aids)
        self._kind = smoother
        self._lag = lag_s
        self._interval = 1.0 / rate_hz
        if settings.imu is None:
            self._interval = max(self._interval, 1.0 / _MOST_WITHOUT_IMU)
        self._samples = SampleBuffer(settings.imu.settings if settings.imu else None)
        # Time, s, up to which all has arrived of a trial without IMU.
        self._reached = -np.inf
        self._initializer = Initializer(
            settings, self._interval, progress or (lambda stage, iteration, cost: None)
        )
        self._navigator: AnyNavigator | None = None
        self._noise: tuple[Noise, ...] = ()
        self._gate = InnovationGate()
        self._pending = PendingMeasurements(settings.body_axes)
        self._duplicates = Duplicates()
        self._clocks = Clocks()
        self._outages = Outages()
        self._newest_state = -np.inf
        # End of the trajectory that updates have carried: a new batch solution corrects rounded
        # stamps, and its state may be some microseconds off.
        self._trajectory_to = -np.inf
        self._too_late: Counter[str] = Counter()
        self._deferred: Counter[str] = Counter()

    @property
    def delay(self) -> float:
        """Time by which estimates are behind the newest IMU sample, or the records, s."""
        if self._settings.planar:
            return 0.0
        return DELAY if self._settings.imu is None else self._samples.delay

    @property
    def interval(self) -> float:
        """Time between updates, s."""
        return self._interval

    @property
    def started(self) -> bool:
        """Whether there is an estimate."""
        return self._navigator is not None

    @property
    def settled(self) -> bool:
        """Whether the calibration is known well enough to go on without batch solutions."""
        return self._initializer.history is None

    @property
    def noise(self) -> tuple[Noise, ...]:
        """Noise of the sensors, as the last batch solution found it."""
        return self._noise

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings that no update has carried yet."""
        return (*self._findings, *self._initializer.findings)

    @property
    def unused(self) -> int:
        """Number of the IMU's samples after the newest state."""
        return self._samples.since(self._newest_state + 0.5 * self._samples.dt).shape[0]

    def counts(self) -> list[Finding]:
        """Return how many measurements were not used, and why."""
        reasons = (
            (self._too_late, message("unused.too_late", lag=self._lag)),
            (self._deferred, message("unused.deferred")),
            (self._duplicates.rejected, message("unused.twice")),
            (self._pending.rejected, message("unused.ahead", ahead=AHEAD)),
            (self._gate.rejected, message("unused.contradicted")),
        )
        out = [
            Finding(Code.UNUSED, message("unused.measurements", count=n, why=why), label)
            for counts, why in reasons
            for label, n in counts.items()
            if n
        ]
        if self._samples.rejected:
            text = message("unused.out_of_order", count=self._samples.rejected)
            out.append(Finding(Code.UNUSED, text, "IMU"))
        if self._samples.interpolated:
            n = self._samples.interpolated
            text = message("lost_samples.after_start", count=n)
            out.append(Finding(Code.LOST_SAMPLES, text, "IMU"))
        return out

    def add_imu(self, time: ArrayLike, gyro: ArrayLike, accel: ArrayLike) -> list[Update]:
        """Add one IMU sample, or some, and return the updates that they make possible.

        Parameters
        ----------
        time : array_like, shape () or (N,), s
            Times of the samples.
        gyro : array_like, shape (3,) or (N, 3), rad/s
            Angular rate in body axes.
        accel : array_like, shape (3,) or (N, 3), m/s²
            Specific force in body axes.

        Raises
        ------
        ConfigError
            If the trial has no IMU.
        """
        time = np.atleast_1d(np.asarray(time, dtype=float)) + self._clocks.imu
        table = np.column_stack([time, np.reshape(gyro, (-1, 3)), np.reshape(accel, (-1, 3))])
        used, jump = self._samples.add(table)
        if jump:
            self._clocks.jumped_back(jump)
            self._findings.append(
                Finding(
                    Code.CLOCK_JUMP,
                    message("clock_jump.back", jump=jump, time=self._samples.newest),
                    "IMU",
                )
            )
        if isinstance(self._initializer.history, InertialHistory):
            self._initializer.history.add_samples(used)
        return list(self._advance(end=False))

    def advance(self, time: float) -> list[Update]:
        """Say that all that was measured without an IMU up to a time, s, has arrived.

        Returns
        -------
        list of Update
            The updates that this makes possible.
        """
        self._reached = time
        for section in self._pending.sections:
            self._due(section, time + 2.0 * SAME_TIME)
        return list(self._advance(end=False))

    def add(self, record: Aid) -> None:
        """Add one measurement of another sensor, or some.

        Parameters
        ----------
        record : Aid
            Record of a `Gnss`, `Dvl`, ...; one row or more.

        Raises
        ------
        ConfigError
            If the trial does not have such a sensor.
        """
        if record.section not in self._sections:
            raise ConfigError(
                f"the trial has no sensor {record.section}", expected=", ".join(self._sections)
            )
        record = self._duplicates.without(record)
        if record.time.size:
            self._pending.add(self._clocks.corrected(record), self._samples.newest)

    def finish(self) -> list[Update]:
        """Return the updates that the last samples allow, without waiting for more."""
        out = list(self._advance(end=True))
        nav = self._navigator
        rest = None if nav is None else nav.smoothed(self._settings.body_axes, rest=True)
        if nav is not None and rest is not None:
            if not out:
                nothing = nav.last_segment(self._settings.body_axes, nav.time)
                out = [self._update(nav, perf_counter(), nothing, solved=False, end=True)]
            out[-1] = replace(out[-1], smoothed=rest)
        return out

    def _advance(self, *, end: bool) -> Iterator[Update]:
        while True:
            began = perf_counter()
            nav = self._navigator
            if nav is None:
                until = self._attempt_due(end=end)
                if until is None:
                    return
                nav = self._start(until)
                if nav is not None:
                    motion = nav.first_motion
                    self._trajectory_to = float(np.max(motion.time, initial=nav.time))
                    yield self._update(nav, began, _constantly(motion), solved=True, end=end)
                elif end and until >= self._arrived:
                    return
                continue
            last = None
            if end and self._settings.imu is None and self._initializer.knew_less(self._reached):
                # Where states are behind the records, they go on from this solution to the end.
                last = self._solve_again(nav)
                nav = last or nav
            extended = self._extend(nav, end=end)
            if isinstance(extended, Gap):
                self._restart(nav, extended)
                continue
            if not extended and last is None:
                return
            if self._initializer.history is not None:
                for i in nav.innovations:
                    self._initializer.history.reject(i.label, i.time[~i.used])
            trajectory = nav.last_segment(self._settings.body_axes, self._trajectory_to)
            self._trajectory_to = nav.time
            # What has not settled by the end is solved once more.
            due = self._initializer.solve_due(nav, self._known_to(nav)) or (
                end and not self.settled and self._is_last(nav.time)
            )
            again = self._solve_again(nav) if due else None
            known, solved = (nav, last is not None) if again is None else (again, True)
            yield self._update(known, began, trajectory, solved=solved, end=end)

    @property
    def _arrived(self) -> float:
        """Time, s, up to which records can be solved."""
        if self._settings.imu is None:
            return self._reached
        return self._samples.newest - self.delay if self._samples.dt else -np.inf

    def _known_to(self, nav: AnyNavigator) -> float:
        """Return the time, s, up to which the history has what a navigator was given."""
        return nav.time if isinstance(nav, Navigator) else self._reached

    def _is_last(self, time: float) -> bool:
        """Whether a state at a time, s, is at the last sample of the IMU."""
        return self._settings.imu is not None and (
            time > self._samples.newest - 0.5 * self._samples.dt
        )

    def _extend(self, nav: AnyNavigator, *, end: bool) -> bool | Gap:
        """Extend a navigator; return whether what has arrived does, or the gap that follows."""
        if isinstance(nav, RecordNavigator):
            assert self._initializer.history is not None
            return nav.advance(self._initializer.history, self._reached, end=end)
        wanted = self._next_own_state(nav)
        seg = self._samples.segment_after(nav.time, self._interval, wanted, end=end)
        if seg is None or isinstance(seg, Gap):
            return seg or False
        until = float(seg.node_time[1])
        if end and self._is_last(until):
            # No segment follows that what was measured right now would belong to.
            until += 2.0 * SAME_TIME
        nav.extend(seg, self._take(nav, until))
        self._samples.forget(nav.time)
        return True

    def _next_own_state(self, nav: Navigator) -> float:
        """Return the time of the next attitude that needs a state of its own, s."""
        after = nav.time + CLOSEST
        times = (self._pending.first_after(s, after) for s in nav.start.own_states)
        return min(times, default=np.inf)

    def _restart(self, nav: AnyNavigator, gap: Gap) -> None:
        """End the inertial chain at a gap of the IMU."""
        assert isinstance(nav, Navigator)
        self._initializer.restart(gap, nav, self._samples.since(gap.after))
        self._outages.reset()
        self._samples.forget(gap.after)
        self._navigator = None

    def _attempt_due(self, *, end: bool) -> float | None:
        """Return the time up to which a start is to be attempted now, None if it is too early."""
        if self._initializer.history is None or not np.isfinite(self._arrived):
            return None
        return self._initializer.attempt_due(self._arrived, end=end)

    def _start(self, until: float) -> AnyNavigator | None:
        """Solve the records up to a time, and start from there if that succeeds."""
        for section in self._pending.sections:
            self._due(section, until)
        self._samples.forget(until)
        return self._solve(until)

    def _solve(self, until: float) -> AnyNavigator | None:
        """Replace the navigator by one from a batch solution; return it, None on failure."""
        start, jump = self._initializer.solve(
            until, self._samples.dt, self._trajectory_to, self._navigator
        )
        if jump is not None:
            assert isinstance(self._initializer.history, InertialHistory)
            self._samples.shift(jump.since, -jump.by)
            self._clocks.jumped_ahead(jump.by)
            for record in self._initializer.history.remove_after(until - jump.by):
                self._pending.add(record)
        if start is None:
            return None
        self._deferred.clear()
        self._noise = start.noise
        if isinstance(start, ReplayStart):
            kept = self._lag if self._kind == "fixed-lag" else None
            self._navigator = Navigator(start, self._gate, lag=kept, memory=self._lag)
            self._samples.smoothing, self._samples.longest = start.smoothing, start.longest
        else:
            before, lag = self._navigator, self._lag
            assert not isinstance(before, Navigator)
            if isinstance(start, StartInPlane):
                self._navigator = NavigatorInPlane(
                    start, self._gate, interval=self._interval, lag=lag, before=before
                )
            else:
                self._navigator = NavigatorWithoutImu(start, self._gate, lag=lag, before=before)
        # What is there now stays: to look for cycles in it again takes 5 ms of some updates.
        gc.collect()
        gc.freeze()
        return self._navigator

    def _solve_again(self, before: AnyNavigator) -> AnyNavigator | None:
        """Replace a navigator that runs by one from a new batch solution; None on failure."""
        after = self._solve(self._known_to(before))
        if after is not None:
            self._initializer.release_if_settled(before, after)
            after.innovations, after.findings = before.innovations, before.findings
        return after

    def _take(self, nav: Navigator, end: float) -> list[Aid]:
        """Return measurements true after the newest state and before `end`; late ones correct."""
        out = []
        late: dict[int, list[Aid]] = {}
        for section in self._pending.sections:
            found = self._due(section, end)
            if found is None:
                continue
            if section not in nav.start.sections:
                # Its parameters are not in the graph yet.
                self._initializer.solve_by(end)
                continue
            for record, true in self._by_clock(nav, *found):
                now = true >= nav.time - SAME_TIME
                if now.all():
                    out.append(record)
                    continue
                if now.any():
                    out.append(rows_of(record, now))
                for i in np.flatnonzero(~now).tolist():
                    row = rows_of(record, np.array([i]))
                    k = nav.node_before(float(true[i]))
                    if k is not None:
                        late.setdefault(k, []).append(row)
                    else:
                        self._count_late(nav, row)
        if late:
            nav.correct(late)
        return out

    def _by_clock(self, nav: Navigator, record: Aid, true: Array) -> Iterator[tuple[Aid, Array]]:
        """Yield what was measured by each clock of a sensor, and its true times."""
        parts = record.of_one_clock() if isinstance(record, ClocksAid) else (record,)
        if parts[0] is record:
            yield record, true
            return
        for part in parts:
            (observed,) = part.observations(nav.start.frame, nav.start.body_axes)
            assert observed.clock is not None
            lag = observed.clock.lag(part.time, nav.values, nav.start.clock_zero)
            yield part, np.asarray(part.time - lag)

    def _count_late(self, nav: Navigator, row: Aid) -> None:
        """Count a measurement that is older than all states that can be corrected."""
        if self._initializer.history is None:
            self._too_late[row.label] += 1
            return
        self._deferred[row.label] += 1
        for o in row.observations(nav.start.frame, nav.start.body_axes):
            if o.label in self._gate.excluded:
                self._initializer.history.reject(o.label, o.time)

    def _due(self, section: str, end: float) -> tuple[Aid, Array] | None:
        """Return what is pending of a sensor and was true before a time, and its true times."""
        nav = self._navigator
        frame, values, clock_zero = None, {}, 0.0
        # Before its first measurement a sensor's clock offset is not known.
        if isinstance(nav, Navigator) and section in nav.start.sections:
            frame, values, clock_zero = nav.start.frame, nav.values, nav.start.clock_zero
        found = self._pending.due(section, end, frame, values, clock_zero)
        if found is None or not self._measures(found[0]):
            return None
        if self._initializer.history is not None:
            self._initializer.history.add_aid(found[0])
        return found

    def _measures(self, record: Aid) -> bool:
        """Whether a record contains any measurement.

        A sensor that only says that it cannot measure has not reported: its parameters must not
        be linearised at their priors.
        """
        if not record.missing.all():
            return True
        anywhere = LocalFrame(0.0, 0.0, 0.0, self._settings.epoch)
        return bool(record.observations(anywhere, self._settings.body_axes))

    def _update(
        self,
        nav: AnyNavigator,
        began: float,
        trajectory: Callable[[], Trajectory],
        *,
        solved: bool,
        end: bool,
    ) -> Update:
        """Return what is known now; `trajectory` since the update before."""
        self._newest_state = nav.time
        findings = (
            *self.findings,
            *self._outages.findings(nav.time, nav.innovations),
            *nav.findings,
        )
        innovations = tuple(nav.innovations)
        for taken in (self._findings, self._initializer.findings, nav.findings, nav.innovations):
            taken.clear()
        return Update(
            time=nav.time,
            latency=perf_counter() - began,
            find_state=nav.newest(self._settings.body_axes),
            find_trajectory=trajectory,
            find_calibration=nav.find_calibration(),
            smoothed=None if end else nav.smoothed(self._settings.body_axes),
            innovations=innovations,
            findings=findings,
            solved=solved,
            inconsistent=tuple(sorted(self._gate.inconsistent)),
        )


def _constantly(trajectory: Trajectory) -> Callable[[], Trajectory]:
    """Return what returns a trajectory."""
    return lambda: trajectory
