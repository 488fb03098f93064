"""The chain of a planar trial: positions and velocities, with heading and height as recorded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import gtsam
import numpy as np

from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, frd_from_body, rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.chain import MOTION, AtTrueTimes, StepRows, WithoutImu
from factorgraph_dvl.graph.smooth_motion import variance_between
from factorgraph_dvl.graph.trajectory import epochs_between, reported
from factorgraph_dvl.sensors.protocol import Linearization, Motion, Window

# Dimensions of a state: position and velocity, east and north.
SIZE = 4
# Mean radius of the Earth, m. Measured: over 10 km a sphere errs by 3 cm in height.
EARTH_RADIUS = 6.371e6
# What rounding may add to a time, s.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Recorded:
    """What is recorded of the motion, linear between times.

    Parameters
    ----------
    time : ndarray, shape (G,), s
        Times of the values.
    heading : ndarray, shape (G,)
        Clockwise from north, unwrapped, rad.
    height, climb : ndarray, shape (G,)
        Above the ellipsoid and its rate, m, m/s.
    heading_std, height_std, climb_std : float
        White noise of each value, rad, m, m/s.
    """

    time: Array
    heading: Array
    height: Array
    climb: Array
    heading_std: float
    height_std: float
    climb_std: float

    @cached_property
    def heading_rate(self) -> Array:
        """Rate of the heading, (G,), rad/s."""
        return np.asarray(np.gradient(self.heading, self.time))

    @cached_property
    def heading_rate_std(self) -> float:
        """Standard deviation of that rate, rad/s: of two values two intervals apart."""
        return self.heading_std / (np.sqrt(2.0) * float(np.median(np.diff(self.time))))


@dataclass(frozen=True)
class PlanarStates:
    """States of K nodes.

    Parameters
    ----------
    time : ndarray, shape (K,), s
        Times of the nodes.
    x : ndarray, shape (K, 4)
        Position and velocity over ground, east and north, m, m/s.
    nRb : ndarray, shape (K, 3, 3)
        Attitude, body to n, as recorded.
    p_n, v_n : ndarray, shape (K, 3)
        Position and velocity in n, m, m/s.
    """

    time: Array
    x: Array
    nRb: Array
    p_n: Array
    v_n: Array


@dataclass(frozen=True)
class Attached:
    """Where M times are attached to the chain.

    Parameters
    ----------
    node : ndarray of int, shape (M,)
        Node before.
    segment : ndarray of int, shape (M,)
        The same: segments are from node to node.
    time : ndarray, shape (M,), s
        The times.
    """

    node: IntArray
    segment: IntArray
    time: Array


@dataclass(frozen=True)
class Between:
    """The motion between nodes, and its derivatives.

    Parameters
    ----------
    motion : Motion
        Motion at M times.
    by_nodes : ndarray, shape (M, 9, 8)
        Derivatives of attitude, position and velocity by the nodes before and after.
    """

    motion: Motion
    by_nodes: Array


@dataclass(frozen=True)
class PlanarChain(WithoutImu, AtTrueTimes):
    """Nodes of a planar trial, tied by white acceleration in the plane.

    Parameters
    ----------
    frame : LocalFrame
        Tangent frame n.
    node_time : ndarray, shape (K,), s
        Times of the nodes.
    density : ndarray, shape (K - 1, 2, 2), m²/s³
        Power spectral densities of the acceleration between nodes.
    recorded : Recorded
        Heading and height.
    start : ndarray, shape (4,)
        Prior mean of the first state.
    start_std : ndarray, shape (4,)
        Its standard deviations.
    body_axes : BodyAxes
        Axes of the body.
    heading_bias : str, optional
        Name of the parameter by which the recorded heading is too large.
    block : slice, optional
        Steps whose prior it has, of a part; by default all.
    """

    frame: LocalFrame
    node_time: Array
    density: Array
    recorded: Recorded
    start: Array
    start_std: Array
    body_axes: BodyAxes
    heading_bias: str | None = None
    block: slice | None = None
    first_state: ClassVar[str] = "initial position"

    @property
    def log_determinant(self) -> float:
        """Log det of the covariance of the steps, but for what their length makes it."""
        return 2.0 * float(np.linalg.slogdet(self.density)[1].sum())

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Prior of the first state."""
        graph = gtsam.NonlinearFactorGraph()
        if self.block is None or self.block.start == 0:
            noise = gtsam.noiseModel.Diagonal.Sigmas(self.start_std, False)
            graph.addPriorVector(keys.node(0), self.start, noise)
        return graph

    @property
    def sizes(self) -> list[int]:
        """Dimensions of the variables of a measurement."""
        return [SIZE, SIZE]

    def until(self, nodes: int) -> PlanarChain:
        """Return the chain of the first nodes."""
        return replace(
            self, node_time=self.node_time[:nodes], density=self.density[: max(nodes - 1, 0)]
        )

    def part(self, block: slice) -> PlanarChain:
        """Return the part of some steps in a row; states keep their keys."""
        return replace(self, block=block)

    def keys_of(self, nodes: Iterable[int]) -> list[int]:
        """Return the keys of the states of nodes."""
        return [keys.node(k) for k in nodes]

    def variables(self, nodes: IntArray) -> list[IntArray]:
        """Return the keys of the variables of measurements after nodes (M, 1), (M,) each."""
        node = nodes[:, 0]
        return [keys.nodes(node), keys.nodes(node + 1)]

    def values(self, states: PlanarStates) -> gtsam.Values:
        """Return GTSAM's values of states."""
        out = gtsam.Values()
        for k, x in enumerate(states.x):
            out.insert(keys.node(k), x)
        return out

    def states(self, values: gtsam.Values) -> PlanarStates:
        """Return states as arrays."""
        return self._states(values, range(self.node_time.size))

    def _states(self, values: gtsam.Values, nodes: range) -> PlanarStates:
        x = np.array([values.atVector(keys.node(k)) for k in nodes])
        return self.with_recorded(self.node_time[nodes.start : nodes.stop], x)

    def with_recorded(self, time: Array, x: Array) -> PlanarStates:
        """Return states (K, 4) at times with the heading and the height there."""
        nRb, p_n, v_n = self._in_space(time, x)
        return PlanarStates(time, x, nRb, p_n, v_n)

    def from_node(self, nodes: IntArray) -> PlanarChain:
        """Return what carries the motion from a node (1,) to the next: they are the first two."""
        (k,) = nodes.tolist()
        return replace(
            self,
            node_time=self.node_time[k : k + 2],
            density=self.density[k : k + 1],
            block=None,
        )

    def covers(self, time: Array) -> BoolArray:
        """Whether times (M,) are between the first node and the last."""
        first, last = self.node_time[[0, -1]]
        return np.asarray((time >= first - _ROUNDING) & (time <= last + _ROUNDING))

    def attach(
        self,
        time: Array,
        shift: float = 0.0,
        window: Window | None = None,
        *,
        of_attitude: bool = False,
    ) -> Attached:
        """Return where times (M,) are attached to the chain; the nearest place if not covered."""
        time = np.clip(time, self.node_time[0], self.node_time[-1])
        node = np.searchsorted(self.node_time, time, side="right") - 1
        node = np.clip(node, 0, self.count - 1)
        return Attached(node, node, time)

    @cached_property
    def _down_b(self) -> Array:
        """Down in body axes, (3,)."""
        return frd_from_body(self.body_axes)[2]

    @property
    def _convergence(self) -> float:
        """Angle by which meridians converge per metre to the east, rad/m."""
        return float(np.tan(self.frame.lat)) / EARTH_RADIUS

    def missing(self, at: Attached, lin: Linearization) -> Array:
        """Return the variance (M, d) of what is predicted at attached times given the nodes.

        Of the motion between them, and of the heading and height that are recorded.
        """
        begin, span = self.node_time[at.node], np.diff(self.node_time)[at.node]
        of_value, of_both, of_rate = variance_between(at.time - begin, span)[..., None]
        density = self.density[at.node]
        out = np.zeros_like(lin.residual)
        if lin.d_p is not None:
            out += of_value * _variance(lin.d_p, density, lin.d_p)
            out += (self.recorded.height_std * lin.d_p[:, :, 2]) ** 2
        if lin.d_v is not None:
            out += of_rate * _variance(lin.d_v, density, lin.d_v)
            out += (self.recorded.climb_std * lin.d_v[:, :, 2]) ** 2
        if lin.d_p is not None and lin.d_v is not None:
            out += 2.0 * of_both * _variance(lin.d_p, density, lin.d_v)
        if lin.d_theta is not None:
            out += (self.recorded.heading_std * (lin.d_theta @ self._down_b)) ** 2
        return out

    def motion(self, at: Attached, states: PlanarStates) -> Motion:
        """Return the motion at M attached times."""
        return self.transition(at, states).motion

    def transition(
        self, at: Attached, states: PlanarStates, motion: Motion | None = None
    ) -> Between:
        """Return the motion at attached times, with its derivatives by the nodes."""
        begin, span = states.time[at.node], np.diff(states.time)[at.node]
        s, one = (at.time - begin) / span, np.ones_like(span)
        # Cubic by values and rates at both ends (Hermite): weights of p, v before, p, v after.
        weights = np.stack(
            [
                [2 * s**3 - 3 * s**2 + 1, (s**3 - 2 * s**2 + s) * span],
                [3 * s**2 - 2 * s**3, (s**3 - s**2) * span],
            ]
        ).reshape(4, -1)
        slopes = np.stack(
            [
                [(6 * s**2 - 6 * s) / span, 3 * s**2 - 4 * s + 1],
                [(6 * s - 6 * s**2) / span, 3 * s**2 - 2 * s],
            ]
        ).reshape(4, -1)
        bends = np.stack(
            [
                [(12 * s - 6) / span**2, (6 * s - 4) / span],
                [(6 - 12 * s) / span**2, (6 * s - 2) / span],
            ]
        ).reshape(4, -1)
        ends = np.stack([states.x[at.node], states.x[at.node + 1]], axis=1).reshape(-1, 4, 2)
        p, v, a = (np.einsum("wm,mwi->mi", w, ends) for w in (weights, slopes, bends))
        nRb, p_n, v_n = self._in_space(at.time, np.hstack([p, v]))
        of = self.recorded
        rate = np.interp(at.time, of.time, of.heading_rate)
        zero = np.zeros((at.time.size, 3))
        by_nodes = np.zeros((at.time.size, 9, 8))
        for axis in range(2):
            by_nodes[:, 3 + axis, axis::2] = weights.T
            by_nodes[:, 6 + axis, axis::2] = slopes.T
        # North turns with the place, and the height over the tangent plane drops. Measured:
        # without the first, steps along the arc that ranges leave do not end.
        by_nodes[:, :3] = -self._convergence * self._down_b[:, None] * by_nodes[:, 3:4]
        by_nodes[:, 5] = -np.einsum("mi,mij->mj", p, by_nodes[:, 3:5]) / EARTH_RADIUS
        moving = Motion(
            nRb=nRb,
            p_n=p_n,
            v_n=v_n,
            omega_eb_b=rate[:, None] * self._down_b,
            a_n=np.column_stack([a, 0.0 * one]),
            alpha_b=zero,
            omega_sigma=zero + of.heading_rate_std * np.abs(self._down_b),
        )
        return Between(moving, by_nodes)

    def _in_space(self, time: Array, x: Array) -> tuple[Array, Array, Array]:
        """Return attitude, position and velocity in n of states (M, 4) at times."""
        of, p = self.recorded, x[:, :2]
        down = np.sum(p**2, axis=1) / (2.0 * EARTH_RADIUS)
        height = np.interp(time, of.time, of.height) - self.frame.height
        # North at a place east of the origin is not that of n: meridians converge.
        rph = np.zeros((len(x), 3))
        rph[:, 2] = np.interp(time, of.time, of.heading) - self._convergence * p[:, 0]
        climb = np.interp(time, of.time, of.climb)
        p_n = np.column_stack([p, height - down])
        return rotation_from_rph(rph, self.body_axes), p_n, np.column_stack([x[:, 2:], climb])

    def node_jacobian(self, lin: Linearization, transition: Between) -> Array:
        """Return the derivative of residuals by the variables of measurements, (M, d, 8)."""
        return lin.by_motion[:, :, :9] @ transition.by_nodes

    @cached_property
    def _step_rows(self) -> tuple[Array, Array]:
        """Whitened derivatives of the steps by the states before and after, (K - 1, 4, 4)."""
        dt = np.diff(self.node_time)
        in_time = np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]]).transpose(2, 0, 1)
        covariance = np.einsum("kab,kij->kaibj", in_time, self.density).reshape(-1, SIZE, SIZE)
        root = np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
        carry = np.tile(np.eye(SIZE), (dt.size, 1, 1))
        carry[:, [0, 1], [2, 3]] = dt[:, None]
        return -root @ carry, root

    def steps(self, states: PlanarStates) -> Iterator[StepRows]:
        """Yield the whitened rows of the prior of the motion."""
        block = slice(0, self.count) if self.block is None else self.block
        before, after = (each[block] for each in self._step_rows)
        x, components = states.x[block.start : block.stop + 1], ("shift e", "shift n")
        residual = np.einsum("kij,kj->ki", before, x[:-1]) + np.einsum("kij,kj->ki", after, x[1:])
        names = (*components, "acceleration e", "acceleration n")
        yield StepRows(
            MOTION, names, block.start, residual, np.concatenate([before, after], axis=2)
        )

    def epochs(self, rate_hz: float, after: float = -np.inf) -> Array:
        """Return the epochs at a rate after a time, s, and up to the last node."""
        first, last = self.node_time[[0, -1]]
        time = epochs_between(max(after, first - 0.5 / rate_hz), last, rate_hz)
        return time[time >= first]

    def trajectory(
        self, states: PlanarStates, P: Array, body_axes: BodyAxes, time: Array
    ) -> Trajectory:
        """Return the motion at times (M,), s, with its covariance; headings as recorded.

        Parameters
        ----------
        states : PlanarStates
            States of the K nodes.
        P : ndarray, shape (K, 4, 4)
            Their covariances.
        body_axes : BodyAxes
            Axes of the body.
        time : ndarray, shape (M,), s
            The times.
        """
        at = self.attach(time)
        time = at.time
        begin, span = self.node_time[at.node], np.diff(self.node_time)[at.node]
        fraction = ((time - begin) / span)[:, None, None]
        of_nodes = P[at.node] + fraction * (P[at.node + 1] - P[at.node])
        of_value, _, of_rate = variance_between(time - begin, span)[..., None, None]
        P_n = np.zeros((time.size, 3, 3, 3))
        P_n[:, 1, :2, :2] = of_nodes[:, :2, :2] + of_value * self.density[at.node]
        P_n[:, 2, :2, :2] = of_nodes[:, 2:, 2:] + of_rate * self.density[at.node]
        P_n[:, 1, 2, 2] = self.recorded.height_std**2
        P_n[:, 2, 2, 2] = self.recorded.climb_std**2
        out = reported(time, self.motion(at, states), P_n, self.frame, body_axes)
        rph = out.rph.copy()
        rph[:, :2] = 0.0
        # Nothing measures roll and pitch.
        rph_cov = np.full(out.rph_cov.shape, np.nan)
        rph_cov[:, 2, 2] = self.recorded.heading_std**2
        return replace(out, rph=rph, rph_cov=rph_cov)

    def assumed(self) -> dict[str, str]:
        """Return what is assumed of each of these sources, as text."""
        density = np.sqrt(np.median(np.trace(self.density, axis1=1, axis2=2)) / 2.0)
        text = f"{density:.2g} m/s/√s"
        if np.isfinite(self.start_std).all():
            return {MOTION: text, self.first_state: f"{self.start_std[:2].max():.2g} m"}
        return {MOTION: text}


def _variance(a: Array, density: Array, b: Array) -> Array:
    """Return aᵀ Q b of derivatives (M, d, 3), in the plane, by densities (M, 2, 2), (M, d)."""
    return np.asarray(np.sum((a[:, :, :2] @ density) * b[:, :, :2], axis=2))
