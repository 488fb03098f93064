"""Observability of a DVL's calibration by segments: stacked matrices and singular values.

The states are constant, so a segment's observability matrix is the stack of its measurement
rows (the powers of F = I add nothing). Luo et al. (2024), eq. 10, rotate the data by the
known part of the misalignment and use

    H = [-[v_b x], v_b, [omega x]]        for (alpha, scale error, lever arm).

Here the same rows are derived from the full model v_d = (1 + k) D (v_b + omega x l), whose
misalignment D may be large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline

from factorgraph_dvl.analysis.information.manoeuvres import Segment
from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.rotations import (
    BodyAxes,
    exp_so3,
    log_so3,
    right_jacobian,
    rotation_from_rph,
)
from factorgraph_dvl.geometry.unit_vectors import turned
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.sensors.beam_model import FreeGeometry
from factorgraph_dvl.trial import Reference

# Chosen: the posterior standard deviation is half the prior's, 1 / sqrt(1 + s²) = 1 / 2.
OBSERVABLE = np.sqrt(3.0)
# Chosen: from this share of spurious information on, a direction counts as undetermined.
SPURIOUS = 0.5
# Chosen: components at least this large, relative to the largest, are named.
_NAMED = 0.4
# Chosen: smaller singular values, relative to the largest, are rounding errors.
_NOTHING = 1e-9
# Coefficients of first derivatives of sixth order where the value is zero: centred, one-sided.
_CENTRED = np.array([45.0, -9.0, 1.0]) / 60.0
_ONE_SIDED = np.array([360.0, -450.0, 400.0, -225.0, 72.0, -10.0]) / 60.0
# Chosen: epochs further apart than this many median intervals have a gap between them.
GAP = 1.5


@dataclass(frozen=True)
class BodyMotion:
    """Motion in body axes at M times.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Epochs.
    v_b : ndarray, shape (M, 3)
        Velocity of the IMU over ground, or through the water, m/s.
    omega_b : ndarray, shape (M, 3), rad/s
        Angular rate relative to the Earth.
    """

    time: Array
    v_b: Array
    omega_b: Array

    def at(self, time: Array) -> tuple[BodyMotion, np.ndarray]:
        """Return the motion at other times, and which of them (bool) it covers."""
        interval = float(np.median(np.diff(self.time)))
        after = np.clip(np.searchsorted(self.time, time), 1, self.time.size - 1)
        within = (time >= self.time[0] - 1e-9) & (time <= self.time[-1] + 1e-9)
        within &= self.time[after] - self.time[after - 1] < GAP * interval
        time = time[within]
        both = CubicSpline(self.time, np.hstack([self.v_b, self.omega_b]))(time)
        return BodyMotion(time, both[:, :3], both[:, 3:]), within


@dataclass(frozen=True)
class MountingModel:
    """Linearisation point of the model.

    Parameters
    ----------
    misalignment : ndarray, shape (3,), rad
        Rotation vector of C_b^d.
    scale_error : ndarray, shape (1,) or (3,)
        Scale error, common or for each axis.
    lever_arm : ndarray, shape (3,), m
        Lever arm from the IMU to the DVL, in body.
    """

    misalignment: Array
    scale_error: Array
    lever_arm: Array

    @property
    def gain(self) -> Array:
        """Matrix from the velocity in body to the DVL's reading: (1 + k) D, (3, 3)."""
        return np.broadcast_to(1.0 + self.scale_error, (3,))[:, None] * exp_so3(self.misalignment)


@dataclass(frozen=True)
class BeamMounting:
    """Linearisation point of the model of single beams.

    Parameters
    ----------
    nominal_b : ndarray, shape (N, 3)
        Nominal unit vectors in body.
    turns : ndarray, shape (2N,), rad
        Two angles that turn each nominal vector to the actual one.
    scale_error : ndarray, shape (N,)
        Scale error of each beam.
    lever_arm : ndarray, shape (3,), m
        Lever arm from the IMU to the DVL, in body.
    """

    nominal_b: Array
    turns: Array
    scale_error: Array
    lever_arm: Array

    @property
    def gain(self) -> Array:
        """Matrix from the velocity in body to the beam velocities, (N, 3)."""
        directions = turned(self.nominal_b, self.turns.reshape(-1, 2))
        return np.asarray((1.0 + self.scale_error)[:, None] * directions)


