"""Dead reckoning in the plane by heading, speed and depth, and how smooth the motion is."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import msgspec
import numpy as np
from scipy.integrate import cumulative_trapezoid

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import rph_from_rotation
from factorgraph_dvl.geometry.vectors import Array, interpolate, rotate
from factorgraph_dvl.imu.timestamps import JUMP
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.sensors.depth import Depth, DepthSettings
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.speed_log import (
    CURRENT,
    HEADING_BIAS,
    SCALE_ERROR,
    Heading,
    HeadingSettings,
    LogSettings,
    SpeedLog,
)
from factorgraph_dvl.trial import InitialPosition, Trial

# Chosen: values further apart, s, miss a whole turn of a vehicle.
_SLOWEST_S = 60.0
# Chosen: velocities closer than this, s, show no more.
_LEAST_INTERVAL = 0.2
# Chosen: time over which the rate of climb is taken, s; between two depths it is noise.
_SLOPE_OVER = 10.0
# Chosen: times over which the smoothness of the motion is estimated, s, the longest first: from a
# slow turn to a quick one.
_SMOOTH_OVER = (60.0, 20.0, 6.0)
# Chosen: slopes over the shorter times count from this many standard deviations on.
_SIGNIFICANT = 3.0
# Chosen: keeps the density of acceleration regular, m²/s³.
_LEAST_DENSITY = 1e-10
# Chosen: standard deviations of dead reckoning before anything is solved, wide of what alignment
# and a DVL's data sheet promise: heading, deg, scale of the speed, noise of the velocity, m/s in
# 1 s, and current, m/s.
_HEADING_DEG = 2.0
_SCALE = 0.02
_VELOCITY = 0.05
_CURRENT = 0.5


@dataclass(frozen=True)
class DeadReckoning:
    """A dead-reckoned track, on a grid on which everything is linear in time.

    Parameters
    ----------
    time : ndarray, shape (G,), s
        Times of the grid: of the log or the compass, whichever is faster.
    heading : ndarray, shape (G,)
        Clockwise from north, unwrapped, rad.
    velocity : ndarray, shape (G, 2), m/s
        Through the water or over ground, east and north.
    height, climb : ndarray, shape (G,)
        Height above the ellipsoid and its rate, m, m/s.
    density : ndarray, shape (G, 2, 2), m²/s³
        Power spectral density of changes of the true velocity.
    spread : ndarray, shape (G,), m²
        Variance of the displacement since the start, of both components together.
    heading_std, height_std, climb_std : float
        White noise of each value, rad, m, m/s.
    log : SpeedLog
        Log on this grid.
    beacons : Beacons
        Beacons as recorded.
    parameters : tuple of Parameter
        Constants with priors, fixed ones included.
    """

    time: Array
    heading: Array
    velocity: Array
    height: Array
    climb: Array
    density: Array
    spread: Array
    heading_std: float
    height_std: float
    climb_std: float
    log: SpeedLog
    beacons: Beacons
    parameters: tuple[Parameter, ...]
    heading_bias: ClassVar[str] = HEADING_BIAS
    current: ClassVar[str] = CURRENT

    @property
    def displacement(self) -> Array:
        """Since the start, east and north, (G, 2), m."""
        return np.asarray(cumulative_trapezoid(self.velocity, self.time, axis=0, initial=0))

    def over_ground(self, time: Array, values: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return displacement since the start and velocity over ground at times (M,), (M, 2).

        Parameters
        ----------
        time : ndarray, shape (M,), s
            Within the track.
        values : mapping of str to ndarray
            Constants by name, SI.
        """
        b, gain = float(values[HEADING_BIAS][0]), 1.0 + float(values[SCALE_ERROR][0])
        turn = np.array([[np.cos(b), np.sin(b)], [-np.sin(b), np.cos(b)]]) / gain
        since = (time - self.time[0])[:, None]
        moved = interpolate(time, self.time, self.displacement) @ turn
        velocity = interpolate(time, self.time, self.velocity) @ turn
        return moved + values[CURRENT] * since, velocity + values[CURRENT]


