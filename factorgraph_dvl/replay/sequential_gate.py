"""Measurements of a window against its prediction: each kind one after another, and gated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.graph.problem import Evaluation, Problem, Rows
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.replay.gate import InnovationGate
from factorgraph_dvl.replay.update import Innovations
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Standard deviations beyond which a measurement does not change the prediction of the next.
# Chosen: as of the gate.
_LIMIT = 6.0


@dataclass(frozen=True)
class Judged:
    """What was measured against what was predicted.

    Parameters
    ----------
    innovations : tuple of Innovations
        Of each kind.
    rejected : dict of str to ndarray
        By label, times (K,) of the measurements that are not to be used, s.
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
        Of the same variables, without the measurements.
    new : mapping of str to ndarray of bool
        Measurements (M,) by label.
    gate : InnovationGate
        Gate, which remembers what it sees.
    """
    by_label = {b.observation.label: b for b in problem.bound}
    rows = []
    for each in problem.observation_rows(evaluation):
        own = each.begin + np.flatnonzero(new[each.source][each.begin :][: len(each.vector)])
        if own.size:
            rows.append((own, _some(each, own - each.begin)))
    if not rows:
        return Judged((), {}, ())
    # Of the variables of all new measurements.
    place: dict[int, slice] = {}
    size = 0
    for _, each in rows:
        for keys in each.keys.tolist():
            for key, width in zip(keys, each.sizes, strict=True):
                if key not in place:
                    place[key] = slice(size, size + width)
                    size += width
    step = predicted.solution()
    off, every = np.empty(size), {}
    for key, columns in place.items():
        off[columns] = step.at(key)
        every[key] = np.eye(size)[:, columns]
    P = predicted.covariance_of([every])
    innovations, rejected, findings = [], {}, []
    for own, each in rows:
        o = by_label[each.source].observation
        matrix = _scattered(each, place, size)
        residual = each.vector.ravel() + matrix @ off
        found, spread = _one_after_another(residual, matrix @ P @ matrix.T, each.vector.shape)
        weight = by_label[each.source].weight[own]
        there = weight > 0.0
        found, spread = (np.where(there, x, np.nan) for x in (found, spread))
        used, finding = gate.accept(o.label, found / spread, o.gate)
        findings += [] if finding is None else [finding]
        if not used.all():
            rejected[o.label] = o.time[own][~used]
        scale = np.where(there, weight, 1.0)
        innovations.append(
            Innovations(
                o.label, o.unit, o.components, o.time[own], found / scale, spread / scale, used
            )
        )
    return Judged(tuple(innovations), rejected, tuple(findings))


def _some(rows: Rows, some: IntArray) -> Rows:
    """Return the rows of some measurements."""
    return Rows(
        rows.source,
        rows.components,
        rows.keys[some],
        rows.sizes,
        rows.matrix[some],
        rows.vector[some],
    )


def _scattered(rows: Rows, place: Mapping[int, slice], size: int) -> Array:
    """Return the Jacobian of rows by all variables that have a place, (M d, size)."""
    out = np.zeros((*rows.vector.shape, size))
    edges = np.cumsum([0, *rows.sizes])
    for i, keys in enumerate(rows.keys.tolist()):
        for key, first, last in zip(keys, edges[:-1], edges[1:], strict=True):
            out[i, :, place[key]] += rows.matrix[i, :, first:last]
    return out.reshape(-1, size)


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
        Of the prediction.
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
