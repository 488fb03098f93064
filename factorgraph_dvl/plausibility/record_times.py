"""Whether the times of records are plausible: units, overlap, gaps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.plausibility.records import GAP_INTERVALS, SensorSurvey
from factorgraph_dvl.plausibility.sensor_clocks import whole_hours
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.clock import ClockSection
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.trial import Trial


def time_findings(trial: Trial, sensors: list[SensorSurvey]) -> Iterator[Finding]:
    """Yield what is wrong with the times of records against the IMU or what takes its place."""
    body = trial.body_sensor
    if isinstance(body, Imu):
        name, (imu, *aids) = message("words.the_imu"), sensors
    else:
        aids = sensors
        imu = next(s for s in sensors if s.label == body.label)
        name = message("words.the_sensor", sensor=body.label)
    interval = 1.0 / imu.rate
    if trial.imu is None:
        pass
    elif interval >= 0.5:
        unit: Message | str = ""
        if interval >= 1.0:
            unit = message("time_unit.milliseconds", rate=1000.0 / interval)
        text = message("time_unit.slow", interval=interval, unit=unit)
        yield Finding(Code.TIME_UNIT, text, "IMU", severity="error")
    elif imu.rate > 2e4:
        text = message("time_unit.fast", rate=imu.rate)
        yield Finding(Code.TIME_UNIT, text, "IMU", severity="error")
    for aid, record in zip(aids, trial.aids, strict=True):
        if aid.missing == 1.0:
            text = message("no_measurement.rows")
            yield Finding(Code.NO_MEASUREMENT, text, aid.label, severity="error")
            continue
        inside = min(aid.end, imu.end) - max(aid.start, imu.start)
        if not _meets(record, body.time):
            hours = whole_hours((imu.start, imu.end), (aid.start, aid.end))
            if hours:
                yield Finding(
                    Code.LOCAL_TIME,
                    message(
                        "local_time.later" if hours > 0 else "local_time.earlier",
                        name=name,
                        hours=abs(hours),
                    ),
                    aid.label,
                    severity="error",
                )
                continue
            yield Finding(
                Code.NO_OVERLAP,
                message(
                    "no_overlap.times",
                    start=aid.start,
                    end=aid.end,
                    names=name,
                    other_start=imu.start,
                    other_end=imu.end,
                ),
                aid.label,
                severity="error",
            )
        elif inside < 0.5 * (aid.end - aid.start):
            text = message("partial_overlap.outside", names=name)
            yield Finding(Code.PARTIAL_OVERLAP, text, aid.label)
        elif inside < 0.5 * (imu.end - imu.start):
            percent = 100.0 * inside / (imu.end - imu.start)
            text = message("partial_overlap.covers", percent=percent, name=name)
            yield Finding(Code.PARTIAL_OVERLAP, text, aid.label)
    for sensor in sensors:
        if sensor.gaps:
            yield Finding(
                Code.GAPS,
                message(
                    "gaps.longer",
                    count=sensor.gaps,
                    intervals=GAP_INTERVALS,
                    longest=sensor.longest_gap,
                ),
                sensor.label,
            )
        if 0.5 < sensor.missing < 1.0:
            yield Finding(
                Code.MISSING,
                message("missing.rows", percent=100.0 * sensor.missing),
                sensor.label,
            )


def _meets(aid: Aid, body: Array) -> bool:
    """Whether the body's record, (M,) times, has a sample at any measurement of a sensor."""
    settings = aid.settings
    offset = settings.time_offset_s if isinstance(settings, ClockSection) else 0.0
    time = aid.time[np.logical_not(aid.missing)] - offset
    after = np.searchsorted(body, time)
    edges = np.concatenate([[-np.inf], body, [np.inf]])
    deviation = np.minimum(time - edges[after], edges[after + 1] - time)
    interval = float(np.median(np.diff(body))) if body.size > 1 else 0.0
    return bool(np.any(deviation <= interval))
