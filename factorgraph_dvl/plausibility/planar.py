"""What is implausible about the records of a planar trial, before anything is solved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.timestamps import JUMP
from factorgraph_dvl.message import message
from factorgraph_dvl.plausibility.records import SensorSurvey
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.sensors.depth import Depth
from factorgraph_dvl.sensors.speed_log import Heading, SpeedLog
from factorgraph_dvl.trial import Trial

# Usual intervals, and seconds, that make a gap. Chosen: a lost sample is none, and in a gap a
# vehicle has time to turn.
_GAP_INTERVALS = 3.0
_GAP_S = 5.0
# Height above the sea, m, from which on it is a mistake. Chosen: tide, and a beacon's float.
_ABOVE_SEA_M = 10.0
# Speed, m/s, up to which a vehicle is at rest, and share of the stated noise below which a record
# has none. Chosen: what currents make; no data sheet is ten times too careful.
_MOVING_M_S = 0.1
_QUIET = 0.1


def planar_findings(trial: Trial, sensors: Sequence[SensorSurvey]) -> Iterator[Finding]:
    """Check overlap, gaps, units and signs of the records of a trial.

    Parameters
    ----------
    trial : Trial
        Trial with compass, log, depth and beacons.
    sensors : sequence of SensorSurvey
        Its records.
    """
    heading, log = trial.required(Heading), trial.required(SpeedLog)
    depth, beacons = trial.required(Depth), trial.required(Beacons)
    surveys = {s.label: s for s in sensors}
    carried = [surveys[record.label] for record in (heading, log, depth)]
    start, end = max(s.start for s in carried), min(s.end for s in carried)
    if not start < end:
        names = message("words.heading_log_and_depth")
        text = message("no_overlap.none_in_common", names=names)
        yield Finding(Code.NO_OVERLAP, text, heading.label, severity="error")
        return
    yield from _overlap(surveys[beacons.label], start, end)
    for record, values in ((heading, heading.heading), (log, log.speed), (depth, depth.depth)):
        yield from _gaps(record.time[~np.isnan(values)], record.label)
    psi = heading.heading[~np.isnan(heading.heading)] / DEG
    if psi.size > 2 and np.abs(psi).max() <= 2.0 * np.pi:
        noise = float(np.median(np.abs(np.diff(psi))))
        if noise < _QUIET * heading.settings.std_deg:
            text = message(
                "heading_unit.near_north", most=np.abs(psi).max(), std=heading.settings.std_deg
            )
            yield Finding(Code.HEADING_UNIT, text, heading.label)
    speed = float(np.nanmedian(log.speed)) if np.isfinite(log.speed).any() else 0.0
    if speed < -_MOVING_M_S:
        yield Finding(Code.LOG_SIGN, message("log_sign.astern", speed=speed), log.label)
    if abs(speed) <= _MOVING_M_S and len(beacons.settings.positions) == 1:
        yield Finding(Code.AT_REST, message("at_rest.circle", speed=abs(speed)), log.label)
    below = float(np.nanmedian(depth.depth)) if np.isfinite(depth.depth).any() else 0.0
    if below < -_ABOVE_SEA_M:
        yield Finding(Code.DEPTH_SIGN, message("depth_sign.above", depth=below), depth.label)
    sea = depth.settings.sea_surface_height_m
    for name, place in beacons.settings.positions.items():
        above = place.height_m - sea
        if above > _ABOVE_SEA_M + 3.0 * place.std_m:
            yield Finding(
                Code.BEACON_HEIGHT,
                message("beacon_height.above", name=name, above=above),
                beacons.label,
            )


def _overlap(beacons: SensorSurvey, start: float, end: float) -> Iterator[Finding]:
    """Yield what to say of beacons that are heard outside the time of the other records, s."""
    names = message("words.heading_log_and_depth")
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


def _gaps(time: Array, label: str) -> Iterator[Finding]:
    """Yield what to say of jumps and gaps between (M,) times."""
    steps = np.diff(time)
    for k in np.flatnonzero(steps > JUMP).tolist():
        yield Finding(
            Code.CLOCK_JUMP,
            message("clock_jump.ranges", start=time[k], end=time[k + 1]),
            label,
            severity="warning",
        )
    steps = np.where(steps > JUMP, 0.0, steps)
    if not steps.size:
        return
    gaps = steps[steps > max(_GAP_S, _GAP_INTERVALS * float(np.median(steps)))]
    if gaps.size:
        k = int(np.argmax(steps))
        yield Finding(
            Code.GAPS,
            message(
                "gaps.interpolated",
                count=gaps.size,
                start=time[k],
                end=time[k + 1],
            ),
            label,
            severity="warning",
        )
