"""Figures of a solution, as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from factorgraph_dvl.analysis.beam_quality import beam_quality, calibrates, calibration_of
from factorgraph_dvl.analysis.error_statistics import trajectory_errors
from factorgraph_dvl.report.figures.beams import beam_quality_figure
from factorgraph_dvl.report.figures.calibration import calibration_figure, correlation_figure
from factorgraph_dvl.report.figures.drawing import save_figures
from factorgraph_dvl.report.figures.error_budget import error_budget_figure
from factorgraph_dvl.report.figures.residuals import residuals_figure
from factorgraph_dvl.report.figures.trajectory import motion_figure, track_figure
from factorgraph_dvl.solution import Residuals, Solution, Trajectory
from factorgraph_dvl.trial import PlanarTrial, Trial

_LARGEST_TRAJECTORY = 20_000


def write_figures(trial: Trial | PlanarTrial, solution: Solution, folder: Path) -> list[Path]:
    """Draw a solution: track, motion, residuals, calibration, correlation.

    Figures for which there is nothing to draw are left out. Long lines are drawn as
    the envelope of what they pass through, which looks the same.

    Parameters
    ----------
    trial : Trial or PlanarTrial
        For its GNSS fixes, reference and true calibration.
    solution : Solution
        What to draw.
    folder : path-like
        Where the PNG files go; created if needed.

    Returns
    -------
    list of Path
        The files: `track.png`, `motion.png`, `<sensor>_residuals.png` of each sensor with
        residuals, `beam_quality.png`, `calibration.png`, `correlation.png`,
        `error_budget.png`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    thinned = replace(solution, trajectory=_thinned(solution.trajectory))
    reference = trial.reference
    errors = trajectory_errors(thinned, reference) if reference is not None else None
    if errors is not None and errors.time.size == 0:
        errors = None

    figures = {
        "track": track_figure(trial, thinned.trajectory, errors, solution.hypotheses[1:]),
        "motion": motion_figure(solution.trajectory, errors),
    }
    for sensor, group in _by_sensor(solution.residuals).items():
        figures[f"{sensor.lower()}_residuals"] = residuals_figure(group)
    if trial.beams is not None and calibrates(solution, trial.beams):
        quality = beam_quality(trial.beams, calibration_of(trial.beams, solution))
        if np.isfinite(quality.error_velocity).any():
            figures["beam_quality"] = beam_quality_figure(quality)
    if solution.estimates:
        figures["calibration"] = calibration_figure(solution, trial.calibration_truth)
    if np.count_nonzero(np.diagonal(solution.covariance) > 0.0) > 1:
        figures["correlation"] = correlation_figure(solution)
    if solution.error_budget:
        figures["error_budget"] = error_budget_figure(solution)

    return save_figures(figures, folder, solution.verdict)


def _thinned(trajectory: Trajectory) -> Trajectory:
    """Return every k-th epoch of a trajectory, so that not too many remain."""
    k = -(-trajectory.time.size // _LARGEST_TRAJECTORY)
    if k == 1:
        return trajectory
    return Trajectory(*(getattr(trajectory, name)[::k] for name in trajectory.__annotations__))


def _by_sensor(residuals: Sequence[Residuals]) -> dict[str, list[Residuals]]:
    """Group residuals by the first word of their label; empty ones are left out."""
    groups: dict[str, list[Residuals]] = {}
    for r in residuals:
        if r.time.size:
            groups.setdefault(r.label.split()[0], []).append(r)
    return groups
