"""Global search for the first position of a track.

With the speed v over ground and the range rate r', the beacon bears acos(-r'/v) off the course
to either side (Chen, Shang and Lan, Journal of Unmanned Undersea Systems 29(4), 2021, fig. 3):
so every row gives two starts. As the current is not known yet, and outliers are among the rows,
bearings all around the beacon are tried too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array, IntArray, interpolate
from factorgraph_dvl.ranging.dead_reckoning import DeadReckoning
from factorgraph_dvl.sensors.beacon import GATE

# Chosen: rows that the coarse search uses, and rows of them whose range rate gives starts.
_SEARCHED = 120
_GIVE_STARTS = 12
# Chosen: bearings around the beacon to start from, 15 degrees apart.
_BEARINGS = 24
# Chosen: steps of the coarse search; the control parameter grows 1.3-fold at each.
_STEPS = 40
# Chosen: least rows to fit; a start has four unknowns.
_LEAST_ROWS = 6
# Chosen: cost over the lowest from which on a start is not followed, a likelihood of e^-60.
_FOLLOWED = 60.0
# Chosen: standard deviation by which any velocity between the records may miss, m/s.
_LEAST_RATE_STD = 1e-3


@dataclass(frozen=True)
class RangingRows:
    """Ranges and range rates at times of a dead-reckoned track, and what they are compared with.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the measurements.
    moved, velocity : ndarray, shape (M, 2) or (M, 3)
        Displacement since the start, m, and velocity of the transponder, m/s, dead-reckoned.
    place : ndarray, shape (M, 2), m
        Stated position of the beacon less the lever arm, east and north.
    above : ndarray, shape (M,), m
        Height of the transponder over the beacon.
    range, rate : ndarray, shape (M,)
        Range and its rate as measured, m, m/s; nan where not.
    range_std, rate_std : ndarray, shape (M,)
        Standard deviations with the noise of dead reckoning.
    since : ndarray, shape (M,), s
        Time since the start of the track.
    """

    time: Array
    moved: Array
    velocity: Array
    place: Array
    above: Array
    range: Array
    rate: Array
    range_std: Array
    rate_std: Array
    since: Array

    def some(self, index: IntArray) -> RangingRows:
        """Return some of the rows."""
        return RangingRows(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def residuals(self, x: Array) -> tuple[Array, Array]:
        """Return whitened residuals (S, 2 M), 0 where none, and Jacobians (S, 2 M, 2 or 4).

        Parameters
        ----------
        x : ndarray, shape (S, 2) or (S, 4)
            First positions, m, and currents, m/s, if there are any.
        """
        drifts = x.shape[1] == 4
        current = x[:, 2:] if drifts else np.zeros((x.shape[0], 2))
        p = x[:, None, :2] + self.moved + current[:, None] * self.since[:, None]
        flat = p - self.place
        distance = np.maximum(np.sqrt(np.sum(flat**2, axis=2) + self.above**2), 1e-3)
        velocity = self.velocity[:, :2] + current[:, None]
        speed = (np.sum(flat * velocity, axis=2) + self.above * self.velocity[:, 2]) / distance
        u = flat / distance[..., None]
        by_p = (velocity - speed[..., None] * u) / distance[..., None]
        e = np.concatenate(
            [(distance - self.range) / self.range_std, (speed - self.rate) / self.rate_std], axis=1
        )
        since = self.since[:, None]
        range_j, rate_j = (u, by_p)
        if drifts:
            range_j = np.concatenate([u, since * u], axis=2)
            rate_j = np.concatenate([by_p, since * by_p + u], axis=2)
        J = np.concatenate(
            [range_j / self.range_std[:, None], rate_j / self.rate_std[:, None]], axis=1
        )
        known = ~np.isnan(e)
        return np.where(known, e, 0.0), J * known[..., None]

    def starts(self, drifts: bool) -> Array:
        """Return starts (S, 2 or 4): by the geometry of the range rate, and all around."""
        good = np.flatnonzero(~np.isnan(self.range))
        flat = np.sqrt(np.maximum(self.range[good] ** 2 - self.above[good] ** 2, 1.0))
        out = []
        if good.size:
            i = good[0]
            angle = np.arange(_BEARINGS) * 2.0 * np.pi / _BEARINGS
            around = flat[0] * np.stack([np.sin(angle), np.cos(angle)], axis=1)
            out.append(self.place[i] + around - self.moved[i])
        both = np.flatnonzero(~np.isnan(self.rate[good]))
        some = np.unique(np.linspace(0, both.size - 1, _GIVE_STARTS).astype(int))
        both = both[some[: both.size]]
        rows, level = good[both], flat[both]
        v = self.velocity[rows, :2]
        speed = np.maximum(np.linalg.norm(v, axis=1), 1e-3)
        climb = self.above[rows] * self.velocity[rows, 2]
        cosine = (self.rate[rows] * self.range[rows] - climb) / (level * speed)
        off = np.arccos(np.clip(cosine, -1.0, 1.0))
        course = np.arctan2(v[:, 0], v[:, 1])
        for side in (-1.0, 1.0):
            bearing = course + side * off
            from_beacon = level[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
            out.append(self.place[rows] + from_beacon - self.moved[rows])
        p = np.concatenate(out) if out else np.zeros((0, 2))
        return np.column_stack([p, np.zeros((p.shape[0], 2 * drifts))])


def ranging_rows(track: DeadReckoning, frame: LocalFrame, body_axes: BodyAxes) -> RangingRows:
    """Return the rows of the beacons' record that the track covers."""
    grid, beacons, s = track.time, track.beacons, track.beacons.settings
    # What constants that are not searched for may do to a range, relative to it.
    slack = np.hypot(s.sound_speed_error_std, track.log.settings.scale_error_std)
    level = np.zeros((grid.size, 3))
    level[:, 2] = track.heading
    arm_n = rotation_from_rph(level, body_axes) @ np.array(s.lever_arm_m)
    covered = (beacons.time >= grid[0]) & (beacons.time <= grid[-1])
    rows = np.flatnonzero(~beacons.missing & covered)
    time = beacons.time[rows]

    def at(values: Array) -> Array:
        return interpolate(time, grid, values)

    names = list(s.positions)
    place = frame.position(*beacons.places.T)[[names.index(name) for name in beacons.name[rows]]]
    arm = at(arm_n)
    velocity = np.column_stack([track.velocity, track.climb]) + np.gradient(arm_n, grid, axis=0)
    wander = at(track.spread)
    noise = np.median(np.diff(track.spread) / np.diff(grid)) if grid.size > 1 else 0.0
    interval = float(np.median(np.diff(grid)))
    range_ = beacons.range[rows]
    return RangingRows(
        time=time,
        moved=at(track.displacement),
        velocity=at(velocity),
        place=place[:, :2] - arm[:, :2],
        above=at(track.height) - frame.height + arm[:, 2] - place[:, 2],
        range=range_,
        rate=beacons.range_rate[rows],
        range_std=np.sqrt(
            s.range_std_m**2
            + track.height_std**2
            + 0.5 * wander
            + (slack * np.nan_to_num(range_)) ** 2
        ),
        rate_std=np.sqrt(s.range_rate_std_m_s**2 + 0.5 * noise / interval + _LEAST_RATE_STD**2)
        * np.ones(time.size),
        since=time - grid[0],
    )


