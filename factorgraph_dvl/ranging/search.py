"""Global search for the first position of a track.

With the speed v over ground and the range rate r', the beacon bears acos(-r'/v) off the course
to either side (Chen, Shang and Lan, Journal of Unmanned Undersea Systems 29(4), 2021, fig. 3):
so every row gives two starts. As the current is not known yet, and outliers are among the rows,
bearings all around the beacon are tried too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.geometry.rotations import wrapped
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.ranging.hypothesis_weights import NEGLIGIBLE, hypothesis_costs
from factorgraph_dvl.ranging.model import GATE, PlanarProblem
from factorgraph_dvl.ranging.smoother import Fit, covariance, fit, truncation_weights

# Chosen: rows that the coarse search uses, and rows of them whose range rate gives starts.
_SEARCHED = 120
_GIVE_STARTS = 12
# Chosen: bearings around the beacon to start from, 15 degrees apart.
_BEARINGS = 24
# Chosen: steps of the coarse search; the control parameter grows 1.3-fold at each.
_STEPS = 40
# Chosen: least rows to fit; a start has four unknowns.
_LEAST_ROWS = 6


def search(problem: PlanarProblem, nodes: int) -> list[Fit]:
    """Return the distinct tracks that fit the first nodes, without knowing where they begin.

    Only start and current are searched for, on some of the rows, for all starts at once;
    what is found is then fitted with everything.
    """
    total = problem.rows(nodes)
    if total < _LEAST_ROWS:
        return []
    rows = np.unique(np.linspace(0, total - 1, _SEARCHED).astype(int))
    coarse = _CoarseSearch(problem, rows)
    x = coarse.descend(coarse.starts())
    cost = coarse.cost(x)
    found: list[Fit] = []
    tried: list[Array] = []
    for i in np.argsort(cost):
        if cost[i] > cost.min() + 3.0 * NEGLIGIBLE:
            break
        start = x[i, :2]
        if any(np.hypot(*(start - other)) < 1.0 for other in tried):
            continue
        tried.append(start)
        theta = np.zeros(problem.prior_sigma.size)
        if "current" in problem.columns:
            theta[problem.columns["current"]] = x[i, 2:]
        first = np.concatenate([start, np.zeros(2)])[None]
        hypothesis = fit(
            problem, problem.carried(first, theta, nodes), theta, graduated=True, iterations=60
        )
        if not any(same_track(problem, hypothesis, f) for f in found):
            found.append(hypothesis)
    against = hypothesis_costs(problem, found)
    return [f for f, value in zip(found, against, strict=True) if value < NEGLIGIBLE]


class _CoarseSearch:
    """Start and current from some rows, for many starts at once.

    The noise of dead reckoning is taken as noise of the measurements.
    """

    def __init__(self, problem: PlanarProblem, rows: NDArray[np.intp]) -> None:
        r = problem.ranging
        node = r.node[rows]
        zero = np.zeros(problem.prior_sigma.size)
        origin = problem.carried(np.zeros((1, 4)), zero, int(node[-1]) + 1)
        self.moved = origin[node, :2]
        self.since = problem.time[node] - problem.time[0]
        self.velocity = np.column_stack([problem.velocity[node], problem.climb[node]])
        self.velocity = self.velocity + problem.arm_velocity[node]
        self.place = problem.place[r.beacon[rows]]
        self.above = problem.height[node] + problem.arm[node, 2] - self.place[:, 2]
        self.place = self.place[:, :2] - problem.arm[node, :2]
        self.range, self.rate = r.range[rows], r.rate[rows]
        lost = problem.step_cov + problem.share[:, None, None] ** 2 * problem.velocity_cov[1:]
        wander = np.concatenate([[0.0], np.cumsum(np.trace(lost, axis1=1, axis2=2))])
        slack = self._slack(problem) * np.nan_to_num(self.range)
        self.range_std = np.sqrt(r.range_std[rows] ** 2 + 0.5 * wander[node] + slack**2)
        rate_var = r.rate_std[rows] ** 2
        rate_var = rate_var + 0.5 * np.trace(problem.velocity_cov[node], axis1=1, axis2=2)
        self.rate_std = np.sqrt(rate_var)
        drifts = "current" in problem.columns
        self.prior_sigma = problem.prior_sigma[problem.columns["current"]] if drifts else zero[:0]
        self.start_mean = problem.start_mean
        self.start_info = np.linalg.inv(problem.start_cov)

    @staticmethod
    def _slack(problem: PlanarProblem) -> float:
        """Return what constants that are not searched for may do to a range, relative to it."""
        small = ("sound_speed_error", "log_scale_error")
        sigmas = [p.sigma[0] for p in problem.constants if p.stem in small]
        return float(np.sqrt(np.sum(np.square(sigmas))))

    def starts(self) -> Array:
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
        return np.column_stack([p, np.zeros((p.shape[0], self.prior_sigma.size))])

    def _residuals(self, x: Array) -> tuple[Array, Array]:
        """Return whitened residuals (S, 2 K), 0 where none, and Jacobians (S, 2 K, 2 or 4)."""
        drifts = x.shape[1] == 4
        current = x[:, 2:] if drifts else np.zeros((x.shape[0], 2))
        p = x[:, None, :2] + self.moved + current[:, None] * self.since[:, None]
        flat = p - self.place
        distance = np.sqrt(np.sum(flat**2, axis=2) + self.above**2)
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

    def cost(self, x: Array) -> Array:
        """Return the truncated cost of each start, (S,)."""
        e, _ = self._residuals(x)
        from_mean = x[:, :2] - self.start_mean
        return 0.5 * (
            np.sum(np.minimum(e**2, GATE**2), axis=1)
            + np.sum((x[:, 2:] / self.prior_sigma) ** 2, axis=1)
            + np.einsum("si,ij,sj->s", from_mean, self.start_info, from_mean)
        )

    def descend(self, x: Array) -> Array:
        """Return the starts after some graduated Gauss-Newton steps, each damped by its own."""
        size = x.shape[1]
        prior = np.zeros((size, size))
        prior[:2, :2] = self.start_info
        prior[2:, 2:] = np.diag(1.0 / self.prior_sigma**2)
        mean = np.concatenate([self.start_mean, np.zeros(size - 2)])
        scale = np.diag([1.0 / 100.0**2] * 2 + [1.0] * (size - 2))
        e, J = self._residuals(x)
        largest = np.maximum(np.max(e**2, axis=1), GATE**2)
        control = GATE**2 / (2.0 * largest - GATE**2)
        damping = np.full(x.shape[0], 1.0)
        cost = np.full(x.shape[0], np.inf)
        best = x.copy()
        for step in range(_STEPS):
            mu = control[:, None] if step < _STEPS - 8 else np.full((x.shape[0], 1), np.inf)
            w = truncation_weights(e**2, np.broadcast_to(mu, e.shape))
            now = 0.5 * np.sum(w * e**2, axis=1)
            # With other weights it is another cost: only a gross failure is taken back.
            worse = now > 4.0 * cost + 10.0
            x = np.where(worse[:, None], best, x)
            damping = np.where(worse, damping * 8.0, damping * 0.5)
            best, cost = x, np.where(worse, cost, now)
            if worse.any():
                e, J = self._residuals(x)
                w = truncation_weights(e**2, np.broadcast_to(mu, e.shape))
            weighted = J * w[..., None]
            H = J.transpose(0, 2, 1) @ weighted + prior + damping[:, None, None] * scale
            g = np.sum(weighted * e[..., None], axis=1) + (x - mean) @ prior
            dx = -np.linalg.solve(H, g[..., None])[..., 0]
            # Geodesic acceleration, as in the smoother.
            probe, _ = self._residuals(x + 0.1 * dx)
            curvature = 20.0 * ((probe - e) / 0.1 - np.einsum("skj,sj->sk", J, dx))
            ddx = -np.linalg.solve(H, np.einsum("skj,sk->sj", weighted, curvature)[..., None])[
                ..., 0
            ]
            lengths = [np.hypot(*d[:, :2].T) for d in (dx, ddx)]
            x = x + dx + 0.5 * ddx * (lengths[1] <= 0.75 * lengths[0])[:, None]
            e, J = self._residuals(x)
            control = np.minimum(control * 1.3, 1e3)
        return x


def same_track(problem: PlanarProblem, a: Fit, b: Fit) -> bool:
    """Whether two fits are the same track, judged by the data.

    They are if at the end of the shorter they bear from the beacon in directions that differ
    by less than three standard deviations. (Their distances to it agree, being measured.)
    """
    last = min(a.p.shape[0], b.p.shape[0]) - 1
    place = problem.place[problem.ranging.beacon[problem.rows(last + 1) - 1], :2]
    one, other = a.p[last] - place, b.p[last] - place
    if np.hypot(*(one - other)) < 1.0:
        return True
    shorter = a if a.p.shape[0] - 1 == last else b
    P = covariance(problem, shorter, last_only=True)[0][0, :2, :2]
    distance = max(float(np.hypot(*one)), 1.0)
    across = np.array([one[1], -one[0]]) / distance
    turn = np.arctan2(other[0], other[1]) - np.arctan2(one[0], one[1])
    arc = distance * abs(wrapped(turn))
    return bool(arc < 3.0 * np.sqrt(across @ P @ across))
