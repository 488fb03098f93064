"""All tracks that the ranges allow, from the first of them on, and when a wrong one dies.

On a straight run ranges and range rates fit two tracks, mirror images about the line of
motion. Both are followed; their weights are their likelihoods, exp(-cost), normalised, as
far as their difference is more than chance. After a turn only the true one still fits.

The start needs no position. With the speed v over ground and the range rate r', the beacon
bears acos(-r'/v) off the course to either side (Chen, Shang and Lan, Journal of Unmanned
Undersea Systems 29(4), 2021, fig. 3): so every row gives two starts. As the current is not
known yet, and outliers are among the rows, bearings all around the beacon are tried too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from factorgraph_dvl.conventions import Array
from factorgraph_dvl.planar.model import GATE, PlanarProblem
from factorgraph_dvl.planar.smoother import (
    Fit,
    cost_terms,
    covariance,
    fit,
    graduated_weights,
)

# Rows that the search for starts looks at, and those of them that give starts.
_SEARCHED = 120
_GIVE_STARTS = 12
_BEARINGS = 24
# Steps of the search.
_STEPS = 40
# Evidence against a hypothesis with which it is given up: its likelihood is e^-20.
_HOPELESS = 20.0
# Weight below which a hypothesis is dead, and above which it was one.
DEAD = 1e-3
_ALIVE = 0.05
# Difference of a single term that is none of noise, if there are several; and standard deviations
# of the sum of the others that are.
_STRONG = 4.0
_SEVERAL = 3
_CHANCE = 2.0
# Rows before which nothing is fitted: as many unknowns as a start has.
_LEAST_ROWS = 6


@dataclass
class Candidate:
    """A track that the ranges allow.

    Parameters
    ----------
    born : s, of the last data when it was found.
    fit : with the data so far, or when it was last followed.
    weight : normalised likelihood among all hypotheses, now.
    highest : the highest weight that it ever had.
    died : s, of the data since which its weight is below `DEAD`; None while it lives.
    history : time (s) and weight at all updates.
    """

    born: float
    fit: Fit
    weight: float = 0.0
    highest: float = 0.0
    died: float | None = None
    history: list[tuple[float, float]] = field(default_factory=list)


def follow(
    problem: PlanarProblem,
    updates: Sequence[int],
    searches: Sequence[int],
    on_update: Callable[[int, list[Candidate]], object] | None = None,
) -> list[Candidate]:
    """Follow all hypotheses through growing data.

    Parameters
    ----------
    problem : PlanarProblem
    updates : numbers of nodes after which to fit, increasing.
    searches : those of them after which to search for new hypotheses as well.
    on_update : called with the number of nodes and the living hypotheses, heaviest first.

    Returns
    -------
    All hypotheses that were ever likely, the living ones first, heaviest first; the fits of
    these are of the last update.
    """
    living: list[Candidate] = []
    gone: list[Candidate] = []
    before = 0
    for nodes in updates:
        time = float(problem.time[nodes - 1])
        last_weights = [(h, h.fit, h.weight) for h in living]
        for h in living:
            h.fit = _followed(problem, h.fit, nodes)
        found = search(problem, nodes) if nodes in searches else []
        if not living and problem.start_known:
            found.append(_from_prior(problem, nodes))
        for new in found:
            if not any(_same(problem, new, h.fit) for h in living):
                living.append(Candidate(time, new))
        living, dropped = _weighed(problem, living, time)
        for h, earlier, weight in last_weights:
            if h.weight < DEAD <= weight:
                h.died = _death(problem, h, earlier, living, before, nodes)
        gone += [h for h in dropped if h.died is not None]
        if on_update is not None:
            on_update(nodes, living)
        before = nodes
    likely = [h for h in (*living, *gone) if h.highest >= _ALIVE]
    return sorted(likely, key=lambda h: (h.died is not None, -h.weight))


def _followed(problem: PlanarProblem, earlier: Fit, nodes: int) -> Fit:
    return fit(problem, problem.carried(earlier.x, earlier.theta, nodes), earlier.theta)


def _from_prior(problem: PlanarProblem, nodes: int) -> Fit:
    theta = np.zeros(problem.prior_sigma.size)
    first = np.concatenate([problem.start_mean, np.zeros(2)])[None]
    return fit(problem, problem.carried(first, theta, nodes), theta, graduated=True)


def _weighed(
    problem: PlanarProblem, hypotheses: list[Candidate], time: float
) -> tuple[list[Candidate], list[Candidate]]:
    """Return hypotheses by weight, and those that are dropped: hopeless, or found twice."""
    kept: list[Candidate] = []
    dropped: list[Candidate] = []
    ordered = sorted(hypotheses, key=lambda h: h.fit.cost)
    for h, against in zip(ordered, evidence(problem, [h.fit for h in ordered]), strict=True):
        if against > _HOPELESS or any(_same(problem, h.fit, other.fit) for other in kept):
            h.weight = 0.0
            dropped.append(h)
        else:
            kept.append(h)
    likelihood = np.exp(-evidence(problem, [h.fit for h in kept]))
    for h, value in zip(kept, likelihood, strict=True):
        h.weight = float(value / likelihood.sum())
        h.highest = max(h.highest, h.weight)
        if h.weight >= DEAD:
            h.died = None
    for h in (*kept, *dropped):
        h.history.append((time, h.weight))
    return kept, dropped


def _death(
    problem: PlanarProblem,
    h: Candidate,
    earlier: Fit,
    living: Sequence[Candidate],
    before: int,
    after: int,
) -> float:
    """Return the time of the first data between two updates that leave no weight, s."""
    others = [other.fit for other in living if other is not h]
    while after - before > 1:
        middle = (before + after) // 2
        own = _followed(problem, earlier, middle)
        fits = [own, *(fit(problem, o.x[:middle], o.theta) for o in others)]
        likelihood = np.exp(-evidence(problem, fits))
        if likelihood[0] / likelihood.sum() < DEAD:
            after = middle
        else:
            before, earlier = middle, own
    return float(problem.time[after - 1])


def evidence(problem: PlanarProblem, fits: Sequence[Fit]) -> Array:
    """Return what speaks against each fit of the same data, by `odds_against`."""
    return odds_against([cost_terms(problem, f) for f in fits])


def odds_against(single: Sequence[Array]) -> Array:
    """Return what speaks against each fit: negative log likelihoods, relative to the best.

    They differ by the sum of the differences of their terms. But a heading that only its noise
    turns takes sides as well, for one mirror image now and for the other then; so the sum of
    many small differences walks at random, on a long straight run as far as one likes. Of
    these no more is believed than the odds of so large a sum D by chance, whose variance is
    the sum of the squares (Vuong, Likelihood ratio tests for model selection and non-nested
    hypotheses, Econometrica 57(2), 1989), and nothing below two of its standard deviations. A
    few measurements that fit one and miss the other, as after a turn, count as they are.

    Parameters
    ----------
    single : of each fit, the terms (T,) of its cost.
    """
    if not single:
        return np.empty(0)
    first = single[int(np.argmin([terms.sum() for terms in single]))]
    out = []
    for terms in single:
        apart = terms - first
        strong = np.abs(apart) > _STRONG
        strong &= strong.sum() >= _SEVERAL
        small = apart[~strong]
        total = float(small.sum())
        z = abs(total) / max(float(np.linalg.norm(small)), 1e-12)
        believed = min(abs(total), max(_log_odds(z) - _log_odds(_CHANCE), 0.0))
        out.append(float(apart[strong].sum()) + np.sign(total) * believed)
    against = np.array(out)
    return against - against.min()


def _log_odds(z: float) -> float:
    """Return the logarithm of the odds that a normal draw is below z."""
    return float(log_ndtr(z) - log_ndtr(-z))


def _same(problem: PlanarProblem, a: Fit, b: Fit) -> bool:
    """Whether two fits are the same track as far as the data tell.

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
    arc = distance * abs((turn + np.pi) % (2.0 * np.pi) - np.pi)
    return bool(arc < 3.0 * np.sqrt(across @ P @ across))


