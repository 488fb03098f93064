"""IMU samples to rotation and velocity increments, free of coning and sculling.

Angular rate and specific force are rebuilt between the samples as polynomials through
the neighbouring samples on both sides. That is better than the usual compensation by
the sample before: all samples are there when a trial is processed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.vectors import Array, IntArray, median
from factorgraph_dvl.imu.arc_polynomials import UNIFORM, ArcPolynomials, open_steps
from factorgraph_dvl.imu.interpolation import Smoothed, smooth, unsmoothed
from factorgraph_dvl.imu.polynomials import evaluate, integrate, rate_and_slope
from factorgraph_dvl.imu.timestamps import JUMP, fill_lost, unrounded
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.imu import Imu, ImuSettings

# Lost samples up to this number are interpolated; a longer gap ends the arc. Chosen: a polynomial
# through six neighbours still follows the motion.
MAX_FILLED = 3
# Median intervals after which a sample was preceded by a lost one. Chosen: half-way between one
# and two.
_LOST = 1.5
# Interval, s, from which on stamps are in another unit. Chosen: so slow no vessel is followed.
_SLOWEST = 0.5
# What rounding may take off a time, s.
_ROUNDING = 1e-6
# Relative spread of the intervals up to which the clock counts as regular. Chosen: stamps in
# milliseconds at 100 Hz.
_REGULAR = 0.1
# Intervals whose polynomials are in memory at a time. Chosen: some MB.
_CHUNK = 4000
# Intervals up to which all increments, and signals at edges and smoothed, are kept. Chosen: some
# 100 MB.
_KEPT = 1_000_000
# Intervals from which on splines of rate and force share their knots. Chosen: a few seconds.
_FEW = 1000
# Samples that an arc has at least: those of the widest stencil.
_LEAST = 6
# Standard deviations from which on a difference may be a step. Chosen: seldom by chance.
_BEYOND_NOISE = 3.0


@dataclass(frozen=True)
class Partial:
    """Motion since the start of M intervals, and the signals at its end.

    Parameters
    ----------
    phi : ndarray, shape (M, 3), rad
        Rotation vector.
    dv, dp : ndarray, shape (M, 3), m/s or m
        Velocity and position increment in the axes at the start of the interval.
    omega, alpha, force : ndarray, shape (M, 3)
        Rate, its derivative, specific force at the end.
    omega_sigma : ndarray, shape (M, 3)
        Standard deviation of omega from noise, and from motion that the samples do not resolve,
        rad/s.
    alpha_sigma, force_sigma : ndarray, shape (M,)
        Standard deviation of alpha and force from noise.
    rough, moving : ndarray, shape (M, 3), optional
        Rates at which attitude and position change at the end, less omega and dv, rad/s and m/s:
        the rate is smoothed, and the increments are those of the samples, smooth and rough
        (Tukey, Exploratory Data Analysis, 1977).
    """

    phi: Array
    dv: Array
    dp: Array
    omega: Array
    alpha: Array
    force: Array
    omega_sigma: Array
    alpha_sigma: Array
    force_sigma: Array
    rough: Array | None = None
    moving: Array | None = None


@dataclass(frozen=True)
class Increments(ArcPolynomials):
    """Increments over N intervals, grouped into arcs without gaps.

    Parameters
    ----------
    open_sigma : ndarray, shape (N, 6)
        Standard deviation of the mean rate and force over an interval where the samples leave it
        open: lost ones, or a step between two of them; else 0.
    accel_sigma : float
        Standard deviation of one sample of the force from its noise, m/s².
    smoothing : tuple of (int, int), optional
        How rate and force are smoothed; None = chosen from the record.
    """

    open_sigma: Array
    accel_sigma: float
    smoothing: tuple[int, int] | None = None

    @cached_property
    def fastest(self) -> float:
        """Largest component of the rate, rad/s."""
        return max(float(self.rate.max()), -float(self.rate.min()))

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
        index = np.maximum(self.start.searchsorted(time + _ROUNDING, side="right") - 1, 0)
        since = time - self.start[index]
        slack = _ROUNDING + 1e-3 * self.dt[index]
        return index, since, (since >= -slack) & (since <= self.dt[index] + slack)

    def over(self, index: IntArray) -> tuple[Array, Array]:
        """Return phi and dv over whole intervals `index`, (M, 3) each."""
        if self.dt.size <= _KEPT:
            return self._every[0][index], self._every[1][index]
        return self._over(index)

    @cached_property
    def _every(self) -> tuple[Array, Array]:
        """Increments over all intervals: asked for again and again."""
        return self._over(np.arange(self.dt.size))

    def edge_signals(self, index: IntArray, *, after: bool) -> Array:
        """Return rate and force at the edges before or after intervals (M,), (2, M, 3)."""
        if self.dt.size > _KEPT:
            return self._edge_signals(index, after=after)
        place = index + self.arc_of[index] + (1 if after else 0)
        return self._every_edge.take(place, axis=1)

    @cached_property
    def _every_edge(self) -> Array:
        """Rate and force at all edges, one more in each arc than it has intervals."""
        every = np.arange(self.dt.size)
        out = np.empty((2, self.dt.size + len(self.arcs), 3))
        out[:, every + self.arc_of] = self._edge_signals(every, after=False)
        last = self.arcs[:, 1] - 1
        out[:, last + self.arc_of[last] + 1] = self._edge_signals(last, after=True)
        return out

    def _edge_signals(self, index: IntArray, *, after: bool) -> Array:
        time = self.start[index] + (self.dt[index] if after else 0.0)
        out = np.empty((2, index.size, 3))
        for mine, signals in self.by_arc(index):
            raw: Array | None = None
            for i, signal in enumerate(signals):
                if signal.spline is not None:
                    out[i, mine] = signal.spline(time[mine])
                    continue
                raw = self._raw_edge(index[mine], after=after) if raw is None else raw
                out[i, mine] = raw[:, 3 * i : 3 * i + 3]
        return out

    def _raw_edge(self, index: IntArray, *, after: bool) -> Array:
        """Return rate and force (M, 6) at edges, half-way between the polynomials beside them."""
        near = np.clip(index + (1 if after else -1), 0, self.dt.size - 1)
        near = np.where(self.arc_of[near] == self.arc_of[index], near, index)
        own, other = self.coefficients(index), self.coefficients(near)
        # A polynomial's value is its first coefficient at the start, the sum of all at the end.
        at_start, at_end = (own, other) if not after else (other, own)
        first, last = at_start[:, 0], at_end.sum(axis=1)
        alone = (near == index)[:, None]
        own_edge = last if after else first
        return np.where(alone, own_edge, 0.5 * (first + last))

    def _over(self, index: IntArray) -> tuple[Array, Array]:
        phi, dv = np.empty((index.size, 3)), np.empty((index.size, 3))
        for a in range(0, index.size, _CHUNK):
            part = index[a : a + _CHUNK]
            c = self.coefficients(part)
            phi[a : a + _CHUNK], dv[a : a + _CHUNK] = integrate(c, self.dt[part])
        return phi, dv

    def partial(self, index: IntArray, since: Array, *, rates: bool = True) -> Partial:
        """Return the motion over the first `since` seconds of intervals `index`, (M,).

        The signals at its end are zero without `rates`: these take most of the time.
        """
        c = self.coefficients(index)
        dt = self.dt[index]
        u = since / dt
        phi, dv = integrate(c, dt, u)
        dp = 0.5 * dv * since[:, None]
        if not rates:
            vectors, numbers = np.zeros((index.size, 3)), np.zeros(index.size)
            return Partial(phi, dv, dp, vectors, vectors, vectors, vectors, numbers, numbers)
        force = np.empty((index.size, 3))
        time = self.start[index] + since
        for mine, (_, forces) in self.by_arc(index):
            if forces.spline is None:
                force[mine] = evaluate(c[mine, :, 3:], u[mine])
            else:
                force[mine] = forces.spline(time[mine])
        return Partial(phi, dv, dp, force=force, **self.rate_at(index, since))

    def rate_at(self, index: IntArray, since: Array) -> dict[str, Array]:
        """Return the rate after `since` seconds of intervals `index`, (M,).

        With its derivative, and the standard deviations of both and of the force, as `Partial` has
        them.
        """
        omega, alpha = np.empty((2, index.size, 3))
        # A step leaves high differences, a smooth motion almost none; what the gyro's noise
        # accounts for is in its own standard deviation already.
        rough = np.abs(self.difference_at(index))
        noise = _BEYOND_NOISE * self.difference_sigma
        unresolved = np.sqrt(np.maximum(rough**2 - noise**2, 0.0)) / 4.0
        omega_sigma, alpha_sigma, force_sigma = np.empty((3, index.size))
        time = self.start[index] + since
        for mine, (rate, forces) in self.by_arc(index):
            omega_sigma[mine], alpha_sigma[mine] = rate.sigma, rate.slope_sigma
            force_sigma[mine] = forces.sigma
            if rate.spline is None:
                omega[mine], alpha[mine] = self._blended_rate(index[mine], since[mine])
            else:
                omega[mine], alpha[mine], misfit = rate.at(time[mine])
                unresolved[mine] = np.hypot(unresolved[mine], misfit)
        return {
            "omega": omega,
            "alpha": alpha,
            "omega_sigma": np.hypot(omega_sigma[:, None], unresolved),
            "alpha_sigma": alpha_sigma,
            "force_sigma": force_sigma,
        }

    def by_arc(
        self, index: IntArray
    ) -> Iterator[tuple[slice | IntArray, tuple[Smoothed, Smoothed]]]:
        """Yield which of intervals (M,) are in each arc, and its smoothed rate and force."""
        for arc, signals in enumerate(self.smoothed):
            # Views of all are no copies.
            alone = len(self.arcs) == 1
            yield slice(None) if alone else np.flatnonzero(self.arc_of[index] == arc), signals

    @property
    def chosen_smoothing(self) -> tuple[int, int]:
        """How rate and force of the last arc are smoothed."""
        rate, force = self.smoothed[-1]
        return rate.window, force.window

    def release(self) -> None:
        """Free the smoothed signals of a long record; they are found anew if needed."""
        if self.dt.size > _KEPT:
            vars(self).pop("smoothed", None)

    @cached_property
    def smoothed(self) -> tuple[tuple[Smoothed, Smoothed], ...]:
        """Rate and force of each arc, smoothed where their noise asks for it."""
        out = []
        for (a, b), base, dt, unlike in zip(
            self.arcs, self.first_sample, self.step, self.unevenness, strict=True
        ):
            time = self.start[a:b] + 0.5 * self.dt[a:b]
            if not self.averaged:
                time = np.append(self.start[a:b], self.end[b - 1])
            own = slice(base, base + time.size)
            rates, forces = self._smoothed_pair(
                time, self.rate[own], self.force[own], dt, regular=unlike < UNIFORM
            )
            # Those of few are not worth sharing.
            if self.dt.size > _FEW:
                forces = forces.on_knots_of(rates)
            out.append((rates, forces))
        return tuple(out)

    def smooth_with_neighbours(self, time: Array, rate: Array, force: Array) -> None:
        """Smooth a single arc as part of samples (S, 3) that reach beyond it, at times (S,)."""
        dt = time[1:] - time[:-1]
        step = median(dt)
        regular = bool(np.abs(dt / step - 1.0).max() < UNIFORM)
        middle = time - 0.5 * np.concatenate([[step], dt]) if self.averaged else time
        smoothed = self._smoothed_pair(middle, rate, force, step, regular=regular)
        vars(self)["smoothed"] = (smoothed,)

    def _smoothed_pair(
        self, time: Array, rate: Array, force: Array, dt: float, *, regular: bool
    ) -> tuple[Smoothed, Smoothed]:
        if not regular:
            return unsmoothed(dt, self.gyro_sigma), unsmoothed(dt, self.accel_sigma)
        by_rate, by_force = (None, None) if self.smoothing is None else self.smoothing
        return (
            smooth(time, rate, dt, self.gyro_sigma, averaged=self.averaged, window=by_rate),
            smooth(
                time,
                force,
                dt,
                self.accel_sigma,
                averaged=self.averaged,
                window=by_force,
                with_misfit=False,
            ),
        )

    def _blended_rate(self, index: IntArray, since: Array) -> tuple[Array, Array]:
        """Return rate and derivative, (M, 3), which do not jump from interval to interval.

        Towards an end of its interval the polynomial gives way to the neighbour's, half and
        half at the end itself, and not at all in its middle. In smooth motion the two agree; at a
        step they do not, and a time offset can only be found where the prediction does not jump.
        """
        u = since / self.dt[index]
        near = np.where(u < 0.5, index - 1, index + 1)
        near = np.clip(near, 0, self.dt.size - 1)
        near = np.where(self.arc_of[near] == self.arc_of[index], near, index)
        gap = np.where(near < index, self.dt[near], -self.dt[index])
        gap = np.where(near == index, 0.0, gap)
        own, own_slope = rate_and_slope(self.coefficients(index), since, self.dt[index])
        other, other_slope = rate_and_slope(self.coefficients(near), since + gap, self.dt[near])
        # From 0 at an end to 1 in the middle.
        inward = np.clip(2.0 * np.minimum(u, 1.0 - u), 0.0, 1.0)[:, None]
        weight = 0.5 + inward - 0.5 * inward**2
        sign = np.where(u < 0.5, 2.0, -2.0) / self.dt[index]
        moving = (1.0 - inward) * sign[:, None]
        return (
            weight * own + (1.0 - weight) * other,
            weight * own_slope + (1.0 - weight) * other_slope + moving * (own - other),
        )


def increments(
    imu: Imu, smoothing: tuple[int, int] | None = None
) -> tuple[Increments, tuple[Finding, ...]]:
    """Return increments between the samples of an IMU, and what had to be bridged.

    Parameters
    ----------
    imu : Imu
        Record of the IMU.
    smoothing : tuple of (int, int), optional
        See `Increments`.

    Returns
    -------
    increments : Increments
        Increments of all arcs.
    findings : tuple of Finding
        What was lost, filled or left out.

    Raises
    ------
    DataError
        If no stretch of the record is long enough to integrate.
    """
    averaged = imu.settings.sampling == "mean"
    time, rate, force, filled_sigma, broken, lost = _bridged(imu)
    bounds = np.concatenate([[0], np.flatnonzero(broken) + 1, [time.size]])
    whole = [(a, b) for a, b in itertools.pairwise(bounds) if b - a >= _LEAST]
    if not whole:
        raise DataError(
            "no stretch without gaps is long enough",
            where=imu.source,
            expected=f"at least {_LEAST} samples in a row",
        )
    # Since the first sample: seconds of an epoch leave a double 1e-7 s only.
    edges = [unrounded(time[a:b]) for a, b in whole]
    if averaged:
        edges = [np.concatenate([[e[0] - median(np.diff(e))], e]) for e in edges]
    ends = np.cumsum([e.size - 1 for e in edges])
    out = _increments(
        imu.settings,
        median(np.diff(imu.time)),
        smoothing,
        start=np.concatenate([time[a] + e[:-1] for (a, _), e in zip(whole, edges, strict=True)]),
        dt=np.concatenate([np.diff(e) for e in edges]),
        arcs=np.stack([np.concatenate([[0], ends[:-1]]), ends], axis=1),
        rate=_in_a_row([rate[a:b] for a, b in whole]),
        force=_in_a_row([force[a:b] for a, b in whole]),
        first_sample=np.cumsum([0, *(b - a for a, b in whole)])[:-1],
        open_sigma=_in_a_row([filled_sigma[a + (not averaged) : b] for a, b in whole]),
    )
    alone = [(b - a, float(time[a])) for a, b in itertools.pairwise(bounds) if b - a < _LEAST]
    return out, (*lost, *_unused(alone), *_gaps(out))


def unbroken_increments(
    settings: ImuSettings,
    time: Array,
    rate: Array,
    force: Array,
    smoothing: tuple[int, int],
    wanted: slice,
) -> Increments:
    """Return increments between samples of which none was lost, with times as they are.

    Those outside of what is wanted are only smoothed with it.

    Parameters
    ----------
    settings : ImuSettings
        Settings of the IMU.
    time : ndarray, shape (S,), s
        Times of the samples, `_LEAST` at least.
    rate, force : ndarray, shape (S, 3)
        The samples.
    smoothing : tuple of (int, int)
        See `Increments`.
    wanted : slice
        The samples between which increments are wanted, `_LEAST` at least.
    """
    own = time[wanted]
    since = own - own[0]
    dt = since[1:] - since[:-1]
    usual = median(dt)
    start = own[:-1]
    if settings.sampling == "mean":
        dt = np.concatenate([[usual], dt])
        start = np.concatenate([[start[0] - usual], start])
    out = _increments(
        settings,
        usual,
        smoothing,
        start=start,
        dt=dt,
        arcs=np.array([[0, dt.size]]),
        rate=rate[wanted],
        force=force[wanted],
        first_sample=np.zeros(1, dtype=int),
        open_sigma=np.zeros((dt.size, 6)),
    )
    out.smooth_with_neighbours(time, rate, force)
    return out


def _increments(
    settings: ImuSettings,
    step: float,
    smoothing: tuple[int, int] | None,
    **arrays: Array,
) -> Increments:
    """Return increments of these arrays, and of the noise of samples every `step` s."""
    root_step = math.sqrt(step)
    averaged = settings.sampling == "mean"
    out = Increments(
        **arrays,
        averaged=averaged,
        gyro_sigma=settings.gyro_noise_root_psd / root_step,
        accel_sigma=settings.accel_noise_root_psd / root_step,
        smoothing=smoothing,
    )
    if not averaged:
        noise = np.repeat([out.gyro_sigma, out.accel_sigma], 3)
        np.hypot(out.open_sigma, open_steps(out, noise), out=out.open_sigma)
    return out


def _in_a_row(parts: Sequence[Array]) -> Array:
    """Return arrays one after another; a single one is not copied."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _bridged(imu: Imu) -> tuple[Array, Array, Array, Array, np.ndarray, list[Finding]]:
    """Return times, rates and forces with few lost ones filled in, and where the record breaks.

    The standard deviations of what was filled in stand fourth, the findings last.
    """
    time = imu.time
    if time.size < _LEAST:
        raise DataError(
            f"only {time.size} samples", where=imu.source, expected=f"at least {_LEAST}"
        )
    step = np.diff(time)
    dt = median(step)
    if dt > _SLOWEST:
        raise DataError(
            f"one sample in {dt:.3g} s",
            where=imu.source,
            expected=f"at least {1.0 / _SLOWEST:.0f} in a second",
            hint="Is time_s in seconds?",
        )
    lost, late = np.zeros(step.size, dtype=int), step > _LOST * dt
    if late.any() and np.quantile(np.abs(step / dt - 1.0), 0.9) < _REGULAR:
        lost = np.where(late, np.rint(step / dt).astype(int) - 1, 0)
    bridged = (lost > 0) & (lost <= MAX_FILLED)
    broken = (lost > MAX_FILLED) | (step > (MAX_FILLED + _LOST) * dt)
    if not bridged.any():
        # Unlike those of `zeros_like`, these zeros take no memory until one is written.
        return time, imu.gyro, imu.accel, np.zeros((time.size, 6)), broken, []
    samples = np.hstack([imu.gyro, imu.accel])
    time, samples, filled_sigma, broken = fill_lost(time, samples, lost, bridged, broken)
    text = message(
        "lost_samples.interpolated",
        samples=int(lost[bridged].sum()),
        places=int(bridged.sum()),
        time=imu.time[np.argmax(bridged)],
    )
    rate, force = samples[:, :3], samples[:, 3:]
    return time, rate, force, filled_sigma, broken, [Finding(Code.LOST_SAMPLES, text, "IMU")]


def _unused(alone: list[tuple[int, float]]) -> Iterator[Finding]:
    """Yield the stretches that are too short, by their samples and start."""
    for count, start in alone:
        text = message("unused.isolated", count=count, start=start)
        yield Finding(Code.UNUSED, text, "IMU")


def _gaps(inc: Increments) -> Iterator[Finding]:
    """Yield the gaps between arcs."""
    for (_, b), (c, _) in itertools.pairwise(inc.arcs):
        end, start = inc.end[b - 1], inc.start[c]
        if start - end > JUMP:
            text = message("clock_jump.imu", start=end, end=start)
            yield Finding(Code.CLOCK_JUMP, text, "IMU")
        else:
            text = message("imu_gap.long", length=start - end, time=end)
            yield Finding(Code.IMU_GAP, text, "IMU")
