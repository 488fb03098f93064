"""Updates of a replay: what is known after each segment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.replay.calibration import CalibrationEstimate


@dataclass(frozen=True)
class Innovations:
    """Innovations of M measurements of one kind.

    Parameters
    ----------
    label, unit : str
        Name of the kind, and unit of its residuals.
    components : tuple of str
        Names of the d components.
    time : ndarray, shape (M,), s
        Times as in the record.
    residual, sigma : ndarray, shape (M, d)
        Predicted - measured, and its standard deviation; nan where a component was not measured.
    used : ndarray, shape (M,)
        Whether the innovation gate accepted the measurement.
    """

    label: str
    unit: str
    components: tuple[str, ...]
    time: Array
    residual: Array
    sigma: Array
    used: np.ndarray


@dataclass(frozen=True)
class Update:
    """What is known after one more segment.

    Parameters
    ----------
    time : float
        Time of the newest state, s.
    latency : float
        Time that the update took to compute, s, without what is computed when it is read.
    find_state, find_trajectory, find_calibration : callable
        Return `state`, `trajectory` and `calibration`, of what was known at the update.
    smoothed : Trajectory or None
        Earlier epochs, smoothed with later data; None if there are none this time.
    innovations : tuple of Innovations
        Measured against predicted, one entry for each kind of measurement.
    findings : tuple of Finding
        What the user must know since the update before.
    solved : bool
        Whether the update includes a batch solution.
    inconsistent : tuple of str
        Kinds of measurements whose innovations are larger than predicted: do not trust the
        standard deviations while there are any.
    """

    time: float
    latency: float
    find_state: Callable[[], Trajectory]
    find_trajectory: Callable[[], Trajectory]
    find_calibration: Callable[[], CalibrationEstimate]
    smoothed: Trajectory | None
    innovations: tuple[Innovations, ...]
    findings: tuple[Finding, ...]
    solved: bool
    inconsistent: tuple[str, ...]

    @cached_property
    def state(self) -> Trajectory:
        """The newest state, as a trajectory of one epoch."""
        return self.find_state()

    @cached_property
    def trajectory(self) -> Trajectory:
        """The motion since the update before, at the epochs of a batch solution."""
        return self.find_trajectory()

    @cached_property
    def calibration(self) -> CalibrationEstimate:
        """The calibration with its joint covariance."""
        return self.find_calibration()
