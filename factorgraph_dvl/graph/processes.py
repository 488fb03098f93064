"""First-order Gauss-Markov processes: errors of a sensor that persist from one measurement on.

The deviation of a measurement is sigma times the linear interpolation of two nodes c of unit
variance, so that another sigma or correlation time changes factors and never their layout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph import keys

# Most of a correlation time between two nodes. Chosen: interpolation then leaves out 6 % of the
# variance.
_MOST_SPACING = 1.0 / 3.0
# Correlation times without a measurement that need no nodes. Chosen: what persists is then gone.
_GAP = 5.0


@dataclass(frozen=True, eq=False)
class Process:
    """A correlated error that adds to the components of an observation.

        c_{j+1} = phi c_j + noise of variance 1 - phi²,    phi = exp(-dt / tau)

    Parameters
    ----------
    label : str
        Label of the observation.
    index : int
        Of the process among those of the problem.
    sigma : ndarray, shape (n,), SI
        Standard deviation of each component.
    tau : ndarray, shape (n,), s
        Correlation time of each component.
    time : ndarray, shape (J,), s
        Times of the nodes.
    density_only : bool, default False
        Whether only the density 2 sigma² / tau can be estimated, and sigma is as stated.
    """

    label: str
    index: int
    sigma: Array
    tau: Array
    time: Array
    density_only: bool = False

    @property
    def name(self) -> str:
        """Name among the values of an evaluation."""
        return f"{self.label}, correlated error"

    def key(self, j: int) -> int:
        """Return the key of node j."""
        return keys.process(self.index, j)

    @property
    def zero(self) -> Array:
        """Nodes without an error, (J, n)."""
        return np.zeros((self.time.size, self.sigma.size))

    def place(self, time: Array) -> tuple[IntArray, Array]:
        """Return the nodes before times (M,), and the weights of the nodes after them."""
        j = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, self.time.size - 2)
        return j, np.clip((time - self.time[j]) / (self.time[j + 1] - self.time[j]), 0.0, 1.0)

    def error(self, nodes: Array, time: Array) -> Array:
        """Return the error (M, n) at times (M,), from the nodes (J, n)."""
        j, after = self.place(time)
        return self.sigma * ((1.0 - after)[:, None] * nodes[j] + after[:, None] * nodes[j + 1])

    def jacobians(self, time: Array) -> list[Array]:
        """Return the derivatives of the error with respect to the nodes before and after."""
        _, after = self.place(time)
        return [share[:, None, None] * np.diag(self.sigma) for share in (1.0 - after, after)]

    @property
    def _weight(self) -> Array:
        """Inverse standard deviations of the innovations, (J - 1, n)."""
        return 1.0 / np.sqrt(-np.expm1(-2.0 * np.diff(self.time)[:, None] / self.tau))

    def prior_residuals(self, nodes: Array) -> Array:
        """Return whitened residuals (J, n): the first node, then the transitions."""
        phi = np.exp(-np.diff(self.time)[:, None] / self.tau)
        steps = (nodes[1:] - phi * nodes[:-1]) * self._weight
        return np.concatenate([nodes[:1], steps])

    def add_prior(self, gaussian: gtsam.GaussianFactorGraph, nodes: Array) -> None:
        """Add the factors of `prior_residuals`, which are linear."""
        n = self.sigma.size
        residuals = self.prior_residuals(nodes)
        unit = gtsam.noiseModel.Unit.Create(n)
        gaussian.add(self.key(0), np.eye(n), -residuals[0], unit)
        phi = np.exp(-np.diff(self.time)[:, None] / self.tau)
        after = self._weight
        for j in range(len(phi)):
            gaussian.add(
                self.key(j),
                np.diag(-phi[j] * after[j]),
                self.key(j + 1),
                np.diag(after[j]),
                -residuals[j + 1],
                unit,
            )


def node_times(time: Array, tau: float, sigma: Array, white: Array) -> Array:
    """Return times of nodes that are close enough for linear interpolation.

    Between two nodes dt apart the interpolation leaves out a variance of about q dt / 6, with
    q = 2 sigma² / tau. It must stay below what white noise leaves of the mean between them,
    white² interval / dt.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the measurements. Nodes leave out what is without any for long.
    tau : float
        Correlation time, s.
    sigma, white : ndarray, shape (n,)
        Standard deviations of the process and of the white noise of each measurement.
    """
    step = np.diff(time)
    interval = float(np.median(step))
    q = 2.0 * sigma**2 / tau
    balanced = np.sqrt(6.0 * white**2 * interval / np.maximum(q, 1e-300))
    spacing = max(min(_MOST_SPACING * tau, float(balanced.min())), interval)
    ends = np.flatnonzero(step > max(_GAP * tau, 2.0 * spacing))
    parts = np.split(time, ends + 1)
    return np.concatenate(
        [
            np.linspace(p[0], p[-1], max(int(np.ceil(np.ptp(p) / spacing)), 1) + 1)
            for p in parts
            if np.ptp(p) > 0.0
        ]
    )


def in_time_order(node_time: Array, processes: Sequence[Process], *, walking: bool) -> list[int]:
    """Return the keys of states, biases and processes in the order of elimination.

    In time: a node of a process goes when the last state that depends on it has gone. COLAMD takes
    four times as long once there are processes.
    """
    items: list[tuple[float, int, int]] = []
    for k, t in enumerate(node_time.tolist()):
        items.append((t, 0, keys.node(k)))
        if walking:
            items.append((t, 1, keys.bias(k)))
    for p in processes:
        last = p.time.size - 1
        items += [(float(p.time[min(j + 1, last)]), 2, p.key(j)) for j in range(last + 1)]
    return [key for _, _, key in sorted(items)]
