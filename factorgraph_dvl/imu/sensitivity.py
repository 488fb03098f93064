"""How errors of the IMU that grow with rate and force move what is integrated from it.

With gyro = (I + Mg) omega + Gg f - tau alpha and accel = (I + Ma) f, an error e of unit size adds
the columns E to the rate and A to the force. To first order, since the start of a segment,

    Theta = ∫ dR E dt,    V = ∫ ([dR f]x Theta - dR A) dt,    P = ∫ V dt

and increments that are free of errors e are Exp(-Theta e) dR, dV + V e, dP + P e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray, rotate, skew
from factorgraph_dvl.imu.between_samples import hermite
from factorgraph_dvl.imu.preintegration import Integrals, Segments, Strides
from factorgraph_dvl.imu.propagation import Attachment, Transition, attitude_jacobian
from factorgraph_dvl.imu.two_way import TwoWay, carried_back
from factorgraph_dvl.sensors.imu import ERRORS, ImuError
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Linearization

# Shortest step, s, that has a mean rate. Chosen: far below the interval of any IMU.
_LEAST_STEP = 1e-7


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of what is integrated up to M times with respect to n errors.

    Parameters
    ----------
    theta, v, p : ndarray, shape (M, 3, n)
        Increments of rotation, velocity and position: -Theta, V, P, in the axes at the segment's
        start.
    gyro, force, alpha : ndarray, shape (M, 3)
        Rate, force and angular acceleration at the times, of which E and A consist; at the ends of
        segments zero.
    """

    theta: Array
    v: Array
    p: Array
    gyro: Array
    force: Array
    alpha: Array


def elements(parameters: Sequence[Parameter]) -> list[ImuError]:
    """Return the errors that parameters of an IMU have as components, in their order."""
    return [error for p in parameters for error in ERRORS[p.name]]


def unit_errors(
    rate: Array, force: Array, alpha: Array, errors: Sequence[ImuError]
) -> tuple[Array, Array]:
    """Return what unit errors add to rates (M, 3) and forces (M, 3), (M, 3, n) each."""
    added = {name: np.zeros((len(rate), 3, len(errors))) for name in ("rate", "force")}
    by = _signals(rate, force, alpha)
    for column, error in enumerate(errors):
        added[error.of][:, error.row, column] = by[error.by][:, error.column]
    return added["rate"], added["force"]


def added_by(
    rate: Array, force: Array, alpha: Array, errors: Sequence[ImuError], sizes: Array
) -> tuple[Array, Array]:
    """Return what errors of given sizes (n,) add to rates (M, 3) and forces (M, 3)."""
    added = {"rate": np.zeros_like(rate), "force": np.zeros_like(force)}
    by = _signals(rate, force, alpha)
    for error, size in zip(errors, sizes.tolist(), strict=True):
        added[error.of][:, error.row] += size * by[error.by][:, error.column]
    return added["rate"], added["force"]


def _signals(rate: Array, force: Array, alpha: Array) -> dict[str, Array]:
    """Return what errors grow with: a late gyro has what the rate was before."""
    return {"rate": rate, "force": force, "delay": -alpha}


def sensitivities(
    seg: Segments, errors: Sequence[ImuError], attachments: Sequence[Attachment]
) -> tuple[Sensitivity, list[Sensitivity]]:
    """Return derivatives with respect to errors of the IMU, by sums over strides.

    Parameters
    ----------
    seg : Segments
        Increments between the nodes.
    errors : sequence of ImuError
        The n errors.
    attachments : sequence of Attachment
        Where measurements are attached to the chain.

    Returns
    -------
    ends : Sensitivity
        Sensitivity of the increments over the S segments.
    attached : list of Sensitivity
        Attachment of the motion that is attached.
    """
    n = len(errors)
    whole = _zeros(seg.first.size, n)
    attached = [_zeros(at.tau.size, n) for at in attachments]
    for block in seg.blocks():
        strides, count = seg.strides(block), block.stop - block.start
        theta, v, p = _zeros(count, n)
        alpha = _accelerations(seg, block, strides, errors)
        rows = [np.flatnonzero(_is_within(at.segment, block)) for at in attachments]
        segment = [
            at.segment[own] - block.start for at, own in zip(attachments, rows, strict=True)
        ]
        numbers = [_stride_of(seg, at, own) for at, own in zip(attachments, rows, strict=True)]
        places = [
            strides.begins[inside] + number
            for inside, number in zip(segment, numbers, strict=True)
        ]
        for j in range(int(strides.count.max())):
            for place, inside, own, outs in zip(places, segment, rows, attached, strict=True):
                here = np.flatnonzero(place - strides.begins[inside] == j)
                for out, now in zip(outs, (theta, v, p), strict=True):
                    out[own[here]] = now[inside[here]]
            live = np.flatnonzero(strides.count > j)
            i = strides.begins[live] + j
            means = _means(strides.phi[i], strides.dv[i], strides.duration[i], alpha[i])
            step = _step(strides.dR[i], means, errors, (theta[live], v[live], p[live]))
            theta[live], v[live], p[live] = step
        for out, each in zip(whole, (-theta, v, p), strict=True):
            out[block] = each
        for place, number, at, own, outs in zip(
            places, numbers, attachments, rows, attached, strict=True
        ):
            first = seg.first[at.segment[own]] + seg.stride * number
            last = np.minimum(first + seg.stride, seg.last[at.segment[own]]) - 1
            begin = _Edge(strides.dR[place], *seg.increments.edge_signals(first, after=False))
            phi, length, turning = strides.phi[place], strides.duration[place], alpha[place]
            end = _Edge(begin.dR @ exp_so3(phi), *seg.increments.edge_signals(last, after=True))
            since = seg.node_time[at.node[own]] + at.tau[own] - strides.start[place]
            before = tuple(out[own] for out in outs)
            means = _means(phi, strides.dv[place], length, turning)
            after = _step(begin.dR, means, errors, before)
            values, _ = hermite(since / length, length)
            theta, v, p = (
                values[0] * one + values[1] * other + values[2] * slope + values[3] * next_slope
                for one, other, slope, next_slope in zip(
                    before,
                    after,
                    begin.slopes(before, turning, errors),
                    end.slopes(after, turning, errors),
                    strict=True,
                )
            )
            for out, each in zip(outs, (-theta, v, p), strict=True):
                out[own] = each
    nothing = np.zeros((seg.first.size, 3))
    return Sensitivity(*whole, nothing, nothing, nothing), [
        Sensitivity(*outs, at.gyro, at.force, at.alpha)
        for outs, at in zip(attached, attachments, strict=True)
    ]


