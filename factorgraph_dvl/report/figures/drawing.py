"""Axes, lines and bands that the figures have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Lock

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.gridspec import GridSpec
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import NDArray

from factorgraph_dvl.analysis.error_statistics import TrajectoryErrors, VectorErrors
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.notation import fixed
from factorgraph_dvl.quality.verdict import Verdict

# What panels stand in.
Canvas = Figure | SubFigure

ACCENT = "#0a6ebd"
ACCENT_LIGHT = "#bcd9f0"
DARK = "#222222"
GREY = "#8a8a8a"
MEDIUM = "#b5b5b5"
LIGHT = "#e9e9e9"
PALE = "#f5f5f5"
VERDICT_COLOURS = {"good": "#2e7d32", "doubtful": "#b26a00", "do not use": "#c62828"}
# Sizes of letters, pt, and dots per inch. Chosen: legible at the width of a page.
SMALL = 7.5
NORMAL = 8.5
TITLE = 10.5
_DPI = 120
# From an axis to its label, inches: numbers such as −0.00025 fit between them.
_LABEL_AT = 0.66
# Chosen: an axis of fewer decades has ticks at 2 and 5 too.
_FEW_DECADES = 1.9
# Reasons that stand on a figure. Chosen: more would reach the titles.
_MOST_CODES = 3
# Stretches whose extremes a line is drawn by. Chosen: more than a panel has pixels.
_BUCKETS = 2_500
# Filling a jagged area costs more than a line, and shows less.
_WIDE_BUCKETS = 400
# A panel has about as many pixels from left to right.
_MOST_CROSSINGS = 500.0
# The envelope of noise is jagged and reads like two lines: later.
_MOST_CROSSINGS_OF_NOISE = 1600.0
# All threads have the same settings of Matplotlib.
_settings = Lock()


def save_figures(
    figures: Mapping[str, Canvas],
    folder: Path,
    verdict: Verdict | None = None,
    *,
    name: str = "",
    note: str = "",
    kind: str = "png",
) -> list[Path]:
    """Write figures as PNG files under their names; return the paths.

    Parameters
    ----------
    figures : mapping of str to Canvas
        Figures by name.
    folder : path-like
        Where the files go.
    verdict : Verdict, optional
        What to write in the upper right corner: the grade, and the codes of its reasons.
    name : str, optional
        Name of the trial, for the lower left corner.
    note : str, optional
        What to write in the upper right corner in place of a verdict.
    kind : {'png', 'svg', 'pdf'}, optional
        Format of further files beside the PNG files; `png` adds none.
    """
    paths = []
    for title, figure in figures.items():
        assert isinstance(figure, Figure)
        label, colour = note, GREY
        if verdict is not None:
            label, colour = verdict_label(verdict), VERDICT_COLOURS[verdict.grade]
        if label:
            figure.text(0.997, 0.995, label, ha="right", va="top", fontsize=SMALL, color=colour)
        if name:
            figure.text(0.003, 0.005, name, ha="left", va="bottom", fontsize=SMALL, color=GREY)
        path = folder / f"{title}.png"
        # Unlike `savefig` this draws only once. The fastest compression level is good
        # enough for line drawings.
        canvas = FigureCanvasAgg(figure)
        canvas.print_png(path, pil_kwargs={"compress_level": 1})  # type: ignore[no-untyped-call]
        paths.append(path)
        if kind != "png":
            paths.append(_save_vectors(figure, folder / f"{title}.{kind}"))
    return paths


def verdict_label(verdict: Verdict) -> str:
    """Return the grade and the codes of the first reasons, with the number of others."""
    codes = list(dict.fromkeys(str(reason.code) for reason in verdict.reasons))
    others = f" and {len(codes) - _MOST_CODES} more" if len(codes) > _MOST_CODES else ""
    shown = f"{', '.join(codes[:_MOST_CODES])}{others}"
    return f"{verdict.grade}: {shown}" if shown else verdict.grade


def _save_vectors(figure: Figure, path: Path) -> Path:
    """Write a figure as SVG or PDF; the same figure gives the same bytes."""
    date = {"svg": "Date", "pdf": "CreationDate"}[path.suffix[1:]]
    with _settings, rc_context({"svg.hashsalt": "factorgraph-dvl"}):
        figure.savefig(path, metadata={date: None})
    return path


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure, inches."""
    return Figure(figsize=(width, height), dpi=_DPI)


