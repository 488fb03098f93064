"""Whether the times of records are plausible: units, overlap, gaps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.quality.records import GAP_INTERVALS, SensorSurvey
from factorgraph_dvl.quality.sensor_clocks import whole_hours
from factorgraph_dvl.sensors.attitude import Attitude
from factorgraph_dvl.sensors.clock import ClockSection
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.trial import Trial


def time_findings(trial: Trial, sensors: list[SensorSurvey]) -> Iterator[Finding]:
    """Yield what is wrong with the times of records against the IMU or what takes its place."""
    body = trial.body_sensor
    if isinstance(body, Imu):
        name, (imu, *aids) = "the IMU", sensors
    else:
        aids = sensors
        imu = next(s for s in sensors if s.label == body.label)
        name = f"the {body.label}"
    interval = 1.0 / imu.rate
    if trial.imu is None:
        pass
    elif interval >= 0.5:
        unit = f", or milliseconds ({1000.0 / interval:.4g} Hz)" if interval >= 1.0 else ""
        yield Finding(
            Code.TIME_UNIT,
            f"one sample every {interval:.4g} s: time_s must be in seconds{unit}; "
            "an IMU this slow does not resolve the motion",
            "IMU",
            severity="error",
        )
    elif imu.rate > 2e4:
        text = f"{imu.rate:.4g} samples per second: is time_s in seconds?"
        yield Finding(Code.TIME_UNIT, text, "IMU", severity="error")
    for aid, record in zip(aids, trial.aids, strict=True):
        if aid.missing == 1.0:
            text = "none of its rows contains a measurement"
            yield Finding(Code.NO_MEASUREMENT, text, aid.label, severity="error")
            continue
        inside = min(aid.end, imu.end) - max(aid.start, imu.start)
        if not _meets(record, body):
            hours = whole_hours((imu.start, imu.end), (aid.start, aid.end))
            if hours:
                yield Finding(
                    Code.LOCAL_TIME,
                    f"its times do not overlap those of {name}, but would {abs(hours)} h "
                    f"{'later' if hours > 0 else 'earlier'}: is one of them in local time?",
                    aid.label,
                    severity="error",
                )
                continue
            yield Finding(
                Code.NO_OVERLAP,
                f"its times, {aid.start:.10g} to {aid.end:.10g} s, do not overlap those of "
                f"{name}, {imu.start:.10g} to {imu.end:.10g} s: "
                "are they from one clock, in seconds?",
                aid.label,
                severity="error",
            )
        elif inside < 0.5 * (aid.end - aid.start):
            yield Finding(
                Code.PARTIAL_OVERLAP,
                f"more than half of its record lies outside that of {name}",
                aid.label,
            )
        elif inside < 0.5 * (imu.end - imu.start):
            yield Finding(
                Code.PARTIAL_OVERLAP,
                f"it covers {100.0 * inside / (imu.end - imu.start):.3g} % of the record of "
                f"{name}",
                aid.label,
            )
    for sensor in sensors:
        if sensor.gaps:
            yield Finding(
                Code.GAPS,
                f"{sensor.gaps} gaps longer than {GAP_INTERVALS:g} sample intervals, the longest "
                f"{sensor.longest_gap:.4g} s",
                sensor.label,
            )
        if 0.5 < sensor.missing < 1.0:
            yield Finding(
                Code.MISSING,
                f"{100.0 * sensor.missing:.3g} % of its rows contain no measurement",
                sensor.label,
            )


def _meets(aid: Aid, imu: Imu | Attitude | Ins) -> bool:
    """Whether the IMU runs at any measurement of a sensor."""
    settings = aid.settings
    offset = settings.time_offset_s if isinstance(settings, ClockSection) else 0.0
    time = aid.time[np.logical_not(aid.missing)] - offset
    after = np.searchsorted(imu.time, time)
    edges = np.concatenate([[-np.inf], imu.time, [np.inf]])
    deviation = np.minimum(time - edges[after], edges[after + 1] - time)
    interval = float(np.median(np.diff(imu.time))) if imu.time.size > 1 else 0.0
    return bool(np.any(deviation <= interval))
