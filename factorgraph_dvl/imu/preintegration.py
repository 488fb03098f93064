"""Increments to segments between nodes, and to GTSAM's preintegrated measurements."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.rotations import cumulative_products, exp_so3, log_so3
from factorgraph_dvl.geometry.vectors import (
    IDENTITY,
    Array,
    IntArray,
    cross,
    rotate,
    skew,
    sums_before,
)
from factorgraph_dvl.imu.increments import Increments

# Time between knots, and the shortest stride, s. Measured: in 2 Hz sway of 4 deg the covariance of
# a second moves by 0.005 %.
_STRIDE = 0.04
# Largest angle, rad, by which a stride of several knots may turn, and most knots of one. Chosen:
# less than that sway turns from knot to knot. Measured: the covariance then moves by 0.06 %.
_LITTLE_TURN = 0.03
_MOST_KNOTS = 3
# Samples that are integrated at once. Chosen: some ten megabytes.
_CHUNK = 100_000


@dataclass(frozen=True)
class Integrals:
    """What the samples add up to since the starts of segments, at M times.

    Parameters
    ----------
    dR : ndarray, shape (M, 3, 3)
        Rotation.
    dV, dP : ndarray, shape (M, 3)
        Velocity and position increment, in the axes at the segment's start.
    dA : ndarray, shape (M, 3, 3), s
        Integral of dR.
    """

    dR: Array
    dV: Array
    dP: Array
    dA: Array

    @classmethod
    def zero(cls, count: int) -> Integrals:
        """Return those at the starts of segments."""
        turn, shift = np.tile(np.eye(3), (count, 1, 1)), np.zeros((2, count, 3))
        return cls(turn, shift[0], shift[1], np.zeros((count, 3, 3)))

    def put(self, index: IntArray | slice, others: Integrals) -> None:
        """Write others in the place of some of them."""
        self.dR[index], self.dV[index] = others.dR, others.dV
        self.dP[index], self.dA[index] = others.dP, others.dA

    def after(self, turn: Array, left: Array, dv: Array, dt: Array) -> Integrals:
        """Return those after one more interval each.

        Parameters
        ----------
        turn, left : ndarray, shape (M, 3, 3)
            `_turns` of the rotation vectors over the intervals.
        dv : ndarray, shape (M, 3)
            Velocity increments over them.
        dt : ndarray, shape (M,), s
            Their lengths.
        """
        turned, h = rotate(self.dR, dv), dt[:, None]
        return Integrals(
            dR=self.dR @ turn,
            dV=self.dV + turned,
            dP=self.dP + (self.dV * h + 0.5 * turned * h),
            dA=self.dA + self.dR @ left * h[:, :, None],
        )


@dataclass(frozen=True)
class Strides:
    """Steps of some samples from the start to the end of each segment.

    Parameters
    ----------
    begins, count : ndarray of int, shape (S,)
        First stride of each segment, and how many it has.
    start, duration : ndarray, shape (T,), s
        When each of the T strides starts, and how long it is.
    dR : ndarray, shape (T, 3, 3)
        Rotation since the segment's start, at the start of each stride.
    dV : ndarray, shape (T, 3)
        Likewise, in the axes at the segment's start.
    phi, dv, dp : ndarray, shape (T, 3)
        Rotation vector, velocity and position increment over each stride, in the axes at its
        start.
    swept : ndarray, shape (T, 3), s
        Rotation since its start, integrated over each stride.
    """

    begins: IntArray
    count: IntArray
    start: Array
    duration: Array
    dR: Array
    dV: Array
    phi: Array
    dv: Array
    dp: Array
    swept: Array


@dataclass(frozen=True)
class Segments:
    """The chain: nodes, the segments between them, and increments since each segment's start.

    Parameters
    ----------
    increments : Increments
        Increments of all arcs.
    node_time : ndarray, shape (K,), s
        Times of the nodes.
    first, last : ndarray of int, shape (S,)
        First and last-plus-one interval of each segment.
    origin : ndarray of int, shape (S,)
        Node at the start of each segment; the node at its end is the next one.
    arc_nodes : ndarray of int, shape (A, 2)
        First and last node of each arc.
    spacing : int
        Intervals from one knot to the next.
    knots : Integrals
        T of them: at the start of each segment, and of every `spacing`-th interval from there on.
    less : ndarray, shape (T, 3), m
        Distance by which each knot would lead less far to the next with a force that turns with
        the body within a sample, as GTSAM has it.
    ends : Integrals
        Integrals at the ends of the S segments.
    """

    increments: Increments
    node_time: Array
    first: IntArray
    last: IntArray
    origin: IntArray
    arc_nodes: IntArray
    spacing: int
    knots: Integrals
    less: Array
    ends: Integrals

    @property
    def duration(self) -> Array:
        """Length of the segments, (S,), s."""
        return self.node_time[self.origin + 1] - self.node_time[self.origin]

    @cached_property
    def stride(self) -> int:
        """Samples in a stride: more of them where the body turns slowly."""
        shortest = _stride(self.increments)
        angle = self.increments.fastest * shortest * float(np.mean(self.increments.dt))
        knots = int(min(_LITTLE_TURN / max(angle, _LITTLE_TURN / _MOST_KNOTS), _MOST_KNOTS))
        return shortest * max(knots, 1)

    @cached_property
    def first_knot(self) -> IntArray:
        """First knot of each segment, (S,)."""
        return _begins(_parts(self.first, self.last, self.spacing))

    def since_start(self, index: IntArray) -> Integrals:
        """Return what adds up from the starts of segments to those of intervals (M,)."""
        if self.spacing == 1 and self.first.size == 1:
            return rows_of(self.knots, index - self.first[0])
        segment = np.searchsorted(self.first, index, side="right") - 1
        inside = index - self.first[segment]
        found = rows_of(self.knots, self.first_knot[segment] + inside // self.spacing)
        left = inside % self.spacing
        for j in range(int(left.max(initial=0))):
            live = np.flatnonzero(left > j)
            i = index[live] - left[live] + j
            phi, dv = self.increments.over(i)
            after = rows_of(found, live).after(*_turns(phi), dv, self.increments.dt[i])
            found.put(live, after)
        return found

    def part(self, block: slice) -> Segments:
        """Return some segments in a row, from a start to a stop; nodes keep their numbers."""
        edges = np.append(self.first_knot, self.less.shape[0])
        knots = slice(int(edges[block.start]), int(edges[block.stop]))
        return replace(
            self,
            first=self.first[block],
            last=self.last[block],
            origin=self.origin[block],
            knots=rows_of(self.knots, knots),
            less=self.less[knots],
            ends=rows_of(self.ends, block),
        )

    def blocks(self) -> Iterator[slice]:
        """Yield the segments in blocks of not too many samples."""
        return _blocks(self.first, self.last)

    def strides(self, block: slice) -> Strides:
        """Return a block of segments in steps of several samples each; both count within it."""
        first, last = self.first[block], self.last[block]
        count = _parts(first, last, self.stride)
        begins = _begins(count)
        segment = np.repeat(np.arange(count.size), count)
        number = np.arange(segment.size) - begins[segment]
        a = first[segment] + self.stride * number
        b = np.minimum(a + self.stride, last[segment])
        knot = self.first_knot[block][segment] + self.stride // self.spacing * number
        start, end = rows_of(self.knots, knot), rows_of(self.knots, np.append(knot[1:], knot[-1]))
        end.put(begins + count - 1, rows_of(self.ends, block))
        of_last = _parts(first[-1:], last[-1:], self.spacing)
        less = self.less[knot[0] : self.first_knot[block][-1] + int(of_last[0])]
        dP = end.dP - np.add.reduceat(less, knot - knot[0])
        duration = self.increments.start[b - 1] + self.increments.dt[b - 1]
        duration -= self.increments.start[a]
        back = start.dR.transpose(0, 2, 1)
        swept = back @ (end.dA - start.dA)
        return Strides(
            begins=begins,
            count=count,
            start=self.increments.start[a],
            duration=duration,
            dR=start.dR,
            dV=start.dV,
            phi=log_so3(back @ end.dR),
            dv=rotate(back, end.dV - start.dV),
            dp=rotate(back, dP - start.dP - start.dV * duration[:, None]),
            swept=0.5 * (swept[:, [2, 0, 1], [1, 2, 0]] - swept[:, [1, 2, 0], [2, 0, 1]]),
        )

    def totals(self) -> tuple[Array, Array, Array]:
        """Return dR (S, 3, 3), dV, dP (S, 3) over whole segments."""
        return self.ends.dR, self.ends.dV, self.ends.dP


def segments(inc: Increments, interval: float, epochs: Array | None = None) -> Segments:
    """Divide the arcs into segments of about `interval` seconds and integrate over each.

    Parameters
    ----------
    inc : Increments
        Increments of all arcs.
    interval : float
        Length of the segments, s.
    epochs : ndarray, shape (M,), optional
        Times, s, of which each has a node at most a sample before it; the segments between them
        are no longer than `interval`. None: no such times.
    """
    cuts = []
    for a, b in inc.arcs:
        length = inc.start[b - 1] + inc.dt[b - 1] - inc.start[a]
        if epochs is None:
            pieces = max(round(length / interval), 1)
            targets = inc.start[a] + length * np.arange(1, pieces) / pieces
            inner = a + nearest(inc.start[a:b], targets)
        else:
            index, _, covered = inc.locate(epochs)
            wanted = index[covered & (index >= a) & (index < b)]
            edges = np.append(inc.start[a:b], inc.end[b - 1])
            inner = a + _filled(np.unique(np.append(wanted - a, [0, b - a])), edges, interval)
        cuts.append(np.unique(np.concatenate([[a], inner, [b]])))
    return integrated(inc, cuts)


def integrated(inc: Increments, cuts: Sequence[IntArray]) -> Segments:
    """Return segments between cuts, which are indices of intervals, of each arc."""
    first, last, origin, arc_nodes, node_time = [], [], [], [], []
    n_nodes = 0
    for inner in cuts:
        first.append(inner[:-1])
        last.append(inner[1:])
        origin.append(n_nodes + np.arange(inner.size - 1))
        node_time.append(np.append(inc.start[inner[:-1]], inc.end[inner[-1] - 1]))
        arc_nodes.append((n_nodes, n_nodes + inner.size - 1))
        n_nodes += inner.size
    i0, i1 = np.concatenate(first), np.concatenate(last)
    spacing = _stride(inc)
    knots, less, ends = _knots(inc, i0, i1, spacing)
    return Segments(
        increments=inc,
        node_time=np.concatenate(node_time),
        first=i0,
        last=i1,
        origin=np.concatenate(origin),
        arc_nodes=np.array(arc_nodes),
        spacing=spacing,
        knots=knots,
        less=less,
        ends=ends,
    )


def _knots(
    inc: Increments, first: IntArray, last: IntArray, spacing: int
) -> tuple[Integrals, Array, Integrals]:
    """Return knots, by how much less far they lead, and the ends of segments of intervals."""
    count = _parts(first, last, spacing)
    begins, total = _begins(count), int(count.sum())
    knots, less, ends = Integrals.zero(total), np.zeros((total, 3)), Integrals.zero(first.size)
    for block in _blocks(first, last):
        begin, end, knot = first[block], last[block], begins[block]
        phi, dv = inc.over(np.arange(begin[0], end[-1]))
        turn, left = _turns(phi)
        behind = cross(phi, dv)
        now = Integrals.zero(begin.size)
        for j in range(int((end - begin).max())):
            is_live = begin + j < end
            # Views of all are no copies.
            live = slice(None) if is_live.all() else np.flatnonzero(is_live)
            i = begin[live] + j
            at, here, dt = knot[live] + j // spacing, rows_of(now, live), inc.dt[i]
            if j % spacing == 0:
                knots.put(at, here)
            i -= begin[0]
            less[at] += rotate(here.dR, behind[i]) * (dt[:, None] / 12.0)
            after = here.after(turn[i], left[i], dv[i], dt)
            if is_live.all():
                now = after
            else:
                now.put(live, after)
        ends.put(np.arange(first.size)[block], now)
    return knots, less, ends


def _turns(phi: Array) -> tuple[Array, Array]:
    """Return Exp(phi), and its mean over the way to it, of rotation vectors (M, 3)."""
    return exp_so3(phi), IDENTITY + 0.5 * skew(phi)


def _stride(inc: Increments) -> int:
    """Return the samples in the shortest stride."""
    return max(int(_STRIDE / float(np.mean(inc.dt)) + 1e-3), 1)


def _parts(first: IntArray, last: IntArray, size: int) -> IntArray:
    """Return how many parts of so many intervals, the last one shorter, each segment has."""
    return np.asarray(-(-(last - first) // size))


def _begins(count: IntArray) -> IntArray:
    """Return the number of the first part of each segment."""
    return np.asarray(np.cumsum(count) - count)


def _blocks(first: IntArray, last: IntArray) -> Iterator[slice]:
    """Yield segments in blocks of not too many samples."""
    begin = 0
    while begin < first.size:
        end = int(np.searchsorted(last, first[begin] + _CHUNK, side="right"))
        end = max(end, begin + 1)
        yield slice(begin, end)
        begin = end


def one_segment(inc: Increments, first: int, last: int) -> Segments:
    """Return intervals [first, last) of a single arc as a chain of two nodes."""
    inside = np.arange(first, last)
    phi, dv = inc.over(inside)
    turn, left = _turns(phi)
    dR = cumulative_products(np.concatenate([IDENTITY[None], turn[:-1]]))
    dt = inc.dt[inside, None]
    turned = rotate(dR, dv)
    dV, dA = sums_before(turned), sums_before(dR @ left * dt[:, :, None])
    dP = sums_before(dV * dt + 0.5 * turned * dt)
    knots, whole = Integrals(dR, dV, dP, dA), slice(-1, None)
    return Segments(
        increments=inc,
        node_time=np.array([inc.start[first], inc.start[last - 1] + inc.dt[last - 1]]),
        first=np.array([first]),
        last=np.array([last]),
        origin=np.array([0]),
        arc_nodes=np.array([[0, 1]]),
        spacing=1,
        knots=knots,
        less=rotate(dR, cross(phi, dv)) * (dt / 12.0),
        ends=rows_of(knots, whole).after(turn[whole], left[whole], dv[whole], dt[whole, 0]),
    )


def _filled(cuts: IntArray, edges: Array, interval: float) -> IntArray:
    """Return cuts with others between them wherever they are more than `interval` apart."""
    out = [cuts]
    for i in np.flatnonzero(np.diff(edges[cuts]) > 1.5 * interval).tolist():
        begin, end = edges[cuts[i]], edges[cuts[i + 1]]
        pieces = round((end - begin) / interval)
        targets = begin + (end - begin) * np.arange(1, pieces) / pieces
        out.append(nearest(edges, targets))
    return np.concatenate(out)


def nearest(grid: Array, targets: Array) -> IntArray:
    """Return the places in a grid that are nearest to targets."""
    right = np.clip(np.searchsorted(grid, targets), 1, grid.size - 1)
    return np.where(targets - grid[right - 1] < grid[right] - targets, right - 1, right)
