"""A trial of every kind, each solved within seconds."""

from __future__ import annotations

import planar
from truth import config, scenario

from factorgraph_dvl.simulation import simulate

_TURNS = [
    {"straight_s": 5},
    {"turn_deg_s": -6, "duration_s": 15, "ramp_s": 3},
    {"accelerate_m_s2": -0.2, "to_m_s": 2},
    {"turn_deg_s": 8, "duration_s": 15, "ramp_s": 3},
    {"straight_s": 5},
]
_SLOW = {"imu": {"rate_hz": 50}, "gnss": {"rate_hz": 2}}

TRIALS = {
    "imu": lambda: simulate(
        scenario(noise=True, manoeuvres=_TURNS, **_SLOW, dvl={"rate_hz": 2}), 1
    ),
    "ship": lambda: simulate(
        config(
            "ship",
            manoeuvres=[
                {"straight_s": 60},
                {"turn_deg_s": 3, "duration_s": 60, "ramp_s": 5},
                {"straight_s": 60},
                {"turn_deg_s": -3, "duration_s": 60, "ramp_s": 5},
            ],
            attitude={"rate_hz": 1},
        ),
        1,
    ),
    "beams": lambda: simulate(
        config(
            "cruise-beams",
            start={"speed_m_s": 4},
            manoeuvres=_TURNS,
            **_SLOW,
            dvl_beams={"rate_hz": 2},
        ),
        1,
    ),
    "star": lambda: simulate(
        config("star", manoeuvres=[{"straight_s": 30}], imu={"rate_hz": 20}), 1
    ),
    "beacon": lambda: planar.trial(1),
}
