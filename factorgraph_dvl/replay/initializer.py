"""Batch solutions of the records so far, from which the smoother starts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.errors import DataError, FactorgraphDvlError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.priors import ConstantsPrior
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay.history import InertialHistory, RecordHistory
from factorgraph_dvl.replay.navigator import Navigator
from factorgraph_dvl.replay.navigator_in_plane import StartInPlane, solve_start_in_plane
from factorgraph_dvl.replay.navigator_without_imu import StartWithoutImu, solve_start_without_imu
from factorgraph_dvl.replay.record_navigator import RecordNavigator
from factorgraph_dvl.replay.samples import Gap
from factorgraph_dvl.replay.start import ReplayStart, solve_start
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.trial import InitialPosition, Trial

# Data before the first attempt to start, s; chosen: in-motion alignment needs some turns or sway,
# and without IMU some legs show the noise of fixes and pings.
_FIRST, _FIRST_WITHOUT_IMU = 30.0, 60.0
# The same after a gap of the IMU, s; chosen: biases and calibration are known by then.
_AFTER_GAP = 10.0
# Growth of the time since the start until the next attempt, and until the next batch solution of a
# smoother that runs; chosen: the cost of all solutions stays a small multiple of the last.
_RETRY = 1.2
_GROWTH = 1.5
# Shortest time between two attempts, and between two solutions of a smoother that runs, s; chosen.
_RETRY_AFTER = 1.0
_SOLVE_AFTER = 10.0
# Ratio of the largest RMS normalised residual to what it was before a gap of the IMU, from which
# on the IMU's clock may have jumped; chosen: noise changes it by a few percent.
_MISFIT = 1.5
# Motion of a vessel during a gap: acceleration, m/s², and sway, m; chosen, generous for ships.
_ACCELERATION = 1.0
_SWAY = 0.5
# Span of data that is kept for a start, s; chosen: 30 minutes at 100 Hz are 10 MB.
_LONGEST = 1800.0
# Change of a rotation since it was linearised that asks for a new batch solution, rad; chosen:
# second-order terms are then 5e-5 of a velocity.
_ROTATION_CHANGE = 0.01


AnyStart = ReplayStart | StartWithoutImu | StartInPlane
AnyNavigator = Navigator | RecordNavigator


@dataclass(frozen=True)
class ClockJump:
    """A jump of the IMU's clock ahead.

    Parameters
    ----------
    since : float
        Time of the first sample after it, s, on the wrong clock.
    by : float
        Size of the jump, s.
    """

    since: float
    by: float


class Initializer:
    """Keeps the records, decides when to solve them as a batch, and does.

    Parameters
    ----------
    settings : Trial
        Trial of which all but the records counts.
    interval : float
        Interval of the states to come, s.
    progress : callable
        Called with stage, iteration and cost.

    Attributes
    ----------
    history : RecordHistory or None
        Records so far; None once no batch solution is needed any more.
    findings : list of Finding
        Findings since they were last taken.
    """

    def __init__(self, settings: Trial, interval: float, progress: Progress) -> None:
        self.history: RecordHistory | None = (
            RecordHistory(settings)
            if settings.imu is None
            else InertialHistory(settings, _LONGEST)
        )
        self.findings: list[Finding] = []
        self._settings = settings
        self._interval = interval
        self._progress = progress
        self._gap: Gap | None = None
        self._prior: ConstantsPrior | None = None
        self._usual_misfit = 1.0
        self._clock_zero: float | None = None
        self._attempt = np.nan
        self._solved_at = np.nan
        self._solve_at = np.nan
        self._reason: Message | None = None
        self._noted = set(settings.notes)

    def restart(self, gap: Gap, navigator: Navigator, samples: Array) -> None:
        """Begin again after a gap of the IMU, with what is known of biases and calibration.

        Parameters
        ----------
        gap : Gap
            Gap of the IMU.
        navigator : Navigator
            Navigator at the gap.
        samples : ndarray, shape (N, 7)
            IMU samples after the gap.
        """
        length = gap.after - gap.before
        self.findings.append(
            Finding(
                Code.IMU_GAP,
                message("imu_gap.aligned", length=length, time=gap.before, after=_AFTER_GAP),
                "IMU",
            )
        )
        if self.history is None:
            state = navigator.newest(self._settings.body_axes)()
            speed = float(np.linalg.norm(state.velocity[0]))
            reach = speed * length + 0.5 * _ACCELERATION * length**2 + _SWAY
            self._prior = navigator.known(length)
            here = InitialPosition(state.geodetic[0], np.hypot(state.position_std[0], reach))
            self._settings = replace(
                self._settings,
                initial_attitude=None,
                initial_position=here,
                initial_velocity=None,
            )
            sections = navigator.start.sections
            history = InertialHistory(self._settings, _LONGEST, length + 1.0, sections)
            history.add_samples(samples)
            self.history = history
        self._gap = gap
        self._attempt = gap.after + _AFTER_GAP

    def attempt_due(self, arrived: float, *, end: bool) -> float | None:
        """Return the time up to which a start is to be attempted, None if it is too early.

        Parameters
        ----------
        arrived : float
            Time up to which IMU samples have arrived, s.
        end : bool
            Whether no more samples come.
        """
        assert self.history is not None
        start = self.history.start
        if arrived < start:
            return None
        if np.isnan(self._attempt):
            without = self._settings.imu is None
            self._attempt = start + (_FIRST_WITHOUT_IMU if without else _FIRST)
        elif self._attempt <= start:
            self.findings.append(
                Finding(
                    Code.UNUSED,
                    message("unused.before_start", start=start, longest=_LONGEST),
                    "IMU",
                )
            )
            self._attempt = start + _FIRST
        if arrived < self._attempt and not end:
            return None
        # However many samples came at once.
        until = min(arrived, self._attempt)
        self._attempt = until + max((_RETRY - 1.0) * (until - start), _RETRY_AFTER)
        return until

    def solve_by(self, time: float) -> None:
        """Solve again soon after a time, s, as a sensor reports for the first time."""
        self._solve_at = min(self._solve_at, time + _SOLVE_AFTER)

    def solve_due(self, navigator: AnyNavigator, now: float) -> bool:
        """Whether a smoother is to be replaced by a batch solution of the records up to now, s."""
        if self.history is None:
            return False
        turned = now > self._solved_at + _SOLVE_AFTER and (
            navigator.rotation_change > _ROTATION_CHANGE
        )
        return now >= self._solve_at or turned

    def knew_less(self, now: float) -> bool:
        """Whether the last batch solution was of less than the records up to now, s."""
        return self._solved_at < now

    def solve(
        self, until: float, dt: float, since: float, navigator: AnyNavigator | None
    ) -> tuple[AnyStart | None, ClockJump | None]:
        """Solve the records up to a time as a batch.

        Parameters
        ----------
        until : float
            Time, s.
        dt : float
            Sample interval of the IMU, s.
        since : float
            Time after which the trajectory is wanted, s.
        navigator : Navigator or None
            Navigator that runs, and that the solution is to replace.

        Returns
        -------
        AnyStart or None
            Start, None if the data do not allow one yet.
        ClockJump or None
            Jump of the IMU's clock, if that explains the data and a gap does not.
        """
        assert self.history is not None
        start, jump = self._begin(until, since), None
        if navigator is not None and self._contradicts(start):
            start = self._without_rejected(until, since, start, navigator)
        if self._gap is not None and self._contradicts(start):
            start, jump = self._with_clock_jump(until, since, start, self._gap, dt)
            until -= jump.by if jump else 0.0
        self._solved_at = until
        self._solve_at = self.history.start + _GROWTH * (until - self.history.start)
        if isinstance(start, Message):
            if navigator is None:
                if start != self._reason:
                    text = message("not_started.yet", time=until, reason=start)
                    self.findings.append(Finding(Code.NOT_STARTED, text))
                self._reason = start
            return None, jump
        self._reason = None
        self._gap = None
        self._usual_misfit = max(1.0, start.misfit)
        self.findings += [f for f in start.findings if f not in self._noted]
        self._noted.update(start.findings)
        return start, jump

    def release_if_settled(self, before: AnyNavigator, after: AnyNavigator) -> None:
        """Release the history if the smoother found the same as the batch solution after it."""
        assert self.history is not None
        if not (isinstance(before, Navigator) and isinstance(after, Navigator)):
            # Without IMU the noise and the strengths of the motion are always a batch solution's.
            return
        if not (self.history.complete and after.agrees_with(before)):
            return
        duration = after.time - self.history.start
        if after.start.noise_known or _GROWTH * duration > _LONGEST:
            self.history = None

    def _begin(self, until: float, since: float) -> AnyStart | Message:
        assert self.history is not None
        trial = self.history.trial(until)
        try:
            trial.frame()
        except DataError:
            return message("not_started.since_gap" if self._gap else "not_started.no_position")
        try:
            if self._clock_zero is None:
                self._clock_zero = self.history.start
            report, zero = self._progress, self._clock_zero
            if trial.planar:
                return solve_start_in_plane(trial, since, report, zero)
            if trial.imu is None:
                return solve_start_without_imu(trial, until, since, report, zero)
            return solve_start(trial, self._prior, self._interval, since, report, zero)
        except FactorgraphDvlError as error:
            return message("not_started.error", error=str(error))

    def _contradicts(self, start: AnyStart | Message) -> bool:
        """Whether there is no start, or one whose residuals are larger than they were."""
        return isinstance(start, Message) or start.misfit > _MISFIT * self._usual_misfit

    def _without_rejected(
        self, until: float, since: float, start: AnyStart | Message, navigator: AnyNavigator
    ) -> AnyStart | Message:
        """Return a better start without what the innovation gate rejected, if there is one."""
        whole = self.history
        assert whole is not None
        fewer = whole.without_rejected(navigator.frame)
        if fewer is None:
            return start
        self.history = fewer
        other = self._begin(until, since)
        if isinstance(other, Message) or (
            not isinstance(start, Message) and other.misfit >= start.misfit
        ):
            self.history = whole
            return start
        return other

    def _with_clock_jump(
        self, until: float, since: float, start: AnyStart | Message, gap: Gap, dt: float
    ) -> tuple[AnyStart | Message, ClockJump | None]:
        """Solve as if the IMU went on through a gap, and its clock jumped."""
        assert isinstance(self.history, InertialHistory)
        jump = ClockJump(gap.after, gap.after - gap.before - dt)
        self.history.shift_samples(gap.after, -jump.by)
        other = self._begin(until - jump.by, since)
        if self._contradicts(other):
            self.history.shift_samples(gap.before + 0.5 * dt, jump.by)
            why = start
            if not isinstance(why, Message):
                why = message("not_started.misfit", misfit=why.misfit)
            return message("not_started.contradicts", reason=why), None
        self.findings.append(
            Finding(
                Code.CLOCK_JUMP,
                message("clock_jump.ahead", time=gap.before, jump=jump.by),
                "IMU",
            )
        )
        return other, jump
