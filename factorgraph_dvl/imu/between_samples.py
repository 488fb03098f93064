"""Motion between the samples of an IMU, whose derivative does not jump where one ends.

What the samples add up to has the rate and the force of every single sample as its slope, noise
included: a clock that follows it sees the noise of two samples instead of the motion. So the motion
follows the integral of the smoothed rate and force. Only where it is between the nodes changes:
the increments from node to node stay those of the samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, IntArray, cross, rotate
from factorgraph_dvl.imu.increments import Increments, Partial


@dataclass(frozen=True)
class _Edge:
    """Signals at M edges of intervals.

    Parameters
    ----------
    rate, force : ndarray, shape (M, 3)
        Angular rate (rad/s) and specific force (m/s²).
    turn, push : ndarray, shape (M, 3)
        Integrals of them less those of the samples, rad and m/s.
    """

    rate: Array
    force: Array
    turn: Array
    push: Array


def between_samples(inc: Increments, index: IntArray, since: Array) -> Partial:
    """Return the motion `since` seconds after the start of intervals `index`, (M,).

    Cubics of Hermite between the edges of the interval, in the axes at its start: the values there
    are those of the samples and what smoothing adds, the slopes the smoothed rate and force. The
    specific force is that of the cubic.
    """
    before, after = _edge(inc, index, after=False), _edge(inc, index, after=True)
    phi, dv = inc.over(index)
    dt = inc.dt[index]
    values, slopes = _hermite(since / dt, dt)
    turn = phi + after.turn + 0.5 * cross(phi, after.turn)
    across = cross(turn, after.rate)
    whole = exp_so3(turn)
    phi_at = _cubic(
        values,
        before.turn,
        turn,
        before.rate + 0.5 * cross(before.turn, before.rate),
        after.rate + 0.5 * across + cross(turn, across) / 12.0,
    )
    pushed = dv + rotate(whole, after.push)
    of_velocity = (
        before.push,
        pushed,
        before.force + cross(before.turn, before.force),
        rotate(whole, after.force),
    )
    force = _cubic(slopes, *of_velocity)
    return Partial(
        phi=phi_at,
        dv=_cubic(values, *of_velocity),
        dp=_cubic(values, np.zeros_like(dv), 0.5 * dv * dt[:, None], before.push, pushed),
        force=rotate(exp_so3(-phi_at), force),
        **inc.rate_at(index, since),
    )


def _hermite(u: Array, dt: Array) -> tuple[Array, Array]:
    """Return weights (4, M) of values and slopes at both edges, and their derivatives."""
    v = 1.0 - u
    last = u**2 * (3.0 - 2.0 * u)
    change = 6.0 * u * v / dt
    return (
        np.array([1.0 - last, last, dt * u * v**2, -dt * u**2 * v]),
        np.array([-change, change, v * (1.0 - 3.0 * u), u * (3.0 * u - 2.0)]),
    )


def _cubic(weights: Array, *parts: Array) -> Array:
    """Return the sum of vectors (M, 3) with weights (4, M)."""
    return np.asarray(sum(w[:, None] * part for w, part in zip(weights, parts, strict=True)))


def _edge(inc: Increments, index: IntArray, *, after: bool) -> _Edge:
    """Return the signals at the edges before or after intervals (M,)."""
    time = inc.start[index] + (inc.dt[index] if after else 0.0)
    arc_of = inc.arc_of[index]
    out = np.zeros((4, index.size, 3))
    for arc, (signals, leads) in enumerate(zip(inc.smoothed, inc.leads, strict=True)):
        mine = np.flatnonzero(arc_of == arc)
        if mine.size == 0:
            continue
        edge = index[mine] - inc.arcs[arc, 0] + after
        raw: Array | None = None
        for i, (signal, lead) in enumerate(zip(signals, leads, strict=True)):
            if signal.spline is not None:
                out[i, mine] = signal.spline(time[mine])
            else:
                raw = _raw_edge(inc, index[mine], after) if raw is None else raw
                out[i, mine] = raw[:, 3 * i : 3 * i + 3]
            if lead is not None:
                out[2 + i, mine] = lead[edge]
    return _Edge(*out)


def _raw_edge(inc: Increments, index: IntArray, after: bool) -> Array:
    """Return rate and force (M, 6) at edges: half-way between the polynomials on both sides."""
    near = np.clip(index + (1 if after else -1), 0, inc.dt.size - 1)
    near = np.where(inc.arc_of[near] == inc.arc_of[index], near, index)
    own, other = inc.coefficients(index), inc.coefficients(near)
    # A polynomial's value is its first coefficient at the start, the sum of all at the end.
    at_start, at_end = (own, other) if not after else (other, own)
    first, last = at_start[:, 0], at_end.sum(axis=1)
    alone = (near == index)[:, None]
    own_edge = last if after else first
    return np.where(alone, own_edge, 0.5 * (first + last))
