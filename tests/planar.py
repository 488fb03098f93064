"""Planar trials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from truth import merged

from factorgraph_dvl.geometry.vectors import interpolate
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solvers.planar_setup import planar_setup

BASE = {
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
    return simulate(parse_scenario(merged(BASE, changes)), seed)


ALL_CONSTANTS = {
    "heading": {"bias_deg": 1.0, "bias_std_deg": 2.0},
    "log": {"scale_error": 0.02, "scale_error_std": 0.03},
    "beacons": {
        "positions": {
            "B1": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": -80},
            "B2": {"lat_deg": 25.004, "lon_deg": 135.004, "height_m": -90, "std_m": 2},
        },
        "sound_speed_error": 0.003,
        "sound_speed_error_std": 0.004,
        "lever_arm_m": [0.5, 2.0, -1.0],
    },
}


STRAIGHT = {"manoeuvres": [{"straight_s": 300}]}


def truth(t, time):
    r = t.reference
    return t.frame().position(*interpolate(time, r.time, r.geodetic).T)[:, :2]


def setup_of(t):
    return planar_setup(t, t.frame())


def true_state(t, setup):
    """Return true states of the nodes (K, 4) and constants by name."""
    time, h = setup.chain.node_time, 0.01
    p = truth(t, time)
    inside = np.clip(time, time[0] + h, time[-1] - h)
    v = (truth(t, inside + h) - truth(t, inside - h)) / (2.0 * h)
    values = {
        q.name: t.calibration_truth[q.name] * q.si if q.name in t.calibration_truth else q.mean
        for q in setup.parameters
    }
    return np.hstack([p, v]), values


def evaluation_of(t, setup, x, values):
    """Return the problem of the first nodes, weighed, and its evaluation at a state."""
    problem = setup.problem(len(x), {})
    states = setup.chain.with_recorded(problem.chain.node_time, x)
    return problem, problem.weighed(problem.evaluate(problem.values(states, values)))


def error_of(t, solution):
    track = solution.trajectory
    return t.frame().position(*track.geodetic.T)[:, :2] - truth(t, track.time)


def changed(t, *records):
    """Return a trial with records in place of those of the same sensors."""
    new = {type(record): record for record in records}
    return replace(t, others=tuple(new.get(type(aid), aid) for aid in t.others))


def without(record, first, last):
    """Return the record of heading or log without what lies between two times."""
    kept = (record.time <= first) | (record.time >= last)
    name = "heading" if record.label == "Heading" else "speed"
    out = {"time": record.time[kept], name: getattr(record, name)[kept]}
    if name == "speed":
        out["starboard"] = record.starboard[kept]
    return replace(record, **out)
