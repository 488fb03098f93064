"""The shortest addition to a plan that meets what is required.

Sequences of the library's manoeuvres are tried, each by going on from what is known where
the sequence without its last entry ended:

1. one after another, the entry that brings most per second is added until all is met;
2. all sequences of up to two entries, in the order of their duration, that are shorter;
3. all sequences, likewise.

The first that is found in 3 is the shortest there is. Where their number ends the search
before, what 1 or 2 found is proposed, with the duration up to which all were tried.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.planning.library import Item, Library, library
from factorgraph_dvl.planning.prediction import Ending, Prediction, go_on, predict
from factorgraph_dvl.planning.requirements import Requirement

# Called with what was tried last and its number.
Progress = Callable[[str, int, float | None], None]

_MOST_TRIED = 300
# Of sequences that have to be predicted with the plan from its start, which takes longer.
_MOST_PREDICTED = 60
_LONGEST_S = 3600.0
_FEW = 2
# σ that differ by less are the same.
_SAME = 1.01


@dataclass(frozen=True)
class Proposal:
    """An addition to a plan.

    Parameters
    ----------
    names : tuple of str
        Of the manoeuvres in it.
    manoeuvres : tuple of dict of str to object
        As in a scenario, to be added at the end.
    added : float
        Its duration, s.
    requirements : tuple of Requirement
        With what is predicted for plan and addition together.
    met : bool
        Whether all are met; if not, this is the best that was found.
    tried : int
        Number of sequences.
    limit : float
        Duration up to which all sequences were tried, s; if all is met and it is not below
        `added`, there is none shorter.
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
        """Whether it meets all, and all shorter sequences of the library were tried."""
        return self.met and self.limit > self.added - 1e-3

    @property
    def missed(self) -> tuple[Requirement, ...]:
        """What is not met."""
        return tuple(r for r in self.requirements if not r.met)


@dataclass(frozen=True)
class _Tried:
    """A sequence, where it ends (None if that was not asked for), σ in units of those required."""

    items: tuple[int, ...]
    ending: Ending | None
    excess: Array

    @property
    def badness(self) -> float:
        """By how much all that is required is missed; 0 if nothing is."""
        return float(np.sum(np.log(np.maximum(self.excess, 1.0))))


@dataclass
class _Search:
    """What was tried so far, None where it cannot be sailed."""

    prediction: Prediction
    required: Sequence[Requirement]
    shelf: Library
    progress: Progress | None
    tried: dict[tuple[int, ...], _Tried | None] = field(default_factory=dict)

    @property
    def walking(self) -> bool:
        """Whether something that is required is no constant: only a whole prediction has it."""
        return not {r.component for r in self.required} <= set(self.prediction.history.names)

    @property
    def left(self) -> int:
        """How many more may be tried."""
        return (_MOST_PREDICTED if self.walking else _MOST_TRIED) - len(self.tried)

    def chosen(self, items: tuple[int, ...]) -> list[Item]:
        """Return the entries of a sequence, with what gets the vessel under way."""
        first = [] if self.shelf.under_way is None else [self.shelf.under_way]
        return [*first, *(self.shelf.items[i] for i in items)]

    def duration(self, items: tuple[int, ...]) -> float:
        """Return the duration of a sequence, s."""
        return sum(item.duration for item in self.chosen(items))

    def sail(self, items: tuple[int, ...]) -> _Tried | None:
        """Try a sequence whose beginning was tried; None if it cannot be sailed."""
        if items not in self.tried:
            try:
                self.tried[items] = self._whole(items) if self.walking else self._last(items)
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
            ending, new = before.ending, [self.shelf.items[items[-1]]]
        manoeuvres = [m for item in new for m in item.manoeuvres]
        history, after = go_on(self.prediction.scenario, manoeuvres, ending)
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
        # What noise feigns is judged here only.
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
        """Return a sequence that was sailed."""
        found = self.tried[items]
        assert found is not None
        return found


def propose(
    prediction: Prediction,
    required: Sequence[Requirement],
    *,
    progress: Progress | None = None,
) -> Proposal | None:
    """Return the shortest addition that meets what is required; None if nothing is missed.

    Parameters
    ----------
    prediction : Prediction
        Of the plan.
    required : sequence of Requirement
        Of `requirements`, with the predictions for the plan alone.
    progress : callable, optional
        Called for each sequence that is tried.
    """
    if all(r.met for r in required):
        return None
    shelf = library(prediction.scenario, prediction.ending.start.speed_m_s)
    search = _Search(prediction, required, shelf, progress)
    found = _one_by_one(search)
    few, _ = _shorter(search, found, _FEW)
    found = few or found
    shortest, limit = _shorter(search, found, None)
    found = shortest or found
    if found is None:
        sailed = [t for t in search.tried.values() if t is not None]
        if not sailed:
            return None
        best = min(
            sailed,
            key=lambda t: (round(t.badness / np.log(_SAME)), search.duration(t.items)),
        )
        found = search.proposal(best.items)
    return replace(found, tried=len(search.tried), limit=limit)


def _one_by_one(search: _Search) -> Proposal | None:
    """Add the entry that brings most per second until all is met; None if that leads nowhere."""
    items: tuple[int, ...] = ()
    badness = float(np.sum(np.log([max(r.predicted / r.required, 1.0) for r in search.required])))
    while search.left >= len(search.shelf.items):
        further = [search.sail((*items, i)) for i in range(len(search.shelf.items))]
        sailed = [t for t in further if t is not None]
        if not sailed:
            return None

        def gain(t: _Tried, before: float = badness) -> float:
            return (before - t.badness) / search.shelf.items[t.items[-1]].duration

        best = max(sailed, key=gain)
        if gain(best) <= 0.0 or search.duration(best.items) > _LONGEST_S:
            return None
        items, badness = best.items, best.badness
        if badness == 0.0:
            found = search.proposal(items)
            if found.met:
                return found
            badness = search.known(items).badness
    return None


def _shorter(
    search: _Search, found: Proposal | None, deepest: int | None
) -> tuple[Proposal | None, float]:
    """Return the first sequence that meets all, in the order of their duration.

    Parameters
    ----------
    search : _Search
        What was tried before, which is not tried again.
    found : Proposal or None
        Nothing that takes as long is looked at; None if there is none yet.
    deepest : int or None
        Number of entries of a sequence at most.

    Returns
    -------
    It, None if there is none; and the duration up to which all were tried.
    """
    end = _LONGEST_S if found is None else found.added - 1e-6
    queue: list[tuple[float, tuple[int, ...]]] = [
        (search.duration((i,)), (i,)) for i in range(len(search.shelf.items))
    ]
    heapq.heapify(queue)
    limit = 0.0
    while queue and queue[0][0] < end:
        duration, items = heapq.heappop(queue)
        if search.left <= 0 and items not in search.tried:
            return None, limit
        tried = search.sail(items)
        limit = duration
        if tried is None:
            continue
        if tried.badness == 0.0:
            proposal = search.proposal(items)
            if proposal.met:
                return proposal, limit
        if deepest is None or len(items) < deepest:
            for i in range(len(search.shelf.items)):
                heapq.heappush(queue, (search.duration((*items, i)), (*items, i)))
    return None, end if found is None else found.added


def _excess(required: Sequence[Requirement], std: Mapping[str, float]) -> Array:
    return np.array([std[r.component] / r.required for r in required])


def _std(prediction: Prediction) -> dict[str, float]:
    std = np.sqrt(np.diag(prediction.solution.covariance)).tolist()
    return dict(zip(prediction.solution.order, std, strict=True))
