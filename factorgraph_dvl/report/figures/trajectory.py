"""Track and motion over time, with their errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import SubFigure
from matplotlib.gridspec import SubplotSpec
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from factorgraph_dvl.analysis.error_statistics import TrajectoryErrors
from factorgraph_dvl.estimates import Hypothesis, Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.report.figures.drawing import (
    ACCENT,
    DARK,
    LIGHT,
    MEDIUM,
    NORMAL,
    SMALL,
    TITLE,
    Canvas,
    canvas,
    clock,
    draw_error,
    draw_line,
    draw_std,
    draw_swing,
    envelope,
    error_title,
    is_dense,
    new_grid,
    style,
)
from factorgraph_dvl.trial import Reference, Trial

# Length of a close-up, s. Chosen: a period or two of a swell.
# Times that are marked on a track, at most. Chosen: they stay apart.
_TIME_MARKS = 6
# Part of the duration in which the track is near a mark. Chosen: a tight circle takes longer.
_BESIDE = 0.1
# Chosen: share of a track's size that a label of such a mark takes, and how far, as a sine, its
# side may be off an axis for the label to be centred.
_MARKS_APART = 0.06
_STEEP = 0.4
_CLOSE_UP_S = 10.0
# A line is about so thick beside its panel.
_SEEN = 0.005
# At least so many to each side, if the trajectory has few epochs.
_CLOSE_UP_INTERVALS = 20


def track_figure(
    trial: Trial | None,
    trajectory: Trajectory,
    errors: TrajectoryErrors | None,
    others: Sequence[Hypothesis] = (),
    *,
    into: SubFigure | None = None,
) -> Canvas:
    """Draw the track from above, and position errors (or standard deviations) over time."""
    figure = canvas(11.0, 5.6, into)
    grid = new_grid(figure, 3, 2, width_ratios=(1.25, 1.0))
    ax = figure.add_subplot(grid[:, 0])
    frame = LocalFrame(*trajectory.geodetic[0])
    track = frame.position(*trajectory.geodetic.T)
    span = float(np.ptp(track[:, :2], axis=0).max())
    unit, scale = ("km", 1e-3) if span > 20e3 else ("m", 1.0)
    if trial is not None and trial.gnss is not None:
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
    for i, other in enumerate(others):
        other_n = frame.position(*other.trajectory.geodetic.T) * scale
        label = "other hypotheses" if i == 0 else None
        ax.plot(other_n[:, 0], other_n[:, 1], color=MEDIUM, lw=1.2, label=label)
    if trial is not None and trial.beacons is not None:
        beacons_n = frame.position(*trial.beacons.places.T) * scale
        ax.plot(beacons_n[:, 0], beacons_n[:, 1], "^", color=DARK, markersize=8, label="beacon")
    ax.plot(track[:, 0] * scale, track[:, 1] * scale, color=ACCENT, lw=1.5, label="estimate")
    if trial is not None and trial.reference is not None:
        truth_n = _reference_track(trial.reference, trajectory, frame) * scale
        ax.plot(truth_n[:, 0], truth_n[:, 1], color=DARK, lw=0.9, dashes=(5, 4), label="reference")
    ax.plot(0.0, 0.0, "o", color=DARK, markerfacecolor="white", markersize=7, label="start")
    mark_times(ax, trajectory.time, track * scale)
    ax.set_aspect("equal", adjustable="datalim")
    style(ax, f"east of start, {unit}", f"north of start, {unit}")
    ax.margins(0.06)
    ax.set_title("Track", fontsize=TITLE, loc="left")
    ax.set_title("N ↑", fontsize=TITLE, loc="right")
    ax.legend(fontsize=NORMAL, frameon=True, framealpha=0.85, edgecolor="none", loc="best")

    start, time_label = clock(trajectory.time)
    panels = [figure.add_subplot(grid[i, 1]) for i in range(3)]
    for i, (panel, name) in enumerate(zip(panels, ("east", "north", "up"), strict=True)):
        if errors is None:
            draw_std(panel, trajectory.time - start, trajectory.position_std[:, i])
        else:
            draw_error(panel, errors.time - start, errors.position, i, 1.0)
        style(panel, time_label if i == 2 else "", f"{name}, m")
        panel.tick_params(labelbottom=i == 2)
    error_title(panels[0], "Position error", "Position", errors)
    return figure


def mark_times(ax: Axes, time: Array, track: Array) -> None:
    """Mark a few round times since the start on a track.

    Parameters
    ----------
    ax : Axes
        Where the track is drawn.
    time : ndarray, shape (M,), s
        Times of its points.
    track : ndarray, shape (M, 2) or (M, 3)
        Positions in the units of the axes; east and north first.
    """
    duration = float(time[-1] - time[0])
    box = ax.dataLim
    size = max(box.width, box.height, float(np.ptp(track[:, :2], axis=0).max()))
    shown = [track[0, :2]]
    for mark in MaxNLocator(nbins=_TIME_MARKS, steps=[1, 2, 5, 10]).tick_values(0.0, duration):
        if not 0.0 < mark < duration:
            continue
        k = int(np.searchsorted(time, time[0] + mark))
        place = track[k, :2]
        # Labels of marks that are closer would cover each other.
        if min(float(np.linalg.norm(place - other)) for other in shown) < _MARKS_APART * size:
            continue
        shown.append(place)
        near = np.abs(time - time[k]) < _BESIDE * duration
        dx, dy = _beside(place, track[near, :2])
        if place[0] + 2.0 * _MARKS_APART * size > box.x1 and dx > 0.0:
            dx, dy = -dx, -dy
        ax.plot(*place, "o", color=ACCENT, markerfacecolor="white", markersize=4)
        ax.annotate(
            f"{mark:g} s",
            place.tolist(),
            xytext=(7.0 * dx, 7.0 * dy),
            textcoords="offset points",
            ha="center" if abs(dx) < _STEEP else "left" if dx > 0.0 else "right",
            va="center" if abs(dy) < _STEEP else "bottom" if dy > 0.0 else "top",
            fontsize=SMALL,
            color=DARK,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )


def _beside(place: Array, near: Array) -> tuple[float, float]:
    """Return the direction (2,) across a track, to the side on which the track is not."""
    along = near[-1] - near[0]
    across = np.array([-along[1], along[0]]) / max(float(np.linalg.norm(along)), 1e-12)
    if across @ (place - near.mean(axis=0)) < 0.0:
        across = -across
    return float(across[0]), float(across[1])


def motion_figure(
    trajectory: Trajectory, errors: TrajectoryErrors | None, *, into: SubFigure | None = None
) -> Canvas:
    """Draw attitude and velocity, and their errors (or standard deviations), over time.

    If one of them swings too fast to be seen over the whole time, some seconds of all are
    drawn as well.

    Parameters
    ----------
    trajectory : Trajectory
        Trajectory with all its epochs: with fewer, a swing may look like another.
    errors : TrajectoryErrors or None
        Errors of the same or of fewer epochs, if there is a reference.
    into : SubFigure, optional
        Where to draw; by default a new figure.
    """
    start, time_label = clock(trajectory.time)
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
    # A planar trial measures neither roll nor pitch.
    shown = [i for i, row in enumerate(rows) if np.any(row[1]) or not np.isnan(row[2]).all()]
    close_up = _close_up(time) if any(is_dense(value) for _, value, _, _ in rows) else None
    figure = canvas(11.0 if close_up is None else 13.5, 1.5 * len(shown), into)
    grid = new_grid(figure, len(shown), 2, width_ratios=(1.0 if close_up is None else 1.35, 1.0))
    columns: list[list[Axes]] = [[], [], []]
    for k, i in enumerate(shown):
        label, value, std, unit = rows[i]
        last = i == shown[-1]
        row_label = time_label if last else ""
        halves = grid[k, 0].subgridspec(1, 2, width_ratios=(2.4, 1.0), wspace=0.05)
        cell = grid[k, 0] if close_up is None else halves[0]
        left = _panel(figure, cell, columns[0], last=last)
        right = _panel(figure, grid[k, 1], columns[2], last=last)
        _draw_with_band(left, time, value, std)
        style(left, row_label, label)
        if close_up is not None:
            middle = _panel(figure, halves[1], columns[1], last=last, sharey=left)
            _draw_with_band(middle, time[close_up], value[close_up], std[close_up], marker=".")
            style(middle, row_label, "")
            left.axvspan(time[close_up][0], time[close_up][-1], color=DARK, alpha=0.25, lw=0.7)
        if errors is None:
            draw_std(right, time, std)
        else:
            vector = errors.attitude if i < 3 else errors.velocity
            draw_error(right, errors.time - start, vector, i % 3, unit)
        style(right, row_label, label)
    has_band = any(_band_is_seen(rows[i][1], rows[i][2]) for i in shown)
    title = "Attitude and velocity" + (", band ±3σ" if has_band else "")
    columns[0][0].set_title(title, fontsize=TITLE, loc="left")
    if close_up is not None:
        seconds = time[close_up][-1] - time[close_up][0]
        columns[1][0].set_title(f"{seconds:.3g} s of it", fontsize=TITLE, loc="left")
    error_title(columns[2][0], "Error against the reference", "Attitude and velocity", errors)
    return figure


def _close_up(time: Array) -> slice:
    """Return the epochs about the middle of (M,) times that are drawn at large."""
    half = max(0.5 * _CLOSE_UP_S, _CLOSE_UP_INTERVALS * float(np.median(np.diff(time))))
    middle = 0.5 * (time[0] + time[-1])
    first, last = np.searchsorted(time, [middle - half - 1e-6, middle + half + 1e-6])
    return slice(int(first), int(last))


def _panel(
    figure: Canvas,
    cell: SubplotSpec,
    column: list[Axes],
    *,
    last: bool,
    sharey: Axes | None = None,
) -> Axes:
    """Add axes below those of a column, of the same time."""
    ax = figure.add_subplot(cell, sharex=column[0] if column else None, sharey=sharey)
    ax.tick_params(labelbottom=last, labelleft=sharey is None)
    column.append(ax)
    return ax


def _draw_with_band(ax: Axes, time: Array, value: Array, std: Array, marker: str = "") -> None:
    """Draw (M,) values and what lies within ±3σ of them, where that can be seen."""
    if is_dense(value):
        draw_swing(ax, time, value)
        return
    draw_line(ax, time, value, marker=marker)
    if not _band_is_seen(value, std):
        return
    bucket_time, low, high = envelope(time, value)
    three_sigma = 3.0 * envelope(time, std)[2]
    ax.fill_between(
        bucket_time, low - three_sigma, high + three_sigma, color=LIGHT, lw=0, zorder=0
    )


def _band_is_seen(value: Array, std: Array) -> bool:
    """Whether ±3σ about (M,) values is wider than their line."""
    return bool(3.0 * np.nanmax(std, initial=0.0) > _SEEN * np.ptp(value) and not is_dense(value))


def _reference_track(reference: Reference, trajectory: Trajectory, frame: LocalFrame) -> Array:
    """Return the reference's positions during the trajectory, (K, 3), m from its start."""
    during = slice(
        int(np.searchsorted(reference.time, trajectory.time[0] - 1e-6)),
        int(np.searchsorted(reference.time, trajectory.time[-1] + 1e-6)),
    )
    geodetic = reference.geodetic[during]
    return frame.position(*geodetic[:: max(1, len(geodetic) // 5000)].T)
