"""The shortest addition to a plan that meets what is required.

Sequences of the library's manoeuvres are tried in the order of their duration, each by
going on from what is known where the sequence without its last entry ended. Two rules keep
their number small:

- Order is not tried: an entry is never followed by one that stands before it in the library.
- A sequence that takes longer than another and is better in no required σ, by 1 % at least,
  is not extended.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from factorgraph_dvl.conventions import Array
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.planning.library import Item, Library, library
from factorgraph_dvl.planning.prediction import Ending, Prediction, go_on, predict
from factorgraph_dvl.planning.requirements import Requirement

# Called with what was tried last and its number.
Progress = Callable[[str, int, float | None], None]

_MOST_TRIED = 250
_LONGEST_S = 3600.0
# σ that differ by less are the same.
_SAME = 1.01


@dataclass(frozen=True)
class Proposal:
    """An addition to a plan.

    Parameters
    ----------
    names : of the manoeuvres in it.
    manoeuvres : as in a scenario, to be added at the end.
    added : its duration, s.
    requirements : with what is predicted for plan and addition together.
    met : whether all are met; if not, this is the best that was found.
    tried : number of sequences.
    limit : duration of the longest that was tried, s.
    """

    names: tuple[str, ...]
    manoeuvres: tuple[dict[str, Any], ...]
    added: float
    requirements: tuple[Requirement, ...]
    met: bool
    tried: int
    limit: float

    @property
    def missed(self) -> tuple[Requirement, ...]:
        """What is not met."""
        return tuple(r for r in self.requirements if not r.met)


@dataclass(frozen=True)
class _Tried:
    """A sequence, where it ends, and its σ in units of those required."""

    items: tuple[int, ...]
    duration: float
    ending: Ending
    excess: Array


def propose(
    prediction: Prediction,
    required: Sequence[Requirement],
    *,
    progress: Progress | None = None,
) -> Proposal | None:
    """Return the shortest addition that meets what is required; None if nothing is missed.

    Parameters
    ----------
    prediction : of the plan.
    required : of `requirements`, with the predictions for the plan alone.
    progress : called for each sequence that is tried.
    """
    if all(r.met for r in required):
        return None
    scenario = prediction.scenario
    shelf = library(scenario, prediction.ending.start.speed_m_s)
    best: _Tried | None = None
    kept: list[_Tried] = []
    tried = 0
    limit = 0.0
    first = 0.0 if shelf.under_way is None else shelf.under_way.duration
    queue: list[tuple[float, tuple[int, ...], _Tried | None]] = [
        (first + item.duration, (i,), None) for i, item in enumerate(shelf.items)
    ]
    heapq.heapify(queue)
    while queue and tried < _MOST_TRIED and queue[0][0] <= _LONGEST_S:
        duration, items, parent = heapq.heappop(queue)
        names = ", ".join(shelf.items[i].name for i in items)
        found = _try(prediction, required, shelf, items, duration, parent)
        if found is None:
            continue
        tried += 1
        limit = duration
        if progress:
            progress(f"proposal: {duration:.0f} s, {names}", tried, None)
        if best is None or _badness(found) < _badness(best):
            best = found
        if found.excess.max() <= 1.0:
            proposal = _checked(prediction, required, shelf, found, tried, limit)
            if proposal.met:
                return proposal
        if any(
            k.duration <= found.duration and np.all(k.excess <= found.excess * _SAME) for k in kept
        ):
            continue
        kept.append(found)
        for i in range(items[-1], len(shelf.items)):
            more = duration + shelf.items[i].duration
            heapq.heappush(queue, (more, (*items, i), found))
    return None if best is None else _checked(prediction, required, shelf, best, tried, limit)


def _badness(tried: _Tried) -> tuple[float, float]:
    """Return by how much all that is required is missed, and how long it takes."""
    missed = float(np.sum(np.log(np.maximum(tried.excess, 1.0))))
    return round(missed / np.log(_SAME)), tried.duration


def _try(
    prediction: Prediction,
    required: Sequence[Requirement],
    shelf: Library,
    items: tuple[int, ...],
    duration: float,
    parent: _Tried | None,
) -> _Tried | None:
    """Return a sequence, None if it cannot be sailed."""
    last = shelf.items[items[-1]]
    manoeuvres = list(last.manoeuvres)
    if parent is None and shelf.under_way is not None:
        manoeuvres = [*shelf.under_way.manoeuvres, *manoeuvres]
    ending = prediction.ending if parent is None else parent.ending
    try:
        history, after = go_on(prediction.scenario, manoeuvres, ending)
    except ConfigError:
        return None
    std = dict(zip(history.names, history.std[-1].tolist(), strict=True))
    return _Tried(items, duration, after, _excess(required, std))


def _excess(required: Sequence[Requirement], std: Mapping[str, float]) -> Array:
    # What is no constant, as a bias that walks, is only known once all is predicted.
    return np.array([std.get(r.component, r.predicted) / r.required for r in required])


def _checked(
    prediction: Prediction,
    required: Sequence[Requirement],
    shelf: Library,
    found: _Tried,
    tried: int,
    limit: float,
) -> Proposal:
    """Return a proposal with the prediction of the whole plan with it."""
    chosen: list[Item] = [shelf.items[i] for i in found.items]
    if shelf.under_way is not None:
        chosen.insert(0, shelf.under_way)
    added = tuple(m for item in chosen for m in item.manoeuvres)
    scenario = prediction.scenario
    whole = predict(msgspec.structs.replace(scenario, manoeuvres=[*scenario.manoeuvres, *added]))
    std = dict(
        zip(
            whole.solution.order,
            np.sqrt(np.diag(whole.solution.covariance)).tolist(),
            strict=True,
        )
    )
    after = tuple(Requirement(r.component, r.required, std[r.component]) for r in required)
    return Proposal(
        names=tuple(item.name for item in chosen),
        manoeuvres=added,
        added=whole.duration - prediction.duration,
        requirements=after,
        met=all(r.met for r in after),
        tried=tried,
        limit=limit,
    )
