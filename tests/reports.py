"""Results to show on pages, built by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from builders import build_solution

from factorgraph_dvl.estimates import Cause, Residuals, Trajectory
from factorgraph_dvl.files.solution_folder import CHECK_COLUMNS, CHECK_ERRORS
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.report.html.content import Result


def trajectory(seconds: float) -> Trajectory:
    """A vehicle that turns to and fro, ten epochs a second."""
    time = np.arange(0.0, seconds, 0.1)
    heading = 0.8 * np.sin(2.0 * np.pi * time / 300.0)
    velocity = 2.0 * np.stack([np.sin(heading), np.cos(heading), 0.0 * time], axis=1)
    east, north = np.cumsum(velocity[:, :2], axis=0).T * 0.1
    geodetic = np.stack([0.6 + north / 6.37e6, 1.9 + east / 5.27e6, 10.0 + 0.0 * time], axis=1)
    rph = np.stack([0.05 * np.sin(time), 0.03 * np.cos(time), heading], axis=1)
    spread = np.tile(0.01 * np.eye(3), (time.size, 1, 1))
    return Trajectory(time, geodetic, velocity, rph, spread, 0.1 * spread, 0.01 * spread)


def residuals(seconds: float) -> Residuals:
    time = np.arange(0.0, seconds, 0.2)
    rng = np.random.default_rng(1)
    value = rng.normal(0.0, 0.01, (time.size, 3))
    value[5] = 0.2
    return Residuals(
        "DVL velocity", "m/s", ("x", "y", "z"), time, value, np.full(value.shape, 0.01)
    )


def checked(seconds: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Content of check.json and columns of check.parquet."""
    time = np.arange(0.5 * seconds, seconds, 0.2)
    errors = {
        "end_point_error_m": 0.1234, "end_point_percent": 0.011, "global_error_m": 0.2,
        "rms_error_m": 0.05, "distance_m": 907.0,
    }  # fmt: skip
    check = {
        "data": "second half", "positions": "GNSS",
        "residual_rms_m_s": {
            "axes": ["forward", "starboard", "down"], "before": [1.0, 2.0, 0.5],
            "after": [0.01, 0.01, 0.01],
        },
        "dead_reckoning": errors | {"uncalibrated": errors},
    }  # fmt: skip
    table = dict.fromkeys((*CHECK_COLUMNS, *CHECK_ERRORS), np.sin(time) ** 2 + 0.01)
    return check, table | {"time_s": time}


def build_result(seconds: float = 600.0, **changes: Any) -> Result:
    own = build_solution()
    adds = np.concatenate([e.std for e in own.estimates]) / np.sqrt(2.0)
    solution = replace(
        own,
        trajectory=trajectory(seconds),
        residuals=(residuals(seconds),),
        findings=(
            *own.findings,
            Finding(Code.CLOCK_OFFSET, "gnss.csv of by hand is 0.2 s late", "GNSS"),
        ),
        error_budget=(Cause("gyro noise", "0.1 deg/√h", adds), Cause("DVL noise", "", adds)),
    )
    run = {
        "versions": {"python": "3.11.0"},
        "epoch": "2022-10-12T02:00:00Z",
        "settings": {"dvl": {"file": "dvl.csv", "velocity_std_m_s": 0.01},
                     "beacons": {"positions": {"A": {"lat_deg": 34.123456, "lon_deg": 108.9}}}},
        "records": [{"sensor": "dvl", "rows": 3000, "from_s": 0.0, "to_s": 600.0,
                     "interval_s": 0.2, "longest_interval_s": 0.4}],
        "truth": {"scale_error": [0.005]},
    }  # fmt: skip
    check, table = checked(seconds)
    return replace(Result("out", solution, run, check=check, check_table=table), **changes)
