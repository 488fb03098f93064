"""Whether units, signs, axes and clocks of a trial are plausible.

Checks compare sensors with each other or with gravity, never with a solution, so that
they speak before anything is solved.
"""

from __future__ import annotations

from collections.abc import Iterator

from factorgraph_dvl.plausibility.beams import beam_findings
from factorgraph_dvl.plausibility.consistency import consistency_findings
from factorgraph_dvl.plausibility.dvl_units import BEAM_TERMS, DVL_TERMS, dvl_findings
from factorgraph_dvl.plausibility.gnss_units import gnss_findings
from factorgraph_dvl.plausibility.imu_channels import channel_findings
from factorgraph_dvl.plausibility.imu_units import force_findings, gyro_findings
from factorgraph_dvl.plausibility.planar import planar_findings
from factorgraph_dvl.plausibility.record_times import time_findings
from factorgraph_dvl.plausibility.records import SensorSurvey
from factorgraph_dvl.plausibility.star import star_findings
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.beam_geometry import as_dvl
from factorgraph_dvl.sensors.star import Star
from factorgraph_dvl.trial import Trial

# Findings of the sensors together that say better what the gyros' against gravity say.
_BETTER = frozenset({Code.IMU_AXES, Code.GYRO_AXES, Code.ACCEL_AXES, Code.GYRO_UNIT})


def findings(trial: Trial, sensors: list[SensorSurvey]) -> Iterator[Finding]:
    """Check units, signs, axes and clocks of a trial.

    Parameters
    ----------
    trial : Trial
        As loaded.
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
