"""Calibrations of earlier trials."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.solution import Calibration

ALPHA_DEG = np.array([10.0, -25.0, 130.0])


def component_of(name, label):
    """Name of a component as in `covariance.order`."""
    if label == " ":
        return name
    if name == "scale_error":
        return f"{name}_{label}"
    stem, unit = {
        "misalignment_deg": ("misalignment", "deg"),
        "lever_arm_m": ("lever_arm", "m"),
        "gyro_bias_deg_h": ("gyro_bias", "deg_h"),
    }[name]
    return f"{stem}_{label}_{unit}"


def calibration(*, alpha=ALPHA_DEG, converged=True, body_axes="RFU", scale=1):
    """A calibration of seven correlated parameters, and a gyro bias that is nobody's business."""
    values = {
        "misalignment_deg": alpha,
        "scale_error": np.full(scale, 0.01),
        "lever_arm_m": np.array([1.0, 2.0, 3.0]),
        "gyro_bias_deg_h": np.array([1.0, 2.0, 3.0]),
    }
    n = sum(v.size for v in values.values())
    rng = np.random.default_rng(3)
    std = np.concatenate([[0.1, 0.2, 0.3], np.full(scale, 1e-3), np.full(3, 0.05), np.ones(3)])
    mixed = rng.normal(size=(n, 2 * n))
    P = mixed @ mixed.T
    P *= np.outer(std / np.sqrt(np.diag(P)), std / np.sqrt(np.diag(P)))
    estimates, at = [], 0
    for name, v in values.items():
        own = std[at : at + v.size]
        at += v.size
        names = tuple(component_of(name, label) for label in ("xyz" if v.size > 1 else " "))
        estimates.append(Estimate(name, names, v, own, v, own, np.ones(v.size, dtype=bool)))
    return Calibration(
        "before", "batch", body_axes, converged, 1, 0.0, tuple(estimates), P
    )  # fmt: skip
