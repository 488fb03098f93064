"""Dead-reckoned tracks, their errors over distance, and the jump of a neglected lever arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from factorgraph_dvl.analysis.dead_reckoning.before_after import BeforeAfter
from factorgraph_dvl.analysis.dead_reckoning.track_error import Score
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.verdict import Verdict
from factorgraph_dvl.report.figures.drawing import (
    ACCENT,
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
from factorgraph_dvl.report.figures.trajectory import mark_times
from factorgraph_dvl.trial import Reference, Trial

_BEFORE = "#c2571a"
# Points of a track. Chosen: more than a figure has pixels along it.
_POINTS = 5000


def write_dead_reckoning_figures(
    trial: Trial,
    result: BeforeAfter,
    folder: Path,
    verdict: Verdict | None = None,
    *,
    kind: str = "png",
) -> list[Path]:
    """Draw `tracks.png`, `lever_arm.png` and, if the errors are known, `errors.png`.

    Parameters
    ----------
    trial : Trial
        Trial with its reference, if it has one.
    result : BeforeAfter
        What to draw.
    folder : path-like
        Where the files go.
    verdict : Verdict, optional
        Verdict on the records.
    kind : {'png', 'svg', 'pdf'}, optional
        Format of further files beside the PNG files.
    """
    figures = {"tracks": tracks_figure(trial, result), "lever_arm": lever_arm_figure(result)}
    if result.calibrated.score is not None and result.uncalibrated.score is not None:
        figures["errors"] = errors_figure(result.calibrated.score, result.uncalibrated.score)
    return save_figures(figures, folder, verdict, name=trial.name, kind=kind)


def tracks_figure(trial: Trial, result: BeforeAfter) -> Figure:
    """Draw the tracks before and after calibration over the truth."""
    figure = new_figure(8.0, 6.4)
    ax = figure.add_subplot(new_grid(figure, 1, 1)[0, 0])
    calibrated = result.calibrated.track
    frame = LocalFrame(*calibrated.geodetic[0])
    span = np.ptp(frame.position(*calibrated.geodetic.T)[:, :2], axis=0).max()
    unit, scale = ("km", 1e-3) if span > 5e3 else ("m", 1.0)
    if result.scored_by != "nothing":
        truth = _during(trial, calibrated.time[0], calibrated.time[-1])
        ax.plot(*_flat(frame, truth, scale), color=GREY, lw=3.5, label=result.scored_by)
    for track, color, label in (
        (result.uncalibrated.track, _BEFORE, "uncalibrated"),
        (calibrated, ACCENT, "calibrated"),
    ):
        ax.plot(*_flat(frame, track.geodetic, scale), color=color, lw=1.2, label=label)
    ax.plot(0.0, 0.0, "o", color=DARK, markerfacecolor="white", markersize=7, label="start")
    ax.set_aspect("equal", adjustable="datalim")
    style(ax, f"east of start, {unit}", f"north of start, {unit}")
    ax.margins(0.06)
    marked = frame.position(*calibrated.geodetic.T) * scale
    mark_times(ax, calibrated.time, marked)
    ax.set_title("Dead reckoning", fontsize=TITLE, loc="left")
    ax.set_title("N ↑", fontsize=TITLE, loc="right")
    ax.legend(fontsize=NORMAL, frameon=True, framealpha=0.85, edgecolor="none", loc="best")
    return figure


def errors_figure(calibrated: Score, uncalibrated: Score) -> Figure:
    """Draw the errors over the distance travelled, before and after calibration."""
    figure = new_figure(11.0, 6.4)
    grid = new_grid(figure, 3, 2)
    for column, (score, color, title) in enumerate(
        ((uncalibrated, _BEFORE, "Uncalibrated"), (calibrated, ACCENT, "Calibrated"))
    ):
        distance = score.path.distance / 1e3
        thin = slice(None, None, -(-distance.size // _POINTS))
        panels: list[Axes] = []
        for row, (name, value) in enumerate(
            (
                ("horizontal, m", score.horizontal),
                ("along, m", score.along),
                ("across, m", score.across),
            )
        ):
            ax = figure.add_subplot(grid[row, column], sharex=panels[0] if panels else None)
            panels.append(ax)
            ax.plot(distance[thin], value[thin], color=color, lw=1.0)
            style(ax, "distance travelled, km" if row == 2 else "", name)
            ax.tick_params(labelbottom=row == 2)
        end = score.percent(float(score.horizontal[-1]))
        most = score.percent(float(score.horizontal.max()))
        panels[0].set_title(
            f"{title}: end point {end:.2g} %, largest {most:.2g} % of distance",
            fontsize=TITLE,
            loc="left",
        )
    return figure


def lever_arm_figure(result: BeforeAfter) -> Figure:
    """Draw what a neglected lever arm does to the position when the vessel turns."""
    figure = new_figure(11.0, 7.2)
    grid = new_grid(figure, 3, 1, gap=(0.4, 0.85))
    effect, track = result.lever_arm, result.calibrated.track
    start, time_label = clock(effect.time)
    time = effect.time - start
    top, middle, bottom = (figure.add_subplot(grid[i, 0]) for i in range(3))
    # The course of a vessel that goes back and forth jumps less where it is unwrapped.
    top.plot(time, np.unwrap(track.rph[:, 2]) / DEG, color=DARK, lw=0.9)
    style(top, "", "heading, deg")
    top.set_title("A neglected lever arm", fontsize=TITLE, loc="left")
    for i, (name, color) in enumerate((("east", ACCENT), ("north", _BEFORE))):
        middle.plot(time, effect.measured[:, i], color=color, lw=1.6, alpha=0.5, label=f"{name}: "
                    "track without minus track with lever arm")  # fmt: skip
        middle.plot(time, effect.closed_form[:, i], color=color, lw=0.8, dashes=(4, 3),
                    label=f"{name}: (C(t) − C(0)) l")  # fmt: skip
    style(middle, "", "difference, m")
    # Above the panel: the curves of turns go everywhere.
    middle.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=4,
        borderaxespad=0.1,
        fontsize=NORMAL,
        frameon=False,
    )
    bare, full = result.without_lever_arm.score, result.calibrated.score
    if bare is None or full is None:
        bottom.plot(time, np.hypot(effect.measured[:, 0], effect.measured[:, 1]), color=DARK)
        style(bottom, time_label, "difference, m")
    else:
        for score, color, label in (
            (bare, _BEFORE, "without lever arm"),
            (full, ACCENT, "with lever arm"),
        ):
            bottom.plot(score.time - start, score.horizontal, color=color, lw=1.0, label=label)
        style(bottom, time_label, "position error, m")
        bottom.legend(fontsize=NORMAL, frameon=True, framealpha=0.85, edgecolor="none")
    for ax in (top, middle):
        ax.tick_params(labelbottom=False)
        ax.sharex(bottom)
    return figure


def _during(trial: Trial, first: float, last: float) -> Array:
    """Return the reference's positions, else the fixes, during a track."""
    if trial.reference is not None:
        record: Reference = trial.reference
        time, geodetic = record.time, record.geodetic
    else:
        assert trial.gnss is not None
        has_fix = ~np.isnan(trial.gnss.geodetic[:, 0])
        time, geodetic = trial.gnss.time[has_fix], trial.gnss.geodetic[has_fix]
    return geodetic[(time >= first) & (time <= last)]


def _flat(frame: LocalFrame, geodetic: Array, scale: float) -> tuple[Array, Array]:
    thinned = geodetic[:: max(1, len(geodetic) // _POINTS)]
    east, north, _ = frame.position(*thinned.T).T * scale
    return east, north
