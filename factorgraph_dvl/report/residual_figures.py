"""Residuals of a sensor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from factorgraph_dvl.report.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    DARK,
    GREY,
    SMALL,
    TITLE,
    clock,
    draw_band,
    new_figure,
    new_grid,
    number,
    style,
)
from factorgraph_dvl.solution import Residuals

_LARGEST_SCATTER = 20_000
# Half the height of a panel, in units of the largest residual drawn where it is.
_PANEL = 1.05
_CUT_NOTE = (
    "Where ±3σ leaves the panel, the stated σ is large, or the motion is too abrupt for the "
    "gyro's samples: what they do not resolve is part of σ."
)


def residuals_figure(group: Sequence[Residuals]) -> Figure:
    """Draw residuals over time within ±3σ, and the distribution of residual / σ.

    Parameters
    ----------
    group : of one sensor, a measurement each.
    """
    rows = [(r, c) for r in group for c in range(len(r.components)) if _measured(r, c).any()]
    limits = [4.5 * float(np.quantile(r.sigma[_measured(r, c), c], 0.95)) for r, c in rows]
    cut = any(
        3.0 * np.nanmax(r.sigma[:, c]) > _PANEL * limit
        for (r, c), limit in zip(rows, limits, strict=True)
    )
    note_height = 0.22 if cut else 0.0
    height = 0.8 + 1.6 * len(rows) + note_height
    figure = new_figure(11.0, height)
    gap = (0.16 if len(group) == 1 else 0.3, 0.2)
    bottom = 0.48 + note_height
    grid = new_grid(figure, len(rows), 2, bottom=bottom, gap=gap, width_ratios=(3.4, 1.0))
    if cut:
        figure.text(0.75 / 11.0, 0.1 / height, _CUT_NOTE, fontsize=SMALL, color=DARK)
    axes = grid.subplots(squeeze=False, sharex="col")
    start, time_label = clock(np.concatenate([r.time for r in group]))
    x = np.linspace(-5.0, 5.0, 201)
    density = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    for i, (residuals, c) in enumerate(rows):
        left, right = axes[i]
        used = _measured(residuals, c)
        time = residuals.time[used] - start
        value, sigma = residuals.residual[used, c], residuals.sigma[used, c]
        normalised = value / sigma
        limit = limits[i]
        # Outliers are few and matter: every one is drawn, at the edge if beyond it.
        outlying = np.abs(normalised) > 3.0
        stride = -(-value.size // (_LARGEST_SCATTER // len(rows)))
        inside = np.flatnonzero(~outlying)[::stride]
        size = 1.5 if inside.size > 2000 else 2.5
        left.plot(time[inside], value[inside], "o", color=ACCENT, ms=size, mew=0)
        left.plot(
            time[outlying],
            np.clip(value[outlying], -limit, limit),
            linestyle="none",
            marker="o",
            markersize=size + 0.5,
            markeredgewidth=0,
            color=DARK,
        )
        draw_band(left, time, 3.0 * sigma)
        left.axhline(0.0, color=GREY, lw=0.5)
        left.set_ylim(-_PANEL * limit, _PANEL * limit)
        last = i == len(rows) - 1
        style(left, time_label if last else "", f"{residuals.components[c]}, {residuals.unit}")
        bins = np.linspace(-5.0, 5.0, 51 if value.size > 2000 else 26)
        share, _ = np.histogram(np.clip(normalised, -5.0, 5.0), bins, density=True)
        right.stairs(share, bins, fill=True, color=ACCENT_LIGHT)
        right.plot(x, density, color=DARK, lw=1.0)
        right.set_yticks([])
        right.set_xticks([-4, -2, 0, 2, 4])
        style(right, "residual / σ" if last else "", "")
        right.text(
            0.97,
            0.92,
            f"mean {number(normalised.mean(), 2)}\nstd {number(normalised.std(), 2)}",
            transform=right.transAxes,
            ha="right",
            va="top",
            fontsize=SMALL,
            color=DARK,
        )
        if i == 0 or rows[i - 1][0] is not residuals:
            left.set_title(
                f"{residuals.label}: predicted − measured, ±3σ", fontsize=TITLE, loc="left"
            )
    axes[0, 1].set_title("against N(0, 1)", fontsize=TITLE, loc="left")
    return figure


def _measured(residuals: Residuals, component: int) -> np.ndarray:
    return np.isfinite(residuals.residual[:, component])
