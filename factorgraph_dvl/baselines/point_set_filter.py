"""Seven-state Kalman filter between two point sets (Luo, Liu, Liu, Wu and Cheng 2024).

States: misalignment alpha (rad), scale error, lever arm (m), all constant. From
v_d = (1 + k)(I + [alpha x])(v_b + omega x l), to first order in all of them,

    z = v_d - v_b = -[v_b x] alpha + v_b k + [omega x] l.

A large misalignment is removed step by step: when the estimated angle passes a
threshold, the data of the DVL are rotated by it, and the filter goes on with what is left.
"""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.baselines.kalman_filter import update
from factorgraph_dvl.baselines.outcome import Estimated, Outcome, history_rows, prior_of
from factorgraph_dvl.baselines.point_sets import Points, misfit, rotation_starts
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3, right_jacobian
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, skew
from factorgraph_dvl.sensors.parameters import Parameter

# Chosen: angle from which on the data are rotated; Luo et al. leave the threshold open.
_THRESHOLD = 0.05 * DEG
# Chosen: standard deviations from which on an angle is more than noise.
_SIGNIFICANT = 3.0
# Chosen: scale error, halfway between 0 and that of the mirror image, and mean square of the
# normalised residuals at which the filter starts once more.
_MIRRORED = -0.5
_POOR_FIT = 9.0
# Chosen: passes over the data at most, and change of the rotation, in standard deviations, at
# which they end.
_PASSES = 10
_SETTLED = 0.05
# Chosen: change in the last pass, in standard deviations, up to which the filter has converged.
_STILL_MOVING = 1.0
# Chosen: prior standard deviation beyond which a misalignment may be anything.
_WIDE = 30.0 * DEG


def point_set(
    points: Points, misalignment: Parameter, scale: Parameter, lever_arm: Parameter
) -> Outcome:
    """Calibrate with the seven-state filter.

    The first pass over the data is the filter as it would run at sea, and gives the
    history. Its early pings were weighed before the misalignment was known, so the filter
    runs again over the data, rotated by what it found, until that no longer changes.

    From more than 90 degrees away the small-angle model ends in the mirror image, turned
    by 180 degrees with a scale error near -2. The filter then starts once more, from the
    best of the 24 rotations of a cube.

    Parameters
    ----------
    points : Points
        The two point sets.
    misalignment, scale, lever_arm : Parameter
        With their priors; one scale for the three axes.
    """
    parameters = (misalignment, scale, lever_arm)
    starts = rotation_starts(misalignment)
    states = _filter(points, parameters, starts[0])
    best = _estimated(parameters, states[-1])
    arm = lever_arm.mean
    mirrored = best.values[1][0] < _MIRRORED
    if len(starts) > 1 and (mirrored or misfit(points, best, arm) > _POOR_FIT):
        few = points.thinned()
        ends = [_estimated(parameters, _filter(few, parameters, D)[-1]) for D in starts]
        fits = [misfit(few, e, arm) if e.values[1][0] > _MIRRORED else np.inf for e in ends]
        again = _filter(points, parameters, starts[int(np.argmin(fits))])
        other = _estimated(parameters, again[-1])
        if mirrored or misfit(points, other, arm) < misfit(points, best, arm):
            states, best = again, other
    rows = history_rows(len(points))
    history = tuple(
        (float(points.time[i]), _estimated(parameters, states[i + 1])) for i in rows.tolist()
    )
    passes, moved = 1, np.inf
    while passes < _PASSES and moved > _SETTLED:
        before = best
        states = _filter(points, parameters, before.values[0])
        best = _estimated(parameters, states[-1])
        turn = log_so3(before.values[0].T @ best.values[0])
        sigma = np.sqrt(best.covariance.diagonal()[:3])
        moved = float(np.max(np.abs(turn) / np.maximum(sigma, 1e-12)))
        passes += 1
    return Outcome(best, passes, history, converged=moved <= _STILL_MOVING)


_State = tuple[Array, Array, Array]


def measurement_matrix(v_b: Array, omega_b: Array) -> Array:
    """Return H = [-[v_b x], v_b, [omega x]] of pings, (M, 3, 7).

    Parameters
    ----------
    v_b : ndarray, shape (M, 3)
        Velocity over the Earth, in body, m/s.
    omega_b : ndarray, shape (M, 3), rad/s
        Rate relative to the Earth.
    """
    return np.concatenate([-skew(v_b), v_b[:, :, None], skew(omega_b)], axis=2)


def _filter(points: Points, parameters: tuple[Parameter, ...], start: Array) -> list[_State]:
    """Return rotation, states and covariance at the start and after each ping.

    The first is the rotation taken off the data so far: dRb = D Exp(alpha). The prior
    stays where it is: what `start` takes off the data, alpha is expected to lack.
    """
    prior = prior_of(parameters)
    misalignment_sigma = parameters[0].sigma
    D, P = start, prior.covariance.copy()
    left = log_so3(start.T @ prior.values[0])
    left = np.where(misalignment_sigma > _WIDE, 0.0, left)
    x = np.concatenate([left, prior.values[1], prior.values[2]])
    unknown = np.diag(np.concatenate([P.diagonal()[:4] > 0.0, P.diagonal()[4:]]))
    states = [(D, x, P)]
    each = measurement_matrix(points.v_b, points.omega_b)
    for k in range(len(points)):
        H = each[k]
        square = x[4:7] ** 2 + P.diagonal()[4:7]
        arm_variance = 0.5 * float(points.omega_sigma[k] ** 2 @ (square.sum() - square))
        R = (D.T * points.sigma_d[k] ** 2) @ D + points.v_b_covariance[k]
        R.flat[::4] += arm_variance
        z = D.T @ points.v_d[k] - points.v_b[k]
        K, P = update(P, H, R)
        x = x + K @ (z - H @ x)
        alpha = x[:3]
        past = np.abs(alpha) > np.maximum(_THRESHOLD, _SIGNIFICANT * np.sqrt(P.diagonal()[:3]))
        if past.any():
            D, x, P = _rotated(D, x, P, unknown)
        states.append((D, x, P))
    return states


def _rotated(D: Array, x: Array, P: Array, unknown: Array) -> _State:
    """Take the estimated angle off the data.

    The pings so far were weighed with a model that is wrong by half the angle squared.
    That much becomes unknown again, or the first pings would bias all that follow.
    """
    alpha = x[:3]
    T = np.eye(7)
    T[:3, :3] = right_jacobian(alpha)
    wrong = 0.5 * float(alpha @ alpha)
    rest = x.copy()
    rest[:3] = 0.0
    return D @ exp_so3(alpha), rest, T @ P @ T.T + wrong**2 * unknown


def _estimated(parameters: tuple[Parameter, ...], state: _State) -> Estimated:
    """Return the calibration of a state.

    What multiplies omega in the data is (1 + k) l, and so with the angle that is left.
    """
    D, x, P = state
    gain = max(1.0 + x[3], 0.1)
    J = np.eye(7)
    J[:3, :3] /= gain
    J[4:, 4:] /= gain
    J[:3, 3] = -x[:3] / gain**2
    J[4:, 3] = -x[4:] / gain**2
    dRb = D @ exp_so3(x[:3] / gain)
    return Estimated(parameters, (dRb, x[3:4], x[4:] / gain), J @ P @ J.T)
