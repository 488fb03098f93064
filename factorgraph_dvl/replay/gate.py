"""Measurements against their prediction: which are used, one by one and kind by kind."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.graph.problem import Evaluation, Problem, Rows
from factorgraph_dvl.graph.sensor_factor import NodeMeasurements
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay.record import Innovations
from factorgraph_dvl.sensors.protocol import Observation
from factorgraph_dvl.statistics.rows import product
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Standard deviations beyond which a measurement is rejected; chosen: 2e-9 of Gaussian errors.
_LIMIT = 6.0
# Measurements of a kind that are judged together, and fewest that suffice to exclude it; chosen:
# 5 s of a DVL at 10 Hz, and 1 s.
_WINDOW = 50
_LEAST = 10
# Share of the window beyond the limit from which a kind is excluded, and up to which it is used
# again; chosen: far above single outliers, and far below that of a faulty sensor.
_EXCLUDE_SHARE = 0.3
_READMIT_SHARE = 0.05
# The same for kinds with outliers of their own, such as echoes; chosen: half may be echoes.
_EXCLUDE_SHARE_ECHOES = 0.6
_READMIT_SHARE_ECHOES = 0.4
# RMS of the window's normalised innovations from which a kind is inconsistent, excluded, and
# consistent again; chosen. Measured on Gaussian innovations: the RMS of 50 exceeds 1.3 in 1e-6.
_INCONSISTENT_RMS = 1.5
_EXCLUDE_RMS = 3.0
_CONSISTENT_RMS = 1.3


class InnovationGate:
    """Decides for each kind of measurement which are used, by their normalised innovations.

    Attributes
    ----------
    rejected : Counter
        Number of measurements that were not used, by kind.
    inconsistent : set of str
        Kinds whose innovations are larger than predicted at the moment.
    excluded : set of str
        Those among them of which nothing is used.
    """

    def __init__(self) -> None:
        # By kind, of the last measurements: whether each is an outlier, and its mean square, 0 of
        # an outlier.
        self._windows: dict[str, tuple[deque[bool], deque[float]]] = {}
        self.inconsistent: set[str] = set()
        self.excluded: set[str] = set()
        self.rejected: Counter[str] = Counter()

    def accept(
        self, label: str, normalised: Array, echo_limit: float | None = None
    ) -> tuple[np.ndarray, Finding | None]:
        """Return which of M measurements are used, and a finding if a kind's status changes.

        Parameters
        ----------
        label : str
            Name of the kind.
        normalised : ndarray, shape (M, d)
            Innovations over their standard deviations; nan where a component was not measured.
        echo_limit : float, optional
            Standard deviations beyond which a measurement is an outlier of the kind, such as an
            echo; None for kinds without.

        Returns
        -------
        ndarray, shape (M,)
            Whether each measurement is used.
        Finding or None
            What changed; None if nothing did.
        """
        if label not in self._windows:
            self._windows[label] = deque(maxlen=_WINDOW), deque(maxlen=_WINDOW)
        outliers, squares = self._windows[label]
        limit = _LIMIT if echo_limit is None else echo_limit
        # A few numbers at a time: plain ones take a tenth of the time of arrays.
        rows = normalised.tolist()
        beyond = [any(abs(x) >= limit for x in row) for row in rows]
        outliers.extend(beyond)
        squares.extend(
            0.0 if outlier else _mean_square(row)
            for outlier, row in zip(beyond, rows, strict=True)
        )
        finding = self._judge(label, limit, echo_limit is not None)
        excluded = label in self.excluded
        used = [not (excluded or outlier) for outlier in beyond]
        self.rejected[label] += used.count(False)
        return np.array(used, dtype=bool), finding

    def compared(
        self, o: Observation, time: Array, found: Array, spread: Array
    ) -> tuple[Innovations, list[Finding]]:
        """Return innovations (M, d) of a kind at times (M,), s, and what changes by them.

        Parameters
        ----------
        o : Observation
            The kind.
        time : ndarray, shape (M,), s
            Times of the measurements.
        found, spread : ndarray, shape (M, d)
            Innovations and their standard deviations; nan where a component was not measured.
        """
        used, finding = self.accept(o.label, found / spread, o.gate)
        innovations = Innovations(o.label, o.unit, o.components, time, found, spread, used)
        return innovations, [] if finding is None else [finding]

    def _judge(self, label: str, limit: float, echoes: bool) -> Finding | None:
        readmit, exclude = (
            (_READMIT_SHARE_ECHOES, _EXCLUDE_SHARE_ECHOES)
            if echoes
            else (_READMIT_SHARE, _EXCLUDE_SHARE)
        )
        # Outliers are rejected one by one and say nothing of the others.
        outliers, squares = self._windows[label]
        count, total = sum(outliers), len(outliers)
        share = count / total
        rms = math.sqrt(math.fsum(squares) / (total - count)) if count < total else math.inf
        full = total == _WINDOW
        if label in self.inconsistent:
            if full and share <= readmit and rms < _CONSISTENT_RMS:
                self.inconsistent.discard(label)
                self.excluded.discard(label)
                return Finding(Code.HEARD_AGAIN, message("heard_again.consistent"), label)
        elif full and rms > _INCONSISTENT_RMS:
            self.inconsistent.add(label)
            if rms <= _EXCLUDE_RMS and share <= exclude:
                return Finding(
                    Code.CONTRADICTS,
                    message("contradicts.larger", count=_WINDOW, ratio=rms),
                    label,
                )
        if label not in self.excluded and (
            (total >= _LEAST and share > exclude) or (full and rms > _EXCLUDE_RMS)
        ):
            self.inconsistent.add(label)
            self.excluded.add(label)
            text = message("contradicts.excluded", count=_WINDOW, ratio=rms)
            if share > exclude:
                text = message(
                    "contradicts.excluded_beyond", count=count, total=total, limit=limit
                )
            return Finding(Code.CONTRADICTS, text, label)
        return None


def _mean_square(row: list[float]) -> float:
    """Return the mean square of the finite numbers of a row, nan if there are none."""
    squares = [x * x for x in row if math.isfinite(x)]
    return math.fsum(squares) / len(squares) if squares else math.nan


def gated(
    measured: NodeMeasurements,
    residual: Array,
    variance: Array,
    sigma: Array,
    gate: InnovationGate,
) -> tuple[list[Array], list[Innovations], list[Finding]]:
    """Return inverse standard deviations of measurements, 0 for those that the gate rejects.

    Parameters
    ----------
    measured : NodeMeasurements
        Measurements of R components in all.
    residual : ndarray, shape (R,)
        Predicted - measured.
    variance : ndarray, shape (R,)
        Variance of the prediction.
    sigma : ndarray, shape (R,)
        Standard deviation of the residual without that of the prediction.
    gate : InnovationGate
        Gate, which remembers what it sees.

    Returns
    -------
    weights : list of ndarray, each (M, d)
        Inverse standard deviations of each kind.
    innovations : list of Innovations
        Innovations of each kind.
    findings : list of Finding
        What the gate noticed.
    """
    there = np.isfinite(sigma)
    total = np.sqrt(variance + sigma**2)
    all_found, all_spread = np.where(there, (residual, total), np.nan)
    weights, innovations, findings = [], [], []
    first = 0
    for b in measured.bound:
        o = b.observation
        shape = b.weight.shape
        part = slice(first, first + shape[0] * shape[1])
        first = part.stop
        found, spread = all_found[part].reshape(shape), all_spread[part].reshape(shape)
        own, finding = gate.compared(o, o.time, found, spread)
        findings += finding
        weights.append(own.used[:, None] / sigma[part].reshape(shape))
        innovations.append(own)
    return weights, innovations, findings


@dataclass(frozen=True)
class Judged:
    """What was measured against what was predicted.

    Parameters
    ----------
    innovations : tuple of Innovations
        Innovations of each kind.
    rejected : dict of str to ndarray
        Times (K,), s, of the measurements of each label that are not to be used.
    findings : tuple of Finding
        What the gate noticed.
    """

    innovations: tuple[Innovations, ...]
    rejected: dict[str, Array]
    findings: tuple[Finding, ...]


def judged(
    problem: Problem,
    evaluation: Evaluation,
    predicted: SquareRootInformation,
    new: Mapping[str, BoolArray],
    gate: InnovationGate,
) -> Judged:
    """Compare measurements with the prediction of a window.

    Parameters
    ----------
    problem : Problem
        Weighed at the evaluation.
    evaluation : Evaluation
        Where it is linear.
    predicted : SquareRootInformation
        Square-root information of the same variables, without the measurements.
    new : mapping of str to ndarray of bool
        Measurements (M,) by label.
    gate : InnovationGate
        Gate, which remembers what it sees.
    """
    by_label = {b.observation.label: b for b in problem.bound}
    parts: list[tuple[IntArray, Rows]] = []
    sizes: dict[int, int] = {}
    for each in problem.observation_rows(evaluation):
        own = each.begin + np.flatnonzero(new[each.source][each.begin :][: len(each.vector)])
        if own.size:
            matrix, vector = (part[own - each.begin] for part in (each.matrix, each.vector))
            keys = each.keys[own - each.begin]
            parts.append((own, replace(each, keys=keys, matrix=matrix, vector=vector)))
            for column, size in zip(keys.T, each.sizes, strict=True):
                sizes |= dict.fromkeys(column.tolist(), size)
    if not parts:
        return Judged((), {}, ())
    P = predicted.covariance_of([{key: np.eye(size)} for key, size in sizes.items()])
    ends = np.cumsum([*sizes.values()])
    of_all = dict(zip(sizes, np.split(np.eye(len(P)), ends[:-1]), strict=True))
    step = predicted.solution()
    off = np.concatenate([step.at(key) for key in sizes])
    innovations, rejected, findings = [], {}, []
    for own, rows in parts:
        matrix = product(rows, of_all).reshape(-1, len(P))
        residual = rows.vector.ravel() + matrix @ off
        found, spread = _one_after_another(residual, matrix @ P @ matrix.T, rows.vector.shape)
        o, weight = by_label[rows.source].observation, by_label[rows.source].weight[own]
        scale = np.where(weight > 0.0, weight, np.nan)
        innovation, finding = gate.compared(o, o.time[own], found / scale, spread / scale)
        findings += finding
        if not innovation.used.all():
            rejected[o.label] = innovation.time[~innovation.used]
        innovations.append(innovation)
    return Judged(tuple(innovations), rejected, tuple(findings))


def _one_after_another(
    residual: Array, covariance: Array, shape: tuple[int, int]
) -> tuple[Array, Array]:
    """Return innovations, each predicted with those before it, and their standard deviations.

    Measurements that are all compared with one prediction share its error.

    Parameters
    ----------
    residual : ndarray, shape (M d,)
        Predicted - measured, in units of the noise of each.
    covariance : ndarray, shape (M d, M d)
        Covariance of the prediction.
    shape : tuple of int
        (M, d).
    """
    residual, covariance = residual.copy(), covariance + np.eye(residual.size)
    found, spread = np.empty(shape), np.empty(shape)
    for i in range(shape[0]):
        own = slice(i * shape[1], (i + 1) * shape[1])
        found[i], spread[i] = residual[own], np.sqrt(np.diag(covariance)[own])
        if np.all(np.abs(found[i]) < _LIMIT * spread[i]):
            gain = np.linalg.solve(covariance[own, own], covariance[own]).T
            residual -= gain @ found[i]
            covariance -= gain @ covariance[own]
    return found, spread
