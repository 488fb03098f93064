"""Estimates and solutions by hand, to compare."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from builders import build_solution

from factorgraph_dvl.analysis.comparison.calibration_difference import Component
from factorgraph_dvl.analysis.comparison.crosscheck import CrossCheck
from factorgraph_dvl.estimates import Estimate, Trajectory
from factorgraph_dvl.solution import Solution


def estimate(name: str, value: Any, std: Any, observable: Any = True) -> Estimate:
    value, std = (np.atleast_1d(np.array(x, dtype=float)) for x in (value, std))
    n = value.size
    names = tuple(f"{name}_{i}" for i in range(n)) if n > 1 else (name,)
    seen = np.broadcast_to(np.array(observable), n).copy()
    return Estimate(name, names, value, std, np.zeros(n), np.full(n, 1e3), seen)


def result(*estimates: Estimate, **changes: Any) -> Solution:
    std = np.concatenate([np.zeros(0), *(e.std for e in estimates)])
    fields = {"findings": (), "body_axes": "RFU", "covariance": np.diag(std**2)} | changes
    return build_solution(estimates=estimates, **fields)


def one(check: CrossCheck, i: int = 0) -> Component:
    return check.components[i]


def scale(value: Any, std: Any, **changes: Any) -> Solution:
    return result(estimate("scale_error", value, std), **changes)


def moved(trajectory: Trajectory, metres: float) -> Trajectory:
    geodetic = trajectory.geodetic.copy()
    geodetic[:, 2] += metres
    return replace(trajectory, geodetic=geodetic, rph=trajectory.rph + np.array([0.0, 0.0, 0.001]))


def dense(seconds: float, rate: float, start: float = 0.0) -> Trajectory:
    time = start + np.arange(round(seconds * rate)) / rate
    geodetic = np.stack([0.6 + 1e-7 * time, 2.0 + 1e-7 * time, np.sin(time)], axis=1)
    rph = np.stack([0.1 * np.sin(time), 0.0 * time, 0.01 * time], axis=1)
    cov = np.tile(np.eye(3), (time.size, 1, 1)) * (1.0 + time[:, None, None])
    return Trajectory(time, geodetic, np.cos(rph), rph, cov, cov, cov)


def lever_arm(value: Any, std: Any = 0.01) -> Estimate:
    return estimate("lever_arm_m", value, np.broadcast_to(std, 3))
