"""Allan deviation of an IMU at rest."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from factorgraph_dvl.analysis.static_noise import StaticNoise
from factorgraph_dvl.geometry.units import DEG_PER_HOUR, MICRO_G
from factorgraph_dvl.report.figures.drawing import (
    ACCENT,
    DARK,
    GREY,
    NORMAL,
    TITLE,
    log_axis,
    new_figure,
    new_grid,
    style,
)

_COLOURS = (ACCENT, DARK, GREY)


def allan_figure(noise: StaticNoise) -> Figure:
    """Draw the Allan deviation of each axis, ±σ, and the model fitted to it."""
    figure = new_figure(11.0, 4.6)
    grid = new_grid(figure, 1, 2)
    for column, (title, axes, si, unit) in enumerate(
        (
            ("Gyros", noise.gyro, DEG_PER_HOUR, "deg/h"),
            ("Accelerometers", noise.accel, MICRO_G, "µg"),
        )
    ):
        ax = figure.add_subplot(grid[0, column])
        for label, axis, colour in zip("xyz", axes, _COLOURS, strict=True):
            ax.errorbar(
                axis.tau, axis.deviation / si, axis.std / si, fmt=".", color=colour, ms=4, lw=0.8
            )
            fine = np.geomspace(axis.tau[0], axis.tau[-1], 200)
            ax.plot(fine, axis.model(fine) / si, color=colour, lw=1.0, label=label)
        ax.set_xscale("log")
        shown = np.concatenate([[*(a.deviation - a.std), *(a.deviation + a.std)] for a in axes])
        log_axis(ax, "y", float(shown[shown > 0.0].min()) / si, float(shown.max()) / si)
        style(ax, "averaging time, s", f"Allan deviation, {unit}")
        ax.set_title(title, fontsize=TITLE, loc="left")
        ax.legend(fontsize=NORMAL, frameon=False)
    return figure
