"""Planar trials."""

from __future__ import annotations

from truth import merged

from factorgraph_dvl.simulation import parse_scenario, simulate_planar

_BASE = {
    "name": "test",
    "start": {
        "lat_deg": 24.9955,
        "lon_deg": 135.003,
        "height_m": -40,
        "heading_deg": 20,
        "speed_m_s": 2,
    },
    "manoeuvres": [
        {"straight_s": 150},
        {"turn_deg_s": 2, "duration_s": 15},
        {"straight_s": 150},
    ],
    "current_m_s": [0.2, -0.15, 0],
    "heading": {"rate_hz": 1, "std_deg": 0.5},
    "log": {"rate_hz": 1, "speed_std_m_s": 0.05},
    "depth": {"rate_hz": 1, "std_m": 0.1},
    "beacons": {
        "rate_hz": 1,
        "positions": {"B1": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": -80}},
        "range_std_m": 1.0,
        "range_rate_std_m_s": 0.05,
    },
    "trial": {"log": {"current_std_m_s": [0.3, 0.3]}},
}


def trial(seed=0, **changes):
    return simulate_planar(parse_scenario(merged(_BASE, changes)), seed)
