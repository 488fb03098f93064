"""A recorded trial, fed to a replay as it would have arrived, and what came out."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.timestamps import without_strays
from factorgraph_dvl.replay.estimate import Innovations, Update, concatenated
from factorgraph_dvl.replay.samples import LEAST
from factorgraph_dvl.replay.session import LAG, RATE, Kind, Replay
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.solution import (
    Progress,
    Residuals,
    Solution,
    Trajectory,
    consistency_warnings,
)
from factorgraph_dvl.trial import Trial

Watch = Callable[[Update], None]


@dataclass(frozen=True)
class ReplayRecord:
    """What was known when.

    Parameters
    ----------
    time, latency : ndarray, shape (H,), s
        Of the updates.
    solved : ndarray, shape (H,)
        Updates that include a batch solution.
    doubted : ndarray, shape (H,)
        Whether some measurements disagreed with the prediction.
    names : tuple of str
        Of the n calibration components, as in `covariance.order`.
    values, std : ndarray, shape (H, n)
        In reported units; nan before the component was estimated.
    smoothed : Trajectory
        Epochs of the trajectory that later data made better.
    messages : tuple of tuple of (float, str)
        Time, s, and text.
    delay : float
        By which estimates are behind the IMU, s.
    """

    time: Array
    latency: Array
    solved: np.ndarray
    doubted: np.ndarray
    names: tuple[str, ...]
    values: Array
    std: Array
    smoothed: Trajectory
    messages: tuple[tuple[float, str], ...]
    delay: float


def replay(
    trial: Trial,
    *,
    smoother: Kind = "fixed-lag",
    lag_s: float = LAG,
    rate_hz: float = RATE,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> tuple[Solution, ReplayRecord]:
    """Feed a recorded trial in the order of time, and show what was known when.

    Parameters
    ----------
    trial : Trial
        Recorded.
    smoother, lag_s, rate_hz, progress : see `Replay`.
    watch : Watch, optional
        Called with every update.

    Returns
    -------
    Solution
        The calibration at the end, and the trajectory as it was known at each time.
    Record

    Raises
    ------
    ConfigError
        If an option is out of range.
    DataError
        If the trial has no position.
    SolveError
        If the data never sufficed to start.
    """
    trial = without_strays(trial)
    trial.frame()
    run = Replay(trial, smoother=smoother, lag_s=lag_s, rate_hz=rate_hz, progress=progress)
    tape = _Tape()
    imu = trial.imu
    step = 1.0 / rate_hz
    # Gaps cost one step, whatever their length.
    steps = np.unique(np.floor((imu.time - imu.time[0]) / step))
    edges = imu.time[0] + step * np.union1d(steps, steps + 1.0)
    edges[-1] = np.inf
    samples = np.searchsorted(imu.time, edges)
    rows = [np.searchsorted(aid.time, edges) for aid in trial.aids]
    for each in rows:
        each[0] = 0

    def take(updates: list[Update]) -> None:
        for update in updates:
            tape.add(update)
            if watch is not None:
                watch(update)

    for j, (a, b) in enumerate(pairwise(samples.tolist())):
        for aid, each in zip(trial.aids, rows, strict=True):
            first, last = each[j : j + 2].tolist()
            if last > first:
                run.add(rows_of(aid, slice(first, last)))
        if b > a:
            take(run.add_imu(imu.time[a:b], imu.gyro[a:b], imu.accel[a:b]))
    take(run.finish())
    if tape.last is None:
        why = "; ".join(run.messages) or "the record is too short"
        raise SolveError(f"the data never sufficed to start: {why}", where=trial.name)
    return _solution(trial, run, tape), tape.record(run)


class _Tape:
    """Updates, one row of numbers each."""

    def __init__(self) -> None:
        self.last: Update | None = None
        # By what was estimated, which grows when a sensor is heard for the first time.
        self._numbers: list[tuple[tuple[str, ...], array[float]]] = []
        self._trajectory: list[Trajectory] = []
        self._smoothed: list[Trajectory] = []
        self._innovations: dict[str, list[Innovations]] = {}
        self.messages: list[tuple[float, str]] = []
        self.count = 0

    def add(self, update: Update) -> None:
        self.last = update
        self.count += 1
        estimates = update.calibration.estimates
        names = tuple(name for e in estimates for name in e.component_names)
        if not self._numbers or self._numbers[-1][0] != names:
            self._numbers.append((names, array("d")))
        values = np.concatenate([e.value for e in estimates])
        std = np.concatenate([e.std for e in estimates])
        head = [update.time, update.latency, float(update.solved), float(bool(update.doubted))]
        self._numbers[-1][1].extend([*head, *values, *std])
        self._trajectory.append(update.trajectory)
        if update.smoothed is not None:
            self._smoothed.append(update.smoothed)
        for i in update.innovations:
            self._innovations.setdefault(i.label, []).append(i)
        self.messages += [(update.time, text) for text in update.messages]

    def trajectory(self) -> Trajectory:
        return concatenated(self._trajectory)

    def residuals(self) -> tuple[Residuals, ...]:
        return tuple(
            Residuals(
                label=label,
                unit=parts[0].unit,
                components=parts[0].components,
                time=np.concatenate([p.time[p.used] for p in parts]),
                residual=np.concatenate([p.residual[p.used] for p in parts]),
                sigma=np.concatenate([p.sigma[p.used] for p in parts]),
            )
            for label, parts in self._innovations.items()
        )

    def record(self, run: Replay) -> ReplayRecord:
        assert self.last is not None
        names = self._numbers[-1][0]
        n = len(names)
        table = np.vstack([_columns(np.array(x), there, names) for there, x in self._numbers])
        return ReplayRecord(
            time=table[:, 0],
            latency=table[:, 1],
            solved=table[:, 2] > 0.0,
            doubted=table[:, 3] > 0.0,
            names=names,
            values=table[:, 4 : 4 + n],
            std=table[:, 4 + n :],
            smoothed=concatenated(self._smoothed)
            if self._smoothed
            else rows_of(self.last.state, []),
            messages=tuple(self.messages),
            delay=run.delay,
        )


def _columns(numbers: Array, there: tuple[str, ...], names: tuple[str, ...]) -> Array:
    """Return rows of numbers for some components as rows for others, nan where there are none."""
    table = numbers.reshape(-1, 4 + 2 * len(there))
    if there == names:
        return table
    out = np.full((table.shape[0], 4 + 2 * len(names)), np.nan)
    out[:, :4] = table[:, :4]
    for i, name in enumerate(there):
        if name in names:
            j = names.index(name)
            out[:, [4 + j, 4 + len(names) + j]] = table[:, [4 + i, 4 + len(there) + i]]
    return out


def _solution(trial: Trial, run: Replay, tape: _Tape) -> Solution:
    assert tape.last is not None
    calibration = tape.last.calibration
    residuals = tape.residuals()
    warnings = [*trial.notes, *(f"{time:.1f} s: {text}" for time, text in tape.messages)]
    warnings += [f"at the end: {text}" for text in run.messages]
    if run.unused:
        warnings.append(
            f"the replay ended at {tape.last.time:.3f} s: {run.unused} samples of the IMU follow, "
            "and were not used with what was measured then"
        )
    warnings += run.counts()
    warnings += consistency_warnings(calibration.estimates, residuals)
    for e in calibration.estimates:
        bad = np.flatnonzero(~e.observable & (e.prior_std > 0.0))
        if bad.size:
            names = ", ".join(e.component_names[i] for i in bad)
            warnings.append(f"{names} not observable in what was measured until the end")
    known = {e.name for e in calibration.estimates}
    for aid in trial.aids:
        if any(p.estimated and p.name not in known for p in aid.parameters()):
            warnings.append(f"{aid.label} was not heard in time to be calibrated")
    if trial.imu.settings.bias_walks:
        warnings.append(
            "a bias of the IMU walks: what is reported is its value at the end, where a solution "
            "of all data at once reports the mean over the trial"
        )
    cost = 0.5 * sum(float(np.nansum((r.residual / r.sigma) ** 2)) for r in residuals)
    return Solution(
        trial=trial.name,
        solver="replay",
        body_axes=trial.body_axes,
        inputs=trial.inputs,
        converged=run.unused < LEAST and not tape.last.doubted,
        iterations=tape.count,
        cost=cost,
        estimates=calibration.estimates,
        covariance=calibration.covariance,
        trajectory=tape.trajectory(),
        residuals=residuals,
        warnings=tuple(warnings),
    )
