"""Figures of a solution, as PNG files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.gridspec import GridSpec

from factorgraph_dvl.analysis.beam_quality import beam_quality, calibrates, calibration_of
from factorgraph_dvl.analysis.error_statistics import trajectory_errors
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.estimates import Residuals, Trajectory
from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.report.figures.beams import beam_quality_figure
from factorgraph_dvl.report.figures.calibration import (
    calibration_figure,
    correlation_figure,
    error_budget_figure,
)
from factorgraph_dvl.report.figures.drawing import Canvas, save_figures
from factorgraph_dvl.report.figures.residuals import residuals_figure
from factorgraph_dvl.report.figures.trajectory import motion_figure, track_figure
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import Trial

# Draws into a part of a figure, or into a new one.
Drawing = Callable[[SubFigure | None], Canvas]

# Epochs that are drawn. Chosen: ten times the pixels of a figure.
_LARGEST_TRAJECTORY = 20_000


def write_figures(
    trial: Trial, solution: Solution, folder: Path, *, kind: str = "png"
) -> list[Path]:
    """Draw a solution: track, motion, residuals, calibration, correlation.

    Figures for which there is nothing to draw are left out. Long lines are drawn as
    the envelope of what they pass through, which looks the same.

    Parameters
    ----------
    trial : Trial
        Trial for its GNSS fixes, reference and true calibration.
    solution : Solution
        What to draw.
    folder : path-like
        Where the PNG files go; created if needed.
    kind : {'png', 'svg', 'pdf'}, optional
        Format of further files beside them.

    Returns
    -------
    list of Path
        The files: `track.png`, `motion.png`, `<sensor>_residuals.png` of each sensor with
        residuals, `beam_quality.png`, `calibration.png`, `correlation.png`,
        `error_budget.png`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    figures = {name: draw(None) for name, draw in drawings(solution, trial).items()}
    return save_figures(figures, folder, solution.verdict, name=solution.trial, kind=kind)


def plot(
    solution: Solution,
    figure: str = "calibration",
    *,
    trial: Trial | None = None,
    axes: Axes | None = None,
) -> Canvas:
    """Draw one of the figures that `solve` writes.

    Parameters
    ----------
    solution : Solution
        What to draw.
    figure : str, default 'calibration'
        `track`, `motion`, `calibration`, `correlation`, `error_budget`, `beam_quality`, or the
        residuals of a sensor, such as `dvl_residuals`.
    trial : Trial, optional
        Trial for its GNSS fixes, reference and true calibration, which are drawn if it is given.
    axes : matplotlib.axes.Axes, optional
        Axes of your own figure: the panels take their place. By default a new figure.

    Returns
    -------
    matplotlib.figure.Figure or matplotlib.figure.SubFigure
        The new figure, or the part of yours.

    Raises
    ------
    ConfigError
        If there is no such figure, or nothing to draw in it.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> trial = fd.simulate("examples/short.yaml", seed=1)
    >>> figure = fd.plot(fd.solve(trial), "track", trial=trial)
    """
    known = drawings(solution, trial)
    if figure not in known:
        raise ConfigError(f"there is no figure {figure!r}", expected=f"one of {', '.join(known)}")
    return known[figure](None if axes is None else _place_of(axes))


def drawings(solution: Solution, trial: Trial | None) -> dict[str, Drawing]:
    """Return by name what draws each figure of a solution for which there is something to draw."""
    thinned = replace(solution, trajectory=_thinned(solution.trajectory))
    reference = None if trial is None else trial.reference
    errors = trajectory_errors(thinned, reference) if reference is not None else None
    if errors is not None and errors.time.size == 0:
        errors = None
    figures: dict[str, Drawing] = {}
    if solution.trajectory.time.size:
        others = solution.hypotheses[1:]
        figures["track"] = lambda into: track_figure(
            trial, thinned.trajectory, errors, others, into=into
        )
        figures["motion"] = lambda into: motion_figure(solution.trajectory, errors, into=into)
    for sensor, group in _by_sensor(solution.residuals).items():
        figures[f"{sensor.lower()}_residuals"] = partial(_residuals, group)
    if trial is not None and trial.beams is not None and calibrates(solution, trial.beams):
        quality = beam_quality(trial.beams, calibration_of(trial.beams, solution))
        if np.isfinite(quality.error_velocity).any():
            figures["beam_quality"] = lambda into: beam_quality_figure(quality, into=into)
    if solution.estimates:
        truth = {} if trial is None else trial.calibration_truth
        figures["calibration"] = lambda into: calibration_figure(solution, truth, into=into)
    if np.count_nonzero(np.diagonal(solution.covariance) > 0.0) > 1:
        figures["correlation"] = lambda into: correlation_figure(solution, into=into)
    if solution.error_budget:
        figures["error_budget"] = lambda into: error_budget_figure(solution, into=into)
    return figures


def _residuals(group: Sequence[Residuals], into: SubFigure | None) -> Canvas:
    return residuals_figure(group, into=into)


def _place_of(axes: Axes) -> SubFigure:
    """Return an empty part of a figure in the place of axes, which it takes out of the figure."""
    figure, place = axes.figure, axes.get_position()
    axes.remove()
    part = figure.add_subfigure(GridSpec(1, 1, cast(Figure, figure))[0, 0])
    # Matplotlib places a part by the ratios of its grid alone.
    part.bbox_relative.p0, part.bbox_relative.p1 = place.p0, place.p1
    return part


def _thinned(trajectory: Trajectory) -> Trajectory:
    """Return every k-th epoch of a trajectory, so that not too many remain."""
    k = -(-trajectory.time.size // _LARGEST_TRAJECTORY)
    if k == 1:
        return trajectory
    return rows_of(trajectory, slice(None, None, k))


def _by_sensor(residuals: Sequence[Residuals]) -> dict[str, list[Residuals]]:
    """Group residuals by the first word of their label; empty ones are left out."""
    groups: dict[str, list[Residuals]] = {}
    for r in residuals:
        if r.time.size:
            groups.setdefault(r.label.split()[0], []).append(r)
    return groups
