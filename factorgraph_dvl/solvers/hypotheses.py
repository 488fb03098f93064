"""All tracks that the ranges allow, followed as the data grow.

On a straight run ranges and range rates fit two tracks, mirror images about the line of
motion. Both are followed. Their weights are the normalised likelihoods, exp(-cost), without the
differences that chance explains. After a turn only the true one still fits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from factorgraph_dvl.estimates import Hypothesis
from factorgraph_dvl.geometry.rotations import wrapped
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.ranging.hypothesis_weights import NEGLIGIBLE, hypothesis_costs
from factorgraph_dvl.ranging.search import search
from factorgraph_dvl.solvers.planar_setup import PlanarSetup, Track

# Chosen: weight below which a hypothesis is dead: one in a thousand.
DEAD = 1e-3
# Chosen: a hypothesis is reported if its weight ever reached this.
_LIKELY = 0.05
# Chosen: number of times at which hypotheses are fitted and weighed.
_UPDATES = 24
# Chosen: indices of those at which to search for new hypotheses as well, denser at first, when
# the ranges determine little.
_SEARCHES = (0, 1, 2, 4, 8, 16)
# Chosen: rows before the first of them; a start and a current have four unknowns.
_FIRST_ROWS = 8


@dataclass
class TrackedHypothesis:
    """A track that the ranges allow.

    Parameters
    ----------
    born : float
        Time of the last data when it was found, s.
    fit : Track
        Track with the data so far, or when it was last followed.
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
    fit: Track
    weight: float = 0.0
    highest: float = 0.0
    died: float | None = None
    history: list[tuple[float, float]] = field(default_factory=list)


def schedule(setup: PlanarSetup) -> tuple[list[int], list[int]]:
    """Return the numbers of nodes at which to weigh hypotheses, and to search for new ones."""
    time, node_time = setup.rows.time, setup.chain.node_time
    counts = np.linspace(min(_FIRST_ROWS, time.size), time.size, _UPDATES).astype(int)
    nodes = np.searchsorted(node_time, time[counts - 1]) + 1
    updates = np.unique(np.clip(nodes, 2, node_time.size)).tolist()
    updates[-1] = node_time.size
    return updates, [*(updates[i] for i in _SEARCHES if i < len(updates)), updates[-1]]


def reported(hypothesis: TrackedHypothesis) -> Hypothesis:
    """Return a hypothesis with its track at 1 Hz."""
    history = np.array(hypothesis.history).reshape(-1, 2)
    track = hypothesis.fit.trajectory(1.0)
    return Hypothesis(hypothesis.weight, hypothesis.born, hypothesis.died, track, history)


