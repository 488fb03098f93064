"""What a trial contains, and what is implausible about it: errors refuse it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.errors import DataError, FactorgraphDvlError
from factorgraph_dvl.plausibility.beacons import beacon_findings
from factorgraph_dvl.plausibility.clocks import time_findings
from factorgraph_dvl.plausibility.consistency import consistency_findings
from factorgraph_dvl.plausibility.dvl import BEAM_TERMS, DVL_TERMS, beam_findings, dvl_findings
from factorgraph_dvl.plausibility.gnss import gnss_findings
from factorgraph_dvl.plausibility.imu import channel_findings, force_findings, gyro_findings
from factorgraph_dvl.plausibility.planar import planar_findings
from factorgraph_dvl.plausibility.records import SensorSurvey, record_of, travel
from factorgraph_dvl.plausibility.star import star_findings
from factorgraph_dvl.plausibility.usbl import usbl_findings
from factorgraph_dvl.quality.finding import Code, Finding, errors_of
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.sensors.beam_geometry import as_dvl
from factorgraph_dvl.sensors.speed_log import SpeedLog
from factorgraph_dvl.sensors.star import Star
from factorgraph_dvl.sensors.usbl import Usbl
from factorgraph_dvl.trial import Trial

# Findings of the sensors together that say better what the gyros' against gravity say.
_BETTER = frozenset({Code.IMU_AXES, Code.GYRO_AXES, Code.ACCEL_AXES, Code.GYRO_UNIT})


def findings(trial: Trial, sensors: list[SensorSurvey]) -> Iterator[Finding]:
    """Check units, signs, axes and clocks of a trial.

    Parameters
    ----------
    trial : Trial
        Trial as loaded.
    sensors : list of SensorSurvey
        Its records, that of the IMU first.
    """
    if trial.planar:
        yield from planar_findings(trial, sensors)
        return
    alone = list(_of_single_sensors(trial, sensors))
    together = []
    if trial.imu is not None:
        together = list(consistency_findings(trial, [f for f in alone if f.severity == "error"]))
    known = {f.code for f in together}
    for finding in alone:
        if finding.code != Code.GYRO_UNIT or known.isdisjoint(_BETTER):
            yield finding
    yield from together


def _of_single_sensors(trial: Trial, sensors: list[SensorSurvey]) -> Iterator[Finding]:
    """Yield what is wrong with sensors alone, and with their speeds."""
    yield from time_findings(trial, sensors)
    if trial.imu is not None:
        yield from force_findings(trial.imu, trial.body_axes)
        yield from channel_findings(trial.imu)
        yield from gyro_findings(trial.imu)
    if trial.gnss is not None:
        yield from gnss_findings(trial.gnss)
    if trial.dvl is not None:
        yield from dvl_findings(trial.dvl, trial.gnss, trial.body_axes, DVL_TERMS)
    if trial.beams is not None:
        log = as_dvl(trial.beams)
        yield from dvl_findings(log, trial.gnss, trial.body_axes, BEAM_TERMS)
        yield from beam_findings(trial.beams)
    for aid in trial.others:
        if isinstance(aid, Star) and trial.imu is not None:
            yield from star_findings(aid, trial)
        if isinstance(aid, Usbl):
            yield from usbl_findings(trial, aid)
        if isinstance(aid, Beacons):
            yield from beacon_findings(trial, aid)


@dataclass(frozen=True)
class Survey:
    """What a trial contains.

    Parameters
    ----------
    trial : str
        Name.
    sensors : tuple of SensorSurvey
        One entry for each.
    duration : float
        Duration of the record of the IMU, or of what takes its place, s.
    distance : float
        Travelled, m; nan without GNSS, DVL and log.
    speed_min, speed_max : float
        Slowest and fastest, m/s; nan likewise.
    findings : tuple of Finding
        About units, signs, clocks and gaps.
    """

    trial: str
    sensors: tuple[SensorSurvey, ...]
    duration: float
    distance: float
    speed_min: float
    speed_max: float
    findings: tuple[Finding, ...]

    @property
    def errors(self) -> tuple[Finding, ...]:
        """The findings for which a solution is not to be used, or cannot be had."""
        return errors_of(self.findings)

    @property
    def problems(self) -> tuple[Finding, ...]:
        """The findings that are not ok."""
        return tuple(f for f in self.findings if f.severity != "ok")


def survey(trial: Trial) -> Survey:
    """Survey a trial: rates, gaps, motion, and whether units and signs are plausible.

    Parameters
    ----------
    trial : Trial
        Trial as loaded.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> found = fd.survey(fd.simulate("examples/short.yaml", seed=1))
    >>> found.duration, len(found.sensors)
    (85.98, 3)
    """
    # What looks for findings takes long to load.

    sensors = []
    if trial.imu is not None:
        sensors.append(record_of("IMU", trial.imu.time, np.zeros(trial.imu.time.size, dtype=bool)))
    body = trial.body_sensor
    sensors += [record_of(aid.label, aid.time, aid.missing) for aid in trial.aids]
    distance, speed = travel(trial.gnss, trial.log, trial.find(SpeedLog))
    return Survey(
        trial=trial.name,
        sensors=tuple(sensors),
        duration=float(body.time[-1] - body.time[0]),
        distance=distance,
        speed_min=float(speed.min()) if speed.size else np.nan,
        speed_max=float(speed.max()) if speed.size else np.nan,
        findings=tuple(findings(trial, sensors)),
    )


def accepted_errors(found: Survey, *, anyway: bool) -> tuple[Finding, ...]:
    """Return the errors in records with which there is still something to solve.

    And warnings of axes that the course contradicts: no residual shows these.

    Parameters
    ----------
    found : Survey
        Survey of the trial.
    anyway : bool
        Accept all of them.

    Raises
    ------
    DataError
        If there are records that cannot be used, unless `anyway`.
    """
    unusable = [str(f) for f in found.errors if f.unusable]
    if unusable and not anyway:
        raise DataError(
            "; ".join(unusable),
            where=found.trial,
            hint="Correct the record, leave its sensor out, or go on with --anyway "
            "(in Python anyway=True)",
        )
    off_course = [f for f in found.problems if f.code == Code.COURSE and f.severity == "warning"]
    return (*found.errors, *off_course)


@contextmanager
def explained(errors: Sequence[Finding]) -> Iterator[None]:
    """Add errors in the records as notes to the exception if what is done with them fails."""
    try:
        yield
    except FactorgraphDvlError as failure:
        for error in errors:
            failure.add_note(str(error))
        raise
