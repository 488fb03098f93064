"""Noise figures of an IMU as a table, and as keys of trial.yaml."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph_dvl.analysis.static_noise import AxisNoise, Figure, StaticNoise
from factorgraph_dvl.geometry.units import DEG_PER_HOUR, DEG_PER_SQRT_HOUR, HOUR, MICRO_G
from factorgraph_dvl.quality.notation import with_std
from factorgraph_dvl.report.table import Table

# By definition, in SI.
_PER_SQRT_HOUR = 1.0 / np.sqrt(HOUR)


def noise_table(noise: StaticNoise) -> Table:
    """Return a table of the figures of every axis; `<` marks what the record does not show."""
    table = Table(title=(f"Static record of {noise.duration:.6g} s at {noise.rate:.4g} Hz"))
    table.column("axis")
    for header in ("random walk", "bias instability", "walk of the bias"):
        table.column(header, numeric=True)
    for name, axes, units in (
        (
            "gyro",
            noise.gyro,
            (
                (DEG_PER_SQRT_HOUR, "deg/√h"),
                (DEG_PER_HOUR, "deg/h"),
                (DEG_PER_HOUR * _PER_SQRT_HOUR, "deg/h/√h"),
            ),
        ),
        (
            "accel",
            noise.accel,
            ((MICRO_G, "µg/√Hz"), (MICRO_G, "µg"), (MICRO_G * _PER_SQRT_HOUR, "µg/√h")),
        ),
    ):
        for label, axis in zip("xyz", axes, strict=True):
            figures = (axis.white, axis.instability, axis.walk)
            cells = [_cell(f, *unit) for f, unit in zip(figures, units, strict=True)]
            table.row(f"{name} {label}", *cells)
    return table


def imu_yaml(noise: StaticNoise) -> str:
    """Return the figures as keys of trial.yaml, the mean square of the three axes.

    The walk of a bias stands for bias instability and rate random walk together: it varies as
    much within an hour.
    """
    gyro, accel = noise.gyro, noise.accel
    keys = {
        "gyro_noise_deg_sqrt_h": _rms([a.white.value for a in gyro]) / DEG_PER_SQRT_HOUR,
        "gyro_bias_walk_deg_h_sqrt_h": _walk(gyro) / (DEG_PER_HOUR * _PER_SQRT_HOUR),
        "accel_noise_ug_sqrt_hz": _rms([a.white.value for a in accel]) / MICRO_G,
        "accel_bias_walk_ug_sqrt_h": _walk(accel) / (MICRO_G * _PER_SQRT_HOUR),
    }
    return "imu:\n" + "".join(f"  {name}: {value:.4g}\n" for name, value in keys.items())


def _cell(figure: Figure, si: float, unit: str) -> str:
    if not figure.seen:
        return f"< {figure.limit / si:.2g} {unit}"
    return f"{with_std(figure.value / si, figure.std / si)} {unit}"


def _walk(axes: Sequence[AxisNoise]) -> float:
    return _rms([axis.walk_over_hour for axis in axes])


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
