"""Figures of a solution, as PNG files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from factorgraph_dvl.analysis.consistency import (
    TrajectoryErrors,
    VectorErrors,
    trajectory_errors,
    true_value_of,
)
from factorgraph_dvl.conventions import DEG, Array
from factorgraph_dvl.earth import LocalFrame
from factorgraph_dvl.solution import Estimate, Residuals, Solution, Trajectory
from factorgraph_dvl.trial import Reference, Trial

_DPI = 120
_ACCENT = "#0a6ebd"
_ACCENT_MEDIUM = "#6aa8dc"
_ACCENT_LIGHT = "#bcd9f0"
_DARK = "#222222"
_GREY = "#8a8a8a"
_MEDIUM = "#b5b5b5"
_LIGHT = "#e9e9e9"
_DIVERGING = LinearSegmentedColormap.from_list("correlation", ["#6b6b6b", "#ffffff", _ACCENT])
_SMALL = 7.5
_NORMAL = 8.5
_TITLE = 10.5

_LARGEST_TRAJECTORY = 20_000
_LARGEST_SCATTER = 20_000
_BUCKETS = 2_500
# Filling a jagged area costs more than a line, and shows less.
_WIDE_BUCKETS = 400

_UNITS = {
    "deg_h": "deg/h",
    "m_s": "m/s",
    "deg": "deg",
    "ug": "µg",
    "m": "m",
    "s": "s",
}


def write_figures(trial: Trial, solution: Solution, folder: Path) -> list[Path]:
    """Draw a solution: track, motion, residuals, calibration, correlation.

    Figures for which there is nothing to draw are left out. Long lines are drawn as
    the envelope of what they pass through, which looks the same.

    Parameters
    ----------
    trial : for its GNSS fixes, reference and true calibration.
    solution : what to draw.
    folder : where the PNG files go; created if needed.

    Returns
    -------
    Paths of the files: `track.png`, `motion.png`, `<sensor>_residuals.png` of each
    sensor with residuals, `calibration.png`, `correlation.png`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    thinned = replace(solution, trajectory=_thinned(solution.trajectory))
    reference = trial.reference
    errors = trajectory_errors(thinned, reference) if reference is not None else None
    if errors is not None and errors.time.size == 0:
        errors = None

    figures = {
        "track": _track(trial, thinned.trajectory, errors),
        "motion": _motion(thinned.trajectory, errors),
    }
    for sensor, group in _by_sensor(solution.residuals).items():
        figures[f"{sensor.lower()}_residuals"] = _residuals(sensor, group)
    if solution.estimates:
        figures["calibration"] = _calibration(solution, trial.calibration_truth)
    if np.count_nonzero(np.diagonal(solution.covariance) > 0.0) > 1:
        figures["correlation"] = _correlation(solution)

    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        # Unlike `savefig` this draws only once. The fastest compression level is good
        # enough for line drawings.
        canvas = FigureCanvasAgg(figure)
        canvas.print_png(path, pil_kwargs={"compress_level": 1})  # type: ignore[no-untyped-call]
        paths.append(path)
    return paths


