"""Calibration, the correlation of its components, and its error budget."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import SubFigure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from factorgraph_dvl.analysis.error_statistics import true_value_of
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.notation import in_words, split_unit, with_std
from factorgraph_dvl.report.figures.drawing import (
    ACCENT,
    DARK,
    GREY,
    LIGHT,
    NORMAL,
    SMALL,
    TITLE,
    Canvas,
    canvas,
    new_grid,
    number,
    size_of,
    style,
    typeset,
)
from factorgraph_dvl.solution import Solution

_DIVERGING = LinearSegmentedColormap.from_list("correlation", ["#b34700", "#ffffff", ACCENT])


def calibration_figure(
    solution: Solution, truth: Mapping[str, ArrayLike], *, into: SubFigure | None = None
) -> Canvas:
    """Draw every calibration component with its uncertainty, prior and truth."""
    rows = _calibration_rows(solution.estimates)
    figure = canvas(11.0, 0.87 + 1.12 * len(rows), into)
    grid = new_grid(
        figure, len(rows), 3, left=0.15, right=0.15, bottom=0.42, top=0.85, gap=(0.52, 0.4)
    )
    known = False
    for i, row in enumerate(rows):
        for j, (estimate, c) in enumerate(row):
            true_value = true_value_of(estimate, truth)
            known |= true_value is not None
            ax = figure.add_subplot(grid[i, j])
            _draw_component(ax, estimate, c, None if true_value is None else float(true_value[c]))
    handles = figure.axes[0]
    legend = [
        *handles.plot([], [], "o", color=ACCENT, markersize=5, label="estimate"),
        *handles.plot([], [], color=ACCENT, lw=4, label="±1σ"),
        *handles.plot([], [], color=ACCENT, lw=1.2, label="±3σ"),
        *handles.plot([], [], color=LIGHT, lw=9, label="prior ±1σ, where comparable"),
    ]
    if known:
        legend += handles.plot(
            [], [], "D", color=DARK, markerfacecolor="none", markersize=6, label="truth"
        )
    figure.legend(
        handles=legend,
        loc="upper left",
        borderaxespad=0.3,
        ncols=len(legend),
        fontsize=NORMAL,
        frameon=False,
        title="Calibration",
        title_fontsize=TITLE,
        alignment="left",
    )
    return figure


def _draw_component(ax: Axes, estimate: Estimate, c: int, truth: float | None) -> None:
    """Draw one component as a horizontal error bar."""
    value, std = float(estimate.value[c]), float(estimate.std[c])
    prior, prior_std = float(estimate.prior_value[c]), float(estimate.prior_std[c])
    observable = bool(estimate.observable[c])
    fixed = std <= 0.0
    color = ACCENT if observable and not fixed else GREY
    half = 5.0 * std if not fixed else max(0.1 * abs(value), 1e-3)
    low, high = value - half, value + half
    if truth is not None:
        low, high = min(low, truth - 0.2 * half), max(high, truth + 0.2 * half)
    if not fixed and prior_std < 6.0 * std:
        low, high = min(low, prior - 1.2 * prior_std), max(high, prior + 1.2 * prior_std)
        ax.axvspan(prior - prior_std, prior + prior_std, color=LIGHT, lw=0, zorder=0)
    ax.plot([value - 3.0 * std, value + 3.0 * std], [0.0, 0.0], color=color, lw=1.2)
    ax.plot([value - std, value + std], [0.0, 0.0], color=color, lw=4, solid_capstyle="butt")
    ax.plot(value, 0.0, "o", color=color, markersize=5)
    if truth is not None:
        ax.plot(truth, 0.0, "D", color=DARK, markerfacecolor="none", markersize=6)
    ax.set_xlim(low, high)
    ax.set_ylim(-1.0, 1.0)
    ax.set_yticks([])
    ticks, labels = _ticks(low, high)
    ax.set_xticks(ticks, labels)
    style(ax, "", "")
    ax.grid(visible=False)
    ax.spines["left"].set_visible(False)
    name, unit = readable(estimate.component_names[c])
    ax.set_title(f"{name}, {unit}" if unit else name, fontsize=NORMAL, loc="left", pad=3)
    ax.set_title(typeset(with_std(value, std)), fontsize=NORMAL, loc="right", pad=3, color=color)
    if fixed or not observable:
        note = "held fixed" if fixed else "not observable"
        ax.text(
            0.5,
            0.93,
            note,
            transform=ax.transAxes,
            ha="center",
            va="top",
            fontsize=SMALL,
            color=DARK,
        )


def correlation_figure(solution: Solution, *, into: SubFigure | None = None) -> Canvas:
    """Draw the correlation matrix of the calibration components."""
    std = np.sqrt(np.maximum(np.diagonal(solution.covariance), 0.0))
    free = std > 0.0
    names = [name for name, shown in zip(solution.order, free, strict=True) if shown]
    correlation = solution.covariance[np.ix_(free, free)] / np.outer(std[free], std[free])
    return heat_map(names, correlation, into=into)


def heat_map(
    components: Sequence[str], correlation: Array, *, into: SubFigure | None = None
) -> Canvas:
    """Draw a correlation matrix (n, n) of components, with its numbers."""
    names = [readable(name)[0] for name in components]
    n = len(names)
    cell = min(0.5, 13.0 / max(n, 1))
    side = cell * max(n, 3)
    size = min(NORMAL, 22.0 * cell)
    label_size = min(NORMAL, 40.0 * cell)
    margin = 0.2 + max(map(len, names), default=0) * 0.56 * label_size / 72.0
    width, height = margin + side + 1.0, margin + side + 0.4
    figure = canvas(width, height, into)
    place = size_of(figure)
    shrunk = min(1.0, place[0] / width, place[1] / height)
    size, label_size = shrunk * size, shrunk * label_size
    ax = figure.add_axes((margin / width, margin / height, side / width, side / height))
    image = ax.imshow(correlation, cmap=_DIVERGING, vmin=-1.0, vmax=1.0)
    for i in range(n):
        for j in range(i):
            rho = correlation[i, j]
            ax.text(
                j,
                i,
                number(rho, 2),
                ha="center",
                va="center",
                fontsize=size,
                color="white" if abs(rho) > 0.6 else DARK,
            )
    ax.set_xticks(range(n), names, rotation=90, fontsize=label_size)
    ax.set_yticks(range(n), names, fontsize=label_size)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    ax.set_title("Correlation of the calibration", fontsize=TITLE, loc="left")
    bar_ax = figure.add_axes(
        (
            (margin + side + 0.3) / width,
            (margin + 0.2 * side) / height,
            0.15 / width,
            0.6 * side / height,
        )
    )
    bar = figure.colorbar(image, cax=bar_ax, ticks=[-1.0, -0.5, 0.0, 0.5, 1.0])
    bar.ax.tick_params(labelsize=SMALL, length=2)
    bar.outline.set_visible(False)
    return figure


def _calibration_rows(estimates: Sequence[Estimate]) -> list[list[tuple[Estimate, int]]]:
    """Arrange components in rows of three: vectors in rows of their own, then scalars."""
    rows: list[list[tuple[Estimate, int]]] = []
    scalars: list[tuple[Estimate, int]] = []
    for estimate in estimates:
        components = [(estimate, c) for c in range(len(estimate.component_names))]
        if len(components) == 1:
            scalars += components
        else:
            rows += _chunks(components)
    return rows + list(_chunks(scalars))


def _chunks(components: list[tuple[Estimate, int]]) -> Iterator[list[tuple[Estimate, int]]]:
    return (components[i : i + 3] for i in range(0, len(components), 3))


def readable(component: str) -> tuple[str, str]:
    """Split the name of a component into words and unit: `lever_arm_x_m`, `lever arm x`, `m`."""
    name, unit = split_unit(component)
    return in_words(name), unit


def _ticks(low: float, high: float) -> tuple[NDArray[np.float64], list[str]]:
    """Return a few round ticks inside an interval, and their labels without offset."""
    ticks = np.asarray(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
    step = ticks[1] - ticks[0]
    margin = 0.03 * (high - low)
    ticks = ticks[(ticks >= low + margin) & (ticks <= high - margin)]
    digits = next((d for d in range(12) if abs(round(step, d) / step - 1.0) < 1e-3), 12)
    return ticks, [number(t, digits) for t in ticks]


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
