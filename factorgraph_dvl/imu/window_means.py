"""Means of the motion over windows, for sensors that average: from the samples alone.

With s the time since the middle of a window of length T, E(s) the rotation since then and V(s) the
integral of the specific force, in the axes in the middle, the velocity in body axes is

    v_b(s) = E(s)ᵀ (v_b(0) + V(s) + g_b s),

linear in velocity and gravity there. Its mean over the window, and the derivatives of the mean by
the time of the middle and by the length, follow from running integrals over the samples: what
vibrates between two measurements is averaged as the sensor averages it. The mean of the rate is
smoothed by so much that it has the noise of the smoothed rate at one time, as long as it has
that. Else a longer window would have less noise than a shorter one, and be the better model for
that alone. A mean of velocities in n is, in the axes in the middle, that of v_b(0) + V(s) + g_b s;
by it a lever arm moves from where it is at one end to where it is at the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.geometry.records import concatenated, rows_of
from factorgraph_dvl.geometry.rotations import cumulative_products, exp_so3
from factorgraph_dvl.geometry.vectors import (
    IDENTITY,
    Array,
    IntArray,
    cross,
    rotate,
    skew,
    sums_before,
)
from factorgraph_dvl.imu.between_samples import Cubics, between_samples, cubics_between
from factorgraph_dvl.imu.increments import Increments, Partial
from factorgraph_dvl.imu.interpolation import Smoothed, smoothed_share
from factorgraph_dvl.sensors.protocol import Linearization, MeanMotion, Motion, Window

# Samples whose running integrals are in memory at once. Chosen: some ten megabytes.
_CHUNK = 50_000
# Samples between two windows from which on they are left out. Chosen: a second or more.
_APART = 1000
# Lengths, s, up to the shorter of which the effect is a straight line in the square of the length
# through these two: so it has a derivative at zero, and vibration between samples, which no sensor
# follows, is averaged there too. In sway of 2 Hz it is off by 0.03 %. The line then bends to the
# slope at the longer one: where a slope jumps, a minimisation does not end.
_SHORT, SHORTEST = 0.05, 0.1
# Part of the length that a window keeps where the samples end. Chosen: regular.
_LEAST = 1e-3


@dataclass(frozen=True)
class BodyMotion:
    """Velocity and rate in body axes, or a derivative of them, by the motion at M times.

    Parameters
    ----------
    turn : ndarray, shape (M, 3, 3)
        Factor of the velocity in body axes at the time.
    swept : ndarray, shape (M, 3, 3), s
        Factor of gravity in body axes at the time.
    added : ndarray, shape (M, 3), m/s
        What the specific force adds to the velocity.
    rate : ndarray, shape (M, 3), rad/s
        Rate, less that at the time.
    """

    turn: Array
    swept: Array
    added: Array
    rate: Array

    def velocity(self, v_b: Array, gravity_b: Array) -> Array:
        """Return the velocity in body axes, (M, 3), m/s."""
        return rotate(self.turn, v_b) + rotate(self.swept, gravity_b) + self.added

    def over(self, length: Array) -> BodyMotion:
        """Return it over lengths (M,), s."""
        return BodyMotion(*(_per_second(each, length) for each in vars(self).values()))

    def times(self, factor: Array) -> BodyMotion:
        """Return it times factors (M,)."""
        return BodyMotion(*((each.T * factor).T for each in vars(self).values()))

    def plus(self, others: BodyMotion, weight: float, own: float = 1.0) -> BodyMotion:
        """Return a weighed sum with others."""
        pairs = zip(vars(self).values(), vars(others).values(), strict=True)
        return BodyMotion(*(own * a + weight * b for a, b in pairs))


@dataclass(frozen=True)
class Windows:
    """Windows about M times.

    Parameters
    ----------
    mean : BodyMotion
        Mean over each window.
    by_time, by_length : BodyMotion
        Derivatives of the mean by the time and by the length of the window, 1/s.
    slope : BodyMotion
        Derivative by the time of what is not averaged, by the samples, 1/s.
    rate_sigma, slope_sigma, force_sigma : ndarray, shape (M,)
        Standard deviations that the noise of the samples gives the mean rate, rad/s, and the
        derivatives by the time of mean rate and velocity, rad/s², m/s².
    """

    mean: BodyMotion
    by_time: BodyMotion
    by_length: BodyMotion
    slope: BodyMotion
    rate_sigma: Array
    slope_sigma: Array
    force_sigma: Array


def windows(inc: Increments, time: Array, window: Window) -> Windows:
    """Return windows about times (M,).

    A window is shorter where the samples begin or end. One of negative length has the effect of a
    positive one with the opposite sign: an estimate of a length that is zero has no bias then.

    Parameters
    ----------
    inc : Increments
        Increments between the samples.
    time : ndarray, shape (M,), s
        Middles of the windows.
    window : Window
        Length of the windows, and what is averaged.
    """
    length, of_body = window
    if length >= SHORTEST:
        return _of_lengths(inc, time, (length,), of_body=of_body)[0]
    short, long = _of_lengths(inc, time, (_SHORT, SHORTEST), of_body=of_body)
    span = SHORTEST**2 - _SHORT**2
    share = (length * abs(length) - _SHORT**2) / span
    slope = max(2.0 * abs(length), SHORTEST) / span
    # Slope at the longer one beyond that of the line, by the share.
    beyond = long.by_length.plus(long.mean.plus(short.mean, -1.0), -1.0, 0.5 * span / SHORTEST)
    after = max((length**2 - _SHORT**2) / span, 0.0)
    bend = float(np.sign(length)) * after**2 * (after - 1.0)
    return Windows(
        mean=short.mean.plus(long.mean, share, 1.0 - share).plus(beyond, bend),
        by_time=short.by_time.plus(long.by_time, share, 1.0 - share),
        by_length=long.mean.plus(short.mean, -slope, slope).plus(
            beyond, slope * after * (3.0 * after - 2.0)
        ),
        slope=long.slope,
        rate_sigma=short.rate_sigma,
        slope_sigma=short.slope_sigma,
        force_sigma=short.force_sigma,
    )


def _of_lengths(
    inc: Increments, time: Array, lengths: Sequence[float], *, of_body: bool
) -> list[Windows]:
    """Return windows of some lengths as they are, about the same times."""
    order = np.argsort(time, kind="stable")
    middle, since, _ = inc.locate(time[order])
    since = np.clip(since, 0.0, inc.dt[middle])
    at = inc.start[middle] + since
    first, last = inc.arcs[inc.arc_of[middle]].T
    before, after = at - inc.start[first], inc.end[last - 1] - at
    reach = np.minimum(before, after)
    halves = [0.5 * np.clip(2.0 * reach, _LEAST * size, size) for size in lengths]
    # By how much a window that is cut grows as its middle moves, from the end of the samples on.
    nearer = np.where(before < after, 2.0, -2.0)
    growths = [np.where(2.0 * reach < size, nearer, 0.0) for size in lengths]
    edges = [
        [_inside(inc, at + sign * half, first, last) for sign in (-1.0, 1.0)] for half in halves
    ]
    widest = edges[int(np.argmax(lengths))]
    found: list[list[Windows]] = [[] for _ in lengths]
    for own in _chunks(widest[0][0], widest[1][0], inc.arc_of[middle]):
        begin, end = int(widest[0][0][own].min()), int(widest[1][0][own].max()) + 1
        run = _Run.of(inc, begin, end, of_body=of_body)
        now = run.at(middle[own], since[own])
        for out, pair, growth in zip(found, edges, growths, strict=True):
            ends = [run.at(index[own], after[own]) for index, after in pair]
            out.append(_windows(run, now, ends, growth[own]))
    back = np.empty_like(order)
    back[order] = np.arange(order.size)
    return [rows_of(concatenated(parts), back) for parts in found]


def _inside(
    inc: Increments, time: Array, first: IntArray, last: IntArray
) -> tuple[IntArray, Array]:
    """Return the intervals that times (M,) are in, of arcs, and the times since their start."""
    index = np.clip(inc.locate(time)[0], first, last - 1)
    return index, np.clip(time - inc.start[index], 0.0, inc.dt[index])


def _chunks(before: IntArray, after: IntArray, arc: IntArray) -> Iterator[slice]:
    """Yield windows in blocks of one arc and of not too many samples."""
    begin = 0
    gaps = np.append(np.flatnonzero(before[1:] > after[:-1] + _APART) + 1, before.size)
    while begin < before.size:
        end = int(np.searchsorted(after, before[begin] + _CHUNK, side="right"))
        end = min(end, int(np.searchsorted(arc, arc[begin], side="right")))
        end = min(end, int(gaps[np.searchsorted(gaps, begin, side="right")]))
        end = max(end, begin + 1)
        yield slice(begin, end)
        begin = end


@dataclass(frozen=True)
class _Point:
    """Motion since the start of a run of intervals, and its integrals, at M times.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Time since then.
    dR : ndarray, shape (M, 3, 3)
        Rotation.
    dV : ndarray, shape (M, 3)
        Integral of the specific force, in the axes at the start.
    integrals : tuple of ndarray
        Integrals of dRᵀ, of t dRᵀ and of dRᵀ dV; of means in n, of dV alone.
    angle, rate : ndarray, shape (M, 3), rad and rad/s
        Integral of the rate of the samples, and its slope.
    smooth : ndarray, shape (M, 3), rad
        Integral of the rate as it is smoothed; zero where it is not.
    signals : Partial
        Signals there.
    """

    time: Array
    dR: Array
    dV: Array
    integrals: tuple[Array, ...]
    angle: Array
    rate: Array
    smooth: Array
    signals: Partial


@dataclass(frozen=True)
class _Run:
    """Running integrals at the starts of intervals in a row; fields as of `_Point`."""

    inc: Increments
    begin: int
    time: Array
    dR: Array
    dV: Array
    integrals: tuple[Array, ...]
    angle: Array
    rates: Smoothed
    of_body: bool

    @classmethod
    def of(cls, inc: Increments, begin: int, end: int, *, of_body: bool) -> _Run:
        """Return those from the start of an interval to the start of another one."""
        inside = np.arange(begin, end)
        phi, dv = inc.over(inside)
        time = inc.start[inside] - inc.start[begin]
        dR = cumulative_products(np.concatenate([IDENTITY[None], exp_so3(phi[:-1])]))
        dV = sums_before(rotate(dR, dv))
        dt = inc.dt[inside]
        cubics = cubics_between(inc, inside, dt)
        steps = _steps(dR, dV, phi, dv, time, dt, cubics, of_body=of_body)
        sums = tuple(sums_before(each) for each in steps)
        rates, _ = inc.smoothed[inc.arc_of[begin]]
        return cls(inc, begin, time, dR, dV, sums, sums_before(phi), rates, of_body)

    def at(self, index: IntArray, since: Array) -> _Point:
        """Return the motion `since` seconds after the start of intervals `index`."""
        part, k = between_samples(self.inc, index, since), index - self.begin
        dR, dV = self.dR[k], self.dV[k]
        cubics = cubics_between(self.inc, index, since)
        start = self.time[k]
        smooth = np.zeros_like(part.phi)
        if self.of_body and self.rates.integral is not None:
            smooth = self.rates.integral(self.inc.start[index] + since)
        steps = _steps(dR, dV, part.phi, part.dv, start, since, cubics, of_body=self.of_body)
        return _Point(
            start + since,
            dR @ exp_so3(part.phi),
            dV + rotate(dR, part.dv),
            tuple(before[k] + step for before, step in zip(self.integrals, steps, strict=True)),
            self.angle[k] + part.phi,
            cubics.rate,
            smooth,
            part,
        )


def _steps(
    dR: Array,
    dV: Array,
    phi: Array,
    dv: Array,
    start: Array,
    h: Array,
    cubics: Cubics,
    *,
    of_body: bool,
) -> tuple[Array, ...]:
    """Return what h s, (M,), add to the integrals, with increments phi and dv.

    By the means of Exp(-u phi) and of u Exp(-u phi), u from 0 to 1, and by what the integrals of
    phi and dv are beyond those of their chords: so the slope of an integral is what is integrated,
    also inside an interval.
    """
    if not of_body:
        width = h[:, None]
        return (dV * width + rotate(dR, 0.5 * dv * width + cubics.velocity),)
    bRt = dR.transpose(0, 2, 1)
    across = skew(phi)
    once = across @ bRt
    twice = across @ once
    h = h[:, None, None]
    back = (bRt - once / 2.0 + twice / 6.0) * h - skew(cubics.angle) @ bRt
    moment = start[:, None, None] * back + (bRt / 2.0 - once / 3.0 + twice / 8.0) * h**2
    crossed = cross(phi, dv)
    added = (dv / 2.0 - crossed / 3.0 + cross(phi, crossed) / 8.0) * h[:, :, 0]
    added = added + cubics.velocity
    return back, moment, rotate(back, dV) + added


def _windows(run: _Run, now: _Point, ends: Sequence[_Point], growth: Array) -> Windows:
    """Return windows about points of a run from one end to the other, which grow with time."""
    # Where the samples end, the least window is cut.
    length = ends[1].time - ends[0].time
    here = now.signals.omega
    step = float(np.mean(run.inc.dt))
    mean, change, lengthened = (_in_body if run.of_body else _in_n)(now, ends, length)
    gyro = run.inc.gyro_sigma * np.sqrt(step / length)
    if run.of_body and run.rates.integral is not None:
        share, by_length, white = smoothed_share(run.rates.window, length / step)
        gyro = run.inc.gyro_sigma * white
        mean, change, lengthened = _smoothed(
            (mean, change, lengthened), ends, length, share, by_length / step
        )
    return Windows(
        mean,
        change.plus(lengthened.times(growth), 1.0).over(length),
        lengthened.times(growth == 0.0).over(length),
        BodyMotion(
            -skew(here),
            np.broadcast_to(IDENTITY, now.dR.shape),
            now.signals.force,
            now.signals.alpha,
        ),
        gyro,
        np.sqrt(2.0) * now.signals.omega_sigma.max(axis=1) / length,
        run.inc.accel_sigma * np.sqrt(step / length),
    )


def _smoothed(
    bodies: tuple[BodyMotion, BodyMotion, BodyMotion],
    ends: Sequence[_Point],
    length: Array,
    share: Array,
    by_length: Array,
) -> tuple[BodyMotion, BodyMotion, BodyMotion]:
    """Return a mean and its derivatives, times the length, with a share of the smoothed rate.

    The share (M,) has a derivative by the length, 1/s.
    """
    mean, change, lengthened = bodies
    beyond = [end.smooth - end.angle for end in ends]
    faster = [end.signals.omega - end.rate for end in ends]
    more, share = _per_second(beyond[1] - beyond[0], length), share[:, None]
    longer = share * (0.5 * (faster[0] + faster[1]) - more)
    longer = longer + (by_length * length)[:, None] * more
    return (
        replace(mean, rate=mean.rate + share * more),
        replace(change, rate=change.rate + share * (faster[1] - faster[0])),
        replace(lengthened, rate=lengthened.rate + longer),
    )


def _in_body(
    now: _Point, ends: Sequence[_Point], length: Array
) -> tuple[BodyMotion, BodyMotion, BodyMotion]:
    """Return the mean in body axes, and its derivatives by time and length, times the length."""
    one, other = ends
    here = now.signals.omega
    back, moment, moved = (
        _per_second(b - a, length) for a, b in zip(one.integrals, other.integrals, strict=True)
    )
    # By the axes and the time in the middle what is by those at the start of the run.
    about = moment - now.time[:, None, None] * back
    mean = BodyMotion(
        back @ now.dR,
        about @ now.dR,
        moved - rotate(back, now.dV),
        _per_second(other.angle - one.angle, length) - here,
    )

    def at_end(end: _Point, sign: float) -> BodyMotion:
        turn = end.dR.transpose(0, 2, 1) @ now.dR
        swept = (sign * 0.5 * length)[:, None, None] * turn
        added = rotate(end.dR.transpose(0, 2, 1), end.dV - now.dV)
        return BodyMotion(turn, swept, added, end.rate - here)

    before, after = at_end(one, -1.0), at_end(other, 1.0)
    lengthened = before.plus(after, 0.5, 0.5).plus(mean, -1.0)
    return mean, after.plus(before, -1.0), lengthened


def _in_n(
    now: _Point, ends: Sequence[_Point], length: Array
) -> tuple[BodyMotion, BodyMotion, BodyMotion]:
    """Return the same of the mean in n, in the axes in the middle.

    The rate is that by which a lever arm turns from one end to the other, over the length: of
    [w x] = (E - E') / length the part that is skew. What is symmetric is of third order.
    """
    one, other = ends
    here = now.signals.omega
    bRs = now.dR.transpose(0, 2, 1)
    gained = _per_second(other.integrals[0] - one.integrals[0], length)
    added = rotate(bRs, gained - now.dV)
    turned = [bRs @ end.dR for end in ends]
    turning = [E @ skew(end.rate) for E, end in zip(turned, ends, strict=True)]
    across, zero = skew(here), np.zeros_like(now.dR)
    whole = turned[1] - turned[0]
    still = np.broadcast_to(IDENTITY, zero.shape)
    sped = [rotate(bRs, end.dV - now.dV) for end in ends]
    wide = length[:, None]
    mean = BodyMotion(still, zero, added, _unskewed(_per_second(whole, length)) - here)
    change = BodyMotion(
        -across * wide[:, :, None],
        still * wide[:, :, None],
        sped[1] - sped[0] - cross(here, added) * wide,
        _unskewed(turning[1] - turning[0] - across @ whole),
    )
    lengthened = BodyMotion(
        zero,
        zero,
        0.5 * (sped[0] + sped[1]) - added,
        _unskewed(0.5 * (turning[0] + turning[1])) - mean.rate - here,
    )
    return mean, change, lengthened


def _unskewed(matrix: Array) -> Array:
    """Return the vectors (M, 3) of the skew parts of matrices (M, 3, 3)."""
    m = 0.5 * (matrix - matrix.transpose(0, 2, 1))
    return np.stack([m[:, 2, 1], m[:, 0, 2], m[:, 1, 0]], axis=1)


def _per_second(values: Array, length: Array) -> Array:
    """Return values (M, ...) over lengths (M,), s."""
    return np.asarray(values / length.reshape(-1, *[1] * (values.ndim - 1)))


def averaged(motion: Motion, over: Windows, gravity_n: Array) -> Motion:
    """Return a motion whose velocity and rate are means over windows.

    Parameters
    ----------
    motion : Motion
        Motion at the middles of M windows.
    over : Windows
        The windows.
    gravity_n : ndarray, shape (M, 3), m/s²
        Gravity there.
    """
    R = motion.nRb
    bRn = R.transpose(0, 2, 1)
    v_b, gravity_b = rotate(bRn, motion.v_n), rotate(bRn, gravity_n)
    mean_b = over.mean.velocity(v_b, gravity_b)
    by_length = over.by_length.velocity(v_b, gravity_b)
    rate, move = motion.changes
    # What moves the middle beside the samples: biases, and nodes between which it is blended.
    beside = rotate(bRn, motion.a_n) - cross(rate, v_b) - over.slope.velocity(v_b, gravity_b)
    by_time = over.by_time.velocity(v_b, gravity_b) + rotate(over.mean.turn, beside)
    by_attitude = over.mean.turn @ skew(v_b) + over.mean.swept @ skew(gravity_b) - skew(mean_b)
    return replace(
        motion,
        v_n=rotate(R, mean_b),
        omega_eb_b=motion.omega_eb_b + over.mean.rate,
        a_n=rotate(R, cross(rate, mean_b) + by_time),
        alpha_b=over.by_time.rate,
        omega_sigma=np.repeat(over.rate_sigma[:, None], 3, axis=1),
        mean=MeanMotion(
            turn_rate_b=rate,
            move_rate_n=move,
            v_by_v=R @ over.mean.turn @ bRn,
            v_by_theta=R @ by_attitude,
            v_by_length=rotate(R, by_length),
            omega_by_length=over.by_length.rate,
        ),
    )


def by_motion_in_the_middle(lin: Linearization, mean: MeanMotion) -> Linearization:
    """Return derivatives by a mean motion as those by the motion in the middle of the windows."""
    if lin.d_v is None:
        return lin
    turned = lin.d_v @ mean.v_by_theta
    return replace(
        lin,
        d_v=lin.d_v @ mean.v_by_v,
        d_theta=turned if lin.d_theta is None else lin.d_theta + turned,
    )