def predicted(seg: Segments, ends: Sensitivity) -> Array:
    """Return derivatives of the predicted states at the ends of segments, (S, 9, n).

    In GTSAM's tangent space of NavState: attitude, position, velocity.
    """
    back = seg.totals()[0].transpose(0, 2, 1)
    return np.concatenate([back @ ends.theta, back @ ends.p, back @ ends.v], axis=1)


def at_errors(by: Sensitivity, sizes: Array) -> Sensitivity:
    """Return a sensitivity where errors have sizes (n,): a further one finds axes half turned."""
    return replace(by, theta=by.theta + 0.5 * skew(by.theta @ sizes) @ by.theta)


def carried_back_by(at: TwoWay, forward: Sensitivity, ends: Sensitivity) -> Sensitivity:
    """Return the sensitivity of what is integrated back from the nodes after, in the axes there.

    Of increments dR_Tᵀ dR, dR_Tᵀ (dV - dV_T) and so on, all up to the times and to the ends T.

    Parameters
    ----------
    at : TwoWay
        Where M times are attached to the chain.
    forward : Sensitivity
        Increments of what is integrated up to the times.
    ends : Sensitivity
        The same up to the ends of all segments.
    """
    theta, v, p = (each[at.segment] for each in (ends.theta, ends.v, ends.p))
    back = at.backward.dR @ np.ascontiguousarray(at.forward.dR.transpose(0, 2, 1))
    turned = back @ theta
    return replace(
        forward,
        theta=back @ forward.theta - turned,
        v=back @ (forward.v - v) + skew(at.backward.dV) @ turned,
        p=back @ (forward.p - p - at.backward.tau[:, None, None] * v)
        + skew(at.backward.dP) @ turned,
    )


def corrected_two_way(
    at: TwoWay,
    by: Sensitivity,
    ends: Sensitivity,
    seg: Segments,
    errors: Sequence[ImuError],
    sizes: Array,
) -> TwoWay:
    """Return an attachment without errors of the IMU of given sizes (n,).

    Parameters
    ----------
    at : TwoWay
        Where M times are attached to the chain.
    by, ends : Sensitivity
        Sensitivities as `forward` and `ends` of `carried_back_by`.
    seg : Segments
        Increments between the nodes.
    errors : sequence of ImuError
        The n errors.
    sizes : ndarray, shape (n,)
        Sizes of the variables.
    """
    forward = corrected(at.forward, by, errors, sizes)
    whole = Integrals(
        dR=exp_so3(ends.theta @ sizes) @ seg.ends.dR,
        dV=seg.ends.dV + ends.v @ sizes,
        dP=seg.ends.dP + ends.p @ sizes,
        dA=seg.ends.dA,
    )
    back = carried_back(whole, forward, at.backward)
    # What biases do is left as it is, forward too: errors times biases are next to nothing.
    return replace(at, forward=forward, backward=replace(back, dA=at.backward.dA))


def corrected(
    at: Attachment, by: Sensitivity, errors: Sequence[ImuError], sizes: Array
) -> Attachment:
    """Return an attachment without errors of the IMU of given sizes (n,)."""
    rate, force = added_by(by.gyro, by.force, by.alpha, errors, sizes)
    # What the slopes of force and angular acceleration add is next to nothing.
    nothing = np.zeros_like(by.force)
    alpha, _ = added_by(at.alpha, nothing, nothing, errors, sizes)
    return replace(
        at,
        dR=exp_so3(by.theta @ sizes) @ at.dR,
        dV=at.dV + by.v @ sizes,
        dP=at.dP + by.p @ sizes,
        gyro=at.gyro - rate,
        alpha=at.alpha - alpha,
        force=at.force - force,
    )


