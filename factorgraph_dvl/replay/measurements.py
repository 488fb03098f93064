"""Measurements of one segment against their prediction."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.sensor_factor import NodeMeasurements
from factorgraph_dvl.replay.gate import InnovationGate
from factorgraph_dvl.replay.update import Innovations
from factorgraph_dvl.sensors.finding import Finding


def gated(
    measured: NodeMeasurements,
    residual: Array,
    jacobian: Array,
    sigma: Array,
    P: Array,
    gate: InnovationGate,
) -> tuple[list[Array], list[Innovations], list[Finding]]:
    """Return inverse standard deviations of measurements, 0 for those that the gate rejects.

    Parameters
    ----------
    measured : NodeMeasurements
        Measurements of R components in all.
    residual : ndarray, shape (R,)
        Predicted - measured.
    jacobian : ndarray, shape (R, 15 + n)
        Derivatives with respect to state, bias and the n parameters.
    sigma : ndarray, shape (R,)
        Standard deviation of the residual without that of the prediction.
    P : ndarray, shape (15 + n, 15 + n)
        Joint covariance of these.
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
    total = np.sqrt(((jacobian @ P) * jacobian).sum(axis=1) + sigma**2)
    all_found, all_spread = np.where(there, (residual, total), np.nan)
    weights, innovations, findings = [], [], []
    first = 0
    for b in measured.bound:
        o = b.observation
        shape = b.weight.shape
        part = slice(first, first + shape[0] * shape[1])
        first = part.stop
        found, spread = all_found[part].reshape(shape), all_spread[part].reshape(shape)
        used, finding = gate.accept(o.label, found / spread, o.gate)
        findings += [] if finding is None else [finding]
        weights.append(used[:, None] / sigma[part].reshape(shape))
        innovations.append(Innovations(o.label, o.unit, o.components, o.time, found, spread, used))
    return weights, innovations, findings
