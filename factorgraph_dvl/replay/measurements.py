"""Measurements of one segment: attached to the state before it, and gated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.clocks import parameters_of, true_time
from factorgraph_dvl.graph.sensor_factor import AttachedMeasurements, NodeMeasurements
from factorgraph_dvl.graph.trajectory import Epochs, attached_epochs
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.replay.gate import InnovationGate
from factorgraph_dvl.replay.start import ReplayStart
from factorgraph_dvl.replay.update import Innovations
from factorgraph_dvl.sensors.protocol import Aid


def attached(
    aids: Sequence[Aid],
    seg: Segments,
    gravity_n: Array,
    start: ReplayStart,
    values: Mapping[str, Array],
    epochs: Array,
) -> tuple[NodeMeasurements | None, Epochs]:
    """Return what was measured in a segment, and epochs of the trajectory in it.

    Both at once: attaching few times takes as long as attaching one.

    Parameters
    ----------
    aids : sequence of Aid
        Records of the sensors.
    seg : Segments
        The segment.
    gravity_n : ndarray, shape (1, 3)
        `LocalFrame.gravity_without_rotation` along it, m/s².
    start : ReplayStart
        Frame and parameters.
    values : mapping of str to ndarray
        Values of all parameters, SI.
    epochs : ndarray, shape (M,)
        Times in the segment, s.

    Returns
    -------
    measured : NodeMeasurements or None
        The measurements; None if there are none.
    attached_epochs : Epochs
        The epochs.
    """
    observations = [o for aid in aids for o in aid.observations(start.frame, start.body_axes)]
    rows: list[AttachedMeasurements] = []
    times: list[Array] = []
    count = 0
    for o in observations:
        time = true_time(o, values, start.clock_zero)
        if rows and np.array_equal(time, rows[-1].time):
            # Of one sensor, such as position and velocity of GNSS.
            rows.append(AttachedMeasurements(o, rows[-1].at, time))
            continue
        rows.append(AttachedMeasurements(o, slice(count, count + time.size), time))
        times.append(time)
        count += time.size
    found, at = attached_epochs(seg, epochs, start.frame.earth_rate, np.concatenate([*times, []]))
    if not rows:
        return None, found
    used = {name for o in observations for name in parameters_of(o)}
    measured = NodeMeasurements(
        attachment=at,
        rows=tuple(rows),
        parameters=tuple(p for p in start.parameters if p.name in used),
        fixed=start.fixed,
        gravity_n=gravity_n,
        earth_rate_n=start.frame.earth_rate,
        clock_zero=start.clock_zero,
    )
    return measured, found


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
    for r in measured.rows:
        o = r.observation
        shape = r.time.size, len(o.components)
        part = slice(first, first + shape[0] * shape[1])
        first = part.stop
        found, spread = all_found[part].reshape(shape), all_spread[part].reshape(shape)
        used, finding = gate.accept(o.label, found / spread, o.gate)
        findings += [] if finding is None else [finding]
        weights.append(used[:, None] / sigma[part].reshape(shape))
        innovations.append(Innovations(o.label, o.unit, o.components, o.time, found, spread, used))
    return weights, innovations, findings
