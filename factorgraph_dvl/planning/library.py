"""The manoeuvres that a proposal is made of.

They use the speed at the end of the plan (or its highest speed, if it ends at rest), its
fastest turn and its largest acceleration. Each begins and ends at that speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from factorgraph_dvl.simulation.manoeuvres import Accelerate, Stop, Turn
from factorgraph_dvl.simulation.scenario import Scenario

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
