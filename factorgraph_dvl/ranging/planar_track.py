"""Dead reckoning in the plane: displacement, velocity and their uncertainty over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid

from factorgraph_dvl.geometry.vectors import Array, interpolate

# Chosen: least power spectral density of displacement, m²/s, 3 mm in 1 s; the normal equations
# lose their digits below it.
LEAST_PSD = 1e-5
# Chosen: keeps the covariance of the velocity regular, m²/s².
_LEAST_VELOCITY_VARIANCE = 1e-6
# Chosen: time over which the rate of climb is taken, s; between two depths it is noise.
SLOPE_OVER = 10.0
# Chosen: times over which the smoothness of the motion is estimated, s, the longest first: from a
# slow turn to a quick one.
_SMOOTH_OVER = (60.0, 20.0, 6.0)
# Chosen: slopes over the shorter times count from this many standard deviations on.
_SIGNIFICANT = 3.0


@dataclass(frozen=True)
class PlanarTrack:
    """A dead-reckoned track, on a grid on which everything is linear in time.

    Parameters
    ----------
    time : ndarray, shape (G,), s
        Of the grid.
    displacement : ndarray, shape (G, 2)
        From the start, east and north, through the water or over ground, m.
    velocity : ndarray, shape (G, 2), m/s
        Its derivative.
    height, climb : ndarray, shape (G,)
        Above the ellipsoid and its rate, m, m/s.
    noise : ndarray, shape (G, 2, 2), m²
        Covariance of the displacement since the start.
    velocity_cov : ndarray, shape (G, 2, 2), m²/s²
        Noise of the velocity.
    heading : ndarray, shape (G,)
        Clockwise from north, unwrapped, rad.
    heading_std : float
        White noise of the heading, rad.
    interval : float
        Time over which a sample stands for the velocity, s.
    tangent : bool, optional
        Whether displacement and velocity are in the tangent frame already, and not relative to
        north where the vehicle is.
    """

    time: Array
    displacement: Array
    velocity: Array
    height: Array
    climb: Array
    noise: Array
    velocity_cov: Array
    heading: Array
    heading_std: float
    interval: float
    tangent: bool = False

    def at(self, time: Array) -> PlanarTrack:
        """Return the track at times (M,) within it."""

        def pick(values: Array) -> Array:
            return interpolate(time, self.time, values)

        return PlanarTrack(
            time,
            pick(self.displacement),
            pick(self.velocity),
            pick(self.height),
            pick(self.climb),
            pick(self.noise),
            pick(self.velocity_cov),
            pick(self.heading),
            self.heading_std,
            self.interval,
            self.tangent,
        )


def track_from_records(
    heading: tuple[Array, Array, float],
    speed: tuple[Array, Array, Array, float],
    height: tuple[Array, Array],
    extra: Array,
) -> PlanarTrack:
    """Return the dead-reckoned track of heading, speed and height.

    Velocity u [sin psi, cos psi] + w [cos psi, -sin psi], between samples linear in heading
    and speeds, integrated by the trapezoidal rule. White noise of samples dt apart, of
    standard deviation s, makes the integral a random walk of density s² dt: of the speeds that
    were measured, and of the heading, times the speed, across the velocity.

    Parameters
    ----------
    heading : tuple of (ndarray, ndarray, float)
        Times (s), values (rad), standard deviation (rad).
    speed : tuple of (ndarray, ndarray, ndarray, float)
        Times (s), ahead u and to starboard w (m/s), standard deviation of each (m/s).
    height : tuple of (ndarray, ndarray)
        Times (s) and heights (m).
    extra : ndarray, shape (M,)
        Times that must be on the grid, within all three records.
    """
    heading_time, psi, heading_std = heading
    speed_time, u, w, speed_std = speed
    height_time, h = height
    first = max(heading_time[0], speed_time[0], height_time[0])
    last = min(heading_time[-1], speed_time[-1], height_time[-1])
    grid = np.unique(np.concatenate([heading_time, speed_time, extra, [first, last]]))
    grid = grid[(grid >= first) & (grid <= last)]
    psi_at = np.interp(grid, heading_time, np.unwrap(psi))
    u_at = np.interp(grid, speed_time, u)
    ahead = np.stack([np.sin(psi_at), np.cos(psi_at)], axis=1)
    abeam = np.stack([np.cos(psi_at), -np.sin(psi_at)], axis=1)
    velocity = u_at[:, None] * ahead + np.interp(grid, speed_time, w)[:, None] * abeam
    turned = heading_std * np.stack([velocity[:, 1], -velocity[:, 0]], axis=1)
    by_heading = turned[:, :, None] * turned[:, None, :]
    by_speed = speed_std**2 * ahead[:, :, None] * ahead[:, None, :]
    if np.any(w):
        by_speed = by_speed + speed_std**2 * abeam[:, :, None] * abeam[:, None, :]
    psd = _interval(speed_time) * by_speed + _interval(heading_time) * by_heading
    return PlanarTrack(
        time=grid,
        displacement=cumulative_trapezoid(velocity, grid, axis=0, initial=0),
        velocity=velocity,
        height=np.interp(grid, height_time, h),
        climb=np.interp(grid, height_time, _slope(height_time, h)),
        noise=cumulative_trapezoid(psd + LEAST_PSD * np.eye(2), grid, axis=0, initial=0),
        velocity_cov=by_speed + by_heading + _LEAST_VELOCITY_VARIANCE * np.eye(2),
        heading=psi_at,
        heading_std=heading_std,
        interval=min(_interval(speed_time), _interval(heading_time)),
    )


def velocity_change_psd(track: PlanarTrack) -> Array:
    """Return the power spectral density of changes of the true velocity, (G, 2, 2), m²/s³.

    A straight line through the velocities of a time W around a moment has a slope a, of
    covariance S by their noise: so within W the velocity changes by W² (|a|² I + S), at most, as
    a random walk of density W (|a|² I + S). Of lines through shorter times, which see short
    turns, only slopes count that noise does not explain.
    """
    longest, *shorter = _SMOOTH_OVER
    slope, width, noise = _slopes(track, longest)
    square = width * np.sum(slope**2, axis=1)
    for over in shorter:
        slope, each, spread = _slopes(track, over)
        size = np.sum(slope**2, axis=1)
        significant = size > _SIGNIFICANT**2 * np.trace(spread, axis1=1, axis2=2)
        square = np.maximum(square, np.where(significant, each * size, 0.0))
    return square[:, None, None] * np.eye(2) + width[:, None, None] * noise


def _slopes(track: PlanarTrack, over: float) -> tuple[Array, Array, Array]:
    """Return slopes (G, 2) of lines through velocities, their widths (G,) and covariances."""
    time, v = track.time, track.velocity
    low, high = np.maximum(time - 0.5 * over, time[0]), np.minimum(time + 0.5 * over, time[-1])
    width = np.maximum(high - low, 2.0 * track.interval)
    middle = 0.5 * (low + high)
    # A line through a piecewise linear function: slope = 12 / W³ ∫ (t - m) v dt.
    zeroth = cumulative_trapezoid(v, time, axis=0, initial=0)
    first = cumulative_trapezoid((time - time[0])[:, None] * v, time, axis=0, initial=0)

    def between(integral: Array) -> Array:
        return interpolate(high, time, integral) - interpolate(low, time, integral)

    moment = between(first) - (middle - time[0])[:, None] * between(zeroth)
    slope = 12.0 * moment / width[:, None] ** 3
    return slope, width, (12.0 * track.interval / width**3)[:, None, None] * track.velocity_cov


def _interval(time: Array) -> float:
    return float(np.median(np.diff(time))) if time.size > 1 else 1.0


def _slope(time: Array, values: Array) -> Array:
    """Return the mean slope over some seconds: that between two depths is noise."""
    half = 0.5 * SLOPE_OVER
    before, after = np.maximum(time - half, time[0]), np.minimum(time + half, time[-1])
    rise = np.interp(after, time, values) - np.interp(before, time, values)
    return rise / np.maximum(after - before, 1e-9)
