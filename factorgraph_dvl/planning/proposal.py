"""The shortest addition to a plan that meets its requirements, and the manoeuvres to add."""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.planning.prediction import Ending, Prediction, extend, predict
from factorgraph_dvl.planning.requirements import Requirement
from factorgraph_dvl.simulation.manoeuvres import Accelerate, Stop, Turn
from factorgraph_dvl.simulation.scenario import Scenario
from factorgraph_dvl.solution import Progress

# Chosen: values for a plan without turns, accelerations or speed; survey vessels and AUVs reach
# them.
_TURN_DEG_S = 3.0
_ACCELERATION_M_S2 = 0.2
_SPEED_M_S = 2.0
# Chosen: legs and stops, s, long enough for tens of pings, and half speed for a clear change.
_STRAIGHT_S = 60.0
_REST_S = 30.0
_SLOW = 0.5


@dataclass(frozen=True)
class Item:
    """An entry of the library.

    Parameters
    ----------
    name : str
        Name of the entry.
    manoeuvres : tuple of dict of str to object
        Manoeuvres, as in a scenario.
    duration : float
        Duration, s.
    """

    name: str
    manoeuvres: tuple[dict[str, Any], ...]
    duration: float


@dataclass(frozen=True)
class Library:
    """Entries, and the one to get under way first; None if the plan ends under way."""

    items: tuple[Item, ...]
    under_way: Item | None


def library(scenario: Scenario, speed_at_end: float) -> Library:
    """Return the library for a plan.

    Parameters
    ----------
    scenario : Scenario
        Scenario of the plan.
    speed_at_end : float
        Speed through the water at its end, m/s.
    """
    plan = scenario.plan()
    rate = max((abs(m.turn_deg_s) for m in plan if isinstance(m, Turn)), default=0.0)
    rate = rate or _TURN_DEG_S
    rates = [abs(m.accelerate_m_s2) for m in plan if isinstance(m, Accelerate)]
    rates += [m.acceleration_m_s2 for m in plan if isinstance(m, Stop)]
    acceleration = max(rates, default=0.0) or _ACCELERATION_M_S2
    speeds = [m.to_m_s for m in plan if isinstance(m, Accelerate)]
    # A manoeuvre near rest could not change the speed.
    moving = speed_at_end >= 0.1
    speed = speed_at_end if moving else max(scenario.start.speed_m_s, *speeds, 0.0) or _SPEED_M_S
    under_way = None
    if not moving:
        change = (speed - speed_at_end) / acceleration
        under_way = Item(
            "get under way", ({"accelerate_m_s2": acceleration, "to_m_s": speed},), change
        )

    def turn(angle: float) -> dict[str, Any]:
        sign = 1.0 if angle > 0.0 else -1.0
        return {"turn_deg_s": sign * rate, "duration_s": abs(angle) / rate}

    slow = _SLOW * speed
    straight = {"straight_s": _STRAIGHT_S}
    rest = {"stop_s": _REST_S, "acceleration_m_s2": acceleration}
    slower = (
        {"accelerate_m_s2": -acceleration, "to_m_s": slow},
        {"straight_s": _REST_S},
        {"accelerate_m_s2": acceleration, "to_m_s": speed},
    )
    items = (
        Item("straight", (straight,), _STRAIGHT_S),
        Item("turn by 90° to starboard", (turn(90.0),), 90.0 / rate),
        Item("turn by 90° to port", (turn(-90.0),), 90.0 / rate),
        Item("circle", (turn(360.0),), 360.0 / rate),
        Item("figure-eight", ({"figure_eight_deg_s": rate},), 720.0 / rate),
        Item(
            "there and back",
            (straight, turn(180.0), straight),
            2.0 * _STRAIGHT_S + 180.0 / rate,
        ),
        Item("slow down and back", slower, 2.0 * (speed - slow) / acceleration + _REST_S),
        Item("stop", (rest,), 2.0 * speed / acceleration + _REST_S),
    )
    return Library(items, under_way)


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
