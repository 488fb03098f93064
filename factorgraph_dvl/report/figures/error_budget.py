"""The error budget of a calibration: shares of each variance by cause."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import SubFigure

from factorgraph_dvl.report.figures.calibration import readable
from factorgraph_dvl.report.figures.drawing import (
    LIGHT,
    SMALL,
    TITLE,
    Canvas,
    canvas,
    new_grid,
    style,
)
from factorgraph_dvl.solution import Solution

# Causes with a colour of their own; the others share one. Chosen: as many as the eye separates.
_SHOWN = 9
# Tol's muted scheme, which colour-blind readers distinguish.
_COLOURS = (
    *("#332288", "#88ccee", "#117733", "#ddcc77", "#cc6677", "#aa4499", "#44aa99", "#999933"),
    "#882255",
)


def error_budget_figure(solution: Solution, *, into: SubFigure | None = None) -> Canvas:
    """Draw what share of the variance of each component every cause has."""
    std = np.concatenate([e.std for e in solution.estimates])
    free = np.flatnonzero(std > 0.0)
    variance = np.stack([c.adds[free] ** 2 for c in solution.error_budget])
    share = 100.0 * variance / variance.sum(axis=0)
    read = [readable(solution.order[i]) for i in free]
    names = [
        f"{name}  {std[i]:.2g} {unit}".rstrip() for i, (name, unit) in zip(free, read, strict=True)
    ]
    left = max(1.5, 0.25 + 0.068 * max(map(len, names)))
    figure = canvas(9.5 + left, 1.5 + 0.24 * free.size, into)
    grid = new_grid(figure, 1, 1, left=left, right=3.4, bottom=0.5, top=0.45)
    ax = figure.add_subplot(grid[0, 0])
    y = np.arange(free.size)
    reached = np.zeros(free.size)
    for i, cause in enumerate(solution.error_budget[:_SHOWN]):
        label = f"{cause.cause} ({cause.assumed})" if cause.assumed else cause.cause
        ax.barh(y, share[i], left=reached, color=_COLOURS[i], height=0.7, label=label)
        reached += share[i]
    if len(share) > _SHOWN:
        ax.barh(y, 100.0 - reached, left=reached, color=LIGHT, height=0.7, label="all others")
    ax.set_yticks(y, names, fontsize=SMALL)
    ax.invert_yaxis()
    ax.set_xlim(0.0, 100.0)
    style(ax, "share of the variance, %", "")
    ax.grid(visible=False)
    ax.set_title("Error budget", fontsize=TITLE, loc="left")
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=SMALL, frameon=False)
    return figure
