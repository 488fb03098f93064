"""What a trial holds: its records, its motion, and what is implausible about them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.plausibility.records import SensorSurvey, record_of, travel
from factorgraph_dvl.quality.finding import Finding, errors_of
from factorgraph_dvl.sensors.speed_log import SpeedLog
from factorgraph_dvl.trial import Trial


@dataclass(frozen=True)
class Survey:
    """What a trial holds.

    Parameters
    ----------
    trial : str
        Name.
    sensors : tuple of SensorSurvey
        One entry for each.
    duration : float
        Of the record of the IMU, or of what takes its place, s.
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
        As loaded.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> found = fd.survey(fd.simulate("examples/short.yaml", seed=1))
    >>> found.duration, len(found.sensors)
    (85.98, 3)
    """
    # What looks for findings takes long to load.
    from factorgraph_dvl.plausibility.checks import findings

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
