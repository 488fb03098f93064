"""The shortest addition to a plan that meets its requirements.

The search tries sequences of the library's manoeuvres. Each extends the posterior at the end
of the sequence without its last entry:

1. greedy: the entry with the largest gain per second is added until all requirements are met;
2. all shorter sequences of up to two entries, in the order of their duration;
3. all shorter sequences, in the order of their duration.

The first solution in step 3 is the shortest one. If the number of trials ends the search
earlier, the result of step 1 or 2 is proposed, with the duration up to which all were tried.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.planning.library import Item, Library, library
from factorgraph_dvl.planning.prediction import Ending, Prediction, extend, predict
from factorgraph_dvl.planning.requirements import Requirement
from factorgraph_dvl.solution import Progress

# Called with the last sequence and its number.

# Chosen: limits the search to minutes; a sequence takes about a tenth of a second.
_MAX_TRIED = 300
# Chosen: fewer, because each is predicted with the whole plan from its start.
_MAX_PREDICTED = 60
# Chosen: additions longer than an hour, s, are impractical.
_LONGEST_S = 3600.0
# Chosen: all sequences of up to this many entries are few enough to try first.
_SHORT = 2
# Chosen: σ that differ by less than 1 % are equal in practice.
_SAME = 1.01


@dataclass(frozen=True)
class Proposal:
    """An addition to a plan.

    Parameters
    ----------
    names : tuple of str
        Names of its manoeuvres.
    manoeuvres : tuple of dict of str to object
        Manoeuvres to add at the end, as in a scenario.
    added : float
        Duration of the addition, s.
    requirements : tuple of Requirement
        Requirements with the predictions for plan and addition together.
    met : bool
        Whether all requirements are met; if not, this is the best addition found.
    tried : int
        Number of sequences tried.
    limit : float
        Duration up to which all sequences were tried, s; if all requirements are met and it is
        not below `added`, no shorter addition exists.
    """

    names: tuple[str, ...]
    manoeuvres: tuple[dict[str, Any], ...]
    added: float
    requirements: tuple[Requirement, ...]
    met: bool
    tried: int
    limit: float

    @property
    def shortest(self) -> bool:
        """Whether all requirements are met and all shorter sequences were tried."""
        return self.met and self.limit > self.added - 1e-3

    @property
    def missed(self) -> tuple[Requirement, ...]:
        """Requirements that are not met."""
        return tuple(r for r in self.requirements if not r.met)


@dataclass(frozen=True)
class _Tried:
    """A sequence, its end (None if not needed), and σ in units of the required ones."""

    items: tuple[int, ...]
    ending: Ending | None
    excess: Array

    @property
    def shortfall(self) -> float:
        """Sum of the logarithms of missed σ over required ones; 0 if all are met."""
        return float(np.sum(np.log(np.maximum(self.excess, 1.0))))


@dataclass
class _Search:
    """Sequences tried so far; None for those that cannot be carried out."""

    prediction: Prediction
    required: Sequence[Requirement]
    library: Library
    progress: Progress | None
    tried: dict[tuple[int, ...], _Tried | None] = field(default_factory=dict)

    @property
    def from_start(self) -> bool:
        """Whether only a prediction from the start has it all: without IMU, or of random walks."""
        known = set(self.prediction.history.names)
        no_imu = self.prediction.ending.frontier is None
        return no_imu or not {r.component for r in self.required} <= known

    @property
    def left(self) -> int:
        """Number of sequences that may still be tried."""
        return (_MAX_PREDICTED if self.from_start else _MAX_TRIED) - len(self.tried)

    def chosen(self, items: tuple[int, ...]) -> list[Item]:
        """Return the entries of a sequence, with the one to get under way."""
        first = [] if self.library.under_way is None else [self.library.under_way]
        return [*first, *(self.library.items[i] for i in items)]

    def duration(self, items: tuple[int, ...]) -> float:
        """Return the duration of a sequence, s."""
        return sum(item.duration for item in self.chosen(items))

    def attempt(self, items: tuple[int, ...]) -> _Tried | None:
        """Try a sequence whose beginning was tried; None if it cannot be carried out."""
        if items not in self.tried:
            try:
                self.tried[items] = self._whole(items) if self.from_start else self._last(items)
            except ConfigError:
                self.tried[items] = None
            if self.progress:
                names = ", ".join(item.name for item in self.chosen(items))
                text = f"proposal: {self.duration(items):.0f} s, {names}"
                self.progress(text, len(self.tried), None)
        return self.tried[items]

    def _last(self, items: tuple[int, ...]) -> _Tried:
        before = self.tried.get(items[:-1])
        if before is None or before.ending is None:
            ending, new = self.prediction.ending, self.chosen(items)
        else:
            ending, new = before.ending, [self.library.items[items[-1]]]
        manoeuvres = [m for item in new for m in item.manoeuvres]
        history, after = extend(self.prediction.scenario, manoeuvres, ending)
        std = dict(zip(history.names, history.std[-1].tolist(), strict=True))
        return _Tried(items, after, _excess(self.required, std))

    def _whole(self, items: tuple[int, ...]) -> _Tried:
        return _Tried(items, None, _excess(self.required, _std(self.with_plan(items))))

    def with_plan(self, items: tuple[int, ...]) -> Prediction:
        """Return the prediction of the whole plan with a sequence."""
        scenario = self.prediction.scenario
        added = [m for item in self.chosen(items) for m in item.manoeuvres]
        return predict(
            msgspec.structs.replace(scenario, manoeuvres=[*scenario.manoeuvres, *added])
        )

    def proposal(self, items: tuple[int, ...]) -> Proposal:
        """Return a sequence as a proposal, predicted with the plan as a whole."""
        whole = self.with_plan(items)
        std = _std(whole)
        after = tuple(
            Requirement(r.component, r.required, std[r.component]) for r in self.required
        )
        # Only a whole prediction accounts for spurious information.
        self.tried[items] = replace(self.known(items), excess=_excess(self.required, std))
        chosen = self.chosen(items)
        return Proposal(
            names=tuple(item.name for item in chosen),
            manoeuvres=tuple(m for item in chosen for m in item.manoeuvres),
            added=whole.duration - self.prediction.duration,
            requirements=after,
            met=all(r.met for r in after),
            tried=len(self.tried),
            limit=0.0,
        )

    def known(self, items: tuple[int, ...]) -> _Tried:
        """Return a sequence that was carried out."""
        found = self.tried[items]
        assert found is not None
        return found


def propose(
    prediction: Prediction,
    required: Sequence[Requirement],
    *,
    progress: Progress | None = None,
) -> Proposal | None:
    """Return the shortest addition that meets all requirements; None if the plan meets them.

    Parameters
    ----------
    prediction : Prediction
        Prediction of the plan.
    required : sequence of Requirement
        Result of `requirements` for the plan alone.
    progress : callable, optional
        Function called for each sequence.
    """
    if all(r.met for r in required):
        return None
    entries = library(prediction.scenario, prediction.ending.start.speed_m_s)
    search = _Search(prediction, required, entries, progress)
    found = _one_by_one(search)
    few, _ = _shorter(search, found, _SHORT)
    found = few or found
    shortest, limit = _shorter(search, found, None)
    found = shortest or found
    if found is None:
        feasible = [t for t in search.tried.values() if t is not None]
        if not feasible:
            return None
        best = min(
            feasible,
            key=lambda t: (round(t.shortfall / np.log(_SAME)), search.duration(t.items)),
        )
        found = search.proposal(best.items)
    return replace(found, tried=len(search.tried), limit=limit)


def _one_by_one(search: _Search) -> Proposal | None:
    """Add the entry with the largest gain per second until all are met; None if this fails."""
    items: tuple[int, ...] = ()
    shortfall = float(
        np.sum(np.log([max(r.predicted / r.required, 1.0) for r in search.required]))
    )
    while search.left >= len(search.library.items):
        further = [search.attempt((*items, i)) for i in range(len(search.library.items))]
        feasible = [t for t in further if t is not None]
        if not feasible:
            return None

        def gain(t: _Tried, before: float = shortfall) -> float:
            return (before - t.shortfall) / search.library.items[t.items[-1]].duration

        best = max(feasible, key=gain)
        if gain(best) <= 0.0 or search.duration(best.items) > _LONGEST_S:
            return None
        items, shortfall = best.items, best.shortfall
        if shortfall == 0.0:
            found = search.proposal(items)
            if found.met:
                return found
            shortfall = search.known(items).shortfall
    return None


def _shorter(
    search: _Search, found: Proposal | None, deepest: int | None
) -> tuple[Proposal | None, float]:
    """Return the first sequence, in the order of duration, that meets all requirements.

    Parameters
    ----------
    search : _Search
        Search, which tries no sequence twice.
    found : Proposal or None
        Proposal so far; only shorter sequences are tried.
    deepest : int or None
        Largest number of entries; None = unlimited.

    Returns
    -------
    proposal : Proposal or None
        Proposal with that sequence; None if there is none.
    limit : float
        Duration up to which all were tried, s.
    """
    end = _LONGEST_S if found is None else found.added - 1e-6
    queue: list[tuple[float, tuple[int, ...]]] = [
        (search.duration((i,)), (i,)) for i in range(len(search.library.items))
    ]
    heapq.heapify(queue)
    limit = 0.0
    while queue and queue[0][0] < end:
        duration, items = heapq.heappop(queue)
        if search.left <= 0 and items not in search.tried:
            return None, limit
        tried = search.attempt(items)
        limit = duration
        if tried is None:
            continue
        if tried.shortfall == 0.0:
            proposal = search.proposal(items)
            if proposal.met:
                return proposal, limit
        if deepest is None or len(items) < deepest:
            for i in range(len(search.library.items)):
                heapq.heappush(queue, (search.duration((*items, i)), (*items, i)))
    return None, end if found is None else found.added


def _excess(required: Sequence[Requirement], std: Mapping[str, float]) -> Array:
    return np.array([std[r.component] / r.required for r in required])


def _std(prediction: Prediction) -> dict[str, float]:
    std = np.sqrt(np.diag(prediction.solution.covariance)).tolist()
    return dict(zip(prediction.solution.order, std, strict=True))
