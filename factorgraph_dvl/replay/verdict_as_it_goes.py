"""The verdict on what a replay knows, as it goes: it changes with the data."""

from __future__ import annotations

from factorgraph_dvl.message import message
from factorgraph_dvl.plausibility.survey import survey
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import consistency_findings
from factorgraph_dvl.quality.verdict import Verdict
from factorgraph_dvl.replay.update import Update
from factorgraph_dvl.solution import Calibration
from factorgraph_dvl.trial import Trial

# What holds only until something else is said.
_PASSING = frozenset({Code.CONTRADICTS, Code.SILENT, Code.HEARD_AGAIN})
# Record, s, from which on sensors are compared, and its growth from one comparison to the next.
# Chosen: two windows of the carried IMU; together they cost three times the last.
_FIRST_S = 70.0
_GROWTH = 1.5


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