def follow(
    setup: PlanarSetup,
    updates: Sequence[int],
    searches: Sequence[int],
    on_update: Callable[[int, list[TrackedHypothesis]], object] | None = None,
) -> list[TrackedHypothesis]:
    """Follow all hypotheses through growing data.

    Parameters
    ----------
    setup : PlanarSetup
        Setup of the whole trial.
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
        time = float(setup.chain.node_time[nodes - 1])
        last_weights = [(h, h.fit, h.weight) for h in living]
        for h in living:
            h.fit = setup.followed(h.fit, nodes)
        found = _searched(setup, nodes) if nodes in searches else []
        if not living and setup.known_start:
            found.append(_from_prior(setup, nodes))
        for new in found:
            if not any(same_track(setup, new, h.fit) for h in living):
                living.append(TrackedHypothesis(time, new))
        living, dropped = _weighted(setup, living, time)
        for h, earlier, weight in last_weights:
            if h.weight < DEAD <= weight:
                h.died = _time_of_death(setup, h, earlier, living, before, nodes)
        gone += [h for h in dropped if h.died is not None]
        if on_update is not None:
            on_update(nodes, living)
        before = nodes
    likely = [h for h in (*living, *gone) if h.highest >= _LIKELY]
    return sorted(likely, key=lambda h: (h.died is not None, -h.weight))


def _from_prior(setup: PlanarSetup, nodes: int) -> Track:
    start = setup.reckoned(setup.chain.start[:2], setup.zero, nodes)
    return setup.fitted(start, setup.zero, {})


def _searched(setup: PlanarSetup, nodes: int) -> list[Track]:
    """Return the distinct tracks that fit the first nodes, without knowing where they begin."""
    chain, rows = setup.chain, setup.rows
    known = np.flatnonzero(rows.time <= chain.node_time[nodes - 1])
    (drift,) = (p for p in setup.parameters if p.name == setup.track.current)
    found: list[Track] = []
    for start in search(
        rows.some(known),
        chain.start[:2],
        chain.start_std[:2],
        drift.sigma if drift.estimated else None,
    ):
        values = setup.zero | {drift.name: start.current}
        echoes = {
            o.label: o.time[np.isin(o.time, rows.time[known][wrong])]
            for o in setup.observations
            if o.gate is not None
            for kind, wrong in zip(("m", "m/s"), start.echoes, strict=True)
            if o.unit == kind
        }
        track = setup.fitted(setup.reckoned(start.position, values, nodes), values, echoes)
        if not any(same_track(setup, track, other) for other in found):
            found.append(track)
    against = relative_costs(found)
    return [track for track, value in zip(found, against, strict=True) if value < NEGLIGIBLE]


def relative_costs(found: Sequence[Track]) -> Array:
    """Return the costs of tracks of the same data relative to the best, (F,)."""
    data, priors = zip(*(track.terms for track in found), strict=True) if found else ((), ())
    return hypothesis_costs(data, priors)


def _cut(setup: PlanarSetup, later: Track, nodes: int) -> Track:
    """Return a track that is fitted to the first of its nodes alone."""
    end = setup.chain.node_time[nodes - 1]
    known = {label: t[t <= end] for label, t in later.problem.rejected.items()}
    return setup.fitted(later.x[:nodes], later.values, known)


def same_track(setup: PlanarSetup, a: Track, b: Track) -> bool:
    """Whether two tracks are the same, judged by the data.

    They are if at the end of the shorter they bear from the beacon in directions that differ
    by less than three standard deviations. (Their distances to it agree, being measured.)
    """
    last = min(len(a.x), len(b.x)) - 1
    rows = setup.rows
    heard = np.searchsorted(rows.time, setup.chain.node_time[last], side="right")
    place = rows.place[max(int(heard) - 1, 0)]
    one, other = a.x[last, :2] - place, b.x[last, :2] - place
    if np.hypot(*(one - other)) < 1.0:
        return True
    P = (a if len(a.x) - 1 == last else b).last_position
    distance = max(float(np.hypot(*one)), 1.0)
    across = np.array([one[1], -one[0]]) / distance
    turn = np.arctan2(other[0], other[1]) - np.arctan2(one[0], one[1])
    arc = distance * abs(wrapped(turn))
    return bool(arc < 3.0 * np.sqrt(across @ P @ across))


def _weighted(
    setup: PlanarSetup, hypotheses: list[TrackedHypothesis], time: float
) -> tuple[list[TrackedHypothesis], list[TrackedHypothesis]]:
    """Return hypotheses by weight, and those that are dropped: negligible, or found twice."""
    kept: list[TrackedHypothesis] = []
    dropped: list[TrackedHypothesis] = []
    ordered = sorted(hypotheses, key=lambda h: h.fit.cost)
    for h, against in zip(ordered, relative_costs([h.fit for h in ordered]), strict=True):
        if against > NEGLIGIBLE or any(same_track(setup, h.fit, other.fit) for other in kept):
            h.weight = 0.0
            dropped.append(h)
        else:
            kept.append(h)
    likelihood = np.exp(-relative_costs([h.fit for h in kept]))
    for h, value in zip(kept, likelihood, strict=True):
        h.weight = float(value / likelihood.sum())
        h.highest = max(h.highest, h.weight)
        if h.weight >= DEAD:
            h.died = None
    for h in (*kept, *dropped):
        h.history.append((time, h.weight))
    return kept, dropped


def _time_of_death(
    setup: PlanarSetup,
    h: TrackedHypothesis,
    earlier: Track,
    living: Sequence[TrackedHypothesis],
    before: int,
    after: int,
) -> float:
    """Return the time of the first data between two updates that leave no weight, s."""
    others = [other.fit for other in living if other is not h]
    while after - before > 1:
        middle = (before + after) // 2
        own = setup.followed(earlier, middle)
        fits = [own, *(_cut(setup, o, middle) for o in others)]
        likelihood = np.exp(-relative_costs(fits))
        if likelihood[0] / likelihood.sum() < DEAD:
            after = middle
        else:
            before, earlier = middle, own
    return float(setup.chain.node_time[after - 1])
