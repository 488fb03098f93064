"""Polynomials through the samples of arcs: which neighbours each interval takes.

Where the rate steps, as at the start of an abrupt turn, a polynomial across the step would ring;
there the neighbours are taken from the smoother side (the idea of essentially non-oscillatory
schemes: Harten, Engquist, Osher, Chakravarthy, J. Comput. Phys. 71 (1987)).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import comb

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, IntArray, median
from factorgraph_dvl.imu.polynomials import (
    highest_difference,
    interpolation,
    regular_interpolations,
)

# Relative spread of intervals up to which a stencil counts as regular. Chosen: far below what
# the interpolation sees.
UNIFORM = 1e-3
# The same of intervals against their median, so that every stencil is regular. By definition: two
# of them then differ by less than that.
_EVEN = 0.49 * UNIFORM
# Intervals up to which all polynomials are kept.
_SHORT = 200
# Samples whose differences are in memory at a time. Chosen: some MB.
_CHUNK = 50_000
# How much rougher than the noise of the gyro a motion must be to look for a step in it,
# and how much smoother the stencil on one side.
_ROUGH = 6.0
_SMOOTHER = 0.3


@dataclass(frozen=True)
class ArcPolynomials:
    """Rate and specific force over N intervals as polynomials through neighbouring samples.

    Parameters
    ----------
    start, dt : ndarray, shape (N,), s
        Start and length of the intervals.
    arcs : ndarray of int, shape (A, 2)
        First and last-plus-one interval of each arc.
    rate, force : ndarray, shape (S, 3)
        Samples of rate and specific force: the means over the intervals, or the values at their
        ends.
    first_sample : ndarray of int, shape (A,)
        Index of each arc's first sample.
    averaged : bool
        Whether samples are means over the intervals.
    gyro_sigma : float
        Standard deviation of one sample of the rate from its noise, rad/s.
    """

    start: Array
    dt: Array
    arcs: IntArray
    rate: Array
    force: Array
    first_sample: IntArray
    averaged: bool
    gyro_sigma: float

    @property
    def end(self) -> Array:
        """End of the intervals, (N,), s."""
        return self.start + self.dt

    @cached_property
    def arc_of(self) -> IntArray:
        """Arc of each interval, (N,)."""
        # One byte each, where there are not many.
        if len(self.arcs) == 1:
            return np.zeros(self.dt.size, dtype=np.uint8)
        arc = np.arange(len(self.arcs), dtype=np.min_scalar_type(len(self.arcs)))
        return np.repeat(arc, self.arcs[:, 1] - self.arcs[:, 0])

    def difference_at(self, index: IntArray) -> Array:
        """Return the highest difference of the rate about intervals `index`, (M, 3), rad/s."""
        sample = self._centred_sample(index)
        if self.dt.size <= _SHORT:
            return np.asarray(self._highest[sample])
        arc = self.arc_of[index]
        first = self.arcs[arc, 0] + sample - self.first_sample[arc]
        place = first + np.arange(self.width + self.averaged)[:, None]
        # The last edge of an arc is no start of an interval.
        inside = np.minimum(place, self.arcs[arc, 1] - 1)
        edges = self.start[inside] + np.where(inside < place, self.dt[inside], 0.0)
        values = self.rate[sample + np.arange(self.width)[:, None]]
        step = self.step[arc][:, None]
        out = highest_difference(values, edges, self.width, self.averaged, step)
        return np.asarray(out[0])

    @property
    def width(self) -> int:
        """Number of samples that a polynomial passes through."""
        return 5 if self.averaged else 6

    @cached_property
    def step(self) -> Array:
        """Median length of the intervals of each arc, (A,), s."""
        return np.array([median(self.dt[a:b]) for a, b in self.arcs])

    @cached_property
    def unevenness(self) -> Array:
        """Largest share by which an interval of each arc differs from their median, (A,)."""
        return np.array(
            [
                np.abs(self.dt[a:b] / step - 1.0).max()
                for (a, b), step in zip(self.arcs, self.step, strict=True)
            ]
        )

    @cached_property
    def _highest(self) -> Array:
        """Highest difference of the rate over the stencil from each sample on, (S, 3), rad/s.

        Of a short record; infinite where the arc ends within the stencil.
        """
        out = np.full(self.rate.shape, np.inf)
        for (a, b), base, step in zip(self.arcs, self.first_sample, self.step, strict=True):
            count = b - a + (0 if self.averaged else 1)
            edges = np.concatenate([self.start[a:b], self.start[b - 1 : b] + self.dt[b - 1 : b]])
            out[base : base + count - self.width + 1] = highest_difference(
                self.rate[base : base + count], edges, self.width, self.averaged, step
            )
        return out

    @cached_property
    def _roughness(self) -> Array:
        """Size of the highest difference of the rate over the stencil from each sample on, (S,).

        In rad/s; infinite where the arc ends within the stencil.
        """
        if self.dt.size <= _SHORT:
            return np.asarray(np.sqrt(np.einsum("ij,ij->i", self._highest, self._highest)))
        out = np.full(len(self.rate), np.inf)
        for (a, b), base, step in zip(self.arcs, self.first_sample, self.step, strict=True):
            edges = np.append(self.start[a:b], self.end[b - 1])
            count = b - a + (0 if self.averaged else 1)
            for begin in range(0, count - self.width + 1, _CHUNK):
                size = min(_CHUNK, count - self.width + 1 - begin) + self.width - 1
                highest = highest_difference(
                    self.rate[base + begin : base + begin + size],
                    edges[begin : begin + size + self.averaged],
                    self.width,
                    self.averaged,
                    step,
                )
                out[base + begin : base + begin + len(highest)] = np.linalg.norm(highest, axis=1)
        return out

    def _bounds(self, index: IntArray) -> tuple[IntArray | int, IntArray | int, IntArray | int]:
        """Return first and last-plus-one interval, and first sample, of the arcs of intervals.

        Of a single arc plain numbers, which take less time.
        """
        if len(self.arcs) == 1:
            return int(self.arcs[0, 0]), int(self.arcs[0, 1]), int(self.first_sample[0])
        arc = self.arc_of[index]
        return self.arcs[arc, 0], self.arcs[arc, 1], self.first_sample[arc]

    @property
    def difference_sigma(self) -> float:
        """Standard deviation of the highest difference from the noise of the gyro, rad/s."""
        return self.gyro_sigma * float(np.sqrt(comb(2 * self.width - 2, self.width - 1)))

    def _centred_sample(self, index: IntArray) -> IntArray:
        """Return the first sample of the centred stencil of intervals `index`."""
        first, last, base = self._bounds(index)
        count = last - first + (0 if self.averaged else 1)
        stencil = np.minimum(np.maximum(index - first - 2, 0), count - self.width)
        return np.asarray(base + stencil)

    def _stencil(self, inside: IntArray, most: IntArray | int, base: IntArray | int) -> IntArray:
        """Return the first sample, within the arc, of the stencils of intervals `inside` it.

        Centred, unless the rate is rougher there than noise explains: then the smoothest
        stencil that still contains the interval.
        """
        stencil = np.minimum(np.maximum(inside - 2, 0), most)
        roughness = self._roughness[base + stencil]
        (rough,) = (roughness > _ROUGH * self.difference_sigma).nonzero()
        if rough.size:
            most, base = (np.broadcast_to(each, inside.shape) for each in (most, base))
            back = np.arange(self.width if self.averaged else self.width - 1)
            options = np.clip(inside[rough, None] - back, 0, most[rough, None])
            scores = self._roughness[base[rough, None] + options]
            best = np.argmin(scores, axis=1)
            smoother = scores.min(axis=1) < _SMOOTHER * roughness[rough]
            chosen = np.take_along_axis(options, best[:, None], axis=1)[:, 0]
            stencil[rough[smoother]] = chosen[smoother]
        return stencil

    def coefficients(self, index: IntArray) -> Array:
        """Return coefficients (M, K, 6) of rate and force in powers of (t - start) / dt."""
        if self.dt.size <= _SHORT:
            return np.asarray(self._all[index])
        return self._fit(index)

    @cached_property
    def _all(self) -> Array:
        """All of them, of a short record: asked for again and again."""
        return self._fit(np.arange(self.dt.size))

    def _fit(self, index: IntArray) -> Array:
        first, last, base = self._bounds(index)
        width = self.width
        count = last - first + (0 if self.averaged else 1)
        inside = index - first
        stencil = self._stencil(inside, count - width, base)
        offset = inside - stencil
        rows = (base + stencil)[:, None] + np.arange(width)
        values = np.concatenate([self.rate[rows], self.force[rows]], axis=2)
        edge_count = width + self.averaged
        out = np.matmul(regular_interpolations(edge_count, self.averaged)[offset], values)
        if self.unevenness.max() < _EVEN:
            return np.asarray(out)

        # Edges of the stencil's intervals, relative to the interval and in its lengths.
        intervals = (first + stencil)[:, None] + np.arange(width if self.averaged else width - 1)
        lengths = self.dt[intervals] / self.dt[index][:, None]
        uniform = np.all(np.abs(lengths - 1.0) < UNIFORM, axis=1)
        rest = np.flatnonzero(~uniform)
        if rest.size:
            edges = np.zeros((rest.size, edge_count))
            np.cumsum(lengths[rest], axis=1, out=edges[:, 1:])
            edges -= np.take_along_axis(edges, offset[rest][:, None], axis=1)
            out[rest] = np.matmul(interpolation(edges, self.averaged), values[rest])
        return out


def open_steps(arcs: ArcPolynomials, noise: Array) -> Array:
    """Return the standard deviation of means, (N, 6), over intervals in which a signal steps.

    Two instantaneous samples do not show when between them a signal stepped from the one
    value to the other: the mean is uniform between the two. A step shows as an interval
    that is rough in every stencil that contains it, while the stencils beside it are smooth.

    Parameters
    ----------
    arcs : ArcPolynomials
        Polynomials through instantaneous samples.
    noise : ndarray, shape (6,)
        Standard deviation of the samples.
    """
    width = 6
    sigma = noise * np.sqrt(comb(2 * width - 2, width - 1))
    out = np.zeros((arcs.start.size, 6))
    for (a, b), base in zip(arcs.arcs, arcs.first_sample, strict=True):
        n = b - a
        edges = np.append(arcs.start[a:b], arcs.end[b - 1])
        own = slice(base, base + n + 1)
        values = np.hstack([arcs.rate[own], arcs.force[own]])
        rough = np.abs(highest_difference(values, edges, width, False))
        inside = np.arange(width - 1, n - width + 1)
        if inside.size == 0:
            continue
        holding = np.min([rough[inside - k] for k in range(width - 1)], axis=0)
        beside = np.maximum(rough[inside - width + 1], rough[inside + 1])
        step = (holding > _ROUGH * sigma) & (_SMOOTHER * holding > beside)
        out[a + inside] = np.where(step, holding / np.sqrt(12.0), 0.0)
    return out
