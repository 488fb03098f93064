"""First-order Gauss-Markov processes: errors of a sensor that persist from one measurement on.

The deviation of a measurement is sigma times the linear interpolation of two nodes c of unit
variance, so that another sigma or correlation time changes factors and never their layout. A scale
that walks is one more component of the nodes, with a correlation time of several trials.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph import keys
from factorgraph_dvl.sensors.protocol import ScaleWalk

# Most of a correlation time between two nodes. Chosen: interpolation then leaves out 6 % of the
# variance.
_MOST_SPACING = 1.0 / 3.0
# Correlation times without a measurement that need no nodes. Chosen: what persists is then gone.
_GAP = 5.0
# Correlation time of a scale that walks, in lengths of the record. Chosen: over one length its
# changes then have 85 % of the variance of a walk.
_LENGTHS = 3.0


@dataclass(frozen=True, eq=False)
class Process:
    """A correlated error that adds to the components of an observation, or to a parameter.

        c_{j+1} = phi c_j + noise of variance 1 - phi²,    phi = exp(-dt / tau)

    Parameters
    ----------
    label : str
        Label of the observation; what it is, where it adds to a parameter.
    index : int
        Index of the process among those of the problem.
    sigma : ndarray, shape (n,), SI
        Standard deviation of each component.
    tau : ndarray, shape (n,), s
        Correlation time of each component.
    time : ndarray, shape (J,), s
        Times of the nodes.
    least_sigma : ndarray, shape (n,), optional
        Deviation that each component has at least, where the record is too short to show more of
        it than its density 2 sigma² / tau.
    walk : ScaleWalk, optional
        Random walk of the scale, which is the last component of the nodes.
    parameter : str, optional
        Name of the parameter that it adds to, for all observations that depend on it.
    free : bool, default False
        Whether its deviation and time are to be estimated although it is of no observation, or
        the rate of its walk.
    goes_on : bool, default False
        Whether nodes before it are gone, so that its first node has no prior of its own.
    """

    label: str
    index: int
    sigma: Array
    tau: Array
    time: Array
    least_sigma: Array | None = None
    walk: ScaleWalk | None = None
    parameter: str | None = None
    free: bool = False
    goes_on: bool = False

    @property
    def density_only(self) -> bool:
        """Whether only the density is sure, and the deviation is as stated, or larger."""
        return self.least_sigma is not None

    @property
    def free_walk(self) -> ScaleWalk | None:
        """The walk whose rate is to be estimated, if there is one."""
        return self.walk if self.free else None

    def going_on(self, time: Array, walk: ScaleWalk | None) -> Process:
        """Return it at other nodes, of which the first was among its own.

        Parameters
        ----------
        time : ndarray, shape (J,), s
            Times of the nodes.
        walk : ScaleWalk, optional
            Random walk of the scale, with what is measured there.
        """
        out = replace(self, time=time, walk=walk, goes_on=True)
        # A walk's go by the length of the whole record.
        vars(out)["_of_nodes"] = self._of_nodes
        return out

    @cached_property
    def _of_nodes(self) -> tuple[Array, Array]:
        """Standard deviations and correlation times of the components of a node, (size,)."""
        if self.walk is None:
            return self.sigma, self.tau
        tau = walk_time(self.time)
        sigma = walk_sigma(self.walk, tau)
        return np.append(self.sigma, sigma), np.append(self.tau, tau)

    @property
    def size(self) -> int:
        """Components of a node."""
        return self._of_nodes[0].size

    @property
    def name(self) -> str:
        """Name among the values of an evaluation."""
        return f"{self.label}, correlated error"

    def key(self, j: int) -> int:
        """Return the key of node j."""
        return keys.process(self.index, j)

    @property
    def zero(self) -> Array:
        """Nodes without an error, (J, size)."""
        return np.zeros((self.time.size, self.size))

    def nodes_of(self, values: Mapping[str, Array]) -> Array:
        """Return its nodes (J, size) among values by name: without an error if it had others."""
        nodes = values.get(self.name, self.zero)
        return nodes if nodes.shape == self.zero.shape else self.zero

    def place(self, time: Array) -> tuple[IntArray, Array]:
        """Return the nodes before times (M,), and the weights of the nodes after them."""
        j = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, self.time.size - 2)
        return j, np.clip((time - self.time[j]) / (self.time[j + 1] - self.time[j]), 0.0, 1.0)

    def error(self, nodes: Array, time: Array) -> Array:
        """Return the error of each component of a node at times (M,), (M, size)."""
        j, after = self.place(time)
        between = (1.0 - after)[:, None] * nodes[j] + after[:, None] * nodes[j + 1]
        return np.asarray(self._of_nodes[0] * between)

    def with_error(self, residual: Array, nodes: Array, time: Array) -> Array:
        """Return residuals (M, n) at times (M,) with the error by the nodes (J, size) added."""
        error = self.error(nodes, time)
        n = self.sigma.size
        out = residual + error[:, :n]
        if self.walk is not None:
            out = out + error[:, n:] * self._predicted(residual, time)
        return out

    def gain(self, nodes: Array, time: Array) -> Array:
        """Return the derivatives of `with_error` with respect to residuals, (M, 1)."""
        if self.walk is None:
            return np.ones((time.size, 1))
        return 1.0 + self.error(nodes, time)[:, self.sigma.size :]

    def jacobians(self, residual: Array, time: Array) -> list[Array]:
        """Return the derivatives of `with_error` with respect to nodes before and after."""
        _, after = self.place(time)
        sigma, n = self._of_nodes[0], self.sigma.size
        columns = np.zeros((time.size, n, sigma.size))
        columns[:, :, :n] = np.diag(self.sigma)
        if self.walk is not None:
            columns[:, :, n] = sigma[n] * self._predicted(residual, time)
        return [share[:, None, None] * columns for share in (1.0 - after, after)]

    def through(self, jacobian: Array, time: Array) -> list[Array]:
        """Return the derivatives by nodes before and after of what depends on its parameter.

        Parameters
        ----------
        jacobian : ndarray, shape (M, d, n)
            Derivatives by the parameter.
        time : ndarray, shape (M,), s
            Times of the measurements.
        """
        _, after = self.place(time)
        by_node = jacobian * self._of_nodes[0]
        return [share[:, None, None] * by_node for share in (1.0 - after, after)]

    def _predicted(self, residual: Array, time: Array) -> Array:
        # What was measured has noise, which a scale of its own would make smaller.
        assert self.walk is not None
        return residual + self.walk.measured[np.searchsorted(self.walk.time, time)]

    def mean_walk(self, nodes: Array) -> tuple[float, dict[int, Array]]:
        """Return the mean of a scale that walks, and its derivatives by the key of each node."""
        weight = self._time_about_nodes
        weight *= self._of_nodes[0][-1] / weight.sum()
        last = np.eye(1, self.size, self.size - 1)
        return float(weight @ nodes[:, -1]), {self.key(j): w * last for j, w in enumerate(weight)}

    def mean(self, nodes: Array) -> tuple[Array, dict[int, Array]]:
        """Return the mean of each component, and its derivatives by the key of each node."""
        weight = self._time_about_nodes
        weight = weight[:, None] * self._of_nodes[0] / weight.sum()
        return np.sum(weight * nodes, axis=0), {
            self.key(j): np.diag(w) for j, w in enumerate(weight)
        }

    @property
    def _time_about_nodes(self) -> Array:
        """Twice the time that belongs to each node."""
        out = np.zeros(self.time.size)
        step = np.diff(self.time)
        out[:-1] += step
        out[1:] += step
        return out

    @property
    def _weight(self) -> Array:
        """Inverse standard deviations of the innovations, (J - 1, size)."""
        return 1.0 / np.sqrt(-np.expm1(-2.0 * np.diff(self.time)[:, None] / self._of_nodes[1]))

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the prior covariance of all nodes."""
        return -2.0 * float(np.log(self._weight).sum())

    def prior_residuals(self, nodes: Array) -> Array:
        """Return whitened residuals (J, size): the first node, then the transitions."""
        phi = np.exp(-np.diff(self.time)[:, None] / self._of_nodes[1])
        steps = (nodes[1:] - phi * nodes[:-1]) * self._weight
        first = np.zeros_like(nodes[:1]) if self.goes_on else nodes[:1]
        return np.concatenate([first, steps])

    def add_prior(self, gaussian: gtsam.GaussianFactorGraph, nodes: Array) -> None:
        """Add the factors of `prior_residuals`, which are linear."""
        n = self.size
        residuals = self.prior_residuals(nodes)
        unit = gtsam.noiseModel.Unit.Create(n)
        if not self.goes_on:
            gaussian.add(self.key(0), np.eye(n), -residuals[0], unit)
        phi = np.exp(-np.diff(self.time)[:, None] / self._of_nodes[1])
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


def walk_time(time: Array) -> float:
    """Return the correlation time with which a scale walks over a record at times (M,), s."""
    return _LENGTHS * float(np.ptp(time))


def walk_sigma(walk: ScaleWalk, tau: float) -> float:
    """Return the standard deviation that a scale then has, so that its changes are a walk's."""
    return walk.rate * float(np.sqrt(0.5 * tau))


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
