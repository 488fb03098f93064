"""Playback of a recorded trial in the order of time, and the solution at its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.timestamps import without_restarted_clock
from factorgraph_dvl.imu.vibration import without_vibration
from factorgraph_dvl.message import message
from factorgraph_dvl.plausibility.earlier_calibration import prior_findings
from factorgraph_dvl.plausibility.survey import accepted_errors, explained, survey
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import (
    consistency_findings,
    not_observable,
)
from factorgraph_dvl.quality.verdict import Verdict
from factorgraph_dvl.replay.record import Recorder, ReplayRecord, Update
from factorgraph_dvl.replay.samples import LEAST
from factorgraph_dvl.replay.session import LAG, RATE, Kind, Replay
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.solution import Calibration, Progress, Solution
from factorgraph_dvl.trial import Trial

# What holds only until something else is said.
_PASSING = frozenset({Code.CONTRADICTS, Code.SILENT, Code.HEARD_AGAIN})
# Record, s, from which on sensors are compared, and its growth from one comparison to the next.
# Chosen: two windows of the carried IMU; together they cost three times the last.
_FIRST_S = 70.0
_GROWTH = 1.5
Watch = Callable[[Update], None]


class VerdictAsItGoes:
    """Whether what is known can be used, from the data so far.

    Measurements that contradict the prediction count while they do, and a parameter that is not
    known well enough until it is. Sensors are compared anew whenever the record has grown by half.

    Parameters
    ----------
    trial : Trial
        The records, of which only those up to an update are looked at, and limits.
    """

    def __init__(self, trial: Trial) -> None:
        self._trial = trial
        self._said: list[Finding] = []
        self._compared: tuple[Finding, ...] = ()
        self._due = float(trial.body_sensor.time[0]) + _FIRST_S

    def take(self, update: Update) -> None:
        """Take notice of what an update says."""
        self._said += [f for f in update.findings if f.code not in _PASSING]

    def at(self, update: Update) -> Verdict:
        """Return the verdict on what is known at an update that was taken."""
        if update.time >= self._due:
            start = float(self._trial.body_sensor.time[0])
            self._due = start + _GROWTH * (update.time - start)
            self._compared = survey(self._trial.until(update.time)).errors
        now = [
            Finding(Code.CONTRADICTS, message("contradicts.prediction"), kind)
            for kind in update.inconsistent
        ]
        calibration = update.calibration
        known = consistency_findings(calibration.estimates, ())
        return Calibration(
            trial=self._trial.name,
            solver="replay",
            body_axes=self._trial.body_axes,
            converged=True,
            iterations=1,
            cost=0.0,
            estimates=calibration.estimates,
            covariance=calibration.covariance,
            findings=(*self._compared, *self._said, *now, *known),
            limits=self._trial.limits,
        ).verdict


def replay(
    trial: Trial,
    *,
    smoother: Kind = "fixed-lag",
    lag_s: float = LAG,
    rate_hz: float = RATE,
    anyway: bool = False,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> tuple[Solution, ReplayRecord]:
    """Feed a recorded trial in the order of time, and record what was known when.

    Parameters
    ----------
    trial : Trial
        Trial with its records.
    smoother : Kind, default 'fixed-lag'
        Smoother: `fixed-lag` or `isam2`.
    lag_s : float, optional
        Age beyond which states are no longer corrected, s.
    rate_hz : float, optional
        States a second.
    anyway : bool, optional
        Run although there are records that cannot be used.
    progress : callable, optional
        Called with stage, iteration and cost while a batch solution runs.
    watch : Watch, optional
        Called with every update.

    Returns
    -------
    Solution
        The calibration at the end, and the trajectory as it was known at each time.
    ReplayRecord
        The calibration over time.

    Raises
    ------
    ConfigError
        If an option is out of range.
    DataError
        If the trial has no position, or records that cannot be used.
    SolveError
        If the data never sufficed to start.
    """
    errors = accepted_errors(survey(trial), anyway=anyway)
    with explained(errors):
        solution, record = _played(
            trial if trial.imu is None else _as_prepared(trial),
            smoother=smoother,
            lag_s=lag_s,
            rate_hz=rate_hz,
            progress=progress,
            watch=watch,
        )
    return solution.with_findings(errors), record


def _as_prepared(trial: Trial) -> Trial:
    """Return a trial with the samples of its IMU as `solve` takes them."""
    trial = without_restarted_clock(trial)
    return replace(trial, imu=without_vibration(trial.inertial))


def _played(
    trial: Trial,
    *,
    smoother: Kind,
    lag_s: float,
    rate_hz: float,
    progress: Progress | None,
    watch: Watch | None,
) -> tuple[Solution, ReplayRecord]:
    """Feed a trial without impossible times; the parameters are those of `replay`."""
    # Fails early if the trial has no position.
    trial.frame()
    run = Replay(trial, smoother=smoother, lag_s=lag_s, rate_hz=rate_hz, progress=progress)
    recorder = Recorder()
    imu, time = trial.imu, trial.body_sensor.time
    # Gaps cost one step, whatever their length.
    steps = np.unique(np.floor((time - time[0]) / run.interval))
    edges = time[0] + run.interval * np.union1d(steps, steps + 1.0)
    edges[-1] = max([float(time[-1]), *(float(aid.time[-1]) for aid in trial.aids)])

    def parts(time: Array) -> list[tuple[int, int]]:
        """Return the first rows of each step, and those after them."""
        first = np.searchsorted(time, edges)
        first[[0, -1]] = 0, time.size
        return list(pairwise(first.tolist()))

    def take(updates: list[Update]) -> None:
        for update in updates:
            recorder.add(update)
            if watch is not None:
                watch(update)

    of_aids = [parts(aid.time) for aid in trial.aids]
    for end, (a, b), *others in zip(edges[1:].tolist(), parts(time), *of_aids, strict=True):
        for aid, (first, last) in zip(trial.aids, others, strict=True):
            if last > first:
                run.add(rows_of(aid, slice(first, last)))
        if imu is None:
            take(run.advance(end))
        elif b > a:
            take(run.add_imu(imu.time[a:b], imu.gyro[a:b], imu.accel[a:b]))
    take(run.finish())
    if recorder.last is None:
        raise _never_started(trial, run)
    return _solution(trial, run, recorder, recorder.last), recorder.record(run.delay)


def _never_started(trial: Trial, run: Replay) -> SolveError:
    why = "; ".join(map(str, run.findings)) or "the record is too short"
    return SolveError(f"the data were never sufficient to start: {why}", where=trial.name)


def _solution(trial: Trial, run: Replay, recorder: Recorder, last: Update) -> Solution:
    calibration = last.calibration
    residuals = recorder.residuals()
    findings = [*trial.notes]
    findings += [
        replace(f, message=message("words.at_time", time=time, what=f.message))
        for time, f in recorder.findings
    ]
    findings += [
        replace(f, message=message("words.at_the_end", what=f.message)) for f in run.findings
    ]
    if run.unused:
        findings.append(
            Finding(
                Code.UNUSED,
                message("unused.replay_ended", time=last.time, count=run.unused),
                "IMU",
            )
        )
    findings += run.counts()
    findings += consistency_findings(calibration.estimates, residuals, run.noise)
    findings += prior_findings(trial, calibration.estimates, calibration.covariance)
    why = message("not_observable.prior_reported")
    for e in calibration.estimates:
        findings += not_observable(e, lambda _: why)
    known = {e.name for e in calibration.estimates}
    for aid in () if trial.imu is None else trial.aids:
        if any(p.estimated and p.name not in known for p in aid.parameters()):
            findings.append(
                Finding(
                    Code.SILENT,
                    message("silent.never"),
                    aid.label,
                )
            )
    if trial.imu is not None and trial.imu.settings.bias_walks:
        findings.append(
            Finding(
                Code.MEAN_OR_LAST,
                message("mean_or_last.walks"),
                "IMU",
            )
        )
    dvl = None if trial.imu is None else trial.dvl
    if dvl is not None and "scale_walk_std_sqrt_h" in dvl.settings.left_out:
        findings.append(Finding(Code.MEAN_OR_LAST, message("mean_or_last.scale"), "DVL"))
    if run.unused >= LEAST:
        findings.append(Finding(Code.NOT_CONVERGED, message("not_converged.replay")))
    elif last.inconsistent:
        text = message("not_converged.disagrees", sensors=sorted(last.inconsistent))
        findings.append(Finding(Code.NOT_CONVERGED, text))
    cost = 0.5 * sum(float(np.nansum((r.residual / r.sigma) ** 2)) for r in residuals)
    return Solution(
        trial=trial.name,
        solver="replay",
        body_axes=trial.body_axes,
        epoch=trial.epoch,
        inputs=trial.inputs,
        converged=run.unused < LEAST and not last.inconsistent,
        iterations=recorder.count,
        cost=cost,
        estimates=calibration.estimates,
        covariance=calibration.covariance,
        trajectory=recorder.trajectory(),
        residuals=residuals,
        findings=tuple(findings),
        limits=trial.limits,
        noise=run.noise,
    )