def canvas(width: float, height: float, into: SubFigure | None) -> Canvas:
    """Return an empty figure, inches; or what to draw into instead, whatever its size."""
    return new_figure(width, height) if into is None else into


def size_of(canvas: Canvas) -> tuple[float, float]:
    """Return width and height, inches."""
    box = canvas.bbox
    return box.width / canvas.dpi, box.height / canvas.dpi


def new_grid(
    figure: Canvas,
    rows: int,
    columns: int,
    *,
    left: float = 0.82,
    right: float = 0.12,
    bottom: float = 0.48,
    top: float = 0.45,
    gap: tuple[float, float] = (0.16, 0.92),
    width_ratios: Sequence[float] | None = None,
) -> GridSpec:
    """Return a grid with margins and gaps (vertical, horizontal) in inches.

    Margins of fixed size, because a layout that measures every label is slow: nine panels take
    0.9 s to draw with Matplotlib's constrained layout, and 0.5 s without.
    """
    width, height = size_of(figure)
    # In a small place of a larger figure, margins and gaps leave half of it to the panels.
    small = min(
        1.0,
        0.5 * height / (bottom + top + (rows - 1) * gap[0]),
        0.5 * width / (left + right + (columns - 1) * gap[1]),
    )
    left, right, bottom, top = (small * side for side in (left, right, bottom, top))
    gap = (small * gap[0], small * gap[1])
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
        ax.yaxis.set_label_coords(-_LABEL_AT / width, 0.5)


def log_axis(ax: Axes, which: str, low: float, high: float) -> None:
    """Make an axis logarithmic, with few ticks: those of every decade take long to lay out.

    Parameters
    ----------
    ax : Axes
        Axes.
    which : {'x', 'y'}
        Axis.
    low, high : float
        Least and largest value to show.
    """
    ax.set(**{f"{which}scale": "log"})
    axis = ax.yaxis if which == "y" else ax.xaxis
    few = np.log10(high / low) < _FEW_DECADES
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=8))
    if few:
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.6g}"))
    axis.set_minor_locator(NullLocator())
    ax.set(**{f"{which}lim": (0.6 * low, 2.2 * high)})


def error_title(
    ax: Axes, with_reference: str, without: str, errors: TrajectoryErrors | None
) -> None:
    """Write above axes whether they show errors or, without a reference, their claimed size."""
    title = f"{without}: standard deviation" if errors is None else f"{with_reference}, ±3σ"
    ax.set_title(title, fontsize=TITLE, loc="left")


def is_dense(value: Array, most_crossings: float = _MOST_CROSSINGS) -> bool:
    """Whether a line through (M,) values crosses its panel so often that only a block is seen."""
    crossings = float(np.abs(np.diff(value)).sum()) / max(float(np.ptp(value)), 1e-300)
    return crossings > most_crossings


def draw_line(
    ax: Axes,
    time: Array,
    value: Array,
    *,
    marker: str = "",
    most_crossings: float = _MOST_CROSSINGS,
) -> None:
    """Draw a line through (M,) values; where that would be a solid block, its envelope."""
    if is_dense(value, most_crossings):
        bucket_time, low, high = envelope(time, value)
        # The outline remains where the envelope is too narrow to be seen.
        ax.fill_between(
            bucket_time, low, high, facecolor=ACCENT_LIGHT, edgecolor=ACCENT, lw=0.7, zorder=2
        )
        return
    bucket_time, low, high = envelope(time, value, _BUCKETS)
    if low is high:
        ax.plot(time, value, color=ACCENT, lw=0.9, marker=marker, ms=2.5)
    else:
        zigzag = np.stack([low, high], axis=1).ravel()
        ax.plot(np.repeat(bucket_time, 2), zigzag, color=ACCENT, lw=0.9)


