"""Figures of a solution, as PNG files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from factorgraph_dvl.analysis.consistency import (
    TrajectoryErrors,
    trajectory_errors,
    true_value_of,
)
from factorgraph_dvl.conventions import DEG, Array
from factorgraph_dvl.earth import LocalFrame
from factorgraph_dvl.report.drawing import (
    ACCENT,
    ACCENT_LIGHT,
    DARK,
    GREY,
    LIGHT,
    MEDIUM,
    NORMAL,
    SMALL,
    TITLE,
    WIDE_BUCKETS,
    decimals,
    draw_error,
    draw_line,
    draw_std,
    envelope,
    new_figure,
    new_grid,
    readable,
    round_ticks,
    save,
    style,
    time_axis,
    with_std,
)
from factorgraph_dvl.solution import Estimate, Residuals, Solution, Trajectory
from factorgraph_dvl.trial import Reference, Trial

_DIVERGING = LinearSegmentedColormap.from_list("correlation", ["#6b6b6b", "#ffffff", ACCENT])

_LARGEST_TRAJECTORY = 20_000
_LARGEST_SCATTER = 20_000


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
        save(figure, path)
        paths.append(path)
    return paths


def _track(trial: Trial, trajectory: Trajectory, errors: TrajectoryErrors | None) -> Figure:
    """Draw the track from above, and position errors (or standard deviations) over time."""
    figure = new_figure(11.0, 5.6)
    grid = new_grid(figure, 3, 2, width_ratios=(1.25, 1.0))
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
                color=MEDIUM,
                label="GNSS fixes",
            )
    ax.plot(track[:, 0] * scale, track[:, 1] * scale, color=ACCENT, lw=1.5, label="estimate")
    if trial.reference is not None:
        truth_n = _reference_track(trial.reference, trajectory, frame) * scale
        ax.plot(truth_n[:, 0], truth_n[:, 1], color=DARK, lw=0.9, dashes=(5, 4), label="reference")
    ax.plot(0.0, 0.0, "o", color=DARK, markerfacecolor="white", markersize=7, label="start")
    ax.set_aspect("equal", adjustable="datalim")
    style(ax, f"east of start, {unit}", f"north of start, {unit}")
    ax.margins(0.06)
    ax.set_title("Track", fontsize=TITLE, loc="left")
    ax.legend(fontsize=NORMAL, frameon=True, framealpha=0.85, edgecolor="none", loc="best")

    start, time_label = time_axis(trajectory.time)
    panels = [figure.add_subplot(grid[i, 1]) for i in range(3)]
    for i, (panel, name) in enumerate(zip(panels, ("east", "north", "up"), strict=True)):
        if errors is None:
            draw_std(panel, trajectory.time - start, trajectory.position_std[:, i])
        else:
            draw_error(panel, errors.time - start, errors.position, i, 1.0)
        style(panel, time_label if i == 2 else "", f"{name}, m")
        panel.tick_params(labelbottom=i == 2)
    _error_title(panels[0], "Position error", "Position", errors)
    return figure


def _motion(trajectory: Trajectory, errors: TrajectoryErrors | None) -> Figure:
    """Draw attitude and velocity, and their errors (or standard deviations), over time."""
    figure = new_figure(11.0, 9.0)
    axes = new_grid(figure, 6, 2).subplots(sharex=True, squeeze=False)
    start, time_label = time_axis(trajectory.time)
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
        draw_line(left, time, value)
        bucket_time, low, high = envelope(time, value, WIDE_BUCKETS)
        three_sigma = 3.0 * envelope(time, std, WIDE_BUCKETS)[2]
        left.fill_between(
            bucket_time,
            low - three_sigma,
            high + three_sigma,
            color=ACCENT_LIGHT,
            lw=0,
            zorder=1,
        )
        style(left, time_label if i == 5 else "", label)
        if errors is None:
            draw_std(right, time, std)
        else:
            vector = errors.attitude if i < 3 else errors.velocity
            draw_error(right, errors.time - start, vector, i % 3, unit)
        style(right, time_label if i == 5 else "", label)
    axes[0, 0].set_title("Attitude and velocity, band ±3σ", fontsize=TITLE, loc="left")
    _error_title(axes[0, 1], "Error against the reference", "Attitude and velocity", errors)
    return figure


def _residuals(sensor: str, group: Sequence[Residuals]) -> Figure:
    """Draw residuals over time within ±3σ, and the distribution of residual / σ."""
    rows = [(r, c) for r in group for c in range(len(r.components))]
    figure = new_figure(11.0, 0.8 + 1.6 * len(rows))
    gap = (0.16 if len(group) == 1 else 0.3, 0.2)
    grid = new_grid(figure, len(rows), 2, gap=gap, width_ratios=(3.4, 1.0))
    axes = grid.subplots(squeeze=False, sharex="col")
    start, time_label = time_axis(np.concatenate([r.time for r in group]))
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
        bucket_time, _, high = envelope(time, 3.0 * sigma, WIDE_BUCKETS)
        left.plot(bucket_time, high, color=GREY, lw=1.0)
        left.plot(bucket_time, -high, color=GREY, lw=1.0)
        left.axhline(0.0, color=GREY, lw=0.5)
        left.set_ylim(-1.05 * limit, 1.05 * limit)
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
            f"mean {decimals(normalised.mean(), 2)}\nstd {decimals(normalised.std(), 2)}",
            transform=right.transAxes,
            ha="right",
            va="top",
            fontsize=SMALL,
            color=DARK,
        )
        if c == 0:
            left.set_title(
                f"{residuals.label}: predicted − measured, ±3σ", fontsize=TITLE, loc="left"
            )
    axes[0, 1].set_title("against N(0, 1)", fontsize=TITLE, loc="left")
    return figure


def _calibration(solution: Solution, truth: Mapping[str, ArrayLike]) -> Figure:
    """Draw every calibration component with its uncertainty, prior and truth."""
    rows = _calibration_rows(solution.estimates)
    figure = new_figure(11.0, 0.75 + 1.12 * len(rows))
    grid = new_grid(
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
    ticks, labels = round_ticks(low, high)
    ax.set_xticks(ticks, labels)
    style(ax, "", "")
    ax.grid(visible=False)
    ax.spines["left"].set_visible(False)
    name, unit = readable(estimate.component_names[c])
    ax.set_title(f"{name}, {unit}" if unit else name, fontsize=NORMAL, loc="left", pad=3)
    ax.set_title(with_std(value, std), fontsize=NORMAL, loc="right", pad=3, color=color)
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


def _correlation(solution: Solution) -> Figure:
    """Draw the correlation matrix of the calibration components."""
    std = np.sqrt(np.maximum(np.diagonal(solution.covariance), 0.0))
    free = std > 0.0
    names = [readable(name)[0] for name, shown in zip(solution.order, free, strict=True) if shown]
    correlation = solution.covariance[np.ix_(free, free)] / np.outer(std[free], std[free])
    n = len(names)
    cell = min(0.5, 13.0 / max(n, 1))
    side = cell * max(n, 3)
    size = min(NORMAL, 22.0 * cell)
    label_size = min(NORMAL, 40.0 * cell)
    margin = 0.2 + max(map(len, names), default=0) * 0.56 * label_size / 72.0
    width, height = margin + side + 1.0, margin + side + 0.4
    figure = new_figure(width, height)
    ax = figure.add_axes((margin / width, margin / height, side / width, side / height))
    image = ax.imshow(correlation, cmap=_DIVERGING, vmin=-1.0, vmax=1.0)
    for i in range(n):
        for j in range(i):
            rho = correlation[i, j]
            ax.text(
                j,
                i,
                decimals(rho, 2),
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


def _error_title(
    ax: Axes, with_reference: str, without: str, errors: TrajectoryErrors | None
) -> None:
    title = f"{without}: standard deviation" if errors is None else f"{with_reference}, ±3σ"
    ax.set_title(title, fontsize=TITLE, loc="left")


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
