"""Calibration over time, with what was claimed of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from factorgraph_dvl.analysis.convergence import Convergence
from factorgraph_dvl.analysis.error_statistics import true_value_of
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.verdict import Verdict
from factorgraph_dvl.report.figures.calibration import readable
from factorgraph_dvl.report.figures.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    DARK,
    GREY,
    NORMAL,
    TITLE,
    clock,
    new_figure,
    new_grid,
    save_figures,
    style,
)

# Points of a line. Chosen: more than a panel has pixels.
_POINTS = 2000
# Share of the record from which on errors set the axes. Chosen: before it they are far larger.
_SHOWN_FROM = 0.15


def write_convergence_figures(
    time: Array,
    values: Array,
    std: Array,
    latency: Array,
    estimates: Sequence[Estimate],
    truth: Mapping[str, ArrayLike],
    found: Convergence,
    folder: Path,
    verdict: Verdict,
    *,
    name: str = "",
    kind: str = "png",
) -> list[Path]:
    """Draw `convergence.png` and `latency.png`.

    Parameters
    ----------
    time : ndarray, shape (H,), s
        Times of the updates.
    values, std : ndarray, shape (H, n)
        What was known then, in the order of `estimates`.
    latency : ndarray, shape (H,), s
        Time that each update took.
    estimates : sequence of Estimate
        Estimates at the end.
    truth : mapping of str to array_like
        True values by reported name; may be empty.
    found : Convergence
        When they were good enough.
    folder : path-like
        Where the files go.
    verdict : Verdict
        Verdict on the calibration.
    name : str, optional
        Name of the trial.
    kind : {'png', 'svg', 'pdf'}, optional
        Format of further files beside them.
    """
    pick = np.unique(np.linspace(0, time.size - 1, min(time.size, _POINTS)).astype(int))
    figures = {
        "convergence": convergence_figure(
            time[pick], values[pick], std[pick], estimates, truth, found.good_since
        ),
        "latency": latency_figure(time, latency),
    }
    return save_figures(figures, folder, verdict, name=name, kind=kind)


def convergence_figure(
    time: Array,
    values: Array,
    std: Array,
    estimates: Sequence[Estimate],
    truth: Mapping[str, ArrayLike],
    good_since: float,
) -> Figure:
    """Draw each component over time, ±σ and ±3σ, with its truth.

    Parameters
    ----------
    time, values, std, estimates, truth : ndarray, sequence of Estimate, mapping
        Parameters as of `write_convergence_figures`.
    good_since : float
        A moment to mark, s; nan for none.
    """
    columns = 3
    free = [e for e in estimates if np.any(e.prior_std > 0.0)]
    # Of four beams there are more components than columns.
    rows = [
        (e, list(range(len(e.component_names)))[first : first + columns])
        for e in free
        for first in range(0, len(e.component_names), columns)
    ]
    figure = new_figure(11.0, 1.0 + 1.75 * len(rows))
    grid = new_grid(figure, len(rows), columns, top=0.85, gap=(0.45, 0.85))
    start, label = clock(time)
    x = time - start
    place = 0
    shown = {}
    for e in estimates:
        shown[e.name] = place
        place += len(e.component_names)
    known = False
    for i, (e, part) in enumerate(rows):
        true_value = true_value_of(e, truth)
        known |= true_value is not None
        for j, n in enumerate(part):
            ax = figure.add_subplot(grid[i, j])
            c = shown[e.name] + n
            true = np.nan if true_value is None else float(true_value[n])
            _panel(ax, x, values[:, c], std[:, c], true)
            if np.isfinite(good_since):
                ax.axvline(good_since - start, color=GREY, lw=0.9, ls=":")
            name, unit = readable(e.component_names[n])
            style(ax, label if i == len(rows) - 1 else "", "")
            ax.set_title(f"{name}, {unit}" if unit else name, fontsize=NORMAL, loc="left")
    handles = figure.axes[0]
    legend = [
        *handles.plot([], [], color=ACCENT, lw=1.0, label="estimate"),
        handles.fill_between([], [], [], color=ACCENT_LIGHT, label="±1σ"),
        handles.fill_between([], [], [], color=ACCENT_LIGHT, alpha=0.35, label="±3σ"),
    ]
    if known:
        legend += handles.plot([], [], color=DARK, lw=0.9, ls="--", label="truth")
    if np.isfinite(good_since):
        legend += handles.plot(
            [], [], color=GREY, lw=0.9, ls=":", label="good enough from here on"
        )
    figure.legend(
        handles=legend,
        loc="upper left",
        ncols=len(legend),
        fontsize=NORMAL,
        frameon=False,
        borderaxespad=0.3,
        title="Calibration as it was known",
        title_fontsize=TITLE,
        alignment="left",
    )
    return figure


def _panel(ax: Axes, x: Array, value: Array, sigma: Array, true: float) -> None:
    """Draw one component over time, ±σ and ±3σ, with its truth if that is finite."""
    for k, alpha in ((3.0, 0.35), (1.0, 1.0)):
        ax.fill_between(
            x, value - k * sigma, value + k * sigma, color=ACCENT_LIGHT, alpha=alpha, lw=0
        )
    ax.plot(x, value, color=ACCENT, lw=1.0)
    # Before its sensor was heard a component has no estimate.
    there = np.flatnonzero(np.isfinite(value))
    tail = there[int(_SHOWN_FROM * there.size) :]
    low = float((value - 3.0 * sigma)[tail].min())
    high = float((value + 3.0 * sigma)[tail].max())
    ax.set_xlim(x[0], x[-1] if x.size > 1 else x[0] + 1.0)
    if np.isfinite(true):
        ax.axhline(true, color=DARK, lw=0.9, ls="--")
        low, high = min(low, true), max(high, true)
    margin = 0.05 * (high - low) or 1.0
    ax.set_ylim(low - margin, high + margin)


def latency_figure(time: Array, latency: Array) -> Figure:
    """Draw how long each update took."""
    figure = new_figure(11.0, 3.0)
    ax = figure.add_subplot(new_grid(figure, 1, 1)[0, 0])
    start, label = clock(time)
    ax.semilogy(time - start, 1e3 * latency, ".", color=ACCENT, ms=1.5)
    style(ax, label, "latency, ms")
    ax.set_title("Time that each update took", fontsize=TITLE, loc="left")
    return figure