def search(problem: PlanarProblem, nodes: int) -> list[Fit]:
    """Return the distinct tracks that fit the first nodes, without knowing where they begin.

    Only start and current are searched for, on some of the rows, for all starts at once;
    what is found is then fitted with everything.
    """
    total = problem.rows(nodes)
    if total < _LEAST_ROWS:
        return []
    rows = np.unique(np.linspace(0, total - 1, _SEARCHED).astype(int))
    seek = _Seek(problem, rows)
    x = seek.descend(seek.starts())
    cost = seek.cost(x)
    found: list[Fit] = []
    tried: list[Array] = []
    for i in np.argsort(cost):
        if cost[i] > cost.min() + 3.0 * _HOPELESS:
            break
        start = x[i, :2]
        if any(np.hypot(*(start - other)) < 1.0 for other in tried):
            continue
        tried.append(start)
        theta = np.zeros(problem.prior_sigma.size)
        if "current" in problem.columns:
            theta[problem.columns["current"]] = x[i, 2:]
        first = np.concatenate([start, np.zeros(2)])[None]
        candidate = fit(
            problem, problem.carried(first, theta, nodes), theta, graduated=True, iterations=60
        )
        if not any(_same(problem, candidate, f) for f in found):
            found.append(candidate)
    against = evidence(problem, found)
    return [f for f, value in zip(found, against, strict=True) if value < _HOPELESS]


