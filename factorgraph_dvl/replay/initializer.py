"""Batch solutions of the records so far, from which the smoother starts."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from factorgraph_dvl.errors import DataError, FactorgraphDvlError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.priors import ConstantsPrior
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay.navigator import Navigator
from factorgraph_dvl.replay.samples import Gap
from factorgraph_dvl.replay.start import ReplayStart, solve_start
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.records import joined, rows_of
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.trial import InitialPosition, Trial

# What rounding may take off a time, s: the sample at which a segment ended belongs to it.
_ROUNDING = 1e-6
# Data before the first attempt to start, s; chosen: in-motion alignment needs some turns or sway.
_FIRST = 30.0
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
# Agreement of smoother and batch solution, in standard deviations, and standard deviation of
# rotations, rad, from which on linearising once is enough; chosen. Measured: final estimates are
# then within 0.1 standard deviations of those of a batch solution.
_AGREEMENT = 0.1
_SETTLED_ROTATION = np.radians(0.2)
# Change of a rotation since it was linearised that asks for a new batch solution, rad; chosen:
# second-order terms are then 5e-5 of a velocity.
_ROTATION_CHANGE = 0.01


class RecordHistory:
    """Records that grow, and lose what is too old.

    Parameters
    ----------
    settings : Trial
        Trial of which all but the records counts.
    longest : float
        Span of data that is kept, s.
    before : float, default 1.0
        Span before the first IMU sample from which measurements are kept, s.
    calibrated : sequence of str, optional
        Sections of sensors that have reported before, and whose calibration is known.
    """

    def __init__(
        self,
        settings: Trial,
        longest: float,
        before: float = 1.0,
        calibrated: Sequence[str] = (),
    ) -> None:
        self._settings = settings
        self._longest = longest
        self._before = before
        self._calibrated = calibrated
        self._samples: list[Array] = []
        self._aids: dict[str, list[Aid]] = {}
        self._rejected: dict[str, list[Array]] = {}

    @property
    def start(self) -> float:
        """Time of the first sample, s; infinite if there is none."""
        return float(self._samples[0][0, 0]) if self._samples else np.inf

    @property
    def empty(self) -> bool:
        """Whether there are no samples."""
        return not self._samples

    @property
    def complete(self) -> bool:
        """Whether every sensor of the trial has reported."""
        return all(aid.section in self._aids for aid in self._settings.aids)

    def add_samples(self, table: Array) -> None:
        """Add IMU samples (N, 7): time, angular rate, specific force."""
        if table.shape[0]:
            self._samples.append(table)
            while self._samples[-1][-1, 0] - self._samples[0][-1, 0] > self._longest:
                self._samples.pop(0)

    def add_aid(self, record: Aid) -> None:
        """Add rows of a sensor."""
        self._aids.setdefault(record.section, []).append(record)

    def reject(self, label: str, time: Array) -> None:
        """Mark measurements of a kind, by their times, s, as rejected by the innovation gate."""
        if time.size:
            self._rejected.setdefault(label, []).append(time)

    def without_rejected(self, frame: LocalFrame) -> RecordHistory | None:
        """Return the history without the rejected rows, None if there are none."""
        if not self._rejected:
            return None
        out = copy(self)
        out._rejected = {}
        out._aids = {}
        for section, records in self._aids.items():
            record = joined(records)
            kinds = {
                o.label for o in record.observations(frame, self._settings.body_axes)
            } & self._rejected.keys()
            times = [time for kind in kinds for time in self._rejected[kind]]
            if times:
                record = rows_of(record, ~np.isin(record.time, np.concatenate(times)))
            if record.time.size:
                out._aids[section] = [record]
        return out

    def shift_samples(self, since: float, by: float) -> None:
        """Move the IMU samples at and after a time by some seconds."""
        table = np.concatenate(self._samples)
        table[table[:, 0] >= since, 0] += by
        self._samples = [table]

    def remove_after(self, since: float) -> list[Aid]:
        """Remove the sensors' rows at and after a time, s, and return them."""
        out = []
        for section, records in list(self._aids.items()):
            record = joined(records)
            later = record.time >= since
            if later.any():
                out.append(rows_of(record, later))
                self._aids[section] = [rows_of(record, ~later)]
        return out

    def trial(self, until: float) -> Trial:
        """Return the records up to a time, s, as a trial."""
        whole = np.concatenate(self._samples)
        self._samples = [whole]
        samples = whole[whole[:, 0] <= until + _ROUNDING]
        aids: dict[str, Aid] = {}
        for section, records in self._aids.items():
            record = joined(records)
            # Rows from before the first sample are of no use, and end here.
            keep = np.flatnonzero(record.time >= self.start - self._before)
            if keep.size:
                record = rows_of(record, keep)
                self._aids[section] = [record]
                aids[section] = record
        settings = self._settings
        imu = replace(
            settings.inertial,
            time=samples[:, 0],
            gyro=samples[:, 1:4],
            accel=samples[:, 4:7],
            prior=settings.inertial.prior_after(samples[0, 0] - settings.inertial.time[0]),
        )
        if settings.inertial.time[0] < samples[0, 0] - 1.0:
            # What `initial` states is of a start that has been dropped.
            settings = replace(
                settings, initial_attitude=None, initial_position=None, initial_velocity=None
            )
        # A sensor that has not reported yet must not be known of: its record is of the future.
        known: dict[str, Any] = dict.fromkeys(aid.section for aid in settings.aids)
        known |= {
            aid.section: rows_of(aid, [])
            for aid in settings.aids
            if aid.section in self._calibrated and any(p.estimated for p in aid.parameters())
        }
        known |= aids
        named = {f.name: known.pop(f.name) for f in fields(Trial) if f.name in known}
        others = tuple(aid for aid in known.values() if aid is not None)
        return replace(settings, imu=imu, others=others, **named)


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
        self.history: RecordHistory | None = RecordHistory(settings, _LONGEST)
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
            self.history = RecordHistory(self._settings, _LONGEST, length + 1.0, sections)
            self.history.add_samples(samples)
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
            self._attempt = start + _FIRST
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

    def solve_due(self, navigator: Navigator) -> bool:
        """Whether a smoother that runs is to be replaced by a new batch solution."""
        if self.history is None:
            return False
        now = navigator.time
        turned = now > self._solved_at + _SOLVE_AFTER and (
            navigator.rotation_change > _ROTATION_CHANGE
        )
        return now >= self._solve_at or turned

    def solve(
        self, until: float, dt: float, since: float, navigator: Navigator | None
    ) -> tuple[ReplayStart | None, ClockJump | None]:
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
        ReplayStart or None
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

    def release_if_settled(self, before: Navigator, after: Navigator) -> None:
        """Release the history if the smoother found the same as the batch solution after it."""
        assert self.history is not None
        if not self.history.complete or before.start.sections != after.start.sections:
            return
        old, new = before.calibration(), after.calibration()
        if [e.name for e in old.estimates] != [e.name for e in new.estimates]:
            # A parameter that was stated as known is estimated instead.
            return
        std = np.sqrt(np.diag(new.covariance))
        free = std > 0.0
        moved = np.concatenate(
            [a.value - b.value for a, b in zip(old.estimates, new.estimates, strict=True)]
        )
        agrees = bool(np.all(np.abs(moved[free]) < _AGREEMENT * std[free]))
        known = all(
            np.all(np.diag(after.covariance_of(p)) < _SETTLED_ROTATION**2)
            for p in after.start.parameters
            if p.rotation
        )
        duration = after.time - self.history.start
        noise_known = after.start.noise_known or _GROWTH * duration > _LONGEST
        if agrees and known and noise_known and not after.undetermined.size:
            self.history = None

    def _begin(self, until: float, since: float) -> ReplayStart | Message:
        assert self.history is not None
        trial = self.history.trial(until)
        try:
            trial.frame()
        except DataError:
            return message("not_started.since_gap" if self._gap else "not_started.no_position")
        try:
            if self._clock_zero is None:
                self._clock_zero = float(trial.inertial.time[0])
            return solve_start(
                trial, self._prior, self._interval, since, self._progress, self._clock_zero
            )
        except FactorgraphDvlError as error:
            return message("not_started.error", error=str(error))

    def _contradicts(self, start: ReplayStart | Message) -> bool:
        """Whether there is no start, or one whose residuals are larger than they were."""
        return isinstance(start, Message) or start.misfit > _MISFIT * self._usual_misfit

    def _without_rejected(
        self, until: float, since: float, start: ReplayStart | Message, navigator: Navigator
    ) -> ReplayStart | Message:
        """Return a better start without what the innovation gate rejected, if there is one."""
        whole = self.history
        assert whole is not None
        fewer = whole.without_rejected(navigator.start.frame)
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
        self, until: float, since: float, start: ReplayStart | Message, gap: Gap, dt: float
    ) -> tuple[ReplayStart | Message, ClockJump | None]:
        """Solve as if the IMU went on through a gap, and its clock jumped."""
        assert self.history is not None
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
