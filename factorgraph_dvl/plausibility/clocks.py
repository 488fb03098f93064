"""Whether the times of records are plausible, and what clocks of GNSS and DVL are off."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.initialization.clock_offsets import ClockOffset
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.plausibility.records import GAP_INTERVALS, SensorSurvey
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.averaging import hidden_delay, stated_window
from factorgraph_dvl.sensors.clock import ClockSection
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.dvl_beams import DvlBeams
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.trial import Trial

# Offsets below this, s, are left to the solver; times σ, and gain in log-likelihood, from which on
# one is certain. Chosen: chance makes none in 10 000 trials.
_LEAST_S = 0.05
_SIGMAS = 6.0
_LEAST_GAIN = 15.0
# A jump below this, s, is none. Chosen: no parameter takes up the smallest that is certain.
_LEAST_JUMP_S = 0.01
# Prior standard deviations that an offset may be off, and s that a fixed one may. Chosen: beyond,
# the result is not to be used.
_COVERED = 3.0
_HARMLESS_S = 0.1
# GPS time less UTC, s, since 2017.
LEAP_SECONDS = 18.0


def clock_findings(
    sensor: Gnss | Dvl | DvlBeams, clock: ClockOffset, span: float
) -> Iterator[Finding]:
    """Yield what is wrong with a clock.

    Parameters
    ----------
    sensor : Gnss, Dvl or DvlBeams
        Sensor whose clock it is; its settings say what is known of it.
    clock : ClockOffset
        Clock as found.
    span : float
        Length of its record, s.
    """
    mean, std = sensor.settings.velocity_lag_s
    if clock.gain < _LEAST_GAIN:
        return
    change = clock.rate * span
    if abs(change) > max(_LEAST_S, _SIGMAS * clock.rate_sigma * span):
        rate_std = 1e-6 * sensor.settings.clock_rate_std_ppm
        covered = max(_COVERED * rate_std * span, _HARMLESS_S)
        yield Finding(
            Code.CLOCK_DRIFT,
            message(
                "clock_drift.loses" if change < 0 else "clock_drift.gains",
                change=abs(change),
                span=span,
                rate=1e6 * clock.rate,
                std=1e6 * clock.rate_sigma,
            ),
            sensor.label,
            severity="error" if abs(change) > covered else "warning",
        )
    if abs(clock.jump) > max(_LEAST_JUMP_S, _SIGMAS * clock.jump_sigma):
        yield Finding(
            Code.CLOCK_STEP,
            message(
                "clock_step.jumps", jump=clock.jump, std=clock.jump_sigma, time=clock.jump_time
            ),
            sensor.label,
            severity="error",
        )
    off = clock.offset - mean
    hidden = hidden_delay(stated_window(sensor.settings))
    if abs(off) > max(_LEAST_S, _SIGMAS * clock.sigma, hidden):
        stated = sensor.settings.time_offset_s
        offset = stated + off
        yield Finding(
            Code.CLOCK_OFFSET,
            message(
                "clock_offset.late" if offset > 0 else "clock_offset.early",
                size=abs(offset),
                std=max(clock.sigma, 0.005),
                instead="" if stated == 0.0 else message("clock_offset.instead", stated=stated),
                section=sensor.section,
                offset=offset,
            ),
            sensor.label,
            severity="error" if abs(off) > max(_COVERED * std, _HARMLESS_S) else "warning",
        )


def far_clock_finding(sensor: Gnss | Dvl | DvlBeams, offset: float) -> Finding:
    """Return what an offset of many seconds is, as an error."""
    if abs(abs(offset) - LEAP_SECONDS) < 1.5:
        return Finding(
            Code.LEAP_SECONDS,
            message("leap_seconds.late" if offset > 0 else "leap_seconds.early", size=abs(offset)),
            sensor.label,
            severity="error",
        )
    return Finding(
        Code.CLOCK_OFFSET,
        message(
            "clock_offset.far_late" if offset > 0 else "clock_offset.far_early",
            size=abs(offset),
            section=sensor.section,
            offset=offset,
        ),
        sensor.label,
        severity="error",
    )


def whole_hours(first: tuple[float, float], second: tuple[float, float]) -> int:
    """Return the hours by which a record must be moved to overlap another, 0 if none do.

    Parameters
    ----------
    first, second : tuple of float
        Begin and end of both, s.
    """
    if max(first[0], second[0]) <= min(first[1], second[1]):
        return 0
    hours = (np.mean(first) - np.mean(second)) / 3600.0
    nearest = round(float(hours))
    moved = (second[0] + 3600.0 * nearest, second[1] + 3600.0 * nearest)
    inside = min(first[1], moved[1]) - max(first[0], moved[0])
    shorter = min(first[1] - first[0], second[1] - second[0])
    return nearest if abs(nearest) <= 14 and inside > 0.5 * shorter else 0


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