@dataclass(frozen=True)
class SingularValues:
    """Singular values of a stack of measurement rows.

    Parameters
    ----------
    segment : Segment
        Segment of the rows.
    pings : int
        Number of pings in the segment.
    values : ndarray, shape (n,)
        Singular values in descending order. At 1, the data inform a direction as much as the
        prior does.
    directions : ndarray, shape (n, n)
        Right singular vectors as rows, in units of the priors' σ.
    spurious : ndarray, shape (n,)
        Expected share of spurious information, from errors of the motion, in each squared
        singular value.
    states : tuple of str
        Names of the columns.
    """

    segment: Segment
    pings: int
    values: Array
    directions: Array
    spurious: Array
    states: tuple[str, ...]

    @property
    def observed(self) -> np.ndarray:
        """Directions whose prior σ the data at least halve, not by noise, (n,) bool."""
        return (self.values >= OBSERVABLE) & (self.spurious < SPURIOUS)

    def dominant(self, i: int) -> tuple[str, ...]:
        """Return the states that dominate direction i, the largest first."""
        return dominant(self.directions[i], self.states)


def dominant(direction: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the dominant components of a direction, the largest first."""
    size = np.abs(direction)
    order = np.argsort(-size, kind="stable")
    return tuple(names[i] for i in order if size[i] >= _NAMED * size.max())


def body_motion(motion: Trajectory | Reference, body_axes: BodyAxes) -> BodyMotion:
    """Return velocity and angular rate in body of a trajectory.

    The rate is the derivative of Log(R(t)ᵀ R(t + s)) with respect to s at zero, by
    differences of sixth order.

    Parameters
    ----------
    motion : Trajectory or Reference
        Epochs with local-level velocity and attitude.
    body_axes : BodyAxes
        Axes of the body frame.
    """
    nRb = rotation_from_rph(motion.rph, body_axes)
    v_b = rotate(nRb.transpose(0, 2, 1), motion.velocity)
    time = motion.time
    omega = np.zeros_like(v_b)
    if time.size > 1:
        interval = float(np.median(np.diff(time)))
        cuts = np.flatnonzero(np.diff(time) > GAP * interval) + 1
        for a, b in pairwise([0, *cuts, time.size]):
            omega[a:b] = _rates(nRb[a:b], time[a:b])
    return BodyMotion(time, v_b, omega)


def _rates(nRb: Array, time: Array) -> Array:
    n = time.size
    if n < 2 * _ONE_SIDED.size:
        # Too few epochs for more than the mean rate between two of them.
        omega = np.zeros((n, 3))
        if n > 1:
            omega[1:] = log_so3(nRb[:-1].transpose(0, 2, 1) @ nRb[1:]) / np.diff(time)[:, None]
            omega[0] = omega[1]
        return omega
    step = float(time[-1] - time[0]) / (n - 1)
    omega = np.zeros((n, 3))
    edge = _CENTRED.size
    inner, first, last = np.arange(edge, n - edge), np.arange(edge), np.arange(n - edge, n)
    for k, weights, sides in (
        (inner, _CENTRED, (1, -1)),
        (first, _ONE_SIDED, (1,)),
        (last, _ONE_SIDED, (-1,)),
    ):
        here = nRb[k].transpose(0, 2, 1)
        for side in sides:
            for j, weight in enumerate(weights, start=1):
                omega[k] += side * weight / step * log_so3(here @ nRb[k + side * j])
    return omega


def point_set_rows(motion: BodyMotion, mounting: MountingModel) -> Array:
    """Return the measurement rows H in d, (M, 3, 6 + scales).

    For v_d = (1 + k) D (v_b + omega x l) with u = v_b + omega x l:

        H = [-(1 + k) D [u x] J_r(alpha), diag(D u) or D u, (1 + k) D [omega x]],

    where alpha is the rotation vector as reported. With D = I, k = 0 and l = 0 these are the
    rows of Luo et al. (2024), eq. 10.

    Parameters
    ----------
    motion : BodyMotion
        Motion at M pings.
    mounting : MountingModel
        Linearisation point.
    """
    u_b = motion.v_b + np.cross(motion.omega_b, mounting.lever_arm)
    u_d = u_b @ exp_so3(mounting.misalignment).T
    gain = mounting.gain
    by_scale = u_d[:, :, None] * (np.ones((3, 1)) if mounting.scale_error.size == 1 else np.eye(3))
    return np.concatenate(
        [
            -gain @ skew(u_b) @ right_jacobian(mounting.misalignment),
            by_scale,
            gain @ skew(motion.omega_b),
        ],
        axis=2,
    )


def beam_rows(motion: BodyMotion, mounting: BeamMounting) -> Array:
    """Return the measurement rows H of beams, (M, N, 3N + 3).

    For v_i = (1 + k_i) d_i^T u with u = v_b + omega x l, for the turns of the directions,
    the scale errors and the lever arm:

        h_i = [(1 + k_i) u^T dd_i/deta_i, d_i^T u, (1 + k_i) d_i^T [omega x]],

    the first two in the columns of beam i alone.

    Parameters
    ----------
    motion : BodyMotion
        Motion at M pings.
    mounting : BeamMounting
        Linearisation point.
    """
    u_b = motion.v_b + np.cross(motion.omega_b, mounting.lever_arm)
    geometry = FreeGeometry(mounting.nominal_b, "turns", "scale")
    values = {"turns": mounting.turns, "scale": mounting.scale_error}
    found = geometry.derivatives(values, u_b)
    by_lever_arm = mounting.gain @ skew(motion.omega_b)
    return np.concatenate([found["turns"], found["scale"], by_lever_arm], axis=2)


@dataclass(frozen=True)
class _Stack:
    """QR triangle of rows, with the spurious information in them."""

    root: Array
    spurious: Array
    pings: int

    def and_(self, other: _Stack) -> _Stack:
        return _Stack(
            _triangle(np.concatenate([self.root, other.root])),
            self.spurious + other.spurious,
            self.pings + other.pings,
        )


def singular_values(
    rows: Array,
    time: Array,
    segments: Sequence[Segment],
    states: Sequence[str],
    *,
    spurious: Array | None = None,
    nothing: float = 0.0,
    margin: float = 0.0,
) -> tuple[tuple[SingularValues, ...], tuple[SingularValues, ...]]:
    """Return singular values of each segment, and of all data up to its end.

    Parameters
    ----------
    rows : ndarray, shape (M, 3, n)
        Rows in units of the measurements' and the priors' standard deviations, or unscaled.
    time : ndarray, shape (M,), s
        Times of the pings.
    segments : sequence of Segment
        Segments of the trial.
    states : sequence of str
        Names of the n columns.
    spurious : ndarray, shape (M, n, n), optional
        Spurious information: expected contribution of errors of the motion to rowsᵀ rows.
    nothing : float, default 0.0
        Singular values up to this one count as zero; their directions are given in a readable
        basis of their subspace.
    margin : float, default 0.0
        Pings closer than this, s, to the border of two segments are omitted from the single
        segments, so that a straight run excludes the start of a turn. At most a fifth of a
        segment.
    """
    n = rows.shape[2]
    single, cumulative = [], []
    total = _Stack(np.zeros((0, n)), np.zeros((n, n)), 0)

    def stack(inside: np.ndarray) -> _Stack:
        noise = np.zeros((n, n)) if spurious is None else spurious[inside].sum(axis=0)
        return _Stack(_triangle(rows[inside].reshape(-1, n)), noise, int(inside.sum()))

    for i, segment in enumerate(segments):
        inside = segment.covers(time)
        total = total.and_(stack(inside))
        within = min(margin, 0.2 * (segment.end - segment.start))
        if i > 0:
            inside = inside & (time > segment.start + within)
        if i < len(segments) - 1:
            inside = inside & (time <= segment.end - within)
        single.append(_decompose(stack(inside), segment, states, nothing))
        whole = Segment(segments[0].start, segment.end, segment.label)
        cumulative.append(_decompose(total, whole, states, nothing))
    return tuple(single), tuple(cumulative)


def _triangle(rows: Array) -> Array:
    return np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) > rows.shape[1] else rows


def _decompose(
    stack: _Stack, segment: Segment, states: Sequence[str], nothing: float
) -> SingularValues:
    n = stack.root.shape[1]
    values, directions = np.zeros(n), np.eye(n)
    if stack.root.shape[0]:
        _, found, directions = np.linalg.svd(stack.root, full_matrices=True)
        values[: found.size] = found
    zero = values <= max(_NOTHING * float(values[0]), nothing)
    if zero.any():
        directions[zero] = readable_basis(directions[zero])
    noise = np.einsum("ij,jk,ik->i", directions, stack.spurious, directions)
    share = np.divide(noise, values**2, out=np.zeros(n), where=~zero)
    return SingularValues(segment, stack.pings, values, directions, share, tuple(states))


def readable_basis(directions: Array) -> Array:
    """Return a basis of the same subspace with few states in each direction.

    The reduced echelon form, with pivots at the largest components of the subspace. The
    basis of an undetermined subspace is arbitrary: this one names single states if single
    states are undetermined.

    Parameters
    ----------
    directions : ndarray, shape (r, n)
        Orthonormal rows.

    Returns
    -------
    ndarray, shape (r, n)
        Rows of unit length, in general not orthogonal.
    """
    remainder = directions.copy()
    pivots: list[int] = []
    for _ in range(remainder.shape[0]):
        pivot = int(np.argmax(np.linalg.norm(remainder, axis=0)))
        pivots.append(pivot)
        along = remainder[:, pivot] / np.linalg.norm(remainder[:, pivot])
        remainder = remainder - np.outer(along, along @ remainder)
    pivots.sort()
    out = np.linalg.solve(directions[:, pivots], directions)
    out[np.abs(out) < 1e-9] = 0.0
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))
