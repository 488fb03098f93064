"""Residuals of a sensor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import SubFigure

from factorgraph_dvl.estimates import Residuals
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.report.figures.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    DARK,
    GREY,
    LIGHT,
    SMALL,
    TITLE,
    Canvas,
    canvas,
    clock,
    new_grid,
    number,
    style,
)

# Points of a panel. Chosen: more only take time, and hide each other.
_LARGEST_SCATTER = 20_000
# Panels end here, in σ; what lies beyond is a triangle at the edge, and is counted.
_PANEL = 6.0


def residuals_figure(group: Sequence[Residuals], *, into: SubFigure | None = None) -> Canvas:
    """Draw residual / σ over time, and its distribution.

    Each residual in units of its own σ: σ may change from one measurement to the next, and a
    band in metres would show one that its neighbours do not have.

    Parameters
    ----------
    group : sequence of Residuals
        Residuals of one sensor, a measurement each.
    into : SubFigure, optional
        Where to draw; by default a new figure.
    """
    rows = [(r, c) for r in group for c in range(len(r.components)) if _measured(r, c).any()]
    figure = canvas(11.0, 0.8 + 1.6 * len(rows), into)
    gap = (0.16 if len(group) == 1 else 0.3, 0.2)
    grid = new_grid(figure, len(rows), 2, gap=gap, width_ratios=(3.4, 1.0))
    axes = grid.subplots(squeeze=False, sharex="col")
    start, time_label = clock(np.concatenate([r.time for r in group]))
    for i, (residuals, c) in enumerate(rows):
        left, right = axes[i]
        used = _measured(residuals, c)
        sigma = residuals.sigma[used, c]
        normalised = residuals.residual[used, c] / sigma
        last = i == len(rows) - 1
        _draw_over_time(
            left, residuals.time[used] - start, normalised, _LARGEST_SCATTER // len(rows)
        )
        style(left, time_label if last else "", residuals.components[c])
        # Points may be anywhere below.
        _note(left, 0.008, 0.95, _sigma_text(sigma, residuals.unit), align="left")
        _draw_distribution(right, normalised)
        style(right, "residual / σ" if last else "", "")
        if i == 0 or rows[i - 1][0] is not residuals:
            title = f"{residuals.label}: (predicted − measured) / σ, band ±3"
            left.set_title(title, fontsize=TITLE, loc="left")
    axes[0, 1].set_title("against N(0, 1)", fontsize=TITLE, loc="left")
    return figure


def _draw_over_time(ax: Axes, time: Array, normalised: Array, most: int) -> None:
    """Draw (M,) normalised residuals; those beyond the panel as triangles at its edge."""
    ax.axhspan(-3.0, 3.0, color=LIGHT, lw=0, zorder=0)
    ax.axhline(0.0, color=GREY, lw=0.5)
    size = np.abs(normalised)
    # Those outside the band are few and matter: every one is drawn.
    inside = np.flatnonzero(size <= 3.0)[:: -(-normalised.size // most)]
    ms = 1.5 if inside.size > 2000 else 2.5
    ax.plot(time[inside], normalised[inside], "o", color=ACCENT, ms=ms, mew=0)
    outside = (size > 3.0) & (size <= _PANEL)
    ax.plot(time[outside], normalised[outside], "o", color=DARK, ms=ms + 0.5, mew=0)
    for sign, marker in ((1.0, "^"), (-1.0, "v")):
        beyond = sign * normalised > _PANEL
        count = int(beyond.sum())
        if count:
            edge = np.full(count, sign * _PANEL)
            ax.plot(time[beyond], edge, marker, color=DARK, ms=4.5, mew=0, clip_on=False)
            largest = number(float((sign * normalised).max()), 0)
            text = f"{count} beyond the panel, up to {largest} σ"
            _note(ax, 0.992, 0.95 if sign > 0 else 0.05, text, align="right")
    ax.set_ylim(-_PANEL, _PANEL)
    ax.set_yticks([-6, -3, 0, 3, 6])


def _draw_distribution(ax: Axes, normalised: Array) -> None:
    """Draw the density of (M,) normalised residuals; those beyond the panel are not in it."""
    bins = np.linspace(-_PANEL, _PANEL, 61 if normalised.size > 2000 else 31)
    count, _ = np.histogram(normalised, bins)
    ax.stairs(count / (normalised.size * np.diff(bins)), bins, fill=True, color=ACCENT_LIGHT)
    x = np.linspace(-_PANEL, _PANEL, 241)
    ax.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), color=DARK, lw=1.0)
    ax.set_yticks([])
    ax.set_xticks([-6, -3, 0, 3, 6])
    mean, std = number(normalised.mean(), 2), number(normalised.std(), 2)
    _note(ax, 0.97, 0.92, f"mean {mean}\nstd {std}", align="right")


def _sigma_text(sigma: Array, unit: str) -> str:
    """Return in words how large (M,) standard deviations are."""
    low, high = (f"{s:.2g}" for s in np.quantile(sigma, [0.0, 1.0]))
    return f"σ = {low} {unit}" if low == high else f"σ from {low} to {high} {unit}"


def _note(ax: Axes, x: float, y: float, text: str, *, align: str) -> None:
    """Write in axes, at fractions of them, over whatever is drawn there."""
    ax.text(
        x,
        y,
        text,
        transform=ax.transAxes,
        ha=align,
        va="top" if y > 0.5 else "bottom",
        fontsize=SMALL,
        color=DARK,
        bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.0},
    )


def _measured(residuals: Residuals, component: int) -> np.ndarray:
    return np.isfinite(residuals.residual[:, component])
