"""Beams of a DVL against each other."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import SubFigure

from factorgraph_dvl.analysis.beam_quality import BeamQuality
from factorgraph_dvl.report.figures.drawing import (
    ACCENT,
    DARK,
    GREY,
    NORMAL,
    SMALL,
    TITLE,
    Canvas,
    canvas,
    clock,
    draw_band,
    new_grid,
    style,
)

# Groups of beams and points in a panel, at most. Chosen: what the eye keeps apart.
_MOST_GROUPS = 10
_MOST_POINTS = 4000
_COLOURS = (ACCENT, DARK, "#d98c1f", "#3c8a4e", "#a0478f")
_DASHES = ("-", (0, (4, 4)), (0, (5, 2, 1, 2)), (0, (1, 3)))


def beam_quality_figure(quality: BeamQuality, *, into: SubFigure | None = None) -> Canvas:
    """Draw error velocity over time, and how far each group of three is from all beams.

    Parameters
    ----------
    quality : BeamQuality
        Quality of the beams, of which four or more were received together at least once.
    into : SubFigure, optional
        Where to draw; by default a new figure.
    """
    figure = canvas(11.0, 5.6, into)
    grid = new_grid(figure, 4, 1, gap=(0.3, 0.0), right=0.9)
    axes = grid.subplots(squeeze=False, sharex=True)[:, 0]
    start, time_label = clock(quality.time)
    known = np.flatnonzero(np.isfinite(quality.error_velocity))
    stride = -(-known.size // _MOST_POINTS) or 1
    shown = known[::stride]
    axes[0].plot(
        quality.time[shown] - start,
        quality.error_velocity[shown],
        "o",
        color=ACCENT,
        ms=1.5,
        mew=0,
    )
    draw_band(axes[0], quality.time[known] - start, 3.0 * quality.error_sigma[known])
    if np.all(quality.error_velocity[known] >= 0.0):
        axes[0].set_ylim(bottom=0.0)
    axes[0].set_title(
        "Error velocity of the beams as calibrated, ±3σ of their noise", fontsize=TITLE, loc="left"
    )
    style(axes[0], "", "m/s")
    apart = quality.group_velocity - quality.velocity[:, None, :]
    for i, ax in enumerate(axes[1:]):
        for g, name in enumerate(quality.groups[:_MOST_GROUPS]):
            value = _mean_over_time(apart[:, g, i])
            time = _mean_over_time(quality.time - start)
            # Of four beams two groups may have one curve: dashes let the other show through.
            colour, dashes = _COLOURS[g % len(_COLOURS)], _DASHES[g % len(_DASHES)]
            ax.plot(time, value, color=colour, ls=dashes, lw=1.1, label=name)
        ax.axhline(0.0, color=GREY, lw=0.5)
        style(ax, time_label if i == 2 else "", f"{'xyz'[i]}, m/s")
    axes[1].set_title(
        "Velocity of each three beams − velocity of all, means of a hundredth of the time",
        fontsize=TITLE,
        loc="left",
    )
    axes[1].legend(
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        fontsize=SMALL,
        title="beams",
        title_fontsize=NORMAL,
        frameon=False,
    )
    return figure


def _mean_over_time(values: np.ndarray, pieces: int = 100) -> np.ndarray:
    """Return means over equal pieces of a record, nan where nothing was measured."""
    edges = np.linspace(0, values.size, min(pieces, values.size), endpoint=False).astype(int)
    known = np.isfinite(values)
    count = np.add.reduceat(known.astype(float), edges)
    total = np.add.reduceat(np.where(known, values, 0.0), edges)
    return np.where(count > 0.0, total / np.maximum(count, 1.0), np.nan)
