"""IMU samples to rotation and velocity increments, free of coning and sculling.

Angular rate and specific force are rebuilt between the samples as polynomials through
the neighbouring samples on both sides. That is better than the usual compensation by
the sample before: all samples are there when a trial is processed. Where the rate steps,
as at the start of an abrupt turn, a polynomial across the step would ring; there the
neighbours are taken from the smoother side (the idea of essentially non-oscillatory
schemes: Harten, Engquist, Osher, Chakravarthy, J. Comput. Phys. 71 (1987)).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from math import comb

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.interpolation import Smoothed, smooth, unsmoothed
from factorgraph_dvl.imu.polynomials import (
    evaluate,
    highest_difference,
    integrate,
    interpolation,
    rate_and_slope,
    regular_interpolation,
)
from factorgraph_dvl.imu.timestamps import JUMP, fill_lost, unrounded
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.imu import Imu

IntArray = np.ndarray

# Lost samples up to this number are interpolated; a longer gap ends the arc.
MAX_FILLED = 3
# Samples that are this much later than the median interval were preceded by lost ones.
_LOST = 1.5
# Slower samples, s, do not follow any vessel; they are times in another unit.
_SLOWEST = 0.5
# What rounding may take off a time, s.
_ROUNDING = 1e-6
# Relative spread of the intervals up to which the clock counts as regular.
_REGULAR = 0.1
_UNIFORM = 1e-3
_CHUNK = 4000
# Intervals up to which all polynomials are kept.
_SHORT = 200
# How much rougher than the noise of the gyro a motion must be to look for a step in it,
# and how much smoother the stencil on one side.
_ROUGH = 6.0
_SMOOTHER = 0.3
# A difference is no sign of a step before it is so many of its standard deviations.
_BEYOND_NOISE = 3.0


@dataclass(frozen=True)
class Partial:
    """Motion since the start of M intervals, and the signals at its end.

    Parameters
    ----------
    phi : ndarray, shape (M, 3), rad
        Rotation vector.
    dv : ndarray, shape (M, 3), m/s
        Velocity increment in the axes at the start of the interval.
    omega, alpha, force : ndarray, shape (M, 3)
        Rate, its derivative, specific force at the end.
    omega_sigma : ndarray, shape (M, 3)
        Standard deviation of omega from noise, and from motion that the samples do not resolve,
        rad/s.
    alpha_sigma, force_sigma : ndarray, shape (M,)
        Standard deviation of alpha and force from noise.
    """

    phi: Array
    dv: Array
    omega: Array
    alpha: Array
    force: Array
    omega_sigma: Array
    alpha_sigma: Array
    force_sigma: Array


@dataclass(frozen=True)
class Increments:
    """Increments over N intervals, grouped into arcs without gaps.

    Parameters
    ----------
    start, dt : ndarray, shape (N,), s
        Start and length of the intervals.
    arcs : ndarray of int, shape (A, 2)
        First and last-plus-one interval of each arc.
    samples : ndarray, shape (S, 6)
        Rate and specific force that the polynomials pass through: the means over the intervals, or
        the values at their ends.
    first_sample : ndarray of int, shape (A,)
        Index in `samples` of each arc's first.
    averaged : bool
        Whether `samples` are means over the intervals.
    open_sigma : ndarray, shape (N, 6)
        Standard deviation of the mean rate and force over an interval where the samples leave it
        open: lost ones, or a step between two of them; else 0.
    gyro_sigma, accel_sigma : float
        Standard deviation of one sample from its noise, SI.
    windows : tuple of (int, int), optional
        Samples over which rate and force are smoothed; None = chosen from the record.
    """

    start: Array
    dt: Array
    arcs: IntArray
    samples: Array
    first_sample: IntArray
    averaged: bool
    open_sigma: Array
    gyro_sigma: float
    accel_sigma: float
    windows: tuple[int, int] | None = None

    @cached_property
    def arc_of(self) -> IntArray:
        """Arc of each interval, (N,)."""
        return np.repeat(np.arange(len(self.arcs)), self.arcs[:, 1] - self.arcs[:, 0])

    @property
    def end(self) -> Array:
        """End of the intervals, (N,), s."""
        return self.start + self.dt

    def ticks(self, rate_hz: float) -> Array:
        """Return the multiples of 1 / rate that the arcs cover, s; gaps cost nothing."""
        runs = [
            np.arange(np.ceil(first * rate_hz - 1e-6), np.floor(last * rate_hz + 1e-6) + 1)
            for first, last in zip(
                self.start[self.arcs[:, 0]], self.end[self.arcs[:, 1] - 1], strict=True
            )
        ]
        time = np.unique(np.concatenate(runs)) / rate_hz
        return np.asarray(time[self.locate(time)[2]] + 0.0)

    def locate(self, time: Array) -> tuple[IntArray, Array, np.ndarray]:
        """Return interval, time since its start (s) and whether an arc covers the time."""
        # Times that were rounded belong to the interval at whose start they are meant to be.
        index = np.searchsorted(self.start, time + _ROUNDING, side="right") - 1
        index = np.clip(index, 0, None)
        since = time - self.start[index]
        slack = _ROUNDING + 1e-3 * self.dt[index]
        return index, since, (since >= -slack) & (since <= self.dt[index] + slack)

    def over(self, index: IntArray) -> tuple[Array, Array]:
        """Return phi and dv over whole intervals `index`, (M, 3) each."""
        phi, dv = np.empty((index.size, 3)), np.empty((index.size, 3))
        for a in range(0, index.size, _CHUNK):
            part = index[a : a + _CHUNK]
            c = self._polynomials(part)
            phi[a : a + _CHUNK], dv[a : a + _CHUNK] = integrate(c, self.dt[part], 1.0)
        return phi, dv

    def partial(self, index: IntArray, since: Array) -> Partial:
        """Return the motion over the first `since` seconds of intervals `index`, (M,)."""
        c = self._polynomials(index)
        dt = self.dt[index]
        u = since / dt
        phi, dv = integrate(c, dt, u)
        omega, alpha = self._blended_rate(index, since, c)
        force = evaluate(c, u)[:, 3:]
        # A step or a vibration leaves high differences, a smooth motion almost none; what
        # the gyro's noise accounts for is in its own standard deviation already.
        rough = np.abs(self._differences[self._centred_sample(index)])
        noise = _BEYOND_NOISE * self._difference_sigma
        unresolved = np.sqrt(np.maximum(rough**2 - noise**2, 0.0)) / 4.0
        omega_sigma, alpha_sigma, force_sigma = (np.empty(index.size) for _ in range(3))
        time = self.start[index] + since
        for arc, (rates, forces) in enumerate(self._smoothed):
            mine = np.flatnonzero(self.arc_of[index] == arc)
            omega_sigma[mine], alpha_sigma[mine] = rates.sigma, rates.slope_sigma
            force_sigma[mine] = forces.sigma
            if rates.spline is not None:
                omega[mine], alpha[mine], misfit = rates.at(time[mine])
                unresolved[mine] = np.hypot(unresolved[mine], misfit)
            if forces.spline is not None:
                force[mine] = forces.at(time[mine])[0]
        return Partial(
            phi=phi,
            dv=dv,
            omega=omega,
            alpha=alpha,
            force=force,
            omega_sigma=np.hypot(omega_sigma[:, None], unresolved),
            alpha_sigma=alpha_sigma,
            force_sigma=force_sigma,
        )

    @property
    def chosen_windows(self) -> tuple[int, int]:
        """Samples over which rate and force of the last arc are smoothed; 0 = not at all."""
        rate, force = self._smoothed[-1]
        return rate.window, force.window

    @cached_property
    def _smoothed(self) -> tuple[tuple[Smoothed, Smoothed], ...]:
        """Rate and force of each arc, smoothed where their noise asks for it."""
        out = []
        for (a, b), base in zip(self.arcs, self.first_sample, strict=True):
            steps = self.dt[a:b]
            dt = float(np.median(steps))
            time = self.start[a:b] + 0.5 * steps
            if not self.averaged:
                time = np.append(self.start[a:b], self.end[b - 1])
            values = self.samples[base : base + time.size]
            regular = np.abs(steps / dt - 1.0).max() < _UNIFORM
            pair = []
            for i, (signal, sigma) in enumerate(
                ((values[:, :3], self.gyro_sigma), (values[:, 3:], self.accel_sigma))
            ):
                window = None if self.windows is None else self.windows[i]
                pair.append(
                    smooth(time, signal, dt, sigma, averaged=self.averaged, window=window)
                    if regular
                    else unsmoothed(dt, sigma)
                )
            out.append((pair[0], pair[1]))
        return tuple(out)

    def _blended_rate(self, index: IntArray, since: Array, c: Array) -> tuple[Array, Array]:
        """Return rate and derivative, (M, 3), continuous from interval to interval.

        Towards an end of its interval the polynomial gives way to the neighbour's, half and
        half at the end itself. In smooth motion the two agree; at a step they do not, and a
        time offset can only be found where the prediction does not jump.
        """
        u = since / self.dt[index]
        near = np.where(u < 0.5, index - 1, index + 1)
        near = np.clip(near, 0, self.dt.size - 1)
        near = np.where(self.arc_of[near] == self.arc_of[index], near, index)
        gap = np.where(near < index, self.dt[near], -self.dt[index])
        gap = np.where(near == index, 0.0, gap)
        own, own_slope = rate_and_slope(c, since, self.dt[index])
        other, other_slope = rate_and_slope(self._polynomials(near), since + gap, self.dt[near])
        inward = np.where(u < 0.5, 1.0, -1.0)
        weight = np.clip(0.5 + np.where(u < 0.5, u, 1.0 - u), 0.0, 1.0)[:, None]
        moving = ((weight > 0.0) & (weight < 1.0)) * (inward / self.dt[index])[:, None]
        return (
            weight * own + (1.0 - weight) * other,
            weight * own_slope + (1.0 - weight) * other_slope + moving * (own - other),
        )

    @property
    def _width(self) -> int:
        """Number of samples that a polynomial passes through."""
        return 5 if self.averaged else 6

    @cached_property
    def _differences(self) -> Array:
        """Highest difference of the rate over the stencil from each sample on, (S, 3)."""
        out = np.full((self.samples.shape[0], 3), np.inf)
        for (a, b), base in zip(self.arcs, self.first_sample, strict=True):
            edges = np.append(self.start[a:b], self.end[b - 1])
            count = b - a + (0 if self.averaged else 1)
            highest = highest_difference(
                self.samples[base : base + count, :3], edges, self._width, self.averaged
            )
            out[base : base + highest.shape[0]] = highest
        return out

    @cached_property
    def _roughness(self) -> Array:
        """Size of `_differences`, (S,), rad/s."""
        return np.asarray(np.linalg.norm(self._differences, axis=1))

    @property
    def _difference_sigma(self) -> float:
        """Standard deviation of `_differences` from the noise of the gyro, rad/s."""
        return self.gyro_sigma * float(np.sqrt(comb(2 * self._width - 2, self._width - 1)))

    def _centred_sample(self, index: IntArray) -> IntArray:
        """Return the first sample of the centred stencil of intervals `index`."""
        arc = self.arc_of[index]
        first, last = self.arcs[arc, 0], self.arcs[arc, 1]
        count = last - first + (0 if self.averaged else 1)
        return self.first_sample[arc] + np.clip(index - first - 2, 0, count - self._width)

    def _stencil(self, inside: IntArray, most: IntArray, base: IntArray) -> IntArray:
        """Return the first sample, within the arc, of the stencils of intervals `inside` it.

        Centred, unless the rate is rougher there than noise explains: then the smoothest
        stencil that still holds the interval.
        """
        stencil = np.clip(inside - 2, 0, most)
        roughness = self._roughness[base + stencil]
        rough = np.flatnonzero(roughness > _ROUGH * self._difference_sigma)
        if rough.size:
            back = np.arange(self._width if self.averaged else self._width - 1)
            options = np.clip(inside[rough, None] - back, 0, most[rough, None])
            scores = self._roughness[base[rough, None] + options]
            best = np.argmin(scores, axis=1)
            smoother = scores.min(axis=1) < _SMOOTHER * roughness[rough]
            chosen = np.take_along_axis(options, best[:, None], axis=1)[:, 0]
            stencil[rough[smoother]] = chosen[smoother]
        return stencil

    def _polynomials(self, index: IntArray) -> Array:
        """Return coefficients (M, K, 6) of rate and force in powers of (t - start) / dt."""
        if self.dt.size <= _SHORT:
            return np.asarray(self._all_polynomials[index])
        return self._fit(index)

    @cached_property
    def _all_polynomials(self) -> Array:
        """All of them, of a short record: asked for again and again."""
        return self._fit(np.arange(self.dt.size))

    def _fit(self, index: IntArray) -> Array:
        arc = self.arc_of[index]
        first, last = self.arcs[arc, 0], self.arcs[arc, 1]
        width = self._width
        count = last - first + (0 if self.averaged else 1)
        stencil = self._stencil(index - first, count - width, self.first_sample[arc])
        offset = index - first - stencil
        rows = (self.first_sample[arc] + stencil)[:, None] + np.arange(width)
        values = self.samples[rows]

        # Edges of the stencil's intervals, relative to the interval and in its lengths.
        intervals = (first + stencil)[:, None] + np.arange(width if self.averaged else width - 1)
        lengths = self.dt[intervals] / self.dt[index][:, None]
        uniform = np.all(np.abs(lengths - 1.0) < _UNIFORM, axis=1)
        out = np.empty((index.size, width, 6))
        for shift in np.unique(offset[uniform]):
            pick = uniform & (offset == shift)
            matrix = regular_interpolation(lengths.shape[1] + 1, int(shift), self.averaged)
            out[pick] = np.matmul(matrix, values[pick])
        rest = np.flatnonzero(~uniform)
        if rest.size:
            edges = np.zeros((rest.size, lengths.shape[1] + 1))
            np.cumsum(lengths[rest], axis=1, out=edges[:, 1:])
            edges -= np.take_along_axis(edges, offset[rest][:, None], axis=1)
            out[rest] = np.matmul(interpolation(edges, self.averaged), values[rest])
        return out


def increments(
    imu: Imu, windows: tuple[int, int] | None = None
) -> tuple[Increments, tuple[Finding, ...]]:
    """Return increments between the samples of an IMU, and what had to be bridged.

    Parameters
    ----------
    imu : Imu
        Record of the IMU.
    windows : tuple of (int, int), optional
        See `Increments`.

    Returns
    -------
    increments : Increments
        Of all arcs.
    findings : tuple of Finding
        What was lost, filled or left out.

    Raises
    ------
    DataError
        If no stretch of the record is long enough to integrate.
    """
    averaged = imu.settings.sampling == "mean"
    time, samples = imu.time, np.hstack([imu.gyro, imu.accel])
    least = 6
    if time.size < least:
        raise DataError(
            f"only {time.size} samples", where=imu.source, expected=f"at least {least}"
        )
    step = np.diff(time)
    dt = float(np.median(step))
    if dt > _SLOWEST:
        raise DataError(
            f"one sample in {dt:.3g} s",
            where=imu.source,
            expected=f"at least {1.0 / _SLOWEST:.0f} in a second",
            hint="Is time_s in seconds?",
        )
    filled_sigma = np.zeros_like(samples)
    findings: list[Finding] = []

    lost = np.zeros(step.size, dtype=int)
    if np.quantile(np.abs(step / dt - 1.0), 0.9) < _REGULAR:
        lost = np.where(step > _LOST * dt, np.rint(step / dt).astype(int) - 1, 0)
    bridged = (lost > 0) & (lost <= MAX_FILLED)
    broken = (lost > MAX_FILLED) | (step > (MAX_FILLED + _LOST) * dt)
    if bridged.any():
        time, samples, filled_sigma, broken = fill_lost(time, samples, lost, bridged, broken)
        findings.append(
            Finding(
                Code.LOST_SAMPLES,
                f"{int(lost[bridged].sum())} lost samples in {int(bridged.sum())} places were "
                f"interpolated, the first after {imu.time[np.argmax(bridged)]:.3f} s",
                sensor="IMU",
            )
        )

    bounds = np.concatenate([[0], np.flatnonzero(broken) + 1, [time.size]])
    starts, lengths, arcs, first_sample, kept, fill = [], [], [], [], [], []
    n_intervals = n_samples = 0
    for a, b in itertools.pairwise(bounds):
        if b - a < least:
            findings.append(
                Finding(
                    Code.UNUSED,
                    f"{b - a} samples at {time[a]:.3f} s stand alone between gaps and were not "
                    "used",
                    sensor="IMU",
                )
            )
            continue
        # Since the first sample: seconds of an epoch leave a double 1e-7 s only.
        edges = unrounded(time[a:b])
        if averaged:
            edges = np.concatenate([[edges[0] - np.median(np.diff(edges))], edges])
        starts.append(time[a] + edges[:-1])
        lengths.append(np.diff(edges))
        arcs.append((n_intervals, n_intervals + edges.size - 1))
        first_sample.append(n_samples)
        kept.append(samples[a:b])
        fill.append(filled_sigma[a:b] if averaged else filled_sigma[a + 1 : b])
        n_intervals += edges.size - 1
        n_samples += b - a
    if not arcs:
        raise DataError(
            "no stretch without gaps is long enough",
            where=imu.source,
            expected=f"at least {least} samples in a row",
        )
    start, length = np.concatenate(starts), np.concatenate(lengths)
    for (_, b), (c, _) in itertools.pairwise(arcs):
        end = start[b - 1] + length[b - 1]
        code, what = Code.IMU_GAP, f"gap of {start[c] - end:.3f} s at {end:.3f} s"
        if start[c] - end > JUMP:
            code = Code.CLOCK_JUMP
            what = f"time_s jumps from {end:.3f} to {start[c]:.3f} s, as where a clock is set"
        findings.append(Finding(code, f"{what}: the inertial chain breaks there", sensor="IMU"))
    out = Increments(
        start=start,
        dt=length,
        arcs=np.array(arcs),
        samples=np.concatenate(kept),
        first_sample=np.array(first_sample),
        averaged=averaged,
        open_sigma=np.concatenate(fill),
        gyro_sigma=imu.settings.gyro_noise_root_psd / np.sqrt(dt),
        accel_sigma=imu.settings.accel_noise_root_psd / np.sqrt(dt),
        windows=windows,
    )
    if not averaged:
        noise = np.repeat([out.gyro_sigma, out.accel_sigma], 3)
        np.hypot(out.open_sigma, _steps(out, noise), out=out.open_sigma)
    return out, tuple(findings)


def _steps(inc: Increments, noise: Array) -> Array:
    """Return the standard deviation of means, (N, 6), over intervals in which a signal steps.

    Two instantaneous samples do not show when between them a signal stepped from the one
    value to the other: the mean is uniform between the two. A step shows as an interval
    that is rough in every stencil that holds it, while the stencils beside it are smooth.

    Parameters
    ----------
    inc : Increments
        Increments of instantaneous samples.
    noise : ndarray, shape (6,)
        Standard deviation of the samples.
    """
    width = 6
    sigma = noise * np.sqrt(comb(2 * width - 2, width - 1))
    out = np.zeros((inc.start.size, 6))
    for (a, b), base in zip(inc.arcs, inc.first_sample, strict=True):
        n = b - a
        edges = np.append(inc.start[a:b], inc.end[b - 1])
        rough = np.abs(highest_difference(inc.samples[base : base + n + 1], edges, width, False))
        inside = np.arange(width - 1, n - width + 1)
        if inside.size == 0:
            continue
        holding = np.min([rough[inside - k] for k in range(width - 1)], axis=0)
        beside = np.maximum(rough[inside - width + 1], rough[inside + 1])
        step = (holding > _ROUGH * sigma) & (_SMOOTHER * holding > beside)
        out[a + inside] = np.where(step, holding / np.sqrt(12.0), 0.0)
    return out
