"""What is implausible about the records of a planar trial, before anything is solved."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.timestamps import JUMP
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.trial import PlanarTrial

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


def planar_findings(trial: PlanarTrial) -> Iterator[Finding]:
    """Check gaps, units and signs of the records of a trial.

    Parameters
    ----------
    trial : PlanarTrial
        As loaded.
    """
    heading, log, depth = trial.heading, trial.log, trial.depth
    for record, values in ((heading, heading.heading), (log, log.speed), (depth, depth.depth)):
        yield from _gaps(record.time[~np.isnan(values)], record.label)
    psi = heading.heading[~np.isnan(heading.heading)] / DEG
    if psi.size > 2 and np.abs(psi).max() <= 2.0 * np.pi:
        noise = float(np.median(np.abs(np.diff(psi))))
        if noise < _QUIET * heading.settings.std_deg:
            yield Finding(
                Code.HEADING_UNIT,
                f"all of it is within {np.abs(psi).max():.2g} deg of north, and varies less "
                f"than its standard deviation of {heading.settings.std_deg:g} deg: is it in "
                "radians?",
                heading.label,
            )
    speed = float(np.nanmedian(log.speed)) if np.isfinite(log.speed).any() else 0.0
    if speed < -_MOVING_M_S:
        yield Finding(
            Code.LOG_SIGN,
            f"the speed is {speed:.3g} m/s in the median, astern: speed_m_s is positive ahead",
            log.label,
        )
    if abs(speed) <= _MOVING_M_S and len(trial.beacons.settings.positions) == 1:
        yield Finding(
            Code.AT_REST,
            f"the speed is {abs(speed):.2g} m/s in the median: one beacon gives only a circle for "
            "a vehicle at rest, and the hypotheses are points on it",
            log.label,
        )
    below = float(np.nanmedian(depth.depth)) if np.isfinite(depth.depth).any() else 0.0
    if below < -_ABOVE_SEA_M:
        yield Finding(
            Code.DEPTH_SIGN,
            f"the depth is {below:.4g} m in the median, above the sea: depth_m is positive down",
            depth.label,
        )
    sea = depth.settings.sea_surface_height_m
    for name, place in trial.beacons.settings.positions.items():
        above = place.height_m - sea
        if above > _ABOVE_SEA_M + 3.0 * place.std_m:
            yield Finding(
                Code.BEACON_HEIGHT,
                f"{name} is {above:.4g} m above the sea surface: height_m is positive up, and "
                "`depth.sea_surface_height_m` the height of the sea above the ellipsoid",
                trial.beacons.label,
            )


def _gaps(time: Array, label: str) -> Iterator[Finding]:
    """Yield what to say of jumps and gaps between (M,) times."""
    steps = np.diff(time)
    for k in np.flatnonzero(steps > JUMP).tolist():
        yield Finding(
            Code.CLOCK_JUMP,
            f"time_s jumps from {time[k]:.10g} to {time[k + 1]:.10g} s; only the part with the "
            "most ranges is used. Write all of time_s by one clock",
            label,
            severity="warning",
        )
    steps = np.where(steps > JUMP, 0.0, steps)
    if not steps.size:
        return
    gaps = steps[steps > max(_GAP_S, _GAP_INTERVALS * float(np.median(steps)))]
    if gaps.size:
        k = int(np.argmax(steps))
        count = "1 gap" if gaps.size == 1 else f"{gaps.size} gaps, the longest"
        yield Finding(
            Code.GAPS,
            f"{count} from {time[k]:.10g} to {time[k + 1]:.10g} s: it is interpolated, as if the "
            "vehicle had not manoeuvred. The standard deviations do not contain this error",
            label,
            severity="warning",
        )