@dataclass(frozen=True)
class Found:
    """A start that the ranges allow.

    Parameters
    ----------
    position : ndarray, shape (2,), m
        First position, east and north.
    current : ndarray, shape (2,), m/s
        Current; zero where none is estimated.
    echoes : ndarray, shape (2, M)
        Whether ranges and rates of all rows so far are beyond the gate there.
    """

    position: Array
    current: Array
    echoes: Array


def search(
    rows: RangingRows, mean: Array, std: Array, current_std: Array | None
) -> Iterator[Found]:
    """Yield starts that fit rows, without knowing where they begin, the best first.

    Only start and current are searched for, on some of the rows, for all starts at once.

    Parameters
    ----------
    rows : RangingRows
        The data so far.
    mean, std : ndarray, shape (2,), m
        Prior of the first position.
    current_std : ndarray, shape (2,), m/s, optional
        Standard deviation of the current; None where none is estimated.
    """
    total = rows.time.size
    if total < _LEAST_ROWS:
        return
    coarse = _Coarse(
        rows.some(np.unique(np.linspace(0, total - 1, _SEARCHED).astype(int))),
        np.concatenate([mean, np.zeros(0 if current_std is None else 2)]),
        np.concatenate([std, np.zeros(0) if current_std is None else current_std]),
    )
    x = coarse.descend(coarse.rows.starts(current_std is not None))
    if not x.size:
        return
    cost = coarse.cost(x)
    residuals, _ = rows.residuals(x)
    tried: list[Array] = []
    for i in np.argsort(cost):
        if cost[i] > cost.min() + _FOLLOWED:
            break
        if any(np.hypot(*(x[i, :2] - other)) < 1.0 for other in tried):
            continue
        tried.append(x[i, :2])
        current = x[i, 2:] if current_std is not None else np.zeros(2)
        yield Found(x[i, :2], current, np.abs(residuals[i]).reshape(2, -1) > GATE)


