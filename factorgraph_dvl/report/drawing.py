"""What figures share: sizes, colours, axes, lines over time, numbers as text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from factorgraph_dvl.analysis.consistency import VectorErrors
from factorgraph_dvl.conventions import Array

DPI = 120
ACCENT = "#0a6ebd"
ACCENT_MEDIUM = "#6aa8dc"
ACCENT_LIGHT = "#bcd9f0"
DARK = "#222222"
GREY = "#8a8a8a"
MEDIUM = "#b5b5b5"
LIGHT = "#e9e9e9"
SMALL = 7.5
NORMAL = 8.5
TITLE = 10.5
BUCKETS = 2_500
# Filling a jagged area costs more than a line, and shows less.
WIDE_BUCKETS = 400
UNITS = {
    "deg_h": "deg/h",
    "m_s": "m/s",
    "deg": "deg",
    "ug": "µg",
    "m": "m",
    "s": "s",
}


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    # Unlike `savefig` this draws only once. The fastest compression level is good
    # enough for line drawings.
    canvas = FigureCanvasAgg(figure)
    canvas.print_png(path, pil_kwargs={"compress_level": 1})  # type: ignore[no-untyped-call]


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure, inches."""
    return Figure(figsize=(width, height), dpi=DPI)


def new_grid(
    figure: Figure,
    rows: int,
    columns: int,
    *,
    left: float = 0.75,
    right: float = 0.12,
    bottom: float = 0.48,
    top: float = 0.32,
    gap: tuple[float, float] = (0.16, 0.85),
    width_ratios: Sequence[float] | None = None,
) -> GridSpec:
    """Return a grid with margins and gaps (vertical, horizontal) in inches.

    Margins of fixed size, because a layout that measures every label takes as long as
    the drawing itself.
    """
    width, height = figure.get_size_inches()
    cell_height = (height - bottom - top - (rows - 1) * gap[0]) / rows
    cell_width = (width - left - right - (columns - 1) * gap[1]) / columns
    return figure.add_gridspec(
        rows,
        columns,
        left=left / width,
        right=1.0 - right / width,
        bottom=bottom / height,
        top=1.0 - top / height,
        hspace=gap[0] / cell_height,
        wspace=gap[1] / cell_width,
        width_ratios=width_ratios,
    )


def style(ax: Axes, xlabel: str, ylabel: str) -> None:
    """Apply the common look to axes; global settings would leak into the caller's figures."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(GREY)
    ax.tick_params(labelsize=SMALL, length=3, color=GREY)
    ax.grid(color=LIGHT, lw=0.6)
    ax.set_axisbelow(True)
    ax.margins(x=0.01)
    if xlabel:
        ax.set_xlabel(xlabel, fontsize=NORMAL)
    if ylabel:
        ax.set_ylabel(ylabel, fontsize=NORMAL)
        width = ax.get_position().width * ax.figure.get_figure(root=True).get_size_inches()[0]
        ax.yaxis.set_label_coords(-0.58 / width, 0.5)


def draw_line(ax: Axes, time: Array, value: Array) -> None:
    """Draw a line through (M,) values; where that would be a solid block, its envelope."""
    strokes = float(np.abs(np.diff(value)).sum()) / max(float(np.ptp(value)), 1e-300)
    if strokes > 4.0 * WIDE_BUCKETS:
        bucket_time, low, high = envelope(time, value, WIDE_BUCKETS)
        # The outline remains where the envelope is too narrow to be seen.
        ax.fill_between(
            bucket_time, low, high, facecolor=ACCENT_MEDIUM, edgecolor=ACCENT, lw=0.7, zorder=2
        )
        return
    bucket_time, low, high = envelope(time, value)
    if low is high:
        ax.plot(time, value, color=ACCENT, lw=0.9)
    else:
        zigzag = np.stack([low, high], axis=1).ravel()
        ax.plot(np.repeat(bucket_time, 2), zigzag, color=ACCENT, lw=0.9)


def draw_error(ax: Axes, time: Array, errors: VectorErrors, c: int, scale: float) -> None:
    """Draw a component of errors within ±3σ."""
    three_sigma = 3.0 * scale * errors.std[:, c]
    bucket_time, _, high = envelope(time, three_sigma, WIDE_BUCKETS)
    ax.fill_between(bucket_time, -high, high, color=LIGHT, lw=0, zorder=0)
    ax.plot(bucket_time, high, color=GREY, lw=0.7)
    ax.plot(bucket_time, -high, color=GREY, lw=0.7)
    draw_line(ax, time, scale * errors.error[:, c])


def draw_std(ax: Axes, time: Array, std: Array) -> None:
    """Draw a standard deviation."""
    draw_line(ax, time, std)
    ax.set_ylim(0.0, 1.1 * float(std.max()) or 1.0)


def envelope(time: Array, value: Array, buckets: int = BUCKETS) -> tuple[Array, Array, Array]:
    """Return times, least and largest of (M,) values in buckets; the values if M is small."""
    if value.size <= 2 * buckets:
        return time, value, value
    edges = np.linspace(0, value.size, buckets, endpoint=False).astype(int)
    low, high = np.minimum.reduceat(value, edges), np.maximum.reduceat(value, edges)
    return np.append(time[edges], time[-1]), np.append(low, low[-1]), np.append(high, high[-1])


def time_axis(time: Array) -> tuple[float, str]:
    """Return the start of the time axis, s, and its label."""
    first = float(time.min())
    # Seconds since some epoch long ago do not fit on a tick.
    if abs(first) < 1e5:
        return 0.0, "time, s"
    start = float(np.floor(first))
    return start, f"time − {start:.0f}, s"


def readable(component: str) -> tuple[str, str]:
    """Split the name of a component into words and unit: `lever_arm_x_m`, `lever arm x`, `m`."""
    for suffix, unit in UNITS.items():
        if component.endswith(f"_{suffix}"):
            return component.removesuffix(f"_{suffix}").replace("_", " "), unit
    return component.replace("_", " "), ""


def with_std(value: float, std: float) -> str:
    """Write a value with its standard deviation, to two digits of the latter."""
    if std <= 0.0:
        return f"{value:g}"
    digits = max(0, 1 - int(np.floor(np.log10(std))))
    return f"{decimals(value, digits)} ± {decimals(std, digits)}"


def decimals(value: float, digits: int) -> str:
    """Write a number with so many decimals, without a negative zero."""
    return f"{round(float(value), digits) + 0.0:.{digits}f}".replace("-", "−")


def round_ticks(low: float, high: float) -> tuple[NDArray[np.float64], list[str]]:
    """Return a few round ticks inside an interval, and their labels without offset."""
    ticks = np.asarray(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
    step = ticks[1] - ticks[0]
    margin = 0.03 * (high - low)
    ticks = ticks[(ticks >= low + margin) & (ticks <= high - margin)]
    digits = next((d for d in range(12) if abs(round(step, d) / step - 1.0) < 1e-3), 12)
    return ticks, [decimals(t, digits) for t in ticks]