def dead_reckoned(trial: Trial) -> DeadReckoning:
    """Return the track of a trial by heading, speed and depth.

    Velocity u [sin psi, cos psi] + w [cos psi, -sin psi], between samples linear in heading
    and speeds.

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
        apart = float(np.median(np.diff(time))) if time.size > 1 else np.inf
        if apart > _SLOWEST_S:
            raise DataError(
                f"one value every {apart:.4g} s",
                where=record.source,
                expected=f"values at most {_SLOWEST_S:g} s apart for dead reckoning",
                hint="Check that time_s is in seconds",
            )
    inside = [(time >= first) & (time <= last) for time, _ in parts]
    (heading_time, psi), (log_time, u), (depth_time, below) = (
        (time[own], values[own]) for (time, values), own in zip(parts, inside, strict=True)
    )
    _check_covered(beacons, start, end)
    starboard = log.starboard[~np.isnan(log.speed)][inside[1]]
    faster = min((heading_time, log_time), key=_interval)
    grid = _thinned(np.unique([start, *faster[(faster > start) & (faster < end)], end]))
    interval = _interval(grid)
    # A value that stands for several of the grid has as much more noise there.
    shares = [max(_interval(t) / interval, 1.0) ** 0.5 for t in (heading_time, log_time)]
    speed_std = log.settings.speed_std_m_s * shares[1]
    on_grid = replace(
        log,
        settings=msgspec.structs.replace(log.settings, speed_std_m_s=speed_std),
        time=grid,
        speed=np.interp(grid, log_time, u),
        starboard=np.interp(grid, log_time, np.nan_to_num(starboard))
        if np.isfinite(starboard).any()
        else np.full(grid.size, np.nan),
    )
    height = trial.required(Depth).settings.sea_surface_height_m - below
    return _track(
        on_grid,
        np.interp(grid, heading_time, np.unwrap(psi)),
        heading.settings.std_rad * shares[0],
        np.interp(grid, depth_time, height),
        np.interp(grid, depth_time, _slope(depth_time, height)),
        depth.settings.std_m,
        beacons,
        heading.parameters(),
    )


def _check_covered(beacons: Beacons, start: float, end: float) -> None:
    """Raise DataError if no measurement lies within the track."""
    heard = beacons.time[~beacons.missing]
    if not heard.size:
        raise DataError(
            "there is no range and no range rate",
            where=beacons.source,
            expected="numbers in the column range_m or range_rate_m_s",
        )
    if not np.any((heard >= start) & (heard <= end)):
        raise DataError(
            f"no range within the dead-reckoned track, {start:.10g} to {end:.10g} s: they are "
            f"from {heard[0]:.10g} to {heard[-1]:.10g} s",
            where=beacons.source,
            expected="ranges while the other sensors run",
            hint="Check that all clocks start together, and that all times are in seconds",
        )


def _track(
    log: SpeedLog,
    heading: Array,
    heading_std: float,
    height: Array,
    climb: Array,
    depth_std: float,
    beacons: Beacons,
    of_heading: Sequence[Parameter],
) -> DeadReckoning:
    """Return the track of a log on a grid, with heading and height there."""
    sine, cosine = np.sin(heading), np.cos(heading)
    ahead, abeam = np.stack([sine, cosine], axis=1), np.stack([cosine, -sine], axis=1)
    starboard = np.nan_to_num(log.starboard)
    velocity = log.speed[:, None] * ahead + starboard[:, None] * abeam
    turned = heading_std * np.stack([velocity[:, 1], -velocity[:, 0]], axis=1)
    std = log.settings.speed_std_m_s
    noise = turned[:, :, None] * turned[:, None, :] + std**2 * ahead[:, :, None] * ahead[:, None]
    if np.isfinite(log.starboard).any():
        noise += std**2 * abeam[:, :, None] * abeam[:, None]
    interval = _interval(log.time)
    variance = interval * np.trace(noise, axis1=1, axis2=2)
    return DeadReckoning(
        time=log.time,
        heading=heading,
        velocity=velocity,
        height=height,
        climb=climb,
        density=_velocity_change_density(log.time, velocity, noise),
        spread=cumulative_trapezoid(variance, log.time, initial=0),
        heading_std=heading_std,
        height_std=depth_std,
        climb_std=np.sqrt(2.0) * depth_std / _SLOPE_OVER,
        log=log,
        beacons=beacons,
        parameters=(
            *(p for p in log.parameters() if p.name == CURRENT),
            *beacons.parameters(),
            *(p for p in log.parameters() if p.name != CURRENT),
            *of_heading,
        ),
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


def _thinned(time: Array) -> Array:
    """Return times, the first and the last among them, that are far enough apart."""
    kept = [float(time[0])]
    for t in time[1:-1].tolist():
        if t - kept[-1] >= _LEAST_INTERVAL and time[-1] - t >= _LEAST_INTERVAL:
            kept.append(t)
    return np.array([*kept, float(time[-1])])


def _velocity_change_density(time: Array, velocity: Array, noise: Array) -> Array:
    """Return the power spectral density of changes of the true velocity, (G, 2, 2), m²/s³.

    A straight line through the velocities of a time W around a moment has a slope a, of
    covariance S by their noise: so within W the velocity changes by W² (|a|² I + S), at most, as
    a random walk of density W (|a|² I + S). Of lines through shorter times, which see short
    turns, only slopes count that noise does not explain.
    """
    longest, *shorter = _SMOOTH_OVER
    slope, width, spread = _slopes(time, velocity, noise, longest)
    square = width * np.sum(slope**2, axis=1)
    for over in shorter:
        slope, each, own = _slopes(time, velocity, noise, over)
        size = np.sum(slope**2, axis=1)
        significant = size > _SIGNIFICANT**2 * np.trace(own, axis1=1, axis2=2)
        square = np.maximum(square, np.where(significant, each * size, 0.0))
    square = square + _LEAST_DENSITY
    return square[:, None, None] * np.eye(2) + width[:, None, None] * spread


def _slopes(time: Array, v: Array, noise: Array, over: float) -> tuple[Array, Array, Array]:
    """Return slopes (G, 2) of lines through velocities, their widths (G,) and covariances."""
    interval = _interval(time)
    low, high = np.maximum(time - 0.5 * over, time[0]), np.minimum(time + 0.5 * over, time[-1])
    width = np.maximum(high - low, 2.0 * interval)
    middle = 0.5 * (low + high)
    # A line through a piecewise linear function: slope = 12 / W³ ∫ (t - m) v dt.
    zeroth = cumulative_trapezoid(v, time, axis=0, initial=0)
    first = cumulative_trapezoid((time - time[0])[:, None] * v, time, axis=0, initial=0)

    def between(integral: Array) -> Array:
        return interpolate(high, time, integral) - interpolate(low, time, integral)

    moment = between(first) - (middle - time[0])[:, None] * between(zeroth)
    slope = 12.0 * moment / width[:, None] ** 3
    return slope, width, (12.0 * interval / width**3)[:, None, None] * noise


def _interval(time: Array) -> float:
    return float(np.median(np.diff(time))) if time.size > 1 else 1.0


def _slope(time: Array, values: Array) -> Array:
    """Return the mean slope over some seconds: that between two depths is noise."""
    half = 0.5 * _SLOPE_OVER
    before, after = np.maximum(time - half, time[0]), np.minimum(time + half, time[-1])
    rise = np.interp(after, time, values) - np.interp(before, time, values)
    return rise / np.maximum(after - before, 1e-9)


def as_planar(
    trial: Trial,
    frame: LocalFrame,
    time: Array,
    nRb: Array,
    p_n: Array,
    v_n: Array,
    first: InitialPosition | None,
) -> Trial:
    """Return a trial whose motion is known but for position, course and current as a planar one.

    Parameters
    ----------
    trial : Trial
        Trial with beacons.
    frame : LocalFrame
        Tangent frame of the motion.
    time : ndarray, shape (K,), s
        Times of the motion.
    nRb : ndarray, shape (K, 3, 3)
        Attitude, body to n.
    p_n, v_n : ndarray, shape (K, 3)
        Position, m, but for a constant, and velocity, m/s.
    first : InitialPosition, optional
        What is known of the first position.
    """
    level = frame.level_from_tangent(*frame.geodetic(p_n)[:2])
    heading = rph_from_rotation(level @ nRb, trial.body_axes)[:, 2]
    v = rotate(level, v_n)
    sine, cosine = np.sin(heading), np.cos(heading)
    drifts = trial.dvl is not None and trial.dvl.settings.reference == "water"
    log = LogSettings(
        speed_std_m_s=_VELOCITY,
        scale_error_std=_SCALE,
        reference="water" if drifts else "bottom",
        current_std_m_s=(_CURRENT, _CURRENT),
    )
    depth = trial.depth
    if depth is None or depth.missing.all():
        height = frame.geodetic(p_n)[2]
        if trial.gnss is None and trial.initial_position is None:
            # Nothing gives a height: take the start to be at the surface.
            height = height - height[0]
        depth = Depth(DepthSettings(), time, -height)
    others = (
        Heading(HeadingSettings(std_deg=1e-3, bias_std_deg=_HEADING_DEG), time, heading),
        SpeedLog(log, time, sine * v[:, 0] + cosine * v[:, 1], cosine * v[:, 0] - sine * v[:, 1]),
        depth,
        trial.required(Beacons),
    )
    return Trial(
        trial.name, None, others=others, body_axes=trial.body_axes, initial_position=first
    )
