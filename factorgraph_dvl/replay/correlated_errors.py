"""Correlated errors of the sensors in a replay: one vector of unit variance beside every state.

The batch solver puts nodes a share of the correlation time apart. Here every state has one: the
window then keeps and marginalises them as it does a bias that walks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.processes import Process, walk_sigma, walk_time
from factorgraph_dvl.graph.sensor_factor import NodeMeasurements

# Least variance of an innovation. Chosen: the last node of a batch solution may be that of the
# first state, and equal it.
_LEAST_VARIANCE = 1e-6


@dataclass(frozen=True, eq=False)
class CorrelatedErrors:
    """First-order Gauss-Markov processes of the kinds of measurements that have one.

        c_{k+1} = phi c_k + noise of variance 1 - phi²,    phi = exp(-dt / tau)

    A scale that walks at random has phi = 1, and a variance that grows with time.

    Parameters
    ----------
    places : mapping of str to slice
        Components that add to each kind of measurement, by its label.
    walks : mapping of str to (str, int)
        Scale error that walks, and the component that does, by the label of the kind.
    sigma : ndarray, shape (n,), SI
        Standard deviation of each component; that of a walk is its unit.
    tau : ndarray, shape (n,), s
        Correlation time of each component; infinite for a walk.
    growth : ndarray, shape (n,), 1/s
        Growth of the variance of each component; 0 but for a walk.
    """

    places: Mapping[str, slice]
    walks: Mapping[str, tuple[str, int]]
    sigma: Array
    tau: Array
    growth: Array

    @classmethod
    def of(cls, processes: Sequence[Process]) -> CorrelatedErrors:
        """Return the errors of a batch solution."""
        places: dict[str, slice] = {}
        walks: dict[str, tuple[str, int]] = {}
        sigma, tau, growth = [np.empty(0)], [np.empty(0)], [np.empty(0)]
        size = 0
        for p in processes:
            if p.sigma.any():
                places[p.label] = slice(size, size + p.sigma.size)
                size += p.sigma.size
                sigma.append(p.sigma)
                tau.append(p.tau)
                growth.append(np.zeros(p.sigma.size))
            if p.walk is not None:
                walks[p.label] = p.walk.parameter, size
                size += 1
                unit = walk_sigma(p.walk, walk_time(p.time))
                sigma.append(np.array([unit]))
                tau.append(np.array([np.inf]))
                growth.append(np.array([(p.walk.rate / unit) ** 2]))
        return cls(places, walks, *(np.concatenate(each) for each in (sigma, tau, growth)))

    @property
    def size(self) -> int:
        """Components of all kinds together."""
        return self.sigma.size

    def after(self, duration: float) -> Array:
        """Return the share (n,) of errors that is left after some seconds."""
        return np.asarray(np.exp(-max(duration, 0.0) / self.tau))

    def _weight(self, duration: float) -> Array:
        """Return the inverse standard deviations of innovations, (n,)."""
        variance = 1.0 - self.after(duration) ** 2 + self.growth * duration
        return np.asarray(1.0 / np.sqrt(np.maximum(variance, _LEAST_VARIANCE)))

    def transition(self, k: int, duration: float) -> gtsam.LinearContainerFactor:
        """Return the factor of the errors at state k and at the next, some seconds after it."""
        weight = self._weight(duration)
        values = gtsam.Values()
        before, after = keys.correlated(k), keys.correlated(k + 1)
        values.insert(before, np.zeros(self.size))
        values.insert(after, np.zeros(self.size))
        linear = gtsam.JacobianFactor(
            before,
            np.diag(-self.after(duration) * weight),
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
            duration = time - float(process.time[-1])
            phi, weight = self.after(duration), self._weight(duration)
            own, place = self._columns(process)
            if not own.size:
                continue
            rows = np.arange(own.size)
            by_last, by_first = np.zeros((own.size, process.size)), np.zeros((own.size, self.size))
            by_last[rows, own] = -(phi * weight)[place]
            by_first[rows, place] = weight[place]
            out[place] = phi[place] * nodes[process.name][-1, own]
            gaussian.add(
                process.key(process.time.size - 1),
                by_last,
                keys.correlated(k),
                by_first,
                np.zeros(own.size),
                gtsam.noiseModel.Unit.Create(own.size),
            )
        return out

    def _columns(self, process: Process) -> tuple[IntArray, IntArray]:
        """Return components of a node of a batch solution, and their places in the vector."""
        n = process.sigma.size
        own, place = np.empty(0, dtype=int), np.empty(0, dtype=int)
        if process.label in self.places:
            own, place = np.arange(n), np.r_[self.places[process.label]]
        if process.label in self.walks:
            own, place = np.append(own, n), np.append(place, self.walks[process.label][1])
        return own, place

    def gains(self, measured: NodeMeasurements, duration: float) -> tuple[Array, Array]:
        """Return derivatives (R, n) of residuals by the errors at the states before and after.

        The error at a measurement is interpolated between those of the states. A walk multiplies
        what was measured: its noise changes the product by less than a thousandth of itself.

        Parameters
        ----------
        measured : NodeMeasurements
            Measurements of R components in all.
        duration : float, s
            Time between the states.
        """
        rows, shares = [], []
        for b in measured.bound:
            o = b.observation
            own = np.zeros((*b.weight.shape, self.size))
            place = self.places.get(o.label)
            if place is not None:
                own[:, :, place] = np.diag(self.sigma[place])
            if o.label in self.walks and o.scale_walk is not None:
                _, i = self.walks[o.label]
                own[:, :, i] = self.sigma[i] * o.scale_walk.measured
            rows.append(own.reshape(-1, self.size))
            after = np.clip(b.attachment.forward.tau / duration, 0.0, 1.0)
            shares.append(after.repeat(len(o.components)))
        whole, share = np.concatenate(rows), np.concatenate(shares)[:, None]
        return (1.0 - share) * whole, share * whole
