"""Whether ranges to beacons fit the fixes beside them, and what was mistaken where they do not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, interpolate, median
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.plausibility.usbl import BETTER, TIMES
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.trial import Trial

# Fewest ranges to a beacon that are compared, and the longest time between the fixes beside them,
# s. Chosen: a vehicle goes some metres in it.
_FEWEST, _LONGEST = 5, 3.0
# What ranges and fixes may differ by without a mistake, m, and standard deviations of the rest.
# Chosen: lever arms, the way in between fixes, and the height of a fix.
_APART, _FAR = 10.0, 3.0


def beacon_findings(trial: Trial, beacons: Beacons) -> Iterator[Finding]:
    """Yield whose ranges are not the distances from the fixes of GNSS to its stated place."""
    if trial.gnss is None:
        return
    seen = np.isfinite(trial.gnss.geodetic[:, 0])
    time = trial.gnss.time[seen]
    if time.size < _FEWEST:
        return
    place = np.clip(np.searchsorted(time, beacons.time), 1, time.size - 1)
    near = (beacons.time >= time[0]) & (beacons.time <= time[-1])
    near &= (time[place] - time[place - 1] <= _LONGEST) & np.isfinite(beacons.range)
    frame = trial.frame()
    fix_n = interpolate(beacons.time[near], time, frame.position(*trial.gnss.geodetic[seen].T))
    distances = {
        name: np.linalg.norm(fix_n - frame.position(*place.geodetic), axis=1)
        for name, place in beacons.settings.positions.items()
    }
    for name in distances:
        rows = beacons.name[near] == name
        if rows.sum() >= _FEWEST:
            by_name = {other: distance[rows] for other, distance in distances.items()}
            yield from _of_beacon(beacons, name, beacons.range[near][rows], by_name)


def _of_beacon(
    beacons: Beacons, name: str, ranges: Array, distances: Mapping[str, Array]
) -> Iterator[Finding]:
    """Yield what is wrong with the ranges to a beacon, by the distances to all, (M,) each, m."""
    s, distance = beacons.settings, distances[name]
    misfit = median(np.abs(ranges - distance))
    speed = s.sound_speed_error_std * median(distance)
    std = np.linalg.norm([s.positions[name].std_m, s.range_bias_std_m, speed])
    if misfit <= _APART + _FAR * std:
        return
    best, found = misfit / BETTER, None
    for cause, changed, other in _candidates(name, ranges, distances):
        left = median(np.abs(changed - other))
        if left < best:
            best, found = left, cause
    if found is None:
        # Its place may be estimated.
        text = message("beacon_ranges.elsewhere", name=name, misfit=misfit)
        yield Finding(Code.BEACON_RANGES, text, beacons.label, severity="warning")
    else:
        text = message("beacon_ranges.because", name=name, misfit=misfit, left=best, cause=found)
        yield Finding(Code.BEACON_RANGES, text, beacons.label)


def _candidates(
    name: str, ranges: Array, distances: Mapping[str, Array]
) -> Iterator[tuple[Message, Array, Array]]:
    """Yield what may be wrong, the ranges set right, and the distances that they then are."""
    for cause, factor in TIMES:
        yield cause, factor * ranges, distances[name]
    for other, distance in distances.items():
        if other != name:
            yield message("beacon_ranges.other", other=other), ranges, distance
