"""The extended Kalman filters of single-beacon navigation: 4SV-2OB and 4SV-3OB.

Chen, Shang and Lan, Model and algorithm improvement on single beacon underwater tracking,
Journal of Unmanned Undersea Systems 29(4), 2021. Four state variables: position relative to
the beacon and current, east and north; heading and speed drive them. Two observations, slant
range and depth, which give the horizontal distance; the third is the range rate.

They hold what they were told as it is: no sound speed, scale error, heading bias or offset
of a beacon, and no outliers. That is what they are here for, to be compared with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from factorgraph_dvl.conventions import Array
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.kalman.run import History
from factorgraph_dvl.solution import Estimate, Solution, Trajectory
from factorgraph_dvl.trial import PlanarTrial

Method = Literal["4sv-2ob", "4sv-3ob"]
METHODS: tuple[Method, ...] = get_args(Method)

_NAMES = ("current_e_m_s", "current_n_m_s")
_LEAST_CURRENT = 1e-6


@dataclass(frozen=True)
class Filtered:
    """Estimates at all updates of a filter.

    Parameters
    ----------
    time : (U,) s.
    state : (U, 4) position in n, m, and current, m/s.
    covariance : (U, 4, 4).
    velocity : (U, 2) over ground, m/s.
    """

    time: Array
    state: Array
    covariance: Array
    velocity: Array


def filter_planar(
    trial: PlanarTrial,
    method: Method | str,
    *,
    progress: Callable[[str, int, float | None], None] | None = None,
) -> tuple[Solution, History]:
    """Filter a planar trial by 4SV-2OB or 4SV-3OB.

    Parameters
    ----------
    trial : with `initial.position`: the filters cannot find it.
    method : `4sv-2ob` or `4sv-3ob`.
    progress : called with stage, iteration and cost.

    Returns
    -------
    Solution
        Its trajectory is filtered, not smoothed: an epoch for each update.
    History

    Raises
    ------
    ConfigError, DataError
        If the method is unknown, or the trial has no position to start from.
    """
    if method not in METHODS:
        raise ConfigError(f"method is {method!r}", expected=f"one of {', '.join(METHODS)}")
    if trial.initial_position is None:
        raise DataError(
            "the trial has no position to start from",
            where="trial.yaml",
            expected="initial.position: {lat_deg, lon_deg, height_m, std_m}",
            hint="`solve` finds it from the ranges",
        )
    if progress is not None:
        progress(method, 0, None)
    frame = trial.frame()
    mean = frame.position(*trial.initial_position.geodetic)[:2]
    filtered = run_filter(trial, method, mean, trial.initial_position.std[:2])
    m = filtered.time.size
    surface = trial.depth.settings.sea_surface_height_m
    height = surface - _depth_at(trial, filtered.time)
    p = np.column_stack([filtered.state[:, :2], height - frame.height])
    lat, lon, _ = frame.geodetic(p)
    position_cov, velocity_cov = np.zeros((m, 3, 3)), np.zeros((m, 3, 3))
    position_cov[:, :2, :2] = filtered.covariance[:, :2, :2]
    velocity_cov[:, :2, :2] = filtered.covariance[:, 2:, 2:]
    position_cov[:, 2, 2] = velocity_cov[:, 2, 2] = trial.depth.settings.std_m**2
    rph, rph_cov = np.zeros((m, 3)), np.full((m, 3, 3), np.nan)
    rph[:, 2] = np.interp(filtered.time, *_heading(trial))
    rph[:, 2] %= 2.0 * np.pi
    rph_cov[:, 2, 2] = trial.heading.settings.std_rad**2
    value, P = filtered.state[-1, 2:], filtered.covariance[-1, 2:, 2:]
    prior = _current_std(trial)
    std = np.sqrt(np.diag(P))
    estimate = Estimate(
        "current_m_s", _NAMES, value, std, np.zeros(2), prior, (prior > 0.0) & (std <= 0.5 * prior)
    )
    solution = Solution(
        trial=trial.name,
        solver=f"kalman-{method}",
        body_axes=trial.body_axes,
        converged=True,
        iterations=m,
        cost=np.nan,
        estimates=(estimate,),
        covariance=P,
        trajectory=Trajectory(
            time=filtered.time,
            geodetic=np.stack([lat, lon, height], axis=1),
            velocity=np.column_stack([filtered.velocity, np.zeros(m)]),
            rph=rph,
            position_cov=position_cov,
            velocity_cov=velocity_cov,
            rph_cov=rph_cov,
        ),
        warnings=(
            *trial.notes,
            f"{method} takes every range for a good one, and sound speed, log, heading and "
            "beacons for exact",
        ),
    )
    stds = np.sqrt(np.diagonal(filtered.covariance, axis1=1, axis2=2))
    return solution, History(filtered.time, _NAMES, filtered.state[:, 2:], stds[:, 2:])


def run_filter(trial: PlanarTrial, method: Method | str, mean: Array, std: Array) -> Filtered:
    """Run a filter from a position.

    Parameters
    ----------
    trial : PlanarTrial
    method : `4sv-2ob` or `4sv-3ob`.
    mean, std : (2,) position at the start in the trial's frame and its standard deviation, m.

    Returns
    -------
    Filtered
        At the times of the beacons' record that heading and log cover.
    """
    beacons, frame = trial.beacons, trial.frame()
    settings = beacons.settings
    drive = _Drive(trial)
    x = np.array([*mean, 0.0, 0.0])
    P = np.diag([*std, *np.maximum(_current_std(trial), _LEAST_CURRENT)]) ** 2
    places = {n: frame.position(*place.geodetic) for n, place in settings.positions.items()}
    height = trial.depth.settings.sea_surface_height_m - _depth_at(trial, beacons.time)
    now = drive.start
    times, states, covariances, velocities = [], [], [], []
    for i in range(beacons.time.size):
        time = float(beacons.time[i])
        if not drive.start <= time <= drive.end or beacons.missing[i]:
            continue
        moved, Q = drive.between(now, time)
        F = np.eye(4)
        F[0, 2] = F[1, 3] = time - now
        x = F @ x
        x[:2] += moved
        P = F @ P @ F.T
        P[:2, :2] += Q
        now = time
        place = places[str(beacons.name[i])]
        above = height[i] - frame.height - place[2]
        u, C = drive.velocity(time)
        if not np.isnan(beacons.range[i]):
            x, P = _by_range(x, P, place, above, beacons.range[i], settings.range_std_m)
        if method == "4sv-3ob" and not np.isnan(beacons.range_rate[i]):
            rate, rate_std = beacons.range_rate[i], settings.range_rate_std_m_s
            x, P = _by_rate(x, P, place, above, u, C, rate, rate_std)
        times.append(time)
        states.append(x)
        covariances.append(P)
        velocities.append(u + x[2:])
    if not times:
        raise DataError("no range while heading and log run", where=beacons.source)
    return Filtered(np.array(times), np.array(states), np.array(covariances), np.array(velocities))


def _current_std(trial: PlanarTrial) -> Array:
    if trial.log.settings.reference == "bottom":
        return np.zeros(2)
    return np.array(trial.log.settings.current_std_m_s)


def _heading(trial: PlanarTrial) -> tuple[Array, Array]:
    """Return times and measured headings, unwrapped."""
    known = ~np.isnan(trial.heading.heading)
    return trial.heading.time[known], np.unwrap(trial.heading.heading[known])


def _depth_at(trial: PlanarTrial, time: Array) -> Array:
    known = ~np.isnan(trial.depth.depth)
    return np.interp(time, trial.depth.time[known], trial.depth.depth[known])


class _Drive:
    """Heading and speed: displacement and velocity, each with its noise."""

    def __init__(self, trial: PlanarTrial) -> None:
        heading, log = trial.heading, trial.log
        measured = ~np.isnan(log.speed)
        self._heading = _heading(trial)
        starboard = np.nan_to_num(log.starboard[measured])
        self._speed = log.time[measured], log.speed[measured], starboard
        self._std = log.settings.speed_std_m_s, heading.settings.std_rad
        depth = trial.depth.time
        self.start = max(self._heading[0][0], self._speed[0][0], depth[0])
        self.end = min(self._heading[0][-1], self._speed[0][-1], depth[-1])
        self._steps = tuple(
            float(np.median(np.diff(t))) for t in (self._speed[0], self._heading[0])
        )

    def velocity(self, time: float) -> tuple[Array, Array]:
        """Return the velocity through the water (2,), and its covariance (2, 2)."""
        psi = np.interp(time, *self._heading)
        u, w = (np.interp(time, self._speed[0], values) for values in self._speed[1:])
        ahead = np.array([np.sin(psi), np.cos(psi)])
        abeam = np.array([np.cos(psi), -np.sin(psi)])
        speed_std, heading_std = self._std
        across = heading_std * (u * abeam - w * ahead)
        C = speed_std**2 * np.outer(ahead, ahead) + np.outer(across, across)
        return u * ahead + w * abeam, C

    def between(self, a: float, b: float) -> tuple[Array, Array]:
        """Return the displacement from a to b, and its covariance."""
        inner = [t[(t > a) & (t < b)] for t in (self._heading[0], self._speed[0])]
        grid = np.unique(np.concatenate([[a], *inner, [b]]))
        velocity = np.array([self.velocity(t)[0] for t in grid])
        moved = np.trapezoid(velocity, grid, axis=0)
        _, C = self.velocity(0.5 * (a + b))
        return moved, C * max(self._steps) * (b - a)


def _by_range(
    x: Array, P: Array, place: Array, above: float, measured: float, std: float
) -> tuple[Array, Array]:
    """Return state and covariance after a slant range and the depth at that time.

    They give the horizontal distance d = sqrt(r² - z²), whose standard deviation is that of
    the range times r / d.
    """
    distance = np.sqrt(max(measured**2 - above**2, 1.0))
    away = x[:2] - place[:2]
    predicted = max(float(np.hypot(*away)), 1e-3)
    H = np.array([*(away / predicted), 0.0, 0.0])
    return _update(x, P, H, distance - predicted, (std * measured / distance) ** 2)


def _by_rate(
    x: Array,
    P: Array,
    place: Array,
    above: float,
    u: Array,
    C: Array,
    measured: float,
    std: float,
) -> tuple[Array, Array]:
    """Return state and covariance after a range rate; the vertical velocity is taken as 0."""
    away = x[:2] - place[:2]
    distance = max(float(np.sqrt(away @ away + above**2)), 1e-3)
    direction = away / distance
    v = u + x[2:]
    rate = float(direction @ v)
    H = np.concatenate([(v - rate * direction) / distance, direction])
    return _update(x, P, H, measured - rate, std**2 + float(direction @ C @ direction))


def _update(
    x: Array, P: Array, H: Array, innovation: float, variance: float
) -> tuple[Array, Array]:
    gain = P @ H / (H @ P @ H + variance)
    keep = np.eye(4) - np.outer(gain, H)
    # Joseph's form: the covariance stays positive.
    return x + gain * innovation, keep @ P @ keep.T + variance * np.outer(gain, gain)
