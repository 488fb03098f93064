"""The extended Kalman filters of single-beacon navigation: 4SV-2OB and 4SV-3OB.

Chen, Shang and Lan, Model and algorithm improvement for unmanned undersea vehicle navigation
based on single beacon, Journal of Unmanned Undersea Systems 29(4), 428-434, 2021. Four state
variables: position relative to the beacon and current, east and north; heading and speed drive
them. Two observations, slant range and depth, which give the horizontal distance; the third is
the range rate, from the second update on: a start at the beacon has no direction before the first
displacement.

They model no error of sound speed, scale, heading or beacon position, and no outliers: the
baseline to compare with.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from factorgraph_dvl.baselines.outcome import History
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.estimates import Estimate, Residuals, Trajectory
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import contradictions
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.sensors.depth import Depth
from factorgraph_dvl.sensors.speed_log import Heading, SpeedLog
from factorgraph_dvl.solution import Progress, Solution
from factorgraph_dvl.trial import Trial

Method = Literal["4sv-2ob", "4sv-3ob"]
METHODS: tuple[Method, ...] = get_args(Method)

_NAMES = ("current_e_m_s", "current_n_m_s")
# Chosen: least prior standard deviation of the current, m/s; keeps its covariance regular.
_LEAST_CURRENT = 1e-6
# Chosen: largest effect on the end, in its standard deviations, of one standard deviation at the
# start; a linear filter has at most 1.
_LARGEST_EFFECT = 3.0


# State, covariance, innovation (predicted - measured) and its standard deviation.
_Updated = tuple[Array, Array, float, float]


@dataclass(frozen=True)
class Filtered:
    """Estimates at all updates of a filter.

    Parameters
    ----------
    time : ndarray, shape (U,), s
        Times of the updates.
    state : ndarray, shape (U, 4)
        Position in n, m, and current, m/s.
    covariance : ndarray, shape (U, 4, 4)
        Covariances of the state.
    velocity : ndarray, shape (U, 2), m/s
        Over ground.
    innovations : tuple of Residuals
        Predicted - measured, with the standard deviation of that.
    """

    time: Array
    state: Array
    covariance: Array
    velocity: Array
    innovations: tuple[Residuals, ...]


def filter_planar(
    trial: Trial,
    method: Method,
    *,
    progress: Progress | None = None,
) -> tuple[Solution, History]:
    """Filter a planar trial by 4SV-2OB or 4SV-3OB.

    Parameters
    ----------
    trial : Trial
        Trial with `initial.position`: the filters cannot find it.
    method : Method
        `4sv-2ob` or `4sv-3ob`.
    progress : callable, optional
        Called with stage, iteration and cost.

    Returns
    -------
    solution : Solution
        Its trajectory is filtered, not smoothed: an epoch for each update.
    history : History
        History of the current.

    Raises
    ------
    ConfigError, DataError
        If the trial has no compass, log, depth sensor or beacons, or no position to start from.
    """
    if not trial.planar:
        raise ConfigError(
            f"{method} navigates in the plane by a beacon, and this trial is not planar",
            where="trial.yaml",
            expected="sections heading, log, depth and beacons",
        )
    trial.required(Depth)
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
    start_std = trial.initial_position.std[:2]
    filtered = run_filter(trial, method, mean, start_std)
    contradicted = [
        *contradictions(filtered.innovations),
        *_depends_on_start(trial, method, mean, start_std, filtered),
    ]
    value, P = filtered.state[-1, 2:], filtered.covariance[-1, 2:, 2:]
    prior = _current_std(trial)
    std = np.sqrt(np.diag(P))
    estimate = Estimate(
        "current_m_s", _NAMES, value, std, np.zeros(2), prior, (prior > 0.0) & (std <= 0.5 * prior)
    )
    limits = message("method_limits.all_ranges", method=str(method))
    solution = Solution(
        trial=trial.name,
        inputs=trial.inputs,
        solver=f"kalman-{method}",
        body_axes=trial.body_axes,
        converged=not contradicted,
        iterations=filtered.time.size,
        cost=np.nan,
        estimates=(estimate,),
        covariance=P,
        trajectory=_trajectory(trial, filtered),
        findings=(*trial.notes, *contradicted, Finding(Code.METHOD_LIMITS, limits)),
    )
    stds = np.sqrt(np.diagonal(filtered.covariance, axis1=1, axis2=2))
    return solution, History(filtered.time, _NAMES, filtered.state[:, 2:], stds[:, 2:])


def _trajectory(trial: Trial, filtered: Filtered) -> Trajectory:
    """Return the filtered track with depth and heading, an epoch for each update."""
    heading, depth = trial.required(Heading).settings, trial.required(Depth).settings
    frame = trial.frame()
    m = filtered.time.size
    height = depth.sea_surface_height_m - _depth_at(trial, filtered.time)
    p = np.column_stack([filtered.state[:, :2], height - frame.height])
    lat, lon, _ = frame.geodetic(p)
    position_cov, velocity_cov = np.zeros((m, 3, 3)), np.zeros((m, 3, 3))
    position_cov[:, :2, :2] = filtered.covariance[:, :2, :2]
    velocity_cov[:, :2, :2] = filtered.covariance[:, 2:, 2:]
    position_cov[:, 2, 2] = velocity_cov[:, 2, 2] = depth.std_m**2
    rph, rph_cov = np.zeros((m, 3)), np.full((m, 3, 3), np.nan)
    rph[:, 2] = np.interp(filtered.time, *_heading(trial))
    rph[:, 2] %= 2.0 * np.pi
    rph_cov[:, 2, 2] = heading.std_rad**2
    return Trajectory(
        time=filtered.time,
        geodetic=np.stack([lat, lon, height], axis=1),
        velocity=np.column_stack([filtered.velocity, np.zeros(m)]),
        rph=rph,
        position_cov=position_cov,
        velocity_cov=velocity_cov,
        rph_cov=rph_cov,
    )


def run_filter(trial: Trial, method: Method | str, mean: Array, std: Array) -> Filtered:
    """Run a filter from a position.

    Parameters
    ----------
    trial : Trial
        Trial with heading, log, depth and beacons.
    method : Method or str
        `4sv-2ob` or `4sv-3ob`.
    mean, std : ndarray, shape (2,), m
        Position at the start in the trial's frame and its standard deviation.

    Returns
    -------
    Filtered
        At the times of the beacons' record that heading and log cover.
    """
    beacons, frame = trial.required(Beacons), trial.frame()
    settings = beacons.settings
    dead_reckoning = _DeadReckoning(trial)
    x = np.array([*mean, 0.0, 0.0])
    P = np.diag([*std, *np.maximum(_current_std(trial), _LEAST_CURRENT)]) ** 2
    places = {n: frame.position(*place.geodetic) for n, place in settings.positions.items()}
    surface = trial.required(Depth).settings.sea_surface_height_m
    height = surface - _depth_at(trial, beacons.time)
    now = dead_reckoning.start
    times: list[float] = []
    states, covariances, velocities = [], [], []
    innovations_of: dict[str, list[tuple[float, float, float]]] = {"range": [], "range rate": []}
    for i in range(beacons.time.size):
        time = float(beacons.time[i])
        if not dead_reckoning.start <= time <= dead_reckoning.end or beacons.missing[i]:
            continue
        moved, Q = dead_reckoning.between(now, time)
        F = np.eye(4)
        F[0, 2] = F[1, 3] = time - now
        x = F @ x
        x[:2] += moved
        P = F @ P @ F.T
        P[:2, :2] += Q
        now = time
        place = places[str(beacons.name[i])]
        above = height[i] - frame.height - place[2]
        u, C = dead_reckoning.velocity(time)
        if not np.isnan(beacons.range[i]):
            x, P, innovation, sigma = _by_range(
                x, P, place, above, beacons.range[i], settings.range_std_m
            )
            innovations_of["range"].append((time, innovation, sigma))
        if method == "4sv-3ob" and times and not np.isnan(beacons.range_rate[i]):
            rate, rate_std = beacons.range_rate[i], settings.range_rate_std_m_s
            x, P, innovation, sigma = _by_rate(x, P, place, above, u, C, rate, rate_std)
            innovations_of["range rate"].append((time, innovation, sigma))
        times.append(time)
        states.append(x)
        covariances.append(P)
        velocities.append(u + x[2:])
    if not times:
        raise DataError("no range while heading and log run", where=beacons.source)
    innovations = tuple(
        Residuals(f"Beacon {kind}", unit, (kind,), rows[:, 0], rows[:, 1:2], rows[:, 2:3])
        for (kind, values), unit in zip(innovations_of.items(), ("m", "m/s"), strict=True)
        if (rows := np.array(values)).size
    )
    return Filtered(
        np.array(times),
        np.array(states),
        np.array(covariances),
        np.array(velocities),
        innovations,
    )


def _depends_on_start(
    trial: Trial, method: Method | str, mean: Array, std: Array, found: Filtered
) -> list[Finding]:
    """Return a finding if the end depends more on the start than its covariance allows.

    A start moved by one standard deviation moves the end of a linear filter by at most one of
    its own. These filters are not linear, and go to either mirror image.
    """
    P = found.covariance[-1]
    if not (np.isfinite(P).all() and np.linalg.eigvalsh(P)[0] > 0.0):
        return [Finding(Code.FILTER_CONTRADICTED, message("filter_contradicted.diverged"))]
    apart, most = 0.0, 0.0
    for move in (*np.diag(std), *-np.diag(std)):
        moved = run_filter(trial, method, mean + move, std).state[-1] - found.state[-1]
        sigmas = float(np.sqrt(moved @ np.linalg.solve(P, moved)))
        if not sigmas <= most:
            most, apart = sigmas, float(np.hypot(*moved[:2]))
    if most <= _LARGEST_EFFECT:
        return []
    return [
        Finding(
            Code.FILTER_CONTRADICTED,
            message("filter_contradicted.start", apart=apart, sigmas=most),
        )
    ]


def _current_std(trial: Trial) -> Array:
    settings = trial.required(SpeedLog).settings
    return np.array(settings.current_std_m_s) * (settings.reference == "water")


def _heading(trial: Trial) -> tuple[Array, Array]:
    """Return times and measured headings, unwrapped."""
    heading = trial.required(Heading)
    known = ~np.isnan(heading.heading)
    return heading.time[known], np.unwrap(heading.heading[known])


def _depth_at(trial: Trial, time: Array) -> Array:
    depth = trial.required(Depth)
    known = ~np.isnan(depth.depth)
    return np.interp(time, depth.time[known], depth.depth[known])


class _DeadReckoning:
    """Heading and speed: displacement and velocity, each with its noise."""

    def __init__(self, trial: Trial) -> None:
        heading, log = trial.required(Heading), trial.required(SpeedLog)
        measured = ~np.isnan(log.speed)
        self._heading = _heading(trial)
        starboard = np.nan_to_num(log.starboard[measured])
        self._speed = log.time[measured], log.speed[measured], starboard
        self._std = log.settings.speed_std_m_s, heading.settings.std_rad
        depth = trial.required(Depth).time
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
) -> _Updated:
    """Return state, covariance and innovation after a slant range and the depth at that time.

    They give the horizontal distance d = sqrt(r² - z²), whose standard deviation is that of
    the range times r / d.
    """
    distance = np.sqrt(max(measured**2 - above**2, 1.0))
    separation = x[:2] - place[:2]
    predicted = max(float(np.hypot(*separation)), 1e-3)
    H = np.array([*(separation / predicted), 0.0, 0.0])
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
) -> _Updated:
    """Return what a range rate makes; the vertical velocity is taken as 0."""
    separation = x[:2] - place[:2]
    distance = max(float(np.sqrt(separation @ separation + above**2)), 1e-3)
    direction = separation / distance
    v = u + x[2:]
    rate = float(direction @ v)
    H = np.concatenate([(v - rate * direction) / distance, direction])
    return _update(x, P, H, measured - rate, std**2 + float(direction @ C @ direction))


def _update(x: Array, P: Array, H: Array, innovation: float, variance: float) -> _Updated:
    total = float(H @ P @ H) + variance
    gain = P @ H / total
    keep = np.eye(4) - np.outer(gain, H)
    # Joseph's form: the covariance stays positive.
    covariance = keep @ P @ keep.T + variance * np.outer(gain, gain)
    return x + gain * innovation, covariance, -innovation, float(np.sqrt(total))