class _Seek:
    """Start and current from some rows, for many starts at once.

    The noise of the reckoned track is taken as noise of the measurements.
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
        self.range_std = np.sqrt(r.range_std**2 + 0.5 * wander[node] + slack**2)
        rate_var = r.rate_std**2 + 0.5 * np.trace(problem.velocity_cov[node], axis1=1, axis2=2)
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
            away = level[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
            out.append(self.place[rows] + away - self.moved[rows])
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
        away = x[:, :2] - self.start_mean
        return 0.5 * (
            np.sum(np.minimum(e**2, GATE**2), axis=1)
            + np.sum((x[:, 2:] / self.prior_sigma) ** 2, axis=1)
            + np.einsum("si,ij,sj->s", away, self.start_info, away)
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
        softness = GATE**2 / (2.0 * largest - GATE**2)
        damping = np.full(x.shape[0], 1.0)
        cost = np.full(x.shape[0], np.inf)
        best = x.copy()
        for step in range(_STEPS):
            mu = softness[:, None] if step < _STEPS - 8 else np.full((x.shape[0], 1), np.inf)
            w = graduated_weights(e**2, np.broadcast_to(mu, e.shape))
            now = 0.5 * np.sum(w * e**2, axis=1)
            # With other weights it is another cost: only a gross failure is taken back.
            worse = now > 4.0 * cost + 10.0
            x = np.where(worse[:, None], best, x)
            damping = np.where(worse, damping * 8.0, damping * 0.5)
            best, cost = x, np.where(worse, cost, now)
            if worse.any():
                e, J = self._residuals(x)
                w = graduated_weights(e**2, np.broadcast_to(mu, e.shape))
            weighted = J * w[..., None]
            H = J.transpose(0, 2, 1) @ weighted + prior + damping[:, None, None] * scale
            g = np.sum(weighted * e[..., None], axis=1) + (x - mean) @ prior
            dx = -np.linalg.solve(H, g[..., None])[..., 0]
            # As in the smoother: the valley bends around the beacon.
            ahead, _ = self._residuals(x + 0.1 * dx)
            bend = 20.0 * ((ahead - e) / 0.1 - np.einsum("skj,sj->sk", J, dx))
            ddx = -np.linalg.solve(H, np.einsum("skj,sk->sj", weighted, bend)[..., None])[..., 0]
            lengths = [np.hypot(*d[:, :2].T) for d in (dx, ddx)]
            x = x + dx + 0.5 * ddx * (lengths[1] <= 0.75 * lengths[0])[:, None]
            e, J = self._residuals(x)
            softness = np.minimum(softness * 1.3, 1e3)
        return x
