"""From a planar trial to the problem that the smoother minimises."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array, interpolate
from factorgraph_dvl.imu.timestamps import JUMP
from factorgraph_dvl.ranging.model import PlanarProblem, Ranging
from factorgraph_dvl.ranging.planar_track import (
    LEAST_PSD,
    SLOPE_OVER,
    PlanarTrack,
    track_from_records,
    velocity_change_psd,
)
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.sensors.depth import Depth
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.speed_log import Heading, SpeedLog
from factorgraph_dvl.trial import InitialPosition, Trial

# Chosen: times closer than this, s, are one node. The information of a shorter step leaves no
# digits for that of the ranges.
_LEAST_INTERVAL = 1e-3
# Chosen: values further apart, s, miss a whole turn of a vehicle.
_SLOWEST_S = 60.0


@dataclass(frozen=True)
class RangingSetup:
    """A problem, and what it was made from.

    Parameters
    ----------
    problem : PlanarProblem
        What the smoother minimises.
    track : PlanarTrack
        Dead-reckoned.
    frame : LocalFrame
        Tangent frame of the problem.
    rows : ndarray of np.intp, shape (m,)
        Rows of the beacons' record that are in the problem.
    uncovered : int
        Measurements at times without heading, speed or depth.
    """

    problem: PlanarProblem
    track: PlanarTrack
    frame: LocalFrame
    rows: NDArray[np.intp]
    uncovered: int


def dead_reckoned(trial: Trial) -> PlanarTrack:
    """Return the track of a trial by heading, speed and depth.

    Raises
    ------
    ConfigError
        If the trial has no compass, log, depth sensor or beacons.
    DataError
        If one of them has no values or too few, or they have no time in common.
    """
    heading, log = trial.required(Heading), trial.required(SpeedLog)
    depth, beacons = trial.required(Depth), trial.required(Beacons)
    parts = []
    for record, values in ((heading, heading.heading), (log, log.speed), (depth, depth.depth)):
        known = ~np.isnan(values)
        if not known.any():
            raise DataError("no values", where=record.source, expected="at least one")
        parts.append((record.time[known], values[known]))
    first, last = _between_jumps([time for time, _ in parts], beacons.time)
    start = max(first, *(time[0] for time, _ in parts))
    end = min(last, *(time[-1] for time, _ in parts))
    if not start < end:
        raise DataError(
            "heading, log and depth have no time in common",
            where=f"{heading.source}, {log.source}, {depth.source}",
            expected="records of the same time",
            hint="Check that all clocks start together",
        )
    for record, (time, _) in ((heading, parts[0]), (log, parts[1])):
        apart = float(np.median(np.diff(time)))
        if apart > _SLOWEST_S:
            raise DataError(
                f"one value every {apart:.4g} s",
                where=record.source,
                expected=f"values at most {_SLOWEST_S:g} s apart for dead reckoning",
                hint="Check that time_s is in seconds",
            )
    inside = [(time >= first) & (time <= last) for time, _ in parts]
    (heading_time, psi), (log_time, speed), (depth_time, below) = (
        (time[own], values[own]) for (time, values), own in zip(parts, inside, strict=True)
    )
    starboard = np.nan_to_num(log.starboard[~np.isnan(log.speed)])[inside[1]]
    return track_from_records(
        (heading_time, psi, heading.settings.std_rad),
        (log_time, speed, starboard, log.settings.speed_std_m_s),
        (depth_time, depth.settings.sea_surface_height_m - below),
        beacons.time[(beacons.time >= start) & (beacons.time <= end)],
    )


def _between_jumps(records: Sequence[Array], beacons: Array) -> tuple[float, float]:
    """Return the span without a jump of the clock of any record with most rows of the beacons."""
    jumps = [
        (float(time[k]), float(time[k + 1]))
        for time in records
        for k in np.flatnonzero(np.diff(time) > JUMP)
    ]
    edges = np.unique([-np.inf, *itertools.chain(*jumps), np.inf])
    first, last = edges[:-1], edges[1:]
    rows = np.searchsorted(beacons, last, "right") - np.searchsorted(beacons, first)
    for before, after in jumps:
        rows[(first >= before) & (last <= after)] = -1
    k = int(np.argmax(rows))
    return float(first[k]), float(last[k])


def planar_setup(trial: Trial) -> RangingSetup:
    """Return the problem of a planar trial.

    Raises
    ------
    ConfigError, DataError
        As of `dead_reckoned`, or if there are no ranges at times when heading, speed and depth
        are known.
    """
    track = dead_reckoned(trial)
    log, beacons = trial.required(SpeedLog), trial.required(Beacons)
    parameters = (
        *(p for p in log.parameters() if p.stem == "current"),
        *beacons.parameters(),
        *(p for p in log.parameters() if p.stem != "current"),
        *trial.required(Heading).parameters(),
    )
    arm = np.array(beacons.settings.lever_arm_m)
    level = np.zeros((track.time.size, 3))
    level[:, 2] = track.heading
    arm_n = rotation_from_rph(level, trial.body_axes) @ arm
    return ranging_setup(
        track,
        arm_n,
        beacons,
        parameters,
        trial.frame(),
        trial.initial_position,
        trial.required(Depth).settings.std_m,
    )


def ranging_setup(
    track: PlanarTrack,
    arm_n: Array,
    beacons: Beacons,
    parameters: tuple[Parameter, ...],
    frame: LocalFrame,
    initial: InitialPosition | None = None,
    depth_std: float = 0.0,
) -> RangingSetup:
    """Return the problem of a dead-reckoned track with beacons.

    Parameters
    ----------
    track : PlanarTrack
        On its grid.
    arm_n : ndarray, shape (G, 3)
        Lever arm of the transponder on that grid, in n, m.
    beacons : Beacons
        Their record.
    parameters : tuple of Parameter
        Constants with priors.
    frame : LocalFrame
        Tangent frame.
    initial : InitialPosition, optional
        Prior of the first position, None if there is none.
    depth_std : float, default 0.0
        White noise of the height, m; its share in a range is the sine of the elevation.

    Raises
    ------
    DataError
        If no measurement lies within the track.
    """
    grid = track.time
    present = ~beacons.missing
    covered = (beacons.time >= grid[0]) & (beacons.time <= grid[-1])
    rows = np.flatnonzero(present & covered)
    if not present.any():
        raise DataError(
            "there is no range and no range rate",
            where=beacons.source,
            expected="numbers in the column range_m or range_rate_m_s",
        )
    if not rows.size:
        first, last = beacons.time[present][[0, -1]]
        raise DataError(
            f"no range within the dead-reckoned track, {grid[0]:.10g} to "
            f"{grid[-1]:.10g} s: they are from {first:.10g} to {last:.10g} s",
            where=beacons.source,
            expected="ranges while the other sensors run",
            hint="Check that all clocks start together, and that all times are in seconds",
        )
    ends = [t for t in grid[[0, -1]] if np.abs(beacons.time[rows] - t).min() > _LEAST_INTERVAL]
    time = np.union1d(beacons.time[rows], ends)
    at = track.at(time)
    rate = np.gradient(arm_n, grid, axis=0)

    s = beacons.settings
    places = np.array([place.geodetic for place in s.positions.values()])
    # A bound only: the vehicle is within hearing of the beacons.
    reach = 2.0 * float(np.nanmax(beacons.range[rows], initial=1e4))
    mean, cov = np.mean(frame.position(*places.T)[:, :2], axis=0), reach**2 * np.eye(2)
    if initial is not None:
        mean = frame.position(*initial.geodetic)[:2]
        cov = np.diag(np.maximum(initial.std[:2], 1e-3) ** 2)
    names = list(s.positions)
    dt = np.maximum(np.diff(time), _LEAST_INTERVAL)
    share = np.minimum(dt, track.interval)
    changing = interpolate(0.5 * (time[1:] + time[:-1]), grid, velocity_change_psd(track))
    # What the noise at the ends of a step already accounts for.
    counted = share[:, None, None] ** 2 * at.velocity_cov[:-1]
    node = np.searchsorted(time, beacons.time[rows])
    beacon = np.array([names.index(name) for name in beacons.name[rows]])
    place = frame.position(*places.T)
    above = np.abs((at.height - frame.height)[node] - place[beacon, 2])
    sine = np.clip(above / np.nan_to_num(beacons.range[rows], nan=reach), 0.0, 1.0)
    climb_std = np.sqrt(2.0) * depth_std / SLOPE_OVER
    problem = PlanarProblem(
        time=time,
        step=np.diff(at.displacement, axis=0),
        step_cov=_positive(np.diff(at.noise, axis=0) - counted, LEAST_PSD * dt),
        share=share,
        velocity=at.velocity,
        velocity_cov=at.velocity_cov,
        change_cov=changing * dt[:, None, None],
        height=at.height - frame.height,
        climb=at.climb,
        arm=interpolate(time, grid, arm_n),
        arm_velocity=interpolate(time, grid, rate),
        place=place,
        ranging=Ranging(
            node=node,
            beacon=beacon,
            range=beacons.range[rows],
            rate=beacons.range_rate[rows],
            range_std=np.hypot(s.range_std_m, sine * depth_std),
            rate_std=np.hypot(s.range_rate_std_m_s, sine * climb_std),
        ),
        parameters=parameters,
        start_mean=mean,
        start_cov=cov,
        start_known=initial is not None,
        tan_lat=0.0 if track.tangent else float(np.tan(frame.lat)),
    )
    return RangingSetup(problem, track, frame, rows, int((present & ~covered).sum()))


def _positive(matrices: Array, least: Array) -> Array:
    """Return symmetric matrices (M, 2, 2) with eigenvalues of at least (M,)."""
    values, vectors = np.linalg.eigh(matrices)
    values = np.maximum(values, least[:, None])
    return (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1)
