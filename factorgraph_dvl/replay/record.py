"""The record of a replay: what was known after each segment, in compact arrays."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from math import prod

import numpy as np

from factorgraph_dvl.estimates import Residuals, Trajectory
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


# Numbers of an update before its estimates: time, latency, solved, inconsistent.
_HEAD = 4


@dataclass(frozen=True)
class ReplayRecord:
    """What was known when.

    Parameters
    ----------
    time, latency : ndarray, shape (H,), s
        Times of the updates, and how long each took to compute.
    solved : ndarray, shape (H,)
        Whether an update includes a batch solution.
    inconsistent : ndarray, shape (H,)
        Whether some measurements were inconsistent with the prediction.
    names : tuple of str
        Names of the n calibration components, as in `Solution.order`.
    values, std : ndarray, shape (H, n)
        Estimates and standard deviations in reported units; nan before a component was estimated.
    smoothed : Trajectory
        Epochs of the trajectory, smoothed with later data.
    findings : tuple of tuple of (float, Finding)
        Findings, each with its time, s.
    delay : float
        Time by which estimates are behind the newest IMU sample, s.
    """

    time: Array
    latency: Array
    solved: np.ndarray
    inconsistent: np.ndarray
    names: tuple[str, ...]
    values: Array
    std: Array
    smoothed: Trajectory
    findings: tuple[tuple[float, Finding], ...]
    delay: float


class Recorder:
    """Keeps updates as rows of numbers: an object for each would fill the memory in hours."""

    def __init__(self) -> None:
        self.last: Update | None = None
        self.count = 0
        self.findings: list[tuple[float, Finding]] = []
        # By what was estimated, which grows when a sensor first reports.
        self._estimates: list[tuple[tuple[str, ...], array[float]]] = []
        self._trajectory: array[float] = array("d")
        self._smoothed: array[float] = array("d")
        self._residuals: dict[str, tuple[Innovations, array[float]]] = {}

    def add(self, update: Update) -> None:
        """Append one update."""
        self.last = update
        self.count += 1
        estimates = update.calibration.estimates
        names = tuple(name for e in estimates for name in e.component_names)
        if not self._estimates or self._estimates[-1][0] != names:
            self._estimates.append((names, array("d")))
        values = np.concatenate([np.empty(0), *(e.value for e in estimates)])
        std = np.concatenate([np.empty(0), *(e.std for e in estimates)])
        head = [update.time, update.latency, update.solved, bool(update.inconsistent)]
        self._estimates[-1][1].extend([*head, *values, *std])
        _append(self._trajectory, update.trajectory)
        if update.smoothed is not None:
            _append(self._smoothed, update.smoothed)
        for i in update.innovations:
            _, rows = self._residuals.setdefault(i.label, (i, array("d")))
            rows.frombytes(np.column_stack([i.time, i.residual, i.sigma])[i.used].tobytes())
        self.findings += [(update.time, finding) for finding in update.findings]

    def trajectory(self) -> Trajectory:
        """Return the trajectory as it was known at each time."""
        return self._read(self._trajectory)

    def residuals(self) -> tuple[Residuals, ...]:
        """Return the innovations of the measurements that were used."""
        out = []
        for i, rows in self._residuals.values():
            d = len(i.components)
            table = np.frombuffer(rows).reshape(-1, 1 + 2 * d)
            time, residual, sigma = np.split(table, [1, 1 + d], axis=1)
            out.append(Residuals(i.label, i.unit, i.components, time[:, 0], residual, sigma))
        return tuple(out)

    def record(self, delay: float) -> ReplayRecord:
        """Return the record; `delay` is that of the estimates behind the IMU, s."""
        names = self._estimates[-1][0]
        table = np.vstack([_columns(np.frombuffer(x), own, names) for own, x in self._estimates])
        values, std = np.split(table[:, _HEAD:], 2, axis=1)
        return ReplayRecord(
            time=table[:, 0],
            latency=table[:, 1],
            solved=table[:, 2] > 0.0,
            inconsistent=table[:, 3] > 0.0,
            names=names,
            values=values,
            std=std,
            smoothed=self._read(self._smoothed),
            findings=tuple(self.findings),
            delay=delay,
        )

    def _read(self, rows: array[float]) -> Trajectory:
        """Return rows as a trajectory, with the shapes of the last one."""
        assert self.last is not None
        shapes = [getattr(self.last.trajectory, f.name).shape[1:] for f in fields(Trajectory)]
        ends = np.cumsum([prod(shape) for shape in shapes])
        parts = np.split(np.frombuffer(rows).reshape(-1, ends[-1]), ends[:-1], axis=1)
        return Trajectory(
            *(p.reshape(-1, *shape).copy() for p, shape in zip(parts, shapes, strict=True))
        )


def _append(rows: array[float], trajectory: Trajectory) -> None:
    count = trajectory.time.size
    if count:
        parts = [getattr(trajectory, f.name).reshape(count, -1) for f in fields(Trajectory)]
        rows.frombytes(np.concatenate(parts, axis=1).tobytes())


def _columns(numbers: Array, own: tuple[str, ...], names: tuple[str, ...]) -> Array:
    """Return rows for some components as rows for `names`, nan where there are none."""
    table = numbers.reshape(-1, _HEAD + 2 * len(own))
    out = np.full((table.shape[0], _HEAD + 2 * len(names)), np.nan)
    out[:, :_HEAD] = table[:, :_HEAD]
    for i, name in enumerate(own):
        if name in names:
            j = names.index(name)
            out[:, [_HEAD + j, _HEAD + len(names) + j]] = table[
                :, [_HEAD + i, _HEAD + len(own) + i]
            ]
    return out