def draw_band(ax: Axes, time: Array, half: Array) -> None:
    """Draw a band about zero, of (M,) half widths.

    Where they change within a bucket the band is as wide as the narrowest, and paler up to the
    widest: an error that is outside its own σ never lies in the band of a neighbour.
    """
    bucket_time, low, high = envelope(time, half)
    if low is not high:
        ax.fill_between(bucket_time, -high, high, color=PALE, lw=0, zorder=-1)
    ax.fill_between(bucket_time, -low, low, color=LIGHT, lw=0, zorder=0)
    for edge in (-low, low):
        ax.plot(bucket_time, edge, color=GREY, lw=0.7)


def draw_error(ax: Axes, time: Array, errors: VectorErrors, c: int, scale: float) -> None:
    """Draw a component of errors within ±3σ."""
    draw_band(ax, time, 3.0 * scale * errors.std[:, c])
    draw_line(ax, time, scale * errors.error[:, c], most_crossings=_MOST_CROSSINGS_OF_NOISE)


def draw_std(ax: Axes, time: Array, std: Array) -> None:
    """Draw a standard deviation."""
    draw_line(ax, time, std)
    ax.set_ylim(0.0, 1.1 * float(std.max()) or 1.0)


def draw_swing(ax: Axes, time: Array, value: Array) -> None:
    """Draw a swing too fast for its panel: least, mean and largest of each bucket."""
    edges = bucket_edges(value.size)
    bucket_time, low, high = envelope(time, value)
    mean = np.add.reduceat(value, edges) / np.diff(np.append(edges, value.size))
    for line in (low, high):
        ax.plot(bucket_time, line, color=ACCENT, lw=0.7)
    ax.plot(bucket_time, np.append(mean, mean[-1]), color=DARK, lw=0.9)
    seconds = float(time[edges[1]] - time[edges[0]])
    ax.text(
        0.99,
        0.86,
        f"least, mean, largest in {seconds:.2g} s",
        transform=ax.transAxes,
        ha="right",
        va="top",
        fontsize=SMALL,
        color=DARK,
        bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.0},
    )


def bucket_edges(size: int, buckets: int = _WIDE_BUCKETS) -> NDArray[np.intp]:
    """Return the first index of each bucket of `size` values."""
    return np.linspace(0, size, min(buckets, size), endpoint=False).astype(np.intp)


def envelope(
    time: Array, value: Array, buckets: int = _WIDE_BUCKETS
) -> tuple[Array, Array, Array]:
    """Return times, least and largest of (M,) values in buckets; the values if M is small."""
    if value.size <= 2 * buckets:
        return time, value, value
    edges = bucket_edges(value.size, buckets)
    low, high = np.minimum.reduceat(value, edges), np.maximum.reduceat(value, edges)
    return np.append(time[edges], time[-1]), np.append(low, low[-1]), np.append(high, high[-1])


def clock(time: Array) -> tuple[float, str]:
    """Return the start of the time axis, s, and its label."""
    first = float(time.min())
    # Seconds since some epoch long ago do not fit on a tick.
    if abs(first) < 1e5:
        return 0.0, "time, s"
    start = float(np.floor(first))
    return start, f"time − {start:.0f}, s"


def number(value: float, decimals: int) -> str:
    """Write a number with so many decimals, as it is typeset."""
    return typeset(fixed(float(value), decimals))


def typeset(numbers: str) -> str:
    """Replace hyphens by minus signs."""
    return numbers.replace("-", "−")
