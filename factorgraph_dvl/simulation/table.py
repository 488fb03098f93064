"""The angle of a simulated turntable."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import PPoly

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.units import DEG

if TYPE_CHECKING:
    from factorgraph_dvl.simulation.scenario import Scenario


def table_angle(scenario: Scenario, duration: float) -> PPoly | None:
    """Return the angle of the turntable over time, rad; None without one.

    Raises
    ------
    ConfigError
        If a turn ends after the manoeuvres.
    """
    if scenario.turntable is None:
        return None
    breaks, rates, slopes = [0.0], [], []

    def add(until: float, rate: float, slope: float) -> None:
        if until > breaks[-1]:
            breaks.append(until)
            rates.append(rate)
            slopes.append(slope)

    for i, turn in enumerate(scenario.turntable.turns):
        end = turn.at_s + turn.duration_s
        if end > duration:
            raise ConfigError(
                f"the turn ends at {end:g} s, after the manoeuvres, which take {duration:g} s",
                where=f"{scenario.source} key turntable.turns[{i}]",
                expected="an earlier turn, or longer manoeuvres",
            )
        rate = turn.turn_deg * DEG / (turn.duration_s - turn.ramp_s)
        slope = rate / turn.ramp_s if turn.ramp_s > 0.0 else 0.0
        add(turn.at_s, 0.0, 0.0)
        add(turn.at_s + turn.ramp_s, 0.0, slope)
        add(end - turn.ramp_s, rate, 0.0)
        add(end, rate, -slope)
    add(duration, 0.0, 0.0)
    angle = PPoly(np.array([slopes, rates]), np.array(breaks)).antiderivative()
    angle.c[-1] += scenario.turntable.start_deg * DEG
    return angle