@dataclass(frozen=True)
class _Coarse:
    """Start and current from some rows, for many starts at once.

    The noise of dead reckoning is taken as noise of the measurements.
    """

    rows: RangingRows
    mean: Array
    std: Array

    def cost(self, x: Array) -> Array:
        """Return the truncated cost of each start, (S,)."""
        e, _ = self.rows.residuals(x)
        prior = np.sum(((x - self.mean) / self.std) ** 2, axis=1)
        return np.asarray(0.5 * (np.sum(np.minimum(e**2, GATE**2), axis=1) + prior))

    def descend(self, x: Array) -> Array:
        """Return the starts after some graduated Gauss-Newton steps, each damped by its own.

        Yang et al., Graduated non-convexity for robust spatial perception, IEEE RA-L 5(2), 2020.
        While the current is hardly known, the cost has a narrow minimum, curved around the
        beacon, along which straight steps are tiny; so each goes along a geodesic (Transtrum and
        Sethna, Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares
        minimization, arXiv:1201.5885).
        """
        if not x.size:
            return x
        prior = np.diag(1.0 / self.std**2)
        scale = np.diag([1.0 / 100.0**2] * 2 + [1.0] * (x.shape[1] - 2))
        e, J = self.rows.residuals(x)
        largest = np.maximum(np.max(e**2, axis=1), GATE**2)
        control = GATE**2 / (2.0 * largest - GATE**2)
        damping = np.full(x.shape[0], 1.0)
        cost = np.full(x.shape[0], np.inf)
        best = x.copy()
        for step in range(_STEPS):
            mu = control[:, None] if step < _STEPS - 8 else np.full((x.shape[0], 1), np.inf)
            w = _truncation_weights(e**2, np.broadcast_to(mu, e.shape))
            now = 0.5 * np.sum(w * e**2, axis=1)
            # With other weights it is another cost: only a gross failure is taken back.
            worse = now > 4.0 * cost + 10.0
            x = np.where(worse[:, None], best, x)
            damping = np.where(worse, damping * 8.0, damping * 0.5)
            best, cost = x, np.where(worse, cost, now)
            if worse.any():
                e, J = self.rows.residuals(x)
                w = _truncation_weights(e**2, np.broadcast_to(mu, e.shape))
            weighted = J * w[..., None]
            H = J.transpose(0, 2, 1) @ weighted + prior + damping[:, None, None] * scale
            g = np.sum(weighted * e[..., None], axis=1) + (x - self.mean) @ prior
            dx = -np.linalg.solve(H, g[..., None])[..., 0]
            probe, _ = self.rows.residuals(x + 0.1 * dx)
            curvature = 20.0 * ((probe - e) / 0.1 - np.einsum("skj,sj->sk", J, dx))
            bent = np.einsum("skj,sk->sj", weighted, curvature)
            ddx = -np.linalg.solve(H, bent[..., None])[..., 0]
            lengths = [np.hypot(*d[:, :2].T) for d in (dx, ddx)]
            x = x + dx + 0.5 * ddx * (lengths[1] <= 0.75 * lengths[0])[:, None]
            e, J = self.rows.residuals(x)
            control = np.minimum(control * 1.3, 1e3)
        return x


def _truncation_weights(squares: Array, control: Array) -> Array:
    """Return weights of squared whitened residuals; an infinite control parameter truncates."""
    hard = np.isinf(control)
    mu = np.where(hard, 1.0, control)
    with np.errstate(divide="ignore"):
        soft = GATE / np.sqrt(squares) * np.sqrt(mu * (mu + 1.0)) - mu
    return np.where(hard, squares <= GATE**2, np.clip(soft, 0.0, 1.0))
