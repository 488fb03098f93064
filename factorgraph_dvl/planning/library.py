"""The manoeuvres that a proposal is made of.

They are sailed with what the plan's own vessel does: its speed at the end (or the highest
of the plan, where it ends at rest), its fastest turn and its hardest acceleration. Each
begins and ends under way at that speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from factorgraph_dvl.simulation.manoeuvres import Accelerate, Stop, Turn
from factorgraph_dvl.simulation.scenario import Scenario

# Of a plan that never turns, never accelerates or never moves.
_TURN_DEG_S = 3.0
_ACCELERATION_M_S2 = 0.2
_SPEED_M_S = 2.0
_STRAIGHT_S = 60.0
_REST_S = 30.0
_SLOW = 0.5


@dataclass(frozen=True)
class Item:
    """An entry of the library.

    Parameters
    ----------
    name : str
        What it is.
    manoeuvres : tuple of dict of str to object
        As in a scenario.
    duration : float
        S.
    """

    name: str
    manoeuvres: tuple[dict[str, Any], ...]
    duration: float


@dataclass(frozen=True)
class Library:
    """Entries, and how to get under way before the first of them; None if the plan is."""

    items: tuple[Item, ...]
    under_way: Item | None


def library(scenario: Scenario, speed_at_end: float) -> Library:
    """Return the library for a plan.

    Parameters
    ----------
    scenario : Scenario
        The plan.
    speed_at_end : float
        Through the water, m/s.
    """
    plan = scenario.plan()
    rate = max((abs(m.turn_deg_s) for m in plan if isinstance(m, Turn)), default=0.0)
    rate = rate or _TURN_DEG_S
    rates = [abs(m.accelerate_m_s2) for m in plan if isinstance(m, Accelerate)]
    rates += [m.acceleration_m_s2 for m in plan if isinstance(m, Stop)]
    push = max(rates, default=0.0) or _ACCELERATION_M_S2
    speeds = [m.to_m_s for m in plan if isinstance(m, Accelerate)]
    # A manoeuvre from almost rest would have no speed to change.
    moving = speed_at_end >= 0.1
    speed = speed_at_end if moving else max(scenario.start.speed_m_s, *speeds, 0.0) or _SPEED_M_S
    under_way = None
    if not moving:
        change = (speed - speed_at_end) / push
        under_way = Item("get under way", ({"accelerate_m_s2": push, "to_m_s": speed},), change)

    def turn(angle: float) -> dict[str, Any]:
        sign = 1.0 if angle > 0.0 else -1.0
        return {"turn_deg_s": sign * rate, "duration_s": abs(angle) / rate}

    slow = _SLOW * speed
    straight = {"straight_s": _STRAIGHT_S}
    rest = {"stop_s": _REST_S, "acceleration_m_s2": push}
    slower = (
        {"accelerate_m_s2": -push, "to_m_s": slow},
        {"straight_s": _REST_S},
        {"accelerate_m_s2": push, "to_m_s": speed},
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
        Item("slow down and back", slower, 2.0 * (speed - slow) / push + _REST_S),
        Item("stop", (rest,), 2.0 * speed / push + _REST_S),
    )
    return Library(items, under_way)