def _track(trial: Trial, trajectory: Trajectory, errors: TrajectoryErrors | None) -> Figure:
    """Draw the track from above, and position errors (or standard deviations) over time."""
    figure = _figure(11.0, 5.6)
    grid = _grid(figure, 3, 2, width_ratios=(1.25, 1.0))
    ax = figure.add_subplot(grid[:, 0])
    frame = LocalFrame(*trajectory.geodetic[0])
    track = frame.position(*trajectory.geodetic.T)
    span = float(np.ptp(track[:, :2], axis=0).max())
    unit, scale = ("km", 1e-3) if span > 20e3 else ("m", 1.0)
    if trial.gnss is not None:
        fixes = trial.gnss.geodetic[~np.isnan(trial.gnss.geodetic[:, 0])]
        if fixes.size:
            fixes_n = frame.position(*fixes[:: -(-len(fixes) // 2000)].T) * scale
            ax.plot(
                fixes_n[:, 0],
                fixes_n[:, 1],
                linestyle="none",
                marker=".",
                markersize=4,
                markeredgewidth=0,
                color=_MEDIUM,
                label="GNSS fixes",
            )
    ax.plot(track[:, 0] * scale, track[:, 1] * scale, color=_ACCENT, lw=1.5, label="estimate")
    if trial.reference is not None:
        truth_n = _reference_track(trial.reference, trajectory, frame) * scale
        ax.plot(
            truth_n[:, 0], truth_n[:, 1], color=_DARK, lw=0.9, dashes=(5, 4), label="reference"
        )
    ax.plot(0.0, 0.0, "o", color=_DARK, markerfacecolor="white", markersize=7, label="start")
    ax.set_aspect("equal", adjustable="datalim")
    _style(ax, f"east of start, {unit}", f"north of start, {unit}")
    ax.margins(0.06)
    ax.set_title("Track", fontsize=_TITLE, loc="left")
    ax.legend(fontsize=_NORMAL, frameon=True, framealpha=0.85, edgecolor="none", loc="best")

    start, time_label = _clock(trajectory.time)
    panels = [figure.add_subplot(grid[i, 1]) for i in range(3)]
    for i, (panel, name) in enumerate(zip(panels, ("east", "north", "up"), strict=True)):
        if errors is None:
            _draw_std(panel, trajectory.time - start, trajectory.position_std[:, i])
        else:
            _draw_error(panel, errors.time - start, errors.position, i, 1.0)
        _style(panel, time_label if i == 2 else "", f"{name}, m")
        panel.tick_params(labelbottom=i == 2)
    _error_title(panels[0], "Position error", "Position", errors)
    return figure


def _motion(trajectory: Trajectory, errors: TrajectoryErrors | None) -> Figure:
    """Draw attitude and velocity, and their errors (or standard deviations), over time."""
    figure = _figure(11.0, 9.0)
    axes = _grid(figure, 6, 2).subplots(sharex=True, squeeze=False)
    start, time_label = _clock(trajectory.time)
    time = trajectory.time - start
    # A heading that swings about north would fill the panel with jumps.
    attitude = np.unwrap(trajectory.rph, axis=0) / DEG
    rows: list[tuple[str, Array, Array, float]] = [
        (f"{name}, deg", attitude[:, i], trajectory.rph_std[:, i] / DEG, 1.0 / DEG)
        for i, name in enumerate(("roll", "pitch", "heading"))
    ]
    rows += [
        (f"{name}, m/s", trajectory.velocity[:, i], trajectory.velocity_std[:, i], 1.0)
        for i, name in enumerate(("east", "north", "up"))
    ]
    for i, (label, value, std, unit) in enumerate(rows):
        left, right = axes[i]
        _draw_line(left, time, value)
        bucket_time, low, high = _envelope(time, value, _WIDE_BUCKETS)
        three_sigma = 3.0 * _envelope(time, std, _WIDE_BUCKETS)[2]
        left.fill_between(
            bucket_time,
            low - three_sigma,
            high + three_sigma,
            color=_ACCENT_LIGHT,
            lw=0,
            zorder=1,
        )
        _style(left, time_label if i == 5 else "", label)
        if errors is None:
            _draw_std(right, time, std)
        else:
            vector = errors.attitude if i < 3 else errors.velocity
            _draw_error(right, errors.time - start, vector, i % 3, unit)
        _style(right, time_label if i == 5 else "", label)
    axes[0, 0].set_title("Attitude and velocity, band ±3σ", fontsize=_TITLE, loc="left")
    _error_title(axes[0, 1], "Error against the reference", "Attitude and velocity", errors)
    return figure


def _residuals(sensor: str, group: Sequence[Residuals]) -> Figure:
    """Draw residuals over time within ±3σ, and the distribution of residual / σ."""
    rows = [(r, c) for r in group for c in range(len(r.components))]
    figure = _figure(11.0, 0.8 + 1.6 * len(rows))
    gap = (0.16 if len(group) == 1 else 0.3, 0.2)
    grid = _grid(figure, len(rows), 2, gap=gap, width_ratios=(3.4, 1.0))
    axes = grid.subplots(squeeze=False, sharex="col")
    start, time_label = _clock(np.concatenate([r.time for r in group]))
    x = np.linspace(-5.0, 5.0, 201)
    density = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    for i, (residuals, c) in enumerate(rows):
        left, right = axes[i]
        time = residuals.time - start
        value, sigma = residuals.residual[:, c], residuals.sigma[:, c]
        normalised = value / sigma
        limit = 4.5 * float(np.quantile(sigma, 0.95))
        # Outliers are few and matter: every one is drawn, at the edge if beyond it.
        outlying = np.abs(normalised) > 3.0
        stride = -(-value.size // (_LARGEST_SCATTER // len(rows)))
        inside = np.flatnonzero(~outlying)[::stride]
        size = 1.5 if inside.size > 2000 else 2.5
        left.plot(time[inside], value[inside], "o", color=_ACCENT, ms=size, mew=0)
        left.plot(
            time[outlying],
            np.clip(value[outlying], -limit, limit),
            linestyle="none",
            marker="o",
            markersize=size + 0.5,
            markeredgewidth=0,
            color=_DARK,
        )
        bucket_time, _, high = _envelope(time, 3.0 * sigma, _WIDE_BUCKETS)
        left.plot(bucket_time, high, color=_GREY, lw=1.0)
        left.plot(bucket_time, -high, color=_GREY, lw=1.0)
        left.axhline(0.0, color=_GREY, lw=0.5)
        left.set_ylim(-1.05 * limit, 1.05 * limit)
        last = i == len(rows) - 1
        _style(left, time_label if last else "", f"{residuals.components[c]}, {residuals.unit}")
        bins = np.linspace(-5.0, 5.0, 51 if value.size > 2000 else 26)
        share, _ = np.histogram(np.clip(normalised, -5.0, 5.0), bins, density=True)
        right.stairs(share, bins, fill=True, color=_ACCENT_LIGHT)
        right.plot(x, density, color=_DARK, lw=1.0)
        right.set_yticks([])
        right.set_xticks([-4, -2, 0, 2, 4])
        _style(right, "residual / σ" if last else "", "")
        right.text(
            0.97,
            0.92,
            f"mean {_fixed(normalised.mean(), 2)}\nstd {_fixed(normalised.std(), 2)}",
            transform=right.transAxes,
            ha="right",
            va="top",
            fontsize=_SMALL,
            color=_DARK,
        )
        if c == 0:
            left.set_title(
                f"{residuals.label}: predicted − measured, ±3σ", fontsize=_TITLE, loc="left"
            )
    axes[0, 1].set_title("against N(0, 1)", fontsize=_TITLE, loc="left")
    return figure


def _calibration(solution: Solution, truth: Mapping[str, ArrayLike]) -> Figure:
    """Draw every calibration component with its uncertainty, prior and truth."""
    rows = _calibration_rows(solution.estimates)
    figure = _figure(11.0, 0.75 + 1.12 * len(rows))
    grid = _grid(
        figure, len(rows), 3, left=0.15, right=0.15, bottom=0.3, top=0.85, gap=(0.52, 0.4)
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
        *handles.plot([], [], "o", color=_ACCENT, markersize=5, label="estimate"),
        *handles.plot([], [], color=_ACCENT, lw=4, label="±1σ"),
        *handles.plot([], [], color=_ACCENT, lw=1.2, label="±3σ"),
        *handles.plot([], [], color=_LIGHT, lw=9, label="prior ±1σ, where comparable"),
    ]
    if known:
        legend += handles.plot(
            [], [], "D", color=_DARK, markerfacecolor="none", markersize=6, label="truth"
        )
    figure.legend(
        handles=legend,
        loc="upper left",
        borderaxespad=0.3,
        ncols=len(legend),
        fontsize=_NORMAL,
        frameon=False,
        title="Calibration",
        title_fontsize=_TITLE,
        alignment="left",
    )
    return figure


def _draw_component(ax: Axes, estimate: Estimate, c: int, truth: float | None) -> None:
    """Draw one component as a horizontal error bar."""
    value, std = float(estimate.value[c]), float(estimate.std[c])
    prior, prior_std = float(estimate.prior_value[c]), float(estimate.prior_std[c])
    observable = bool(estimate.observable[c])
    fixed = std <= 0.0
    color = _ACCENT if observable and not fixed else _GREY
    half = 5.0 * std if not fixed else max(0.1 * abs(value), 1e-3)
    low, high = value - half, value + half
    if truth is not None:
        low, high = min(low, truth - 0.2 * half), max(high, truth + 0.2 * half)
    if not fixed and prior_std < 6.0 * std:
        low, high = min(low, prior - 1.2 * prior_std), max(high, prior + 1.2 * prior_std)
        ax.axvspan(prior - prior_std, prior + prior_std, color=_LIGHT, lw=0, zorder=0)
    ax.plot([value - 3.0 * std, value + 3.0 * std], [0.0, 0.0], color=color, lw=1.2)
    ax.plot([value - std, value + std], [0.0, 0.0], color=color, lw=4, solid_capstyle="butt")
    ax.plot(value, 0.0, "o", color=color, markersize=5)
    if truth is not None:
        ax.plot(truth, 0.0, "D", color=_DARK, markerfacecolor="none", markersize=6)
    ax.set_xlim(low, high)
    ax.set_ylim(-1.0, 1.0)
    ax.set_yticks([])
    ticks, labels = _ticks(low, high)
    ax.set_xticks(ticks, labels)
    _style(ax, "", "")
    ax.grid(visible=False)
    ax.spines["left"].set_visible(False)
    name, unit = _readable(estimate.component_names[c])
    ax.set_title(f"{name}, {unit}" if unit else name, fontsize=_NORMAL, loc="left", pad=3)
    ax.set_title(_with_std(value, std), fontsize=_NORMAL, loc="right", pad=3, color=color)
    if fixed or not observable:
        note = "held fixed" if fixed else "not observable"
        ax.text(
            0.5,
            0.93,
            note,
            transform=ax.transAxes,
            ha="center",
            va="top",
            fontsize=_SMALL,
            color=_DARK,
        )


def _correlation(solution: Solution) -> Figure:
    """Draw the correlation matrix of the calibration components."""
    std = np.sqrt(np.maximum(np.diagonal(solution.covariance), 0.0))
    free = std > 0.0
    names = [_readable(name)[0] for name, shown in zip(solution.order, free, strict=True) if shown]
    correlation = solution.covariance[np.ix_(free, free)] / np.outer(std[free], std[free])
    n = len(names)
    cell = min(0.5, 13.0 / max(n, 1))
    side = cell * max(n, 3)
    size = min(_NORMAL, 22.0 * cell)
    label_size = min(_NORMAL, 40.0 * cell)
    margin = 0.2 + max(map(len, names), default=0) * 0.56 * label_size / 72.0
    width, height = margin + side + 1.0, margin + side + 0.4
    figure = _figure(width, height)
    ax = figure.add_axes((margin / width, margin / height, side / width, side / height))
    image = ax.imshow(correlation, cmap=_DIVERGING, vmin=-1.0, vmax=1.0)
    for i in range(n):
        for j in range(i):
            rho = correlation[i, j]
            ax.text(
                j,
                i,
                _fixed(rho, 2),
                ha="center",
                va="center",
                fontsize=size,
                color="white" if abs(rho) > 0.6 else _DARK,
            )
    ax.set_xticks(range(n), names, rotation=90, fontsize=label_size)
    ax.set_yticks(range(n), names, fontsize=label_size)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    ax.set_title("Correlation of the calibration", fontsize=_TITLE, loc="left")
    bar_ax = figure.add_axes(
        (
            (margin + side + 0.3) / width,
            (margin + 0.2 * side) / height,
            0.15 / width,
            0.6 * side / height,
        )
    )
    bar = figure.colorbar(image, cax=bar_ax, ticks=[-1.0, -0.5, 0.0, 0.5, 1.0])
    bar.ax.tick_params(labelsize=_SMALL, length=2)
    bar.outline.set_visible(False)
    return figure


def _figure(width: float, height: float) -> Figure:
    """Return an empty figure, inches."""
    return Figure(figsize=(width, height), dpi=_DPI)


def _grid(
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


def _style(ax: Axes, xlabel: str, ylabel: str) -> None:
    """Apply the common look to axes; global settings would leak into the caller's figures."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(_GREY)
    ax.tick_params(labelsize=_SMALL, length=3, color=_GREY)
    ax.grid(color=_LIGHT, lw=0.6)
    ax.set_axisbelow(True)
    ax.margins(x=0.01)
    if xlabel:
        ax.set_xlabel(xlabel, fontsize=_NORMAL)
    if ylabel:
        ax.set_ylabel(ylabel, fontsize=_NORMAL)
        width = ax.get_position().width * ax.figure.get_figure(root=True).get_size_inches()[0]
        ax.yaxis.set_label_coords(-0.58 / width, 0.5)


def _error_title(
    ax: Axes, with_reference: str, without: str, errors: TrajectoryErrors | None
) -> None:
    title = f"{without}: standard deviation" if errors is None else f"{with_reference}, ±3σ"
    ax.set_title(title, fontsize=_TITLE, loc="left")


def _draw_line(ax: Axes, time: Array, value: Array) -> None:
    """Draw a line through (M,) values; where that would be a solid block, its envelope."""
    strokes = float(np.abs(np.diff(value)).sum()) / max(float(np.ptp(value)), 1e-300)
    if strokes > 4.0 * _WIDE_BUCKETS:
        bucket_time, low, high = _envelope(time, value, _WIDE_BUCKETS)
        # The outline remains where the envelope is too narrow to be seen.
        ax.fill_between(
            bucket_time, low, high, facecolor=_ACCENT_MEDIUM, edgecolor=_ACCENT, lw=0.7, zorder=2
        )
        return
    bucket_time, low, high = _envelope(time, value)
    if low is high:
        ax.plot(time, value, color=_ACCENT, lw=0.9)
    else:
        zigzag = np.stack([low, high], axis=1).ravel()
        ax.plot(np.repeat(bucket_time, 2), zigzag, color=_ACCENT, lw=0.9)


def _draw_error(ax: Axes, time: Array, errors: VectorErrors, c: int, scale: float) -> None:
    """Draw a component of errors within ±3σ."""
    three_sigma = 3.0 * scale * errors.std[:, c]
    bucket_time, _, high = _envelope(time, three_sigma, _WIDE_BUCKETS)
    ax.fill_between(bucket_time, -high, high, color=_LIGHT, lw=0, zorder=0)
    ax.plot(bucket_time, high, color=_GREY, lw=0.7)
    ax.plot(bucket_time, -high, color=_GREY, lw=0.7)
    _draw_line(ax, time, scale * errors.error[:, c])


def _draw_std(ax: Axes, time: Array, std: Array) -> None:
    """Draw a standard deviation."""
    _draw_line(ax, time, std)
    ax.set_ylim(0.0, 1.1 * float(std.max()) or 1.0)


def _envelope(time: Array, value: Array, buckets: int = _BUCKETS) -> tuple[Array, Array, Array]:
    """Return times, least and largest of (M,) values in buckets; the values if M is small."""
    if value.size <= 2 * buckets:
        return time, value, value
    edges = np.linspace(0, value.size, buckets, endpoint=False).astype(int)
    low, high = np.minimum.reduceat(value, edges), np.maximum.reduceat(value, edges)
    return np.append(time[edges], time[-1]), np.append(low, low[-1]), np.append(high, high[-1])


def _thinned(trajectory: Trajectory) -> Trajectory:
    """Return every k-th epoch of a trajectory, so that not too many remain."""
    k = -(-trajectory.time.size // _LARGEST_TRAJECTORY)
    if k == 1:
        return trajectory
    return Trajectory(*(getattr(trajectory, name)[::k] for name in trajectory.__annotations__))


def _reference_track(reference: Reference, trajectory: Trajectory, frame: LocalFrame) -> Array:
    """Return the reference's positions during the trajectory, (K, 3), m from its start."""
    during = slice(
        int(np.searchsorted(reference.time, trajectory.time[0] - 1e-6)),
        int(np.searchsorted(reference.time, trajectory.time[-1] + 1e-6)),
    )
    geodetic = reference.geodetic[during]
    return frame.position(*geodetic[:: max(1, len(geodetic) // 5000)].T)


def _clock(time: Array) -> tuple[float, str]:
    """Return the start of the time axis, s, and its label."""
    first = float(time.min())
    # Seconds since some epoch long ago do not fit on a tick.
    if abs(first) < 1e5:
        return 0.0, "time, s"
    start = float(np.floor(first))
    return start, f"time − {start:.0f}, s"


def _by_sensor(residuals: Sequence[Residuals]) -> dict[str, list[Residuals]]:
    """Group residuals by the first word of their label; empty ones are left out."""
    groups: dict[str, list[Residuals]] = {}
    for r in residuals:
        if r.time.size:
            groups.setdefault(r.label.split()[0], []).append(r)
    return groups


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


def _readable(component: str) -> tuple[str, str]:
    """Split the name of a component into words and unit: `lever_arm_x_m`, `lever arm x`, `m`."""
    for suffix, unit in _UNITS.items():
        if component.endswith(f"_{suffix}"):
            return component.removesuffix(f"_{suffix}").replace("_", " "), unit
    return component.replace("_", " "), ""


def _with_std(value: float, std: float) -> str:
    """Write a value with its standard deviation, to two digits of the latter."""
    if std <= 0.0:
        return f"{value:g}"
    digits = max(0, 1 - int(np.floor(np.log10(std))))
    return f"{_fixed(value, digits)} ± {_fixed(std, digits)}"


def _fixed(value: float, digits: int) -> str:
    """Write a number with so many decimals, without a negative zero."""
    return f"{round(float(value), digits) + 0.0:.{digits}f}".replace("-", "−")


def _ticks(low: float, high: float) -> tuple[NDArray[np.float64], list[str]]:
    """Return a few round ticks inside an interval, and their labels without offset."""
    ticks = np.asarray(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
    step = ticks[1] - ticks[0]
    margin = 0.03 * (high - low)
    ticks = ticks[(ticks >= low + margin) & (ticks <= high - margin)]
    digits = next((d for d in range(12) if abs(round(step, d) / step - 1.0) < 1e-3), 12)
    return ticks, [_fixed(t, digits) for t in ticks]