def by_errors(
    lin: Linearization, transition: Transition, by: Sensitivity, errors: Sequence[ImuError]
) -> Array:
    """Return the derivative of residuals with respect to errors of the IMU, (M, d, n).

    Parameters
    ----------
    lin : Linearization
        Derivatives with respect to the motion at the M times.
    transition : Transition
        Transition from the nodes to these times.
    by : Sensitivity
        Derivative of the motion.
    errors : sequence of ImuError
        The n errors.
    """
    out = np.zeros((*lin.residual.shape, by.theta.shape[2]))
    d_theta = attitude_jacobian(lin, transition)
    if lin.d_omega is not None:
        signals = _signals(by.gyro, by.force, by.alpha)
        for column, error in enumerate(errors):
            if error.of == "rate":
                signal = signals[error.by][:, None, error.column]
                out[:, :, column] -= lin.d_omega[:, :, error.row] * signal
    if d_theta is not None:
        out += d_theta @ (transition.at.dR.transpose(0, 2, 1) @ by.theta)
    if lin.d_v is not None:
        out += lin.d_v @ (transition.turned @ by.v)
    if lin.d_p is not None:
        out += lin.d_p @ (transition.turned @ by.p)
    return out


def _zeros(count: int, n: int) -> tuple[Array, Array, Array]:
    return np.zeros((count, 3, n)), np.zeros((count, 3, n)), np.zeros((count, 3, n))


def _is_within(segment: IntArray, block: slice) -> BoolArray:
    return np.asarray((segment >= block.start) & (segment < block.stop))


def _stride_of(seg: Segments, at: Attachment, rows: IntArray) -> IntArray:
    """Return the stride of some attached times, counted from the start of their segments."""
    segment = at.segment[rows]
    time = seg.node_time[at.node[rows]] + at.tau[rows]
    index = np.clip(seg.increments.locate(time)[0], seg.first[segment], seg.last[segment] - 1)
    return np.asarray((index - seg.first[segment]) // seg.stride)


@dataclass(frozen=True)
class _Means:
    """Rate, force and acceleration (M, 3) over steps of h s, (M,), in the axes in their middle.

    `half` (M, 3, 3) turns the axes in the middle into those at the start.
    """

    rate: Array
    force: Array
    alpha: Array
    half: Array
    h: Array


@dataclass(frozen=True)
class _Edge:
    """Rotation (M, 3, 3) since the start of segments, rate and force (M, 3) there."""

    dR: Array
    rate: Array
    force: Array

    def slopes(
        self, at: tuple[Array, ...], alpha: Array, errors: Sequence[ImuError]
    ) -> tuple[Array, ...]:
        """Return the time derivatives of Theta, V and P there."""
        theta, v, _ = at
        by_rate, by_force = unit_errors(self.rate, self.force, alpha, errors)
        pushed = skew(rotate(self.dR, self.force)) @ theta - self.dR @ by_force
        return self.dR @ by_rate, pushed, v


def _accelerations(
    seg: Segments, block: slice, strides: Strides, errors: Sequence[ImuError]
) -> Array:
    """Return the mean angular acceleration (T, 3) over strides; zero where no error needs it."""
    out = np.zeros_like(strides.phi)
    if not any(error.by == "delay" for error in errors):
        return out
    number = np.arange(len(out)) - np.repeat(strides.begins, strides.count)
    first = np.repeat(seg.first[block], strides.count) + seg.stride * number
    last = np.minimum(first + seg.stride, np.repeat(seg.last[block], strides.count)) - 1
    before = seg.increments.edge_signals(first, after=False)[0]
    after = seg.increments.edge_signals(last, after=True)[0]
    safe = np.where(strides.duration > _LEAST_STEP, strides.duration, np.inf)
    return np.asarray((after - before) / safe[:, None])


def _means(phi: Array, dv: Array, h: Array, alpha: Array) -> _Means:
    """Return the means over steps with increments (M, 3), in the axes at their start."""
    # A measurement may lie at the start of a step.
    safe = np.where(np.abs(h) > _LEAST_STEP, h, 1.0)[:, None]
    half = exp_so3(0.5 * phi)
    return _Means(phi / safe, rotate(half.transpose(0, 2, 1), dv) / safe, alpha, half, h)


def _step(
    dR: Array, means: _Means, errors: Sequence[ImuError], before: tuple[Array, ...]
) -> tuple[Array, Array, Array]:
    """Return Theta, V and P after (M,) steps that start at rotations (M, 3, 3)."""
    theta, v, p = before
    h = means.h[:, None, None]
    by_rate, by_force = unit_errors(means.rate, means.force, means.alpha, errors)
    middle = dR @ means.half
    turned = middle @ by_rate * h
    force = rotate(middle, means.force)
    pushed = (skew(force) @ (theta + 0.5 * turned) - middle @ by_force) * h
    return theta + turned, v + pushed, p + v * h + 0.5 * pushed * h
