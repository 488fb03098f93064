"""What a planar trial holds, and what is implausible about it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.quality.plausibility_planar import planar_findings
from factorgraph_dvl.quality.records import SensorSurvey, record_of
from factorgraph_dvl.quality.survey import Survey
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.message import message
from factorgraph_dvl.trial import PlanarTrial


def survey_planar(trial: PlanarTrial) -> Survey:
    """Survey a planar trial: rates, gaps, motion, and whether signs and clocks are plausible.

    Parameters
    ----------
    trial : PlanarTrial
        As loaded.
    """
    heading, log, depth, beacons = trial.records
    sensors = (
        record_of(heading.label, heading.time, np.isnan(heading.heading)),
        record_of(log.label, log.time, np.isnan(log.speed)),
        record_of(depth.label, depth.time, depth.missing),
        record_of(beacons.label, beacons.time, beacons.missing),
    )
    known = ~np.isnan(log.speed)
    velocity = np.stack([log.speed[known], np.nan_to_num(log.starboard[known])])
    speed = np.linalg.norm(velocity, axis=0)
    return Survey(
        trial=trial.name,
        sensors=sensors,
        duration=heading.time[-1] - heading.time[0],
        distance=float(np.trapezoid(speed, log.time[known])) if speed.size > 1 else np.nan,
        speed_min=float(speed.min()) if speed.size else np.nan,
        speed_max=float(speed.max()) if speed.size else np.nan,
        findings=tuple(_findings(trial, sensors)),
    )


def _findings(trial: PlanarTrial, sensors: tuple[SensorSurvey, ...]) -> Iterator[Finding]:
    *carried, beacons = sensors
    start, end = max(s.start for s in carried), min(s.end for s in carried)
    names = message("words.heading_log_and_depth")
    if not start < end:
        text = message("no_overlap.none_in_common", names=names)
        yield Finding(Code.NO_OVERLAP, text, "Heading", severity="error")
        return
    inside = min(beacons.end, end) - max(beacons.start, start)
    if beacons.missing == 1.0:
        text = message("no_measurement.rows")
        yield Finding(Code.NO_MEASUREMENT, text, beacons.label, severity="error")
    elif inside < 0.0:
        text = message(
            "no_overlap.times",
            start=beacons.start,
            end=beacons.end,
            names=names,
            other_start=start,
            other_end=end,
        )
        yield Finding(Code.NO_OVERLAP, text, beacons.label, severity="error")
    elif inside < 0.5 * (beacons.end - beacons.start):
        text = message("partial_overlap.outside", names=names)
        yield Finding(Code.PARTIAL_OVERLAP, text, beacons.label)
    yield from planar_findings(trial)
