"""Correlated errors of the sensors in a replay: one vector of unit variance beside every state.

The batch solver puts nodes a share of the correlation time apart. Here every state has one: the
window then keeps and marginalises them as it does a bias that walks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.graph.sensor_factor import NodeMeasurements

# Least variance of an innovation. Chosen: the last node of a batch solution may be that of the
# first state, and equal it.
_LEAST_VARIANCE = 1e-6


@dataclass(frozen=True, eq=False)
class CorrelatedErrors:
    """First-order Gauss-Markov processes of the kinds of measurements that have one.

        c_{k+1} = phi c_k + noise of variance 1 - phi²,    phi = exp(-dt / tau)

    Parameters
    ----------
    places : mapping of str to slice
        Components of each kind of measurement, by its label.
    sigma : ndarray, shape (n,), SI
        Standard deviation of each component.
    tau : ndarray, shape (n,), s
        Correlation time of each component.
    """

    places: Mapping[str, slice]
    sigma: Array
    tau: Array

    @classmethod
    def of(cls, processes: Sequence[Process]) -> CorrelatedErrors:
        """Return the errors of a batch solution that add to measurements."""
        own = [p for p in processes if p.sigma.any()]
        ends = np.cumsum([0, *(p.sigma.size for p in own)]).tolist()
        none = np.empty(0)
        return cls(
            {p.label: slice(a, b) for p, a, b in zip(own, ends, ends[1:], strict=False)},
            np.concatenate([none, *(p.sigma for p in own)]),
            np.concatenate([none, *(p.tau for p in own)]),
        )

    @property
    def size(self) -> int:
        """Components of all kinds together."""
        return self.sigma.size

    def after(self, duration: float) -> Array:
        """Return the share (n,) of errors that is left after some seconds."""
        return np.asarray(np.exp(-max(duration, 0.0) / self.tau))

    def transition(self, k: int, duration: float) -> gtsam.LinearContainerFactor:
        """Return the factor of the errors at state k and at the next, some seconds after it."""
        phi = self.after(duration)
        weight = _weight(phi)
        values = gtsam.Values()
        before, after = keys.correlated(k), keys.correlated(k + 1)
        values.insert(before, np.zeros(self.size))
        values.insert(after, np.zeros(self.size))
        linear = gtsam.JacobianFactor(
            before,
            np.diag(-phi * weight),
            after,
            np.diag(weight),
            np.zeros(self.size),
            gtsam.noiseModel.Unit.Create(self.size),
        )
        return gtsam.LinearContainerFactor(linear, values)

    def add_start(
        self,
        gaussian: gtsam.GaussianFactorGraph,
        processes: Sequence[Process],
        nodes: Mapping[str, Array],
        k: int,
        time: float,
    ) -> Array:
        """Tie the errors at state k to the last nodes of a batch solution.

        Parameters
        ----------
        gaussian : gtsam.GaussianFactorGraph
            Its factors, to which those of the errors are added.
        processes : sequence of Process
            Its processes.
        nodes : mapping of str to ndarray
            Their nodes (J, size), by the names of the processes.
        k, time : int or float
            The state, and its time, s.

        Returns
        -------
        ndarray, shape (n,)
            The errors at state k where the factors are linear.
        """
        out = np.zeros(self.size)
        for process in processes:
            place = self.places.get(process.label)
            if place is None:
                continue
            own = process.sigma.size
            phi = self.after(time - float(process.time[-1]))[place]
            weight = _weight(phi)
            by_last, by_first = np.zeros((own, process.size)), np.zeros((own, self.size))
            by_last[:, :own] = np.diag(-phi * weight)
            by_first[:, place] = np.diag(weight)
            out[place] = phi * nodes[process.name][-1, :own]
            gaussian.add(
                process.key(process.time.size - 1),
                by_last,
                keys.correlated(k),
                by_first,
                np.zeros(own),
                gtsam.noiseModel.Unit.Create(own),
            )
        return out

    def gains(self, measured: NodeMeasurements, duration: float) -> tuple[Array, Array]:
        """Return derivatives (R, n) of residuals by the errors at the states before and after.

        The error at a measurement is interpolated between those of the states.

        Parameters
        ----------
        measured : NodeMeasurements
            Measurements of R components in all.
        duration : float, s
            Time between the states.
        """
        after = np.clip(measured.attachment.tau / duration, 0.0, 1.0)
        rows = []
        for r in measured.rows:
            d = len(r.observation.components)
            own = np.zeros((r.time.size, d, self.size))
            place = self.places.get(r.observation.label)
            if place is not None:
                own[:, :, place] = np.diag(self.sigma[place])
            rows.append(own.reshape(-1, self.size))
        whole = np.concatenate(rows)
        share = np.concatenate(
            [after[r.at].repeat(len(r.observation.components)) for r in measured.rows]
        )[:, None]
        return (1.0 - share) * whole, share * whole


def _weight(phi: Array) -> Array:
    """Return the inverse standard deviations of innovations, (n,)."""
    return np.asarray(1.0 / np.sqrt(np.maximum(1.0 - phi**2, _LEAST_VARIANCE)))
