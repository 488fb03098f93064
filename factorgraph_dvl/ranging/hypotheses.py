"""All tracks that the ranges allow, followed as the data grow.

On a straight run ranges and range rates fit two tracks, mirror images about the line of
motion. Both are followed. Their weights are the normalised likelihoods, exp(-cost), without the
differences that chance explains. After a turn only the true one still fits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from factorgraph_dvl.ranging.hypothesis_weights import NEGLIGIBLE, hypothesis_costs
from factorgraph_dvl.ranging.model import PlanarProblem
from factorgraph_dvl.ranging.search import same_track, search
from factorgraph_dvl.ranging.smoother import Fit, fit

# Chosen: weight below which a hypothesis is dead: one in a thousand.
DEAD = 1e-3
# Chosen: a hypothesis is reported if its weight ever reached this.
_LIKELY = 0.05
# Chosen: share of rejected measurements among the newest from which on the track is fitted anew.
_MOSTLY_REJECTED = 0.5


@dataclass
class TrackedHypothesis:
    """A track that the ranges allow.

    Parameters
    ----------
    born : float
        Time of the last data when it was found, s.
    fit : Fit
        With the data so far, or when it was last followed.
    weight : float, optional
        Normalised likelihood among all hypotheses, now.
    highest : float, optional
        The highest weight that it ever had.
    died : float, optional
        Time of the data since which its weight is below `DEAD`, s; None while it lives.
    history : list of tuple of (float, float), optional
        Time (s) and weight at all updates.
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
    on_update: Callable[[int, list[TrackedHypothesis]], object] | None = None,
) -> list[TrackedHypothesis]:
    """Follow all hypotheses through growing data.

    Parameters
    ----------
    problem : PlanarProblem
        Of the whole trial.
    updates : sequence of int
        Numbers of nodes after which to fit, increasing.
    searches : sequence of int
        Those of them after which to search for new hypotheses as well.
    on_update : callable of int, list of TrackedHypothesis, object, optional
        Called with the number of nodes and the living hypotheses, most probable first.

    Returns
    -------
    list of TrackedHypothesis
        All that were ever likely, the living ones first, most probable first; their fits are of
        the last update.
    """
    living: list[TrackedHypothesis] = []
    gone: list[TrackedHypothesis] = []
    before = 0
    for nodes in updates:
        time = float(problem.time[nodes - 1])
        last_weights = [(h, h.fit, h.weight) for h in living]
        for h in living:
            h.fit = _refitted(problem, h.fit, nodes)
        found = search(problem, nodes) if nodes in searches else []
        if not living and problem.start_known:
            found.append(_from_prior(problem, nodes))
        for new in found:
            if not any(same_track(problem, new, h.fit) for h in living):
                living.append(TrackedHypothesis(time, new))
        living, dropped = _weighted(problem, living, time)
        for h, earlier, weight in last_weights:
            if h.weight < DEAD <= weight:
                h.died = _time_of_death(problem, h, earlier, living, before, nodes)
        gone += [h for h in dropped if h.died is not None]
        if on_update is not None:
            on_update(nodes, living)
        before = nodes
    likely = [h for h in (*living, *gone) if h.highest >= _LIKELY]
    return sorted(likely, key=lambda h: (h.died is not None, -h.weight))


def _refitted(problem: PlanarProblem, earlier: Fit, nodes: int) -> Fit:
    start = problem.carried(earlier.x, earlier.theta, nodes)
    found = fit(problem, start, earlier.theta)
    if _newly_rejected(problem, found, earlier) < _MOSTLY_REJECTED:
        return found
    # So many are not outliers: dead reckoning has left the region in which they pass the gate.
    other = fit(problem, start, earlier.theta, graduated=True, iterations=60)
    return min(found, other, key=lambda f: f.cost)


def _newly_rejected(problem: PlanarProblem, found: Fit, earlier: Fit) -> float:
    """Return the larger share, of ranges and rates, of the newest that were rejected."""
    new = slice(earlier.range_used.size, found.range_used.size)
    shares = [0.0]
    for values, used in (
        (problem.ranging.range, found.range_used),
        (problem.ranging.rate, found.rate_used),
    ):
        known = ~np.isnan(values[new])
        if known.any():
            shares.append(float(np.mean(used[new][known] == 0.0)))
    return max(shares)


def _from_prior(problem: PlanarProblem, nodes: int) -> Fit:
    theta = np.zeros(problem.prior_sigma.size)
    first = np.concatenate([problem.start_mean, np.zeros(2)])[None]
    return fit(problem, problem.carried(first, theta, nodes), theta, graduated=True)


def _weighted(
    problem: PlanarProblem, hypotheses: list[TrackedHypothesis], time: float
) -> tuple[list[TrackedHypothesis], list[TrackedHypothesis]]:
    """Return hypotheses by weight, and those that are dropped: negligible, or found twice."""
    kept: list[TrackedHypothesis] = []
    dropped: list[TrackedHypothesis] = []
    ordered = sorted(hypotheses, key=lambda h: h.fit.cost)
    for h, against in zip(
        ordered, hypothesis_costs(problem, [h.fit for h in ordered]), strict=True
    ):
        if against > NEGLIGIBLE or any(same_track(problem, h.fit, other.fit) for other in kept):
            h.weight = 0.0
            dropped.append(h)
        else:
            kept.append(h)
    likelihood = np.exp(-hypothesis_costs(problem, [h.fit for h in kept]))
    for h, value in zip(kept, likelihood, strict=True):
        h.weight = float(value / likelihood.sum())
        h.highest = max(h.highest, h.weight)
        if h.weight >= DEAD:
            h.died = None
    for h in (*kept, *dropped):
        h.history.append((time, h.weight))
    return kept, dropped


def _time_of_death(
    problem: PlanarProblem,
    h: TrackedHypothesis,
    earlier: Fit,
    living: Sequence[TrackedHypothesis],
    before: int,
    after: int,
) -> float:
    """Return the time of the first data between two updates that leave no weight, s."""
    others = [other.fit for other in living if other is not h]
    while after - before > 1:
        middle = (before + after) // 2
        own = _refitted(problem, earlier, middle)
        fits = [own, *(fit(problem, o.x[:middle], o.theta) for o in others)]
        likelihood = np.exp(-hypothesis_costs(problem, fits))
        if likelihood[0] / likelihood.sum() < DEAD:
            after = middle
        else:
            before, earlier = middle, own
    return float(problem.time[after - 1])
